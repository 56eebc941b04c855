"""The motion between two scans, measured from the scans alone: the structure of one is moved until it fits that of the other.

The structure of the earlier scan is summarized by a normal distribution in each cell of a grid (the normal distributions transform of Biber and
Strasser, IROS 2003). The later scan is moved so that its points are likely under these distributions: flat ones, of walls, pull across the wall
only. The information of the result says which directions the structure determines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlasc.core.compiling import cached
from carlasc.core.geometry import Transform, invert, transform_points

_FITS = ((2.0, 8), (1.0, 16))  # from a coarse fit to a fine one: the size of cells in metres, and the most iterations
_CELL_POINTS = 6  # cells with fewer points have no distribution
_POINT_M = 0.05  # error of a point
_OUTLIER = 9.0  # squared distance, in standard deviations, from which points count less
_POINTS = 2000
_INDEPENDENT = 300  # number of points with independent errors
_STILL = 1e-4


@dataclass(frozen=True)
class Match:
    """The motion that was measured between two scans.

    Attributes:
        motion: (4, 4) earlier_T_later.
        information: (6, 6) of the errors of the motion: three of the translation in metres, then three of the rotation in radians, on the
            axes of the earlier scan about its origin.
    """

    motion: Transform
    information: NDArray[np.float64]


def match(earlier: NDArray[np.float64], later: NDArray[np.float64], start: Transform) -> Match:
    """Measure the motion between two scans, near a first estimate.

    Args:
        earlier: (M, 3) structure of the earlier scan, metres, in its frame.
        later: (N, 3) structure of the later scan, metres, in its frame.
        start: (4, 4) earlier_T_later, right within about a metre and some degrees.
    """
    points = later[:: max(1, len(later) // _POINTS)]
    motion, information = start.copy(), np.zeros((6, 6))
    for cell_m, iterations in _FITS:
        cells = _Cells(earlier, cell_m)
        for _ in range(iterations):
            moved = transform_points(motion, points)
            information, pull = cells.pull(moved)
            step = np.asarray(np.linalg.solve(information + 1e-6 * np.eye(6), pull), np.float64)
            motion = _exp(step) @ motion
            if np.abs(step).max() < _STILL:
                break
    return Match(motion, information)


def residual(measured: Transform, motion: Transform) -> NDArray[np.float64]:
    """Return (6,) the small motion from `motion` to `measured`, both earlier_T_later: translation, and rotation vector."""
    between = measured @ invert(motion)
    turn = between[:3, :3]
    vector = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    return np.concatenate([between[:3, 3], vector])


class _Cells:
    """The normal distributions of points in cells."""

    def __init__(self, points: NDArray[np.float64], cell_m: float) -> None:
        self.cell_m = cell_m
        columns = points.T.copy()  # the bounds of rows take NumPy a tenth of the time of those of columns
        self.lower = np.floor(columns.min(axis=1) / cell_m) - 1
        self.size = (np.floor(columns.max(axis=1) / cell_m) - self.lower + 2).astype(np.int64)
        flat = self._flat(points)
        counts = np.bincount(flat, minlength=int(self.size.prod()))
        cells = np.flatnonzero(counts)
        counts, self.row = counts[cells], np.full(len(counts), -1)
        self.row[cells] = np.arange(len(cells))
        row, spread = self.row[flat], np.zeros((len(cells), 3, 3))
        means = np.stack([np.bincount(row, column) for column in columns], axis=1) / counts[:, None]
        add_squares(points, row, means, spread)
        spread[:, [1, 2, 2], [0, 0, 1]] = spread[:, [0, 0, 1], [1, 2, 2]]
        spread = spread / counts[:, None, None] + _POINT_M**2 * np.eye(3)
        good = counts >= _CELL_POINTS
        self.means, self.inverse = means[good], np.linalg.inv(spread[good])
        self.row[cells] = np.where(good, np.cumsum(good) - 1, -1)

    def pull(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (6, 6) the information, and (6,) the pull, of the motion of points (N, 3) towards the distributions of their cells."""
        cells = np.floor(points / self.cell_m) - self.lower
        within = np.all((cells >= 0) & (cells < self.size), axis=1)
        row = np.full(len(points), -1)
        row[within] = self.row[self._flat(points[within])]
        points, row = points[row >= 0], row[row >= 0]
        off, inverse = self.means[row] - points, self.inverse[row]
        scaled = (inverse @ off[:, :, None])[:, :, 0]
        squared = (off * scaled).sum(axis=1)
        weight = 1 / (1 + squared / _OUTLIER) ** 2
        weight *= min(1.0, _INDEPENDENT / max(len(points), 1))
        slope = np.zeros((len(points), 3, 6))
        slope[:, range(3), range(3)] = 1.0
        x, y, z = points.T
        slope[:, 0, 4], slope[:, 0, 5] = z, -y
        slope[:, 1, 3], slope[:, 1, 5] = -z, x
        slope[:, 2, 3], slope[:, 2, 4] = y, -x
        rows, columns = slope.reshape(-1, 6), (weight[:, None, None] * (inverse @ slope)).reshape(-1, 6)
        return rows.T @ columns, rows.T @ (weight[:, None] * scaled).reshape(-1)

    def _flat(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        return flat_cells(points, self.cell_m, self.lower, self.size)


@cached(error_model="python")
def flat_cells(
    points: NDArray[np.float64], cell_m: float, lower: NDArray[np.float64], size: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return (N,) the number of the cell of each of (N, 3) points that are inside of a grid.

    Args:
        points: metres.
        cell_m: size of a cell.
        lower: (3,) the first cell of the grid, counted from the origin.
        size: (3,) number of cells.
    """
    flat = np.empty(len(points), np.int64)
    for i in range(len(points)):
        number = 0
        for a in range(3):
            number = number * size[a] + int(np.floor(points[i, a] / cell_m) - lower[a])
        flat[i] = number
    return flat


@cached(error_model="python")
def add_squares(
    points: NDArray[np.float64], row: NDArray[np.int64], means: NDArray[np.float64], squares: NDArray[np.float64]
) -> None:
    """Add the products of the offsets of points from the mean of their cell.

    Args:
        points: (N, 3) metres.
        row: (N,) the cell of each of them.
        means: (R, 3) of the points of each cell.
        squares: (R, 3, 3) the sums. Is changed.
    """
    for i in range(len(points)):
        r = row[i]
        x, y, z = points[i, 0] - means[r, 0], points[i, 1] - means[r, 1], points[i, 2] - means[r, 2]
        for a, b, product in ((0, 0, x * x), (0, 1, x * y), (0, 2, x * z), (1, 1, y * y), (1, 2, y * z), (2, 2, z * z)):
            squares[r, a, b] += product


def _exp(step: NDArray[np.float64]) -> Transform:
    """Return the motion of a small translation and rotation vector, about the origin."""
    angle = float(np.linalg.norm(step[3:]))
    x, y, z = step[3:]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    motion = np.eye(4)
    if angle > 0:
        motion[:3, :3] += np.sin(angle) / angle * cross + (1 - np.cos(angle)) / angle**2 * cross @ cross
    motion[:3, 3] = step[:3]
    return motion
