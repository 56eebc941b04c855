"""The compiled loops of the audit: the voxels of bodies, and the rays that cross each voxel."""

from __future__ import annotations

import numpy as np

from carlasc.core.arrays import BoolArray, FloatArray, IntArray
from carlasc.core.cells import Cells, find_voxel
from carlasc.core.compiling import cached
from carlasc.core.grids import GridSpec

_SAMPLES = 4  # samples on a ray per edge of the smallest voxel
# least samples of a ray in a voxel that it crosses: rays that graze a corner do not count
_INSIDE = 3


def crossings(origins: FloatArray, points: FloatArray, spec: GridSpec, margin_m: float) -> IntArray:
    """Return (X, Y, Z) how many rays cross each voxel, not only a corner of it, before they come
    near their return.

    Args:
        origins: (N, 3) metres, where each ray begins, in the frame of the grid.
        points: (N, 3) metres, the returns.
        spec: geometry of the grid, Cartesian or cylindrical.
        margin_m: rays end this far before their return.
    """
    crossed = np.zeros(spec.num_voxels + 1, np.int64)
    edges = spec.voxel_size[[0, 2]] if spec.coordinates == "cylindrical" else spec.voxel_size
    _cross(origins, points, Cells.of(spec), float(min(edges)) / _SAMPLES, margin_m, crossed)
    return crossed[:-1].reshape(spec.size)


@cached
def _cross(origins, points, cells, step_m, margin_m, crossed):  # type: ignore[no-untyped-def]
    outside = len(crossed) - 1
    for i in range(len(points)):
        x, y, z = origins[i, 0], origins[i, 1], origins[i, 2]
        dx, dy, dz = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        if not length > margin_m:
            continue
        dx, dy, dz = dx / length, dy / length, dz / length
        last, inside = outside, 0
        for k in range(int((length - margin_m) / step_m)):
            t = (k + 0.5) * step_m
            voxel = find_voxel(x + t * dx, y + t * dy, z + t * dz, cells)
            inside = inside + 1 if voxel == last else 1
            last = voxel
            if inside == _INSIDE:
                crossed[voxel] += 1


def voxels_at(points: FloatArray, poses: FloatArray, spec: GridSpec) -> IntArray:
    """Return the voxels that hold any of (N, 3) points at any of (P, 4, 4) poses in the frame of
    the grid, rising.
    """
    inside = np.zeros(spec.num_voxels + 1, np.bool_)
    _mark(points, np.ascontiguousarray(poses), Cells.of(spec), inside)
    return np.flatnonzero(inside[:-1])


@cached
def _mark(points, poses, cells, inside):  # type: ignore[no-untyped-def]
    for p in range(len(poses)):
        m = poses[p]
        for i in range(len(points)):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            voxel = find_voxel(
                m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3],
                m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3],
                m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3],
                cells,
            )
            inside[voxel] = True


def grown(mask: BoolArray, turns: bool) -> BoolArray:
    """Return a mask grown by one voxel in each direction; if `turns`, the azimuth of a cylindrical
    grid is periodic.
    """
    for axis in range(3):
        sides = [(1, 1) if a == axis else (0, 0) for a in range(3)]
        wide = np.moveaxis(
            np.pad(mask, sides, mode="wrap" if turns and axis == 1 else "constant"), axis, 0
        )
        mask = np.moveaxis(wide[:-2] | wide[1:-1] | wide[2:], 0, axis)
    return mask
