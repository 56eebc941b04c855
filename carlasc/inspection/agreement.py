"""The agreement of scans with a grid: the share of points in voxels of their class, the known
mistake that explains a low share, and the share of the ground below the grid.

The share of labelled points in voxels of their class is measured for the data as they are, for
points with axes that are changed by a common mistake, and for the grid shifted by one voxel in each
direction. Only points in known voxels count, so that unknown voxels do not lower the share.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from collections.abc import Sequence as Series
from dataclasses import dataclass, field

import numpy as np

from carlasc.core.arrays import AnyFloatArray, AnyIntArray, Float32Array, IntArray
from carlasc.core.geometry import choices_of_axes
from carlasc.core.grids import Grid, GridSpec
from carlasc.groundtruth.reporting import ActorTrack
from carlasc.inspection.findings import Finding
from carlasc.inspection.points_in_voxels import labels_at
from carlasc.motion.tracks import is_doubtful
from carlasc.storage.protocol import Sequence

_DOUBTFUL_ACTORS = 0.25  # a greater share of doubtful actors is a warning

# Share of the ground points within the other bounds of a grid. With the published bounds, it is 0.0
# % on the simulated drives with flat ground, 2.6% on average (6.6% in one frame) on a real drive
# with a sloping road, and 48% on a drive whose sensor is 0.2 m too high for these bounds.
_SHARE = 0.1
_LOWEST = 0.02  # share of the ground that may be below the advised bound


@dataclass
class GroundBelow:
    """Counts the ground points below a grid, frame by frame.

    Attributes:
        spec: geometry of the grid.
    """

    spec: GridSpec
    _heights: list[Float32Array] = field(default_factory=list)

    def add(self, ground: Float32Array) -> None:
        """Add a frame's ground points (N, 3), metres, finite.

        Those outside of the grid's other bounds do not count.
        """
        axes = self.spec.to_axes(ground)
        lower = self.spec.lower
        upper = self.spec.upper
        inside = ((axes[:, :2] >= lower[:2]) & (axes[:, :2] < upper[:2])).all(axis=1)
        self._heights.append(ground[inside, 2])

    @property
    def share(self) -> float:
        """Mean share of a frame's ground points that are below the grid; NaN without any."""
        shares = [float((z < self.spec.lower[2]).mean()) for z in self._heights if len(z)]
        return float(np.mean(shares)) if shares else math.nan

    def findings(self, sequence: Sequence, grid: str) -> Iterator[Finding]:
        """Yield a warning if much of the ground is below the grid.

        The advised bounds have the same height.
        """
        if not self.share > _SHARE:
            return
        (x0, y0, z0), (x1, y1, z1) = self.spec.lower, self.spec.upper
        if self.spec.coordinates == "cylindrical":
            y0, y1 = np.degrees((y0, y1)).tolist()
        lowest = float(np.quantile(np.concatenate(self._heights), _LOWEST))
        lowest = math.floor(10 * lowest) / 10 - 0.1
        bounds = ",".join(f"{v:.6g}" for v in (x0, x1, y0, y1, lowest, lowest + z1 - z0))
        yield Finding(
            "warning",
            "ground-below-grid",
            f"{sequence.location}/{grid}",
            f"ground points above the lower bound of the grid, z = {z0:g} m",
            f"{self.share:.0%} of the points on the ground below it, in no voxel",
            f"make the grid again with lower bounds: `carlasc regrid --bounds={bounds}`",
        )


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

# description of the mistake, and the axes that correct it (see `choices_of_axes`)
_CAMERA = "points in camera axes (x right, y down, z forward)"
_AXES = (
    ("points with y mirrored against the grid", "x, -y, z"),
    ("points with x mirrored against the grid", "-x, y, z"),
    ("points turned by half a turn against the grid", "-x, -y, z"),
    ("points with x and y exchanged against the grid", "y, x, z"),
    ("points turned by a quarter turn against the grid", "y, -x, z"),
    ("points turned by a quarter turn against the grid", "-y, x, z"),
    ("points upside down (z mirrored) against the grid", "x, y, -z"),
    ("points upside down (y and z mirrored) against the grid", "x, -y, -z"),
    (_CAMERA, "z, x, -y"),
    (_CAMERA, "z, -x, -y"),
)
_MATRICES = dict(choices_of_axes())
_TURNED = np.array([np.pad(_MATRICES[axes], ((0, 0), (0, 2))) for _, axes in _AXES])
_SHIFTS = sorted(  # nearest first
    (shift for shift in itertools.product((-1, 0, 1), repeat=3) if any(shift)),
    key=lambda shift: sum(map(abs, shift)),
)
_SHIFTED = np.array([(0, 0, 0), *_SHIFTS], np.int64)  # first as it is


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
    _right: list[IntArray] = field(default_factory=list)
    _known: list[IntArray] = field(default_factory=list)
    _occupied: list[float] = field(default_factory=list)

    def add(self, points: AnyFloatArray, labels: AnyIntArray | None, grid: Grid) -> None:
        """Measure one frame.

        Args:
            points: (N, 3) metres, finite.
            labels: (N,) class ids; points with id 0 are unlabelled and left out. None compares with
                any class but free.
            grid: the grid of this frame, with geometry `spec`.
        """
        chosen = np.arange(len(points)) if labels is None else np.flatnonzero(labels)
        chosen = chosen[:: max(1, len(chosen) // _MAX_POINTS)]
        about = (points[chosen], grid.spec, grid.labels, grid.known)
        as_is, *shifted = labels_at(*about, shifts=_SHIFTED)
        at_points = np.stack([as_is, *labels_at(*about, warps=_TURNED), *shifted])
        known = at_points >= 0
        occupied = at_points > 0
        counted = known.sum(axis=1)
        if counted[: 1 + len(_AXES)].max() < _MIN_POINTS:
            return
        right = occupied if labels is None else known & (at_points == labels[chosen])
        self._right.append(right.sum(axis=1))
        self._known.append(counted)
        self._occupied.append(float(occupied[0].sum() / max(counted[0], 1)))

    def diagnose(self) -> GridDiagnosis:
        """Return the share of right points over the frames added so far, and the mistake, if any,
        that explains it.

        The data as they are, and with each mistake corrected, are compared by the number of right
        points, divided by the largest number of points in known voxels among them. A correction
        that moves most points out of the grid is therefore not chosen for the few that stay.
        """
        if not self._right:
            return GridDiagnosis(float("nan"), float("nan"), 0)
        right = np.stack(self._right)
        known = np.stack(self._known)
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
    doubtful = [is_doubtful(actor.confidence) for actor in actors if actor.confidence < 1]
    if doubtful:
        is_much = sum(doubtful) > max(_DOUBTFUL_ACTORS * len(doubtful), 2)
        yield Finding(
            "warning" if is_much else "note",
            "actors",
            f"{sequence.location}/{grid}",
            "actors that move with certainty",
            f"{len(doubtful)} actors found by free space, {sum(doubtful)} of them doubtful",
            "check the actors in the report, or give labels, boxes or flow",
        )
