"""The agreement of scans with a grid: the share of points in voxels of their class, the known
mistake that explains a low share, and the share of the ground below the grid.

The share of labelled points in voxels of their class is measured for the data as they are, for
points with axes that are changed by a common mistake, and for the grid shifted by one voxel in each
direction. Only points in known voxels count, so that unknown voxels do not lower the share.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from collections.abc import Sequence as Series
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from carlasc.core.cells import Triple
from carlasc.core.compiling import cached
from carlasc.core.grids import Grid, GridSpec
from carlasc.groundtruth.reporting import ActorTrack
from carlasc.inspection.findings import Finding, Severity
from carlasc.motion.tracks import is_doubtful
from carlasc.storage.protocol import Sequence

_DOUBTFUL_ACTORS = 0.25  # a greater share of doubtful actors is a warning
KNOWN, RIGHT, OCCUPIED = 0, 1, 2
"""Columns of what `Voxels.count` returns."""


class Voxels:
    """The voxels of a grid, in the types that the compiled loop takes."""

    def __init__(self, grid: Grid) -> None:
        self._spec = grid.spec
        self._labels = np.ascontiguousarray(grid.labels, np.uint32).reshape(-1)
        self._known = np.ascontiguousarray(grid.known).reshape(-1)

    def count(
        self, points: NDArray[np.floating], labels: NDArray[np.integer], shifts: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Count points by the labels of their voxels, in grids whose labels are `shifts` cells too
        far along the axes.

        The azimuth of a full turn is periodic. A point outside of a shifted grid counts as in the
        grid without a shift. A point outside of the grid without a shift does not count.

        Args:
            points: (N, 3) metres.
            labels: (N,) class ids.
            shifts: (S, 3) cells.

        Returns:
            (S, 3) numbers of points in known voxels, in known voxels of their class, and in known
            voxels of any class but free.
        """
        spec = self._spec
        lower, upper = spec.lower, spec.upper
        x, y, z = spec.voxel_size.tolist()
        full_turn = spec.coordinates == "cylindrical" and upper[1] - lower[1] > 2 * math.pi - 1e-3
        counted = np.zeros((len(shifts), 3), np.int64)
        axes = np.ascontiguousarray(spec.to_axes(points), np.float64)
        classes = labels.astype(np.int64)
        _count(
            axes,
            classes,
            shifts,
            spec.size,
            lower,
            upper,
            (x, y, z),
            full_turn,
            self._labels,
            self._known,
            counted,
        )
        return counted


@cached
def _count(
    axes: NDArray[np.float64],
    labels: NDArray[np.int64],
    shifts: NDArray[np.int64],
    size: tuple[int, int, int],
    lower: Triple,
    upper: Triple,
    voxel_size: Triple,
    full_turn: bool,
    voxels: NDArray[np.uint32],
    known: NDArray[np.bool_],
    counted: NDArray[np.int64],
) -> None:
    """Add points to `counted`.

    They have the axes of the grid, and their cells are computed as in `GridSpec.index`.
    """
    depth, width, height = size
    for point in range(len(axes)):
        first, second, third = axes[point, 0], axes[point, 1], axes[point, 2]
        if not (
            lower[0] <= first < upper[0]
            and lower[1] <= second < upper[1]
            and lower[2] <= third < upper[2]
        ):
            continue
        i = min(int((first - lower[0]) / voxel_size[0]), depth - 1)
        j = min(int((second - lower[1]) / voxel_size[1]), width - 1)
        k = min(int((third - lower[2]) / voxel_size[2]), height - 1)
        for s in range(len(shifts)):
            x, y, z = i + shifts[s, 0], j + shifts[s, 1], k + shifts[s, 2]
            if full_turn:
                y %= width
            if not (0 <= x < depth and 0 <= y < width and 0 <= z < height):
                x, y, z = i, j, k
            voxel = (x * width + y) * height + z
            if known[voxel]:
                counted[s, 0] += 1
                counted[s, 1] += voxels[voxel] == labels[point]
                counted[s, 2] += voxels[voxel] != 0


# Share of the ground points within the other bounds of a grid. With the published bounds, it is 0.0
# % on the simulated drives with flat ground, 2.6 % on average (6.6 % in one frame) on a real drive
# with a sloping road, and 48 % on a drive whose sensor is 0.2 m too high for these bounds.
_SHARE = 0.1
_LOWEST = 0.02  # share of the ground that may be below the advised bound


