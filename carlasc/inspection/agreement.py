"""Do the scans lie in the voxels of their grid? And if not: which mistake, undone, would put them there?

The share of labelled points that fall in voxels of their class is measured as things stand, with the points' axes changed in the ways in which they
are commonly mistaken, and with the grid shifted by one cell each way. Only points in known voxels count, so that a grid with gaps is no worse
than a full one, as long as enough of them are known.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from carlasc.core.grids import Grid, GridSpec

_MIN_POINTS = 100
_MAX_POINTS = 20_000
_GAIN = 0.01  # a mistake undone must put this share of the points right, more than chance could,
_MISSES = 1.15  # leave so many times fewer wrong, or
_LARGE_GAIN = 0.05  # put as many right as this,
_WINS = 0.75  # and do better on this share of the frames
_TIE = 0.005

_AXES: tuple[tuple[str, NDArray[np.float64]], ...] = (  # what the points look like; the matrix that undoes it
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
_SHIFTS = tuple(  # the nearer cells first
    sorted(((x, y, z) for x in _STEPS for y in _STEPS for z in _STEPS if x or y or z), key=lambda s: sum(map(abs, s)))
)


@dataclass(frozen=True)
class GridDiagnosis:
    """What a grid's scans say of it.

    Attributes:
        share: mean share of points in known space that lie in a voxel of their class; NaN where no frame had enough points.
        occupied_share: the same for voxels of any class but free.
        frames: number of frames with enough points.
        mistake: what it looks like, None where the scans fit best as they stand.
        corrected_share: the share with the mistake undone.
    """

    share: float
    occupied_share: float
    frames: int
    mistake: str | None = None
    corrected_share: float = 0.0


@dataclass
class GridEvidence:
    """Gathers, frame by frame, how well scans lie in a grid as they stand and with each mistake undone."""

    spec: GridSpec
    _right: list[NDArray[np.int64]] = field(
        default_factory=list
    )  # a frame: points in voxels of their class, by candidate
    _known: list[NDArray[np.int64]] = field(default_factory=list)  # and points in known voxels
    _occupied: list[float] = field(default_factory=list)

    def add(self, points: NDArray[np.floating], labels: NDArray[np.integer] | None, grid: Grid) -> None:
        """Measure one frame.

        Args:
            points: (N, 3) metres, finite.
            labels: (N,) classes, 0 is unlabelled and left out; None compares with any class but free.
            grid: of this frame, of `spec`.
        """
        if labels is not None:
            points, labels = points[labels != 0], labels[labels != 0]
        step = max(1, len(points) // _MAX_POINTS)
        points, labels = points[::step], None if labels is None else labels[::step]
        as_is = _place(points, self.spec)
        own = _look_up(as_is, labels, grid)
        verdicts = [own, *(_look_up(_place(points @ matrix.T, self.spec), labels, grid) for _, matrix in _AXES)]
        if max(verdict.known.sum() for verdict in verdicts) < _MIN_POINTS:
            return
        for shift in _SHIFTS:
            shifted, within = as_is.shifted(shift, self.spec)
            there = _look_up(shifted, labels, grid)
            # points whose content the shift has pushed out of the grid speak neither for it nor against it
            verdicts.append(_Verdicts(*(np.append(n, o[~within]) for n, o in zip(there, own, strict=True))))
        self._right.append(np.array([np.count_nonzero(verdict.right) for verdict in verdicts]))
        self._known.append(np.array([np.count_nonzero(verdict.known) for verdict in verdicts]))
        occupied = _look_up(as_is, None, grid)
        self._occupied.append(float(occupied.right.sum() / max(occupied.known.sum(), 1)))

    def diagnose(self) -> GridDiagnosis:
        """Say which mistake, if any, explains the frames seen so far.

        A point votes where it is, so the right candidate has the most points in known space. Candidates are compared by the points that they put
        right among so many: one that throws most of them out of the grid is not better for the few that it keeps.
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
            fewer = 1 - means[0] > _MISSES * (1 - means[column])
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
    """The cells (M, 3) of the points that are in the grid, and which of all points those are."""

    cells: NDArray[np.int32]
    points: NDArray[np.int64]

    def shifted(self, shift: tuple[int, int, int], spec: GridSpec) -> tuple[_Placement, NDArray[np.bool_]]:
        """The same where the grid's content stands `shift` cells too far along its axes, and which of the cells still exist then."""
        cells = self.cells + np.array(shift, np.int32)
        if spec.coordinates == "cylindrical" and spec.upper[1] - spec.lower[1] > 2 * np.pi - 1e-3:
            cells[:, 1] %= spec.size[1]  # the azimuth goes round
        within = np.all((cells >= 0) & (cells < np.array(spec.size)), axis=1)
        return _Placement(cells[within], self.points[within]), within


class _Verdicts(NamedTuple):
    """For each placed point, whether its voxel is known, and whether it is known and of the point's class."""

    known: NDArray[np.bool_]
    right: NDArray[np.bool_]


def _place(points: NDArray[np.floating], spec: GridSpec) -> _Placement:
    cells, inside = spec.index(spec.to_axes(points))
    return _Placement(cells[inside], np.flatnonzero(inside))


def _look_up(placement: _Placement, labels: NDArray[np.integer] | None, grid: Grid) -> _Verdicts:
    index = np.ravel_multi_index(tuple(placement.cells.T), grid.spec.size)
    voxels = grid.labels.reshape(-1)[index]
    known = np.ones(len(voxels), np.bool_) if grid.counts is None else grid.counts.reshape(-1)[index] > 0
    return _Verdicts(known, known & (voxels != 0 if labels is None else voxels == labels[placement.points]))


def _mistake(column: int, spec: GridSpec) -> str:
    if column <= len(_AXES):
        return _AXES[column - 1][0]
    shift = _SHIFTS[column - 1 - len(_AXES)]
    names = ("x", "y", "z") if spec.coordinates == "cartesian" else ("radius", "azimuth", "z")
    steps = " and ".join(
        f"one cell towards {'+' if s > 0 else '-'}{name}" for s, name in zip(shift, names, strict=True) if s
    )
    return f"a grid shifted by {steps}"
