"""The rule that places a sample in a voxel, bit for bit (FORMAT section 4), one sample at a time.

Norm and unit ray are float32, as the points are; distances, differences and the transform are float64; cells are half-open, floor, clamp.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba
import numpy as np

from carlasc.core.geometry import Transform
from carlasc.core.grids import GridSpec

Real = Any  # float32 or float64: compiled code keeps them apart, NumPy's stubs do not
Triple = tuple[float, float, float]
Pose = tuple[float, float, float, float, float, float, float, float, float, float, float, float]
"""The upper 3 x 4 of a transform, row-major, as scalars."""

jit = numba.njit(nogil=True, error_model="numpy")
inlined = numba.njit(nogil=True, error_model="numpy", forceinline=True)  # a loop that calls others is not vectorised
# Where margins cover the rounding, a product and a sum may become one operation.
fused = numba.njit(nogil=True, error_model="numpy", forceinline=True, fastmath={"contract"})
cached = numba.njit(nogil=True, error_model="numpy", cache=True)  # what Python calls; the rest is compiled into it


class Cells(NamedTuple):
    """A GridSpec as scalars, which compiled code keeps in registers."""

    cylindrical: bool
    size: tuple[int, int, int]
    lower: Triple
    upper: Triple
    voxel_size: Triple

    @classmethod
    def of(cls, spec: GridSpec) -> Cells:
        """Return the cells of a grid."""
        x, y, z = spec.voxel_size.tolist()
        return cls(spec.coordinates == "cylindrical", spec.size, spec.lower, spec.upper, (x, y, z))


def as_pose(dst_T_src: Transform) -> Pose:
    """Return a (4, 4) transform as scalars."""
    pose: Pose = tuple(np.asarray(dst_T_src, np.float64)[:3].ravel().tolist())  # type: ignore[assignment]
    return pose


@inlined
def transform(pose: Pose, x: Real, y: Real, z: Real) -> tuple[Real, Real, Real]:
    """Return R @ p + t, summed from the left."""
    return (
        pose[0] * x + pose[1] * y + pose[2] * z + pose[3],
        pose[4] * x + pose[5] * y + pose[6] * z + pose[7],
        pose[8] * x + pose[9] * y + pose[10] * z + pose[11],
    )


@jit
def voxel_of(x: float, y: float, z: float, cells: Cells) -> int:
    """Return the flat index of the voxel of a point in the grid's frame, the number of voxels if outside."""
    first, second = x, y
    if cells.cylindrical:
        first, second = math.sqrt(x * x + y * y), math.atan2(y, x)
        turned = second
        if second < cells.lower[1]:
            turned = second + 2 * math.pi
        elif second >= cells.upper[1]:
            turned = second - 2 * math.pi
        if cells.lower[1] <= turned < cells.upper[1]:
            second = turned
    if not (
        cells.lower[0] <= first < cells.upper[0]
        and cells.lower[1] <= second < cells.upper[1]
        and cells.lower[2] <= z < cells.upper[2]
    ):
        return cells.size[0] * cells.size[1] * cells.size[2]
    i = min(int((first - cells.lower[0]) / cells.voxel_size[0]), cells.size[0] - 1)
    j = min(int((second - cells.lower[1]) / cells.voxel_size[1]), cells.size[1] - 1)
    k = min(int((z - cells.lower[2]) / cells.voxel_size[2]), cells.size[2] - 1)
    return (i * cells.size[1] + j) * cells.size[2] + k


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
    return True, voxel_of(gx, gy, gz, cells)
