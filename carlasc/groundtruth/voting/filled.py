"""The box around the points in each voxel.

A pole, a roof or a kerb hides the space behind this box, not behind its whole voxels.
"""

from __future__ import annotations

import numpy as np

from carlasc.core.arrays import Float32Array, Uint8Array, Uint16Array
from carlasc.core.cells import Cells, Pose, transform
from carlasc.core.compiling import cached

STEPS = 256  # number of steps of a box along an edge of a voxel


def no_boxes(num_voxels: int) -> Uint8Array:
    """Return (V, 6) uint8: the boxes of voxels without points, in which first x, y, z are greater
    than last x, y, z.
    """
    return np.tile(np.array([255, 255, 255, 0, 0, 0], np.uint8), (num_voxels, 1))


@cached
def widen_boxes(
    points: Float32Array,
    pose: Pose,
    cells: Cells,
    regions: Uint16Array,
    region: int,
    boxes: Uint8Array,
) -> None:
    """Widen the boxes of Cartesian voxels by points.

    Args:
        points: (3, N) metres.
        pose: grid_T_points.
        cells: the cells of the grid.
        regions: (V,) region of each voxel; empty: all voxels count.
        region: the region whose voxels count.
        boxes: (V, 6) uint8; widened: first and last x, y, z in 1/256 of a voxel, from its lower
            corner.
    """
    # The rule of `find_voxel`, whose quotients are needed here too. Points that rounding puts
    # beyond the last cell widen no box.
    scaled = np.empty(3)
    for i in range(points.shape[1]):
        at = transform(pose, points[0, i], points[1, i], points[2, i])
        voxel, inside = 0, True
        for axis in range(3):
            scaled[axis] = (at[axis] - cells.lower[axis]) / cells.voxel_size[axis]
            inside &= 0 <= scaled[axis] < cells.size[axis]
            voxel = voxel * cells.size[axis] + int(scaled[axis])
        if inside and (len(regions) == 0 or regions[voxel] == region):
            for axis in range(3):
                step = np.uint8((scaled[axis] - int(scaled[axis])) * STEPS)
                boxes[voxel, axis] = min(boxes[voxel, axis], step)
                boxes[voxel, 3 + axis] = max(boxes[voxel, 3 + axis], step)
