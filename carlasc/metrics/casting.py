"""Casting rays through voxel grids: the first occupied voxel on each ray and its distance."""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from carlasc.core.arrays import AnyFloatArray, FloatArray, IntArray, LabelArray, Uint8Array
from carlasc.core.compiling import cached, jit
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError

# number of pitches of the first part: for a sensor 1 m above flat ground, they hit it every metre
# from 1 m to 10 m
_STEPS = 10
_HIGHEST_RAD = 0.21  # the last pitch is the first one at or above this angle


@cache
def rayiou_directions() -> FloatArray:
    """Return the directions of the rays that RayIoU casts from each origin (SparseOcc's evaluation
    script).

    They are similar to a LiDAR: 360 azimuths, one degree apart, for each of 39 pitches from -45 to
    12.55 degrees.

    Returns:
        (14040, 3) float64 unit vectors, pitch by pitch; read-only.
    """
    pitches = [math.atan(k) - math.pi / 2 for k in range(1, _STEPS + 1)]
    while pitches[-1] < _HIGHEST_RAD:
        pitches.append(pitches[-1] + (pitches[-1] - pitches[-2]))
    pitch, azimuth = np.meshgrid(pitches, np.deg2rad(np.arange(360.0)), indexing="ij")
    directions = np.stack(
        [np.cos(pitch) * np.cos(azimuth), np.cos(pitch) * np.sin(azimuth), np.sin(pitch)], axis=-1
    )
    directions.flags.writeable = False  # the same array in all calls
    return directions.reshape(-1, 3)


def cast_rays(
    grids: LabelArray,
    spec: GridSpec,
    origins: AnyFloatArray,
    directions: AnyFloatArray,
    *,
    free: int = 0,
) -> tuple[IntArray, FloatArray]:
    """Cast rays through grids of the same geometry, and return the first occupied voxel on each
    ray.

    For each ray, the result is the first voxel that is not free, possibly the voxel of the origin.
    If all voxels are free, it is the last voxel before the ray leaves the grid. A ray that starts
    outside the grid begins at the point where it enters the grid.

    Args:
        grids: (G, X, Y, Z) class ids of up to 8 grids; rays are cast through all grids in one pass.
        spec: geometry of the grids, Cartesian.
        origins: (O, 3) metres, in the frame of the grid.
        directions: (R, 3) unit vectors, in the frame of the grid.
        free: the id of free space.

    Returns:
        (G, O * R) flat index of the voxel of each ray, -1 if the ray does not enter the grid; and
        (G, O * R) distance in metres from the origin to the point where the ray leaves that voxel.
        The rays of each origin are consecutive.

    Raises:
        ArgumentError: the grid is cylindrical, or the shapes do not match.
    """
    check_cartesian(spec)
    if grids.ndim != 4 or grids.shape[1:] != spec.size:
        raise ArgumentError(
            "grids", expected=f"shape (G, {', '.join(map(str, spec.size))})", found=grids.shape
        )
    starts = np.asarray(origins, np.float64).reshape(-1, 3)
    lower = np.array(spec.lower)
    voxel = spec.voxel_size
    steps = np.asarray(directions, np.float64).reshape(-1, 3)
    solid = np.zeros(grids.shape[1:], np.uint8)
    for bit, grid in enumerate(grids):
        solid |= (grid != free).astype(np.uint8) << np.uint8(bit)
    if len(grids) > 8:
        raise ArgumentError("grids", expected="at most 8 grids", found=len(grids))
    voxels = np.full((len(grids), len(starts) * len(steps)), -1, np.int64)
    depth = np.zeros(voxels.shape)
    _cast(
        solid.reshape(-1),
        np.array(spec.size),
        (starts - lower) / voxel,
        steps / voxel,
        voxels,
        depth,
    )
    return voxels, depth


def check_cartesian(spec: GridSpec) -> None:
    """Check that rays can be cast through a grid."""
    if spec.coordinates != "cartesian":
        raise ArgumentError(
            "grid", expected="a Cartesian grid to cast rays through", found=spec.coordinates
        )


def follow_rays(
    solid: Uint8Array,
    spec: GridSpec,
    origin: AnyFloatArray,
    points: AnyFloatArray,
) -> tuple[FloatArray, Uint8Array]:
    """Trace measured rays through a grid: the first solid voxel on each ray, and the content of the
    voxels before the measured point.

    Args:
        solid: (X, Y, Z) uint8 bits of the content of a voxel; a ray passes voxels with 0.
        spec: geometry of the grid, Cartesian.
        origin: (3,) metres, origin of the rays in the frame of the grid.
        points: (N, 3) metres, measured points inside the grid.

    Returns:
        (N,) float64 distance in metres from the origin to the middle of the path of the ray through
        its first solid voxel, which may be behind the point; infinite if no voxel on the ray is
        solid. And (N,) uint8 combined bits of all voxels that the ray passes before the point,
        without the voxel of the point and its 26 neighbours.

    Raises:
        ArgumentError: the grid is cylindrical.
    """
    check_cartesian(spec)
    ends = np.asarray(points, np.float64)
    lower = np.array(spec.lower)
    voxel = spec.voxel_size
    first = np.full(len(ends), np.inf)
    passed = np.zeros(len(ends), np.uint8)
    start = (np.asarray(origin, np.float64) - lower) / voxel
    size = np.array(spec.size)
    lengths = np.linalg.norm(ends - origin, axis=1)
    _follow(
        np.ascontiguousarray(solid), size, start, (ends - lower) / voxel, lengths, first, passed
    )
    return first, passed