@dataclass
class GroundBelow:
    """Counts the ground points below a grid, frame by frame.

    Attributes:
        spec: geometry of the grid.
    """

    spec: GridSpec
    _heights: list[NDArray[np.float32]] = field(default_factory=list)

    def add(self, ground: NDArray[np.float32]) -> None:
        """Add a frame's ground points (N, 3), metres, finite.

        Those outside of the grid's other bounds do not count.
        """
        axes, lower, upper = (
            self.spec.to_axes(ground),
            np.array(self.spec.lower),
            np.array(self.spec.upper),
        )
        first, second = ((axes[:, a] >= lower[a]) & (axes[:, a] < upper[a]) for a in (0, 1))
        inside = first & second
        self._heights.append(ground[inside, 2])

    @property
    def share(self) -> float:
        """Mean share of a frame's ground points that are below the grid; NaN without ground points."""
        shares = [float((z < self.spec.lower[2]).mean()) for z in self._heights if len(z)]
        return float(np.mean(shares)) if shares else math.nan

    def findings(self, sequence: Sequence, grid: str) -> Iterator[Finding]:
        """Yield a warning if much of the ground is below the grid.

        The advised bounds have the same height.
        """
        if not self.share > _SHARE:
            return
        z0, z1 = self.spec.lower[2], self.spec.upper[2]
        lowest = (
            math.floor(10 * float(np.quantile(np.concatenate(self._heights), _LOWEST))) / 10 - 0.1
        )
        bounds = [
            value
            for pair in zip(self.spec.lower[:2], self.spec.upper[:2], strict=True)
            for value in pair
        ]
        if self.spec.coordinates == "cylindrical":
            bounds[2:] = np.degrees(bounds[2:]).tolist()
        text = ",".join(f"{value:.6g}" for value in (*bounds, lowest, lowest + z1 - z0))
        found = f"{self.share:.0%} of the points on the ground below it, in no voxel"
        advice = f"make the grid again with lower bounds: `carlasc regrid --bounds={text}`"
        expected = f"ground points above the lower bound of the grid, z = {z0:g} m"
        where = f"{sequence.location}/{grid}"
        yield Finding("warning", "ground-below-grid", sequence.path, where, expected, found, advice)


_MIN_POINTS = 100
_MAX_POINTS = 20_000
# A mistake is reported if correcting it raises the share of right points by _GAIN and by more than
# chance could, and either reduces the wrong points by the factor _FEWER_WRONG or raises the share
# by _LARGE_GAIN, in at least the share _WINS of the frames.
_GAIN = 0.01
_FEWER_WRONG = 1.15
_LARGE_GAIN = 0.05
_WINS = 0.75
_TIE = 0.005  # if the shares of two mistakes differ by less, the first one is reported

# description of the mistake, and the matrix that corrects it
_AXES: tuple[tuple[str, NDArray[np.float64]], ...] = (
    ("points with y mirrored against the grid", np.diag([1.0, -1, 1])),
    ("points with x mirrored against the grid", np.diag([-1.0, 1, 1])),
    ("points turned by half a turn against the grid", np.diag([-1.0, -1, 1])),
    (
        "points with x and y exchanged against the grid",
        np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]]),
    ),
    (
        "points turned by a quarter turn against the grid",
        np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
    ),
    (
        "points turned by a quarter turn against the grid",
        np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
    ),
    ("points upside down (z mirrored) against the grid", np.diag([1.0, 1, -1])),
    ("points upside down (y and z mirrored) against the grid", np.diag([1.0, -1, -1])),
    (
        "points in camera axes (x right, y down, z forward)",
        np.array([[0.0, 0, 1], [1, 0, 0], [0, -1, 0]]),
    ),
    (
        "points in camera axes (x right, y down, z forward)",
        np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
    ),
)
_STEPS = (-1, 0, 1)
_SHIFTS = tuple(  # nearest first
    sorted(
        ((x, y, z) for x in _STEPS for y in _STEPS for z in _STEPS if x or y or z),
        key=lambda s: sum(map(abs, s)),
    )
)
_AS_IS_AND_SHIFTED = np.array([(0, 0, 0), *_SHIFTS], np.int64)


@dataclass(frozen=True)
class GridDiagnosis:
    """The agreement of a grid with its scans.

    Attributes:
        share: mean share of the points in known voxels whose voxel has their class; NaN if no frame
            had enough points.
        occupied_share: the same share, if every class but free is taken as right.
        frames: number of frames with enough points.
        mistake: description of the mistake that explains the share; None if the data fit best as
            they are.
        corrected_share: the share after the mistake is corrected.
    """

    share: float
    occupied_share: float
    frames: int
    mistake: str | None = None
    corrected_share: float = 0.0


