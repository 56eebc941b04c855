"""How well one scan overlaps another: the share of its points that are in cells that the other occupies."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from carlasc.core.compiling import cached
from carlasc.core.geometry import Transform
from carlasc.inspection.structure import MAX_RANGE_M

VOXEL_M = 0.4
"""Size of the cells."""

_CELLS = int(2 * MAX_RANGE_M / VOXEL_M)


def occupancy(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the (C, C, C) cells about the sensor that hold points, (N, 3) metres, sensor frame."""
    occupied = np.zeros((_CELLS, _CELLS, _CELLS), np.bool_)
    occupy(occupied, points, MAX_RANGE_M, VOXEL_M)
    return occupied


def overlap(occupied: NDArray[np.bool_], motion: Transform, points: NDArray[np.float64]) -> float:
    """Return the share of the points of a scan that are in occupied cells of another.

    Args:
        occupied: (C, C, C) cells of the other scan: see `occupancy`.
        motion: (4, 4) other_T_scan.
        points: (N, 3) metres, N > 0.
    """
    return count_occupied(occupied, motion, points, MAX_RANGE_M, VOXEL_M) / len(points)


@cached(error_model="python")
def occupy(occupied: NDArray[np.bool_], points: NDArray[np.float64], reach_m: float, voxel_m: float) -> None:
    """Mark the cells of a grid that hold points; the arguments are those of `count_occupied`."""
    cells = len(occupied)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        a, b, c = (x + reach_m) / voxel_m, (y + reach_m) / voxel_m, (z + reach_m) / voxel_m
        if 0 <= a < cells and 0 <= b < cells and 0 <= c < cells:
            occupied[int(a), int(b), int(c)] = True


@cached(error_model="python")
def count_occupied(
    occupied: NDArray[np.bool_],
    motion: NDArray[np.float64],
    points: NDArray[np.float64],
    reach_m: float,
    voxel_m: float,
) -> int:
    """Return the number of points that are in occupied cells of a grid when they are moved.

    Args:
        occupied: (C, C, C) cells.
        motion: (4, 4) from the frame of the points to that of the grid.
        points: (N, 3) metres.
        reach_m: distance of the lower bounds of the grid from the origin.
        voxel_m: size of a cell.
    """
    count, cells, cell = 0, len(occupied), np.empty(3)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for a in range(3):  # the operations of `transform_points`, in their order
            moved = (x * motion[a, 0] + y * motion[a, 1] + z * motion[a, 2]) + motion[a, 3]
            cell[a] = (moved + reach_m) / voxel_m
        if 0 <= cell[0] < cells and 0 <= cell[1] < cells and 0 <= cell[2] < cells:
            count += occupied[int(cell[0]), int(cell[1]), int(cell[2])]
    return count