@cached
def _follow(solid, size, start, ends, lengths, first, passed):  # type: ignore[no-untyped-def]
    """Walk each ray from voxel to voxel, in voxel units.

    The parameter t is 0 at the origin and 1 at the point.
    """
    step = np.empty(3)
    cell = np.empty(3, np.int64)
    last = np.empty(3, np.int64)
    crossing = np.empty(3)
    between = np.empty(3)
    for r in range(len(ends)):
        inside = True
        for axis in range(3):
            step[axis] = ends[r, axis] - start[axis]
            inside = inside and 0 <= start[axis] < size[axis]
        t = 0.0 if inside else _entry(start, step, size)
        if t < 0 or lengths[r] == 0:
            continue
        for axis in range(3):
            place = start[axis] + t * step[axis]
            cell[axis] = min(max(int(np.floor(place)), 0), size[axis] - 1)
            last[axis] = min(max(int(np.floor(ends[r, axis])), 0), size[axis] - 1)
            forward = step[axis] > 0
            crossing[axis] = (
                (cell[axis] + forward - start[axis]) / step[axis] if step[axis] != 0 else np.inf
            )
            between[axis] = np.abs(1 / step[axis]) if step[axis] != 0 else np.inf
        while True:
            axis = 0
            if crossing[1] < crossing[axis]:
                axis = 1
            if crossing[2] < crossing[axis]:
                axis = 2
            leave = crossing[axis]
            value = solid[cell[0], cell[1], cell[2]]
            if value:
                if first[r] == np.inf:
                    first[r] = (t + leave) / 2 * lengths[r]
                away = max(abs(cell[0] - last[0]), abs(cell[1] - last[1]), abs(cell[2] - last[2]))
                if leave < 1 and away > 1:
                    passed[r] |= value
            t = leave
            if t >= 1 and first[r] < np.inf:
                break
            cell[axis] += 1 if step[axis] > 0 else -1
            crossing[axis] += between[axis]
            if not 0 <= cell[axis] < size[axis]:
                break


@cached
def _cast(solid, size, starts, steps, voxels, depth):  # type: ignore[no-untyped-def]
    """Walk each ray from voxel to voxel (Amanatides and Woo), in voxel units.

    The distance along the ray is in metres.
    """
    num_grids = len(voxels)
    everything = (1 << num_grids) - 1
    nx = size[0]
    ny = size[1]
    nz = size[2]
    row = nz
    plane = ny * nz
    for o in range(len(starts)):
        for r in range(len(steps)):
            ray = o * len(steps) + r
            x = starts[o, 0]
            y = starts[o, 1]
            z = starts[o, 2]
            dx = steps[r, 0]
            dy = steps[r, 1]
            dz = steps[r, 2]
            entry = 0.0
            if not (0 <= x < nx and 0 <= y < ny and 0 <= z < nz):
                entry = _entry((x, y, z), (dx, dy, dz), (nx, ny, nz))
                if entry < 0:
                    continue
            i = min(max(int(np.floor(x + entry * dx)), 0), nx - 1)
            j = min(max(int(np.floor(y + entry * dy)), 0), ny - 1)
            k = min(max(int(np.floor(z + entry * dz)), 0), nz - 1)
            ix = 1 if dx > 0 else -1
            iy = 1 if dy > 0 else -1
            iz = 1 if dz > 0 else -1
            # per axis: distance to the next face that the ray crosses, and between two faces
            tx = (i + (dx > 0) - x) / dx if dx != 0 else np.inf
            ty = (j + (dy > 0) - y) / dy if dy != 0 else np.inf
            tz = (k + (dz > 0) - z) / dz if dz != 0 else np.inf
            sx = np.abs(1 / dx)
            sy = np.abs(1 / dy)
            sz = np.abs(1 / dz)
            # number of faces before the ray leaves the grid: counting down takes one comparison per
            # step
            left_x = nx - 1 - i if dx > 0 else i
            left_y = ny - 1 - j if dy > 0 else j
            left_z = nz - 1 - k if dz > 0 else k
            ix = ix * plane
            iy = iy * row
            voxel = i * plane + j * row + k
            open_grids = everything
            while True:
                t = min(tx, ty, tz)
                hit = solid[voxel] & open_grids
                if hit:
                    for g in range(num_grids):
                        if hit >> g & 1:
                            voxels[g, ray] = voxel
                            depth[g, ray] = t
                    open_grids ^= hit
                    if not open_grids:
                        break
                if tx <= ty and tx <= tz:
                    inside = left_x > 0
                    left_x = left_x - 1
                    tx = tx + sx
                    step = ix
                elif ty <= tz:
                    inside = left_y > 0
                    left_y = left_y - 1
                    ty = ty + sy
                    step = iy
                else:
                    inside = left_z > 0
                    left_z = left_z - 1
                    tz = tz + sz
                    step = iz
                if not inside:
                    for g in range(num_grids):
                        if open_grids >> g & 1:
                            voxels[g, ray] = voxel
                            depth[g, ray] = t
                    break
                voxel += step


@jit
def _entry(start, step, size):  # type: ignore[no-untyped-def]
    """Return the distance at which a ray from outside enters the grid; -1 if it misses the grid."""
    near = 0.0
    far = np.inf
    for axis in range(3):
        if step[axis] == 0:
            if not 0 <= start[axis] < size[axis]:
                return -1.0
            continue
        one = -start[axis] / step[axis]
        other = (size[axis] - start[axis]) / step[axis]
        near = max(near, min(one, other))
        far = min(far, max(one, other))
    return near if near < far else -1.0