@dataclass
class GridEvidence:
    """Measures the agreement of scans with a grid frame by frame: as they are, and with each known
    mistake corrected.
    """

    spec: GridSpec
    # per frame, (1 + mistakes,) number of points in voxels of their class, and in known voxels;
    # first for the data as they are
    _right: list[NDArray[np.int64]] = field(default_factory=list)
    _known: list[NDArray[np.int64]] = field(default_factory=list)
    _occupied: list[float] = field(default_factory=list)

    def add(
        self, points: NDArray[np.floating], labels: NDArray[np.integer] | None, grid: Grid
    ) -> None:
        """Measure one frame.

        Args:
            points: (N, 3) metres, finite.
            labels: (N,) class ids; points with id 0 are unlabelled and left out. None compares with
                any class but free.
            grid: the grid of this frame, with geometry `spec`.
        """
        if labels is None:  # any class but free is right
            labels, chosen, right = (
                np.zeros(len(points), np.uint8),
                np.arange(len(points)),
                OCCUPIED,
            )
        else:
            chosen, right = np.flatnonzero(labels), RIGHT
        chosen = chosen[:: max(1, len(chosen) // _MAX_POINTS)]
        points, labels, voxels = points[chosen], labels[chosen], Voxels(grid)
        as_is = voxels.count(points, labels, _AS_IS_AND_SHIFTED)
        exact = points.astype(np.float64)
        turned = [
            voxels.count(exact @ matrix.T, labels, _AS_IS_AND_SHIFTED[:1]) for _, matrix in _AXES
        ]
        counted = np.concatenate([as_is[:1], *turned, as_is[1:]])
        if counted[: 1 + len(_AXES), KNOWN].max() < _MIN_POINTS:
            return
        self._right.append(counted[:, right])
        self._known.append(counted[:, KNOWN])
        self._occupied.append(float(as_is[0, OCCUPIED] / max(as_is[0, KNOWN], 1)))

    def diagnose(self) -> GridDiagnosis:
        """Return the share of right points over the frames added so far, and the mistake, if any,
        that explains it.

        The data as they are, and with each mistake corrected, are compared by the number of right
        points, divided by the largest number of points in known voxels among them. A correction
        that moves most points out of the grid is therefore not chosen for the few that stay.
        """
        if not self._right:
            return GridDiagnosis(float("nan"), float("nan"), 0)
        right, known = np.stack(self._right), np.stack(self._known)
        shares = right / known.max(axis=1, keepdims=True)
        means = shares.mean(axis=0)
        chance = 3 * float(np.sqrt(max(means[0] * (1 - means[0]), 1e-4) / known.max(axis=1).sum()))
        best = 0
        for column in range(1, shares.shape[1]):
            gain = means[column] - means[0]
            fewer = 1 - means[0] > _FEWER_WRONG * (1 - means[column])
            clear = gain > max(_GAIN, chance) and (fewer or gain > _LARGE_GAIN)
            better = best == 0 or means[column] > means[best] + _TIE
            if clear and better and (shares[:, column] > shares[:, 0]).mean() >= _WINS:
                best = column
        own, corrected = (
            float((right[:, i] / np.maximum(known[:, i], 1)).mean()) for i in (0, best)
        )
        occupied = float(np.mean(self._occupied))
        if best == 0:
            return GridDiagnosis(own, occupied, len(right))
        return GridDiagnosis(own, occupied, len(right), _mistake(best, self.spec), corrected)


def _mistake(column: int, spec: GridSpec) -> str:
    """Return the description of the mistake that a column corrects; column 0 corrects none."""
    if column <= len(_AXES):
        return _AXES[column - 1][0]
    shift = _SHIFTS[column - 1 - len(_AXES)]
    names = ("x", "y", "z") if spec.coordinates == "cartesian" else ("radius", "azimuth", "z")
    steps = " and ".join(
        f"one cell towards {'+' if s > 0 else '-'}{name}"
        for s, name in zip(shift, names, strict=True)
        if s
    )
    return f"a grid shifted by {steps}"


def check_actors(sequence: Sequence, grid: str, actors: Series[ActorTrack]) -> Iterator[Finding]:
    """Yield how many actors of a grid's report were found by free space alone: a warning if many of
    them are doubtful.
    """
    found = [actor for actor in actors if actor.confidence < 1]
    if found:
        doubtful = sum(is_doubtful(actor.confidence) for actor in found)
        severity: Severity = (
            "warning" if doubtful > max(_DOUBTFUL_ACTORS * len(found), 2) else "note"
        )
        what = f"{len(found)} actors found by free space, {doubtful} of them doubtful"
        expected, advice = (
            "actors that move with certainty",
            "check the actors in the report, or give labels, boxes or flow",
        )
        yield Finding(
            severity, "actors", sequence.path, f"{sequence.location}/{grid}", expected, what, advice
        )
