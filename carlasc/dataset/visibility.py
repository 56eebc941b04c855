"""What each scan of a stack saw: voxels that hold a point, voxels that its rays passed through, and the others, of which it tells nothing."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from carlasc.core.grids import GridSpec
from carlasc.dataset.stacking import stack_scans
from carlasc.groundtruth.voting import Observation, count_votes

UNSEEN, PASSED, HIT = 0, 1, 2
"""The values of the field `visibility`."""
_FEWEST_RAYS = 40_000


def stack_visibility(
    scans: Sequence[NDArray[np.float32] | None],
    grid_T_scans: NDArray[np.float64],
    spec: GridSpec,
    min_range_m: float | None = None,
    max_range_m: float | None = None,
) -> NDArray[np.uint8]:
    """Follow the rays of scans through a stack of grids.

    A ray is sampled every shortest edge of a voxel, from its point back to the sensor, so it may miss a voxel of which it cuts a corner only.
    Of a scan with many more points than the box of the grid has outer faces of voxels (and than 40,000), every N-th ray is followed: on the
    published grid that leaves out 4 % of the voxels that rays pass, and takes less than half the time.

    Args:
        scans: T scans, each (N, 3) or (N, 4) float32 metres in its own sensor frame, whose origin is the sensor; None saw nothing.
        grid_T_scans: (T, 4, 4) transforms from each scan's frame to the grid's.
        spec: the grid.
        min_range_m: points nearer to the sensor are left out with their rays; None keeps all.
        max_range_m: points farther from it likewise.

    Returns:
        (T, X, Y, Z) uint8: `HIT` where a scan has a point, `PASSED` where only rays went, otherwise `UNSEEN`.
    """
    seen = 2 * stack_scans(scans, grid_T_scans, spec, "occupancy", min_range_m, max_range_m)
    step_m = float(spec.voxel_size[[0, 2]].min() if spec.coordinates == "cylindrical" else spec.voxel_size.min())
    x, y, z = spec.size
    most = max(_FEWEST_RAYS, 2 * (x * y + y * z + x * z))
    limits = min_range_m or 0.0, math.inf if max_range_m is None else max_range_m
    for grid, points, grid_T_scan in zip(seen, scans, grid_T_scans, strict=True):
        if points is None or not len(points):
            continue
        rays = np.ascontiguousarray(points[:: math.ceil(len(points) / most), :3])
        if limits != (0.0, math.inf):
            distance = np.linalg.norm(rays, axis=1)
            rays = rays[(distance >= limits[0]) & (distance <= limits[1])]
        observation = Observation(rays, np.ones(len(rays), np.uint16), grid_T_scan)
        free = count_votes([observation], spec, free_step_m=step_m).free > 0
        grid[free & (grid == UNSEEN)] = PASSED
    return seen
