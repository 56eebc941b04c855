"""The voxels in which points lie, compiled: what `GridSpec.flat_index` finds, without an array for each step."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from carlasc.core.cells import Cells, Pose, as_pose, find_voxel, transform
from carlasc.core.compiling import cached
from carlasc.core.geometry import Transform
from carlasc.core.grids import GridSpec


def mark(
    points: NDArray[np.floating], grid_T_points: Transform, spec: GridSpec, marked: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """Return which voxels have points, (V,) bool.

    Args:
        points: (N, 3) metres.
        grid_T_points: (4, 4), from the frame of the points to the grid's.
        spec: geometry of the grid.
        marked: (V,) bool, voxels that are marked already; it is changed, and returned. None: no voxel is.
    """
    marked = np.zeros(spec.num_voxels, np.bool_) if marked is None else marked
    _mark(np.ascontiguousarray(points, np.float64), as_pose(grid_T_points), Cells.of(spec), marked)
    return marked


@cached
def _mark(points: NDArray[np.float64], pose: Pose, cells: Cells, marked: NDArray[np.bool_]) -> None:
    for i in range(len(points)):
        x, y, z = transform(pose, points[i, 0], points[i, 1], points[i, 2])
        voxel = find_voxel(x, y, z, cells)
        if voxel < len(marked):
            marked[voxel] = True
