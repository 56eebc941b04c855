"""The agreement of scans with a grid: how many points lie in voxels of their class, and which known mistake explains a low share.

The share of labelled points that fall in voxels of their class is measured for the data as they are, for points whose axes are changed in
the ways that are common mistakes, and for the grid shifted by one cell in each direction. Only points in known voxels count, so that a grid
with unknown voxels is not rated lower than a full one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from carlasc.core.grids import Grid, GridSpec

_MIN_POINTS = 100
_MAX_POINTS = 20_000
# A mistake is reported if undoing it raises the share of right points by _GAIN and by more than chance could, and either reduces
# the wrong points by the factor _FEWER_WRONG or raises the share by _LARGE_GAIN; and if it does so on the share _WINS of the frames.
_GAIN = 0.01
_FEWER_WRONG = 1.15
_LARGE_GAIN = 0.05
_WINS = 0.75
_TIE = 0.005  # of two mistakes whose shares differ by less, the first is reported

_AXES: tuple[tuple[str, NDArray[np.float64]], ...] = (  # description of the mistake, and the matrix that undoes it
    ("points with y mirrored against the grid", np.diag([1.0, -1, 1])),
    ("points with x mirrored against the grid", np.diag([-1.0, 1, 1])),
    ("points turned by half a turn against the grid", np.diag([-1.0, -1, 1])),
    ("points with x and y exchanged against the grid", np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]])),
    ("points turned by a quarter turn against the grid", np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])),
    ("points turned by a quarter turn against the grid", np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])),
    ("points upside down (z mirrored) against the grid", np.diag([1.0, 1, -1])),
    ("points upside down (y and z mirrored) against the grid", np.diag([1.0, -1, -1])),
    ("points in camera axes (x right, y down, z forward)", np.array([[0.0, 0, 1], [1, 0, 0], [0, -1, 0]])),
    ("points in camera axes (x right, y down, z forward)", np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])),
)
_STEPS = (-1, 0, 1)
_SHIFTS = tuple(  # nearest first
    sorted(((x, y, z) for x in _STEPS for y in _STEPS for z in _STEPS if x or y or z), key=lambda s: sum(map(abs, s)))
)


@dataclass(frozen=True)
class GridDiagnosis:
    """The agreement of a grid with its scans.

    Attributes:
        share: mean share of the points in known voxels whose voxel has their class; NaN if no frame had enough points.
        occupied_share: the same share, where a voxel of any class but free is right.
        frames: number of frames with enough points.
        mistake: description of the mistake that explains the share; None if the data fit best as they are.
        corrected_share: the share with the mistake undone.
    """

    share: float
    occupied_share: float
    frames: int
    mistake: str | None = None
    corrected_share: float = 0.0


@dataclass
class GridEvidence:
    """Measures, frame by frame, the agreement of scans with a grid: as they are, and with each known mistake undone."""

    spec: GridSpec
    # per frame, (1 + mistakes,) number of points in voxels of their class, and in known voxels; first for the data as they are
    _right: list[NDArray[np.int64]] = field(default_factory=list)
    _known: list[NDArray[np.int64]] = field(default_factory=list)
    _occupied: list[float] = field(default_factory=list)

    def add(self, points: NDArray[np.floating], labels: NDArray[np.integer] | None, grid: Grid) -> None:
        """Measure one frame.

        Args:
            points: (N, 3) metres, finite.
            labels: (N,) class ids; points with id 0 are unlabelled and left out. None compares with any class but free.
            grid: the grid of this frame, with geometry `spec`.
        """
        if labels is not None:
            points, labels = points[labels != 0], labels[labels != 0]
        step = max(1, len(points) // _MAX_POINTS)
        points, labels = points[::step], None if labels is None else labels[::step]
        as_is = _place(points, self.spec)
        own = _look_up(as_is, labels, grid)
        matches = [own, *(_look_up(_place(points @ matrix.T, self.spec), labels, grid) for _, matrix in _AXES)]
        if max(match.known.sum() for match in matches) < _MIN_POINTS:
            return
        for shift in _SHIFTS:
            shifted, within = as_is.shifted(shift, self.spec)
            moved = _look_up(shifted, labels, grid)
            # points whose voxel is outside the grid after the shift count as they did before
            matches.append(_Match(*(np.append(new, old[~within]) for new, old in zip(moved, own, strict=True))))
        self._right.append(np.array([np.count_nonzero(match.right) for match in matches]))
        self._known.append(np.array([np.count_nonzero(match.known) for match in matches]))
        occupied = _look_up(as_is, None, grid)
        self._occupied.append(float(occupied.right.sum() / max(occupied.known.sum(), 1)))

    def diagnose(self) -> GridDiagnosis:
        """Return the share of right points over the frames added so far, and the mistake, if any, that explains it.

        The data as they are and with each mistake undone are compared by the number of right points, divided by the largest number of points
        in known voxels that any of them has: one that moves most points out of the grid does not win by the few that stay.
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
        own, corrected = (float((right[:, i] / np.maximum(known[:, i], 1)).mean()) for i in (0, best))
        occupied = float(np.mean(self._occupied))
        if best == 0:
            return GridDiagnosis(own, occupied, len(right))
        return GridDiagnosis(own, occupied, len(right), _mistake(best, self.spec), corrected)


@dataclass(frozen=True)
class _Placement:
    """The points that are in a grid: their cells (M, 3), and their indices (M,) among all points."""

    cells: NDArray[np.int32]
    points: NDArray[np.int64]

    def shifted(self, shift: tuple[int, int, int], spec: GridSpec) -> tuple[_Placement, NDArray[np.bool_]]:
        """Return the placement in a grid whose labels are `shift` cells too far along its axes, and (M,) which cells are still inside."""
        cells = self.cells + np.array(shift, np.int32)
        if spec.coordinates == "cylindrical" and spec.upper[1] - spec.lower[1] > 2 * np.pi - 1e-3:
            cells[:, 1] %= spec.size[1]  # the azimuth is periodic
        within = np.all((cells >= 0) & (cells < np.array(spec.size)), axis=1)
        return _Placement(cells[within], self.points[within]), within


class _Match(NamedTuple):
    """For each point in the grid, whether its voxel is known, and whether it is known and has the class of the point."""

    known: NDArray[np.bool_]
    right: NDArray[np.bool_]


def _place(points: NDArray[np.floating], spec: GridSpec) -> _Placement:
    cells, inside = spec.index(spec.to_axes(points))
    return _Placement(cells[inside], np.flatnonzero(inside))


def _look_up(placement: _Placement, labels: NDArray[np.integer] | None, grid: Grid) -> _Match:
    index = np.ravel_multi_index(tuple(placement.cells.T), grid.spec.size)
    voxels = grid.labels.reshape(-1)[index]
    known = np.ones(len(voxels), np.bool_) if grid.counts is None else grid.counts.reshape(-1)[index] > 0
    return _Match(known, known & (voxels != 0 if labels is None else voxels == labels[placement.points]))


def _mistake(column: int, spec: GridSpec) -> str:
    """Return the description of a mistake by its place among all of them; 0 is none."""
    if column <= len(_AXES):
        return _AXES[column - 1][0]
    shift = _SHIFTS[column - 1 - len(_AXES)]
    names = ("x", "y", "z") if spec.coordinates == "cartesian" else ("radius", "azimuth", "z")
    steps = " and ".join(
        f"one cell towards {'+' if s > 0 else '-'}{name}" for s, name in zip(shift, names, strict=True) if s
    )
    return f"a grid shifted by {steps}"
