"""Points looked up in a grid, compiled: how many lie in known voxels, and in voxels of their class, also with the grid shifted.

Importing this module loads Numba.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from carlasc.core.cells import Triple
from carlasc.core.compiling import cached
from carlasc.core.grids import Grid

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
        """Count points by what their voxels hold, in grids whose labels are `shifts` cells too far along the axes.

        The azimuth of a full turn is periodic. A point whose voxel is outside a shifted grid counts as it does in the grid as it is, and
        a point outside that one does not count.

        Args:
            points: (N, 3) metres.
            labels: (N,) class ids.
            shifts: (S, 3) cells.

        Returns:
            (S, 3) numbers of points in known voxels, in known voxels of their class, and in known voxels of any class but free.
        """
        spec = self._spec
        lower, upper = spec.lower, spec.upper
        x, y, z = spec.voxel_size.tolist()
        full_turn = spec.coordinates == "cylindrical" and upper[1] - lower[1] > 2 * math.pi - 1e-3
        counted = np.zeros((len(shifts), 3), np.int64)
        axes = np.ascontiguousarray(spec.to_axes(points), np.float64)
        classes = labels.astype(np.int64)
        _count(axes, classes, shifts, spec.size, lower, upper, (x, y, z), full_turn, self._labels, self._known, counted)
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
    """Add points to `counted`. They are given on the axes of the grid, and their cells are those of `GridSpec.index`."""
    depth, width, height = size
    for point in range(len(axes)):
        first, second, third = axes[point, 0], axes[point, 1], axes[point, 2]
        if not (lower[0] <= first < upper[0] and lower[1] <= second < upper[1] and lower[2] <= third < upper[2]):
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
