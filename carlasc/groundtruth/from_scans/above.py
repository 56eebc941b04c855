"""Free space above bodies: no scan of one LiDAR sees it, and networks that are trained without it
put roofs into the air.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from carlasc.core.arrays import BoolArray, IntArray
from carlasc.core.cells import joined
from carlasc.core.grids import GridSpec

_REACH_M = 1.2  # height of the space above a body that is taken for free


def find_above(solid: BoolArray, known: BoolArray, bodies: BoolArray, spec: GridSpec) -> IntArray:
    """Return the unknown voxels above bodies whose tops were seen.

    A body is a group of columns that touch. Its top was seen if a voxel above it is free: rays
    passed there, and nothing of the body stopped them. Columns beside a body count too, because a
    body fills its outer voxels in part. Nothing above a solid voxel is taken for free.

    Args:
        solid: (V,) bool, occupied voxels.
        known: (V,) bool, free and occupied voxels.
        bodies: (V,) bool, the voxels of vehicles and people.
        spec: the grid.

    Returns:
        Flat indices, increasing.
    """
    nx, ny, levels = spec.size
    solid, known, bodies = (voxels.reshape(-1, levels) for voxels in (solid, known, bodies))
    columns = np.flatnonzero(bodies.any(axis=1))
    # two more columns in a row: the last of one does not touch the first of the next
    rows, places = np.divmod(columns, ny)
    group = joined(rows * (ny + 2) + places, np.ones(len(columns), bool), ny + 2)
    top, passed = np.full((2, len(columns)), -1)
    np.maximum.at(top, group, _highest(bodies[columns]))
    np.maximum.at(passed, group, _highest(known[columns] & ~solid[columns]))

    roofs = np.full((nx + 2, ny + 2), -1)
    roofs[rows + 1, places + 1] = np.where(passed > top, top, -1)[group]
    roof = sliding_window_view(roofs, (3, 3)).max(axis=(2, 3)).reshape(-1)
    roof[columns] = roofs[rows + 1, places + 1]
    chosen = np.flatnonzero(roof >= 0)
    over = np.arange(levels) - roof[chosen, None]
    above = (over > 0) & (over <= round(_REACH_M / float(spec.voxel_size[2])))
    covered = np.logical_or.accumulate(above & solid[chosen], axis=1)
    column, level = np.nonzero(above & ~covered & ~known[chosen])
    return chosen[column] * levels + level


def _highest(voxels: BoolArray) -> IntArray:
    """Return the highest level of the voxels in each of (C, Z) columns, -1 without one."""
    highest = voxels.shape[1] - 1 - np.argmax(voxels[:, ::-1], axis=1)
    return np.where(voxels.any(axis=1), highest, -1)
