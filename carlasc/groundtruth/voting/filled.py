"""The box around the points in each voxel.

A pole, a roof or a kerb hides the space behind this box, not behind its whole voxels.
"""

from __future__ import annotations

import numpy as np

from carlasc.core.arrays import Uint8Array
from carlasc.core.cells import Cells, transform
from carlasc.core.compiling import cached
from carlasc.groundtruth.voting.kernel import Voters

STEPS = 256  # number of steps of a box along an edge of a voxel


def no_boxes(num_voxels: int) -> Uint8Array:
    """Return (V, 6) uint8: the boxes of voxels without points, in which first x, y, z are greater
    than last x, y, z.
    """
    return np.tile(np.array([255, 255, 255, 0, 0, 0], np.uint8), (num_voxels, 1))


@cached
def widen_boxes(cast: Voters, cells: Cells, boxes: Uint8Array) -> None:
    """Widen the boxes of Cartesian voxels by the points of an observation that vote for their
    classes.

    Args:
        cast: the observation.
        cells: the cells of the grid.
        boxes: (V, 6) uint8; widened: first and last x, y, z in 1/256 of a voxel, from its lower
            corner.
    """
    # The rule of `find_voxel`, whose quotients are needed here too. Points that rounding puts
    # beyond the last cell widen no box.
    points, labels, hits, _, poses, ends = cast
    scaled, begin = np.empty(3), 0
    for place in range(len(ends)):
        p = poses[place]
        pose = (p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8], p[9], p[10], p[11])
        for i in range(begin, ends[place]):
            if labels[i] == 0 or (len(hits) and not hits[i]):
                continue
            at = transform(pose, points[3 * i], points[3 * i + 1], points[3 * i + 2])
            voxel, inside = 0, True
            for axis in range(3):
                scaled[axis] = (at[axis] - cells.lower[axis]) / cells.voxel_size[axis]
                inside &= 0 <= scaled[axis] < cells.size[axis]
                voxel = voxel * cells.size[axis] + int(scaled[axis])
            if inside:
                for axis in range(3):
                    step = np.uint8((scaled[axis] - int(scaled[axis])) * STEPS)
                    boxes[voxel, axis] = min(boxes[voxel, axis], step)
                    boxes[voxel, 3 + axis] = max(boxes[voxel, 3 + axis], step)
        begin = ends[place]
