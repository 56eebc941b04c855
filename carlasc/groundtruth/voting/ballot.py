"""The ballot: observations (points, labels and the pose of a sensor), their votes in the voxels of
a grid, and the grid.

Every labelled point votes for its class in its voxel, and free samples on its ray vote for free
space (class 0) in their voxels. A voxel takes the class with most votes, ties go to the lowest id,
and a voxel without votes is unknown: see the format page, `docs/format.md#votes`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from carlasc.core.arrays import (
    AnyArray,
    BoolArray,
    Float32Array,
    IntArray,
    LabelArray,
    Uint8Array,
    Uint16Array,
)
from carlasc.core.cells import Cells, Pose, as_pose
from carlasc.core.choices import VoteRule
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform, check_rigid
from carlasc.core.grids import Grid, GridSpec
from carlasc.core.tables import CARLA
from carlasc.errors import ArgumentError, FormatError, check_choice
from carlasc.groundtruth.voting import filled, kernel
from carlasc.storage.field_files import VOTES_DTYPE, votes_dtype

_MOST_VOTES = int(np.iinfo(VOTES_DTYPE["votes"]).max)
OCCUPIED_DTYPE = np.dtype(
    [
        ("voxel", np.int32),
        ("label", np.uint16),
        ("votes", np.int64),
        ("voters", np.int32),
        ("sure", np.float32),
    ]
)


@dataclass(frozen=True)
class Observation:
    """One voter: the scan of one sensor at one instant.

    Its points vote for their classes, its rays for free space.

    A sensor that moves during the scan, or several sensors, are one observation with K voters: one
    for each origin of rays.

    Attributes:
        points: (N, 3) float32, metres, in the sensor's frame; for K voters, in their order. The
            rounding to float32 is part of the rule: see the format page, `docs/format.md#votes`.
        labels: (N,) unsigned integer class ids. Points labelled 0 and their rays do not vote.
        grid_T_sensor: (4, 4) float64, from the sensor's frame to the grid's; or (K, 4, 4).
        ends: (K,) int64, index after the last point of each voter; None: one voter.

    Raises:
        FormatError: points and labels differ in length, have another shape or type, or the
            transform is not rigid.
    """

    points: Float32Array
    labels: LabelArray
    grid_T_sensor: Transform
    ends: IntArray | None = None

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 3 or self.points.dtype != np.float32:
            found = f"{self.points.shape} {self.points.dtype}"
            raise FormatError("observation points", expected="shape (N, 3) float32", found=found)
        if self.labels.shape != (len(self.points),):
            expected = f"shape ({len(self.points)},), one per point"
            raise FormatError("observation labels", expected=expected, found=self.labels.shape)
        if self.labels.dtype.kind != "u":
            raise FormatError(
                "observation labels", expected="unsigned integers", found=self.labels.dtype
            )
        check_rigid(self.grid_T_sensor, "observation grid_T_sensor")
        poses, ends = np.shape(self.grid_T_sensor)[:-2], self.ends
        voters = () if ends is None else ends.shape
        if poses != voters or (
            ends is not None and ([0, *ends][-1] != len(self) or (np.diff(ends) < 0).any())
        ):
            raise FormatError(
                "observation ends",
                expected=f"shape {poses}, rising to {len(self)}",
                found=ends,
            )

    def __len__(self) -> int:
        return len(self.points)


class ClassPoints(NamedTuple):
    """The points of one class that one voter saw.

    Attributes:
        points: (3, N) float32, metres.
        grid_T_points: the pose of the points.
        sure: (N,) float32, probability of the class of each point; None: 1.
    """

    points: Float32Array
    grid_T_points: Pose
    sure: Float32Array | None = None


_EVERYWHERE, _CERTAIN = np.empty(0, np.uint16), np.empty(0, np.float32)


class SeenClass(NamedTuple):
    """The points of one class, and where they vote.

    Attributes:
        label: the class.
        voters: the points that each voter saw.
        regions: (V,) region of each voxel; empty: the points vote in all voxels.
        region: the region in whose voxels they vote.
    """

    label: int
    voters: Sequence[ClassPoints]
    regions: Uint16Array = _EVERYWHERE
    region: int = 0


def count_votes(
    observations: Iterable[Observation],
    spec: GridSpec,
    classes: ClassTable = CARLA,
    *,
    rule: VoteRule = "sensor",
    free_step_m: float = 1.5,
    keep_boxes: bool = False,
) -> Votes:
    """Count the votes of observations.

    They are read one at a time, so memory does not grow with their number.

    Args:
        observations: the voters, all in one grid frame.
        spec: geometry of the grid.
        classes: class table of the labels.
        rule: "sensor": at most one vote per observation, voxel and class, as in the published
            files; "sample" and "ray": every sample counts (they decide differently: see
            `carlasc.groundtruth.voting.certainty`).
        free_step_m: distance between two free samples on a ray, in metres.
        keep_boxes: also keep the box around the points in each voxel of a Cartesian grid.

    Raises:
        ArgumentError: an unknown rule, or a distance that is not positive.
        FormatError: a label is not below `classes.num_channels`.
    """
    ballot = Ballot(spec, classes, rule=rule, free_step_m=free_step_m, keep_boxes=keep_boxes)
    for observation in observations:
        ballot.add(observation)
    return ballot.votes(copy=False)


def check_rule(rule: str, free_step_m: float) -> None:
    """Check the rule and the distance of free samples.

    Raises:
        ArgumentError: an unknown rule, or a distance that is not positive.
    """
    check_choice("rule", rule, VoteRule)
    if not (math.isfinite(free_step_m) and free_step_m > 0):
        raise ArgumentError(
            "free_step_m", expected="a positive number of metres", found=free_step_m
        )


class Ballot:
    """Counts votes: `add` takes one observation after the other, and `votes` can be read at any
    time.

    A ballot is used by one thread at a time; different ballots are independent, and `add` releases
    the GIL.

    Args:
        spec: geometry of the grid.
        classes: class table of the labels.
        rule: "sensor": at most one vote per observation, voxel and class; "sample" and "ray": every
            sample counts.
        free_step_m: distance between two free samples on a ray, in metres.
        keep_boxes: also keep the box around the points in each voxel of a Cartesian grid.

    Raises:
        ArgumentError: an unknown rule, or a distance that is not positive.
    """

    def __init__(
        self,
        spec: GridSpec,
        classes: ClassTable = CARLA,
        *,
        rule: VoteRule = "sensor",
        free_step_m: float = 1.5,
        keep_boxes: bool = False,
    ) -> None:
        check_rule(rule, free_step_m)
        self.spec = spec
        self.classes = classes
        self.rule = rule
        self.free_step_m = float(free_step_m)
        self.num_observations = 0
        once = rule == "sensor"
        # The arrays of free space have one element more than there are voxels: samples outside of
        # the grid count there, so that the inner loop needs no branch.
        self._cells = Cells.of(spec)
        self._boxes = filled.no_boxes(spec.num_voxels) if keep_boxes else None
        self._tally = kernel.Tally(
            once,
            free=np.zeros(spec.num_voxels + 1, np.uint32),
            passed=np.zeros(spec.num_voxels + 1 if once else 0, np.uint8),
            heads=np.full(spec.num_voxels, kernel.NONE, np.int32),
            candidates=np.empty(0, kernel.CANDIDATE_DTYPE),
            used=np.zeros(1, np.int64),
        )

    def add(self, observation: Observation) -> None:
        """Add the votes of one observation.

        Raises:
            FormatError: a label is not below the class table's number of channels; no vote was
                added.
        """
        self.classes.check(observation.labels, "observation labels")
        ends = np.array([len(observation)]) if observation.ends is None else observation.ends
        self._make_room(len(observation))
        cast = kernel.Voters(
            _ready(observation.points, np.float32).reshape(-1),
            _ready(observation.labels, np.uint16),
            np.ascontiguousarray(observation.grid_T_sensor, np.float64)
            .reshape(-1, 16)[:, :12]
            .copy(),
            ends,
        )
        voter = self.num_observations
        kernel.vote(cast, self._cells, self.free_step_m, voter, self._tally)
        if self._boxes is not None:
            voting = observation.labels > 0
            for pose, begin, end in zip(cast.poses, [0, *ends], ends, strict=False):
                points = observation.points[begin:end][voting[begin:end]]
                self._widen(points.T, as_pose(pose.reshape(3, 4)))
        # Each origin of rays is a voter, with a number of its own: `once` compares these numbers.
        self.num_observations += len(ends)

    def add_points(self, seen: Iterable[SeenClass]) -> None:
        """Add the votes of points without rays, one class after the other."""
        counted = np.zeros(self.spec.num_voxels + 1, kernel.HIT_DTYPE)
        for label, voters, regions, region in seen:
            points, number = sum(one.points.shape[1] for one in voters), 0
            hit = np.empty(min(points, len(counted)), np.int32)
            certain = all(one.sure is None for one in voters)
            doubt = np.zeros(0 if certain else len(counted), np.float32)
            for voter, (place, pose, sure) in enumerate(voters, 1):
                doubts = _CERTAIN if sure is None else sure
                number = kernel.count_hits(
                    place, doubts, pose, self._cells, voter, counted, doubt, hit, number
                )
                if self._boxes is not None:
                    self._widen(place, pose, regions, region)
            self._make_room(number)
            kernel.add_hits(label, counted, doubt, hit[:number], regions, region, self._tally)

    def _widen(
        self, points: Float32Array, pose: Pose, regions: Uint16Array = _EVERYWHERE, region: int = 0
    ) -> None:

        ready = _ready(points, np.float32)
        filled.widen_boxes(ready, pose, self._cells, regions, region, self._boxes)

    @property
    def free(self) -> AnyArray:
        """(V,) votes for free space; a view."""
        return self._tally.free[:-1]

    @property
    def hit(self) -> BoolArray:
        """(V,) bool: voxels with votes for a class other than free space."""
        return self._tally.heads != kernel.NONE

    def seen(self) -> BoolArray:
        """Return (V,) bool: which voxels have votes."""
        return self.hit | (self.free > 0)

    def votes(self, *, copy: bool = True) -> Votes:
        """Return the votes so far.

        Args:
            copy: whether the result is independent of later observations. Without a copy, add no
                more of them.
        """
        # The lists of candidates are in the order of their first votes; `collect` sorts them, so
        # that rows do not depend on the order of observations.
        candidates = self._tally.candidates[: self._tally.used[0]]
        occupied = np.empty(len(candidates), OCCUPIED_DTYPE)
        kernel.collect(self._tally.heads, candidates, occupied)
        free = self.free.reshape(self.spec.size)
        boxes = self._boxes.copy() if copy and self._boxes is not None else self._boxes
        return Votes(self.spec, self.classes, free.copy() if copy else free, occupied, boxes)

    def _make_room(self, points: int) -> None:
        """Make room for one more candidate per point, which is the most that an observation can
        add.
        """
        # The compiled loops cannot grow an array. Doubling copies each candidate once on average.
        used, candidates = int(self._tally.used[0]), self._tally.candidates
        if used + points > len(candidates):
            grown = np.empty(2 * (used + points), candidates.dtype)
            grown[:used] = candidates[:used]
            self._tally = self._tally._replace(candidates=grown)


def _ready(values: AnyArray, dtype: type[np.generic]) -> AnyArray:
    """Return an array as the compiled loops take it.

    Numba compiles a loop again for each layout of its arrays, read-only ones too.
    """
    return np.require(values, dtype, ["C", "A", "W"])


@dataclass(frozen=True, eq=False)
class Votes:
    """The votes of each voxel by class; votes for free space are in their own array.

    Attributes:
        spec: the grid.
        classes: class table of the labels.
        free: (X, Y, Z) unsigned integer, votes for free space.
        occupied: (M,) structured: `voxel` (int32, flat C-order index), `label` (uint16, never 0),
            `votes` (int64, never 0) and `voters` (int32), the number of their observations, and
            `sure` (float32), the sum of their probabilities; one row per voxel and class, sorted by
            voxel, then by label.
        boxes: (V, 6) uint8, the box around the points of each voxel: see
            `carlasc.groundtruth.voting.filled`; None unless they are kept.
    """

    spec: GridSpec
    classes: ClassTable
    free: AnyArray
    occupied: AnyArray
    boxes: Uint8Array | None = None

    def to_grid(self) -> Grid:
        """Return the grid: the class with most votes in each voxel, which may be free space, and
        the sum of its votes. Ties go to the lowest id.
        """
        labels, counts = self._elect(self.free.reshape(-1).copy())
        return Grid(self.spec, labels.reshape(self.spec.size), counts.reshape(self.spec.size))

    def elect_occupied(self) -> tuple[AnyArray, AnyArray]:
        """Return the (V,) classes with most votes, without free space, and the (V,) sums of the
        votes without free space; 0 without any.
        """
        return self._elect(np.zeros(self.spec.num_voxels, self.free.dtype))

    def _elect(self, counts: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Return the (V,) classes with most votes, ties to the lowest id, and the (V,) sums of
        votes. `counts` has the votes of class 0.
        """
        labels = np.zeros(len(counts), self.classes.dtype)
        kernel.elect(self.occupied, labels, counts)
        return labels, counts

    def to_sparse(self) -> AnyArray:
        """Return the votes as the layout stores them: non-zero ones only, sorted by voxel, then by
        label; free space is label 0.

        Numbers of votes above the maximum of the layout are stored as the maximum.

        Returns:
            (M,) `field_files.VOTES_DTYPE`, or `field_files.WIDE_VOTES_DTYPE` if class ids do not
            fit 8 bits.
        """
        rows = np.count_nonzero(self.free) + len(self.occupied)
        votes = np.empty(rows, votes_dtype(self.classes))
        kernel.interleave(self.free.reshape(-1), self.occupied, votes, _MOST_VOTES)
        return votes
