"""The rule that places a sample of a ray in a voxel, bit for bit, one sample at a time. See the format page, `docs/format.md#votes`.

Norm and unit ray are float32, as the points are; distances, differences and the transform are float64. The cell is that of
`carlasc.core.cells.find_voxel`.
"""

from __future__ import annotations

import numpy as np

from carlasc.core.cells import Cells, Pose, Real, find_voxel, transform
from carlasc.core.compiling import inlined, jit


@inlined
def unit_ray(x: Real, y: Real, z: Real) -> tuple[Real, Real, Real, Real]:
    """Return the norm of a point and the unit ray to it, all float32."""
    norm = np.sqrt(x * x + y * y + z * z)
    return norm, x / norm, y / norm, z / norm


@inlined
def before_sensor(x: Real, ux: Real) -> bool:
    """Return whether a sample is kept: its x over the unit ray's is positive. A ray whose x is 0 drops out altogether."""
    return bool(x / ux > 0.0 and ux != 0.0)


@jit
def sample_voxel(
    x: Real, y: Real, z: Real, step: float, free_step_m: float, pose: Pose, cells: Cells
) -> tuple[bool, int]:
    """Return whether the sample `step` steps back from a point (0: the point itself) is kept, and its voxel."""
    _, ux, uy, uz = unit_ray(x, y, z)
    back = step * free_step_m
    sx, sy, sz = np.float64(x) - ux * back, np.float64(y) - uy * back, np.float64(z) - uz * back
    if not before_sensor(sx, ux):
        return False, cells.size[0] * cells.size[1] * cells.size[2]
    gx, gy, gz = transform(pose, sx, sy, sz)
    return True, find_voxel(gx, gy, gz, cells)
