"""Compiled functions for the cell of a point: the rule of `GridSpec.to_axes` and `GridSpec.index`,
one point at a time.

`find_voxel` is the exact rule. Loops over many points use faster arithmetic, and call it only for
the few points near an edge of a cell. `fast_azimuth` is the fast arithmetic for cylindrical grids.
The functions are compiled into the loops that call them, in `carlasc.groundtruth.voting` and
`carlasc.dataset.stacking`. Importing this module loads Numba.

See the format page, `docs/format.md#cells`.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from carlasc.core.arrays import (
    AnyFloatArray,
    AnyIntArray,
    BoolArray,
    Float32Array,
    FloatArray,
    Int32Array,
    IntArray,
    Uint16Array,
)
from carlasc.core.compiling import cached, fused, inlined, jit
from carlasc.core.geometry import Transform
from carlasc.core.grids import GridSpec

_BLOCK = 256  # points whose voxels are found at once
Real = Any  # float32 or float64: compiled code distinguishes them, the stubs of NumPy do not
Triple = tuple[float, float, float]
Pose = tuple[float, float, float, float, float, float, float, float, float, float, float, float]
"""The upper 3 x 4 of a transform, row-major, as scalars."""


class Cells(NamedTuple):
    """A GridSpec as scalars, so that compiled code can keep them in registers."""

    cylindrical: bool
    size: tuple[int, int, int]
    lower: Triple
    upper: Triple
    voxel_size: Triple

    @classmethod
    @lru_cache(maxsize=16)
    def of(cls, spec: GridSpec) -> Cells:
        """Return the cells of a grid."""
        x, y, z = spec.voxel_size.tolist()
        return cls(spec.coordinates == "cylindrical", spec.size, spec.lower, spec.upper, (x, y, z))


def as_pose(dst_T_src: Transform) -> Pose:
    """Return a (4, 4) transform as scalars."""
    rows = np.asarray(dst_T_src, np.float64)[:3].ravel()
    pose: Pose = tuple(rows.tolist())  # type: ignore[assignment]
    return pose


@inlined
def pose_of(poses: FloatArray, row: int) -> Pose:
    """Return one of (K, 12) poses as scalars."""
    p = poses[row]
    return (p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8], p[9], p[10], p[11])


@inlined
def transform(pose: Pose, x: Real, y: Real, z: Real) -> tuple[Real, Real, Real]:
    """Return R @ p + t, summed from the left."""
    return (
        pose[0] * x + pose[1] * y + pose[2] * z + pose[3],
        pose[4] * x + pose[5] * y + pose[6] * z + pose[7],
        pose[8] * x + pose[9] * y + pose[10] * z + pose[11],
    )


@jit
def find_voxel(x: float, y: float, z: float, cells: Cells) -> int:
    """Return the flat index of the voxel of a point in the frame of the grid; the number of voxels
    if the point is outside.

    Cells are half-open. The index is rounded down and clipped to the last cell. In a cylindrical
    grid, an azimuth outside the bounds is changed by 2 pi if it is then inside.
    """
    first = x
    second = y
    if cells.cylindrical:
        first = math.sqrt(x * x + y * y)
        second = math.atan2(y, x)
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
def find_in_box(x: float, y: float, z: float, cells: Cells) -> np.int32:
    """Return what `find_voxel` returns in a Cartesian grid, without a branch, so that loops
    vectorise.
    """
    lower, upper, size, voxel = cells.lower, cells.upper, cells.size, cells.voxel_size
    inside = (x >= lower[0]) & (x < upper[0]) & (y >= lower[1]) & (y < upper[1])
    inside &= (z >= lower[2]) & (z < upper[2])
    i = min(np.floor((x - lower[0]) / voxel[0]), size[0] - 1.0)
    j = min(np.floor((y - lower[1]) / voxel[1]), size[1] - 1.0)
    k = min(np.floor((z - lower[2]) / voxel[2]), size[2] - 1.0)
    voxel_count = size[0] * size[1] * size[2]
    return np.int32((i * size[1] + j) * size[2] + k if inside else np.float64(voxel_count))


# atan(t) / t as a polynomial of t^2, |t| <= tan(pi / 8): Chebyshev interpolation, off by less than
# 3e-10.
_ATAN = (
    0.9999999993712274,
    -0.33333306893036774,
    0.1999818304075261,
    -0.1423953266624381,
    0.10569828793087244,
    -0.060263052137509994,
)
_TAN_PI_8 = math.tan(math.pi / 8)
AZIMUTH_ERROR = 3e-10
"""Maximum error of `fast_azimuth`, radians."""


@fused
def fast_azimuth(x: float, y: float) -> float:
    """Return atan2(y, x) within AZIMUTH_ERROR, without a branch, so that loops vectorise; NaN at
    the origin.
    """
    across = abs(y)
    along = abs(x)
    steep = across > along
    small, large = (along, across) if steep else (across, along)
    wide = small > _TAN_PI_8 * large
    t = ((small - large) if wide else small) / ((small + large) if wide else large)
    w = t * t
    angle = _ATAN[5]
    angle = angle * w + _ATAN[4]
    angle = angle * w + _ATAN[3]
    angle = angle * w + _ATAN[2]
    angle = angle * w + _ATAN[1]
    angle = angle * w + _ATAN[0]
    angle = angle * t + (math.pi / 4 if wide else 0.0)
    angle = math.pi / 2 - angle if steep else angle
    angle = math.pi - angle if x < 0.0 else angle
    return -angle if y < 0.0 else angle


def cells_of(points: AnyFloatArray, size: float) -> IntArray:
    """Return the numbers of the cells of a size that (..., D) points are in, along each axis."""
    return np.floor(points / size).astype(np.int64)


def run_starts(numbers: AnyIntArray) -> IntArray:
    """Return the first index of each run of equal numbers, which are 0 or more."""
    return np.flatnonzero(np.diff(numbers, prepend=-1))


def first_of_cells(cells: IntArray) -> BoolArray:
    """Return (N,) bool: whether each of (N, 3) cells is the first occurrence of this cell."""
    first = np.zeros(len(cells), np.bool_)
    first[numbered(cells)[0]] = True
    return first


def distinct(keys: IntArray) -> tuple[IntArray, IntArray]:
    """Return the (K,) sorted unique keys, and the (N,) index of each key among them.

    Like `np.unique`, without sorting all keys.
    """
    first, number = numbered(keys[:, None])
    order = np.argsort(keys[first])
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    return keys[first[order]], place[number]


@cached
def joined(keys: IntArray, seeds: BoolArray, width: int) -> IntArray:
    """Return the component of each cell: seeds that touch are one component, and other cells belong
    to a seed beside them; -1 without one.

    Args:
        keys: (C,) row times width plus column of each cell, increasing.
        seeds: (C,) which cells are seeds.
        width: columns per row.
    """
    # Union-find: every cell points towards the lowest cell of its component, so components have the
    # same numbers whatever the order of joins. Half of the neighbours is enough: joins go both
    # ways.
    parent = np.arange(len(keys))
    for i in range(len(keys)):
        if not seeds[i]:
            continue
        for step in (1, width - 1, width, width + 1):
            j = np.searchsorted(keys, keys[i] + step)
            if j < len(keys) and keys[j] == keys[i] + step and seeds[j]:
                a = i
                b = j
                while parent[a] != a:
                    a = parent[a]
                while parent[b] != b:
                    b = parent[b]
                parent[max(a, b)] = min(a, b)
    component = np.full(len(keys), -1, np.int64)
    for i in range(len(keys)):
        if seeds[i]:
            a = i
            while parent[a] != a:
                a = parent[a]
            component[i] = a
    for i in range(len(keys)):
        if not seeds[i]:
            for step in (-width - 1, -width, -width + 1, -1, 1, width - 1, width, width + 1):
                j = np.searchsorted(keys, keys[i] + step)
                if j < len(keys) and keys[j] == keys[i] + step and seeds[j]:
                    component[i] = component[j]
    return component


@cached(error_model="python")
def numbered(cells: IntArray) -> tuple[IntArray, IntArray]:
    """Number unique (N, K) cells in order of first occurrence, without sorting.

    Returns:
        (C,) first row of each unique cell, and (N,) number of the cell of each row.
    """
    size = 2
    while size < 2 * len(cells):
        size *= 2
    # 1 + the number of each cell, at the hash of the cell or after it
    table = np.zeros(size, np.int64)
    first = np.empty(len(cells), np.int64)
    number = np.empty(len(cells), np.int64)
    count = 0
    for i in range(len(cells)):
        code = 0
        for axis in range(cells.shape[1]):
            code = (code ^ cells[i, axis]) * 0x9E3779B97F4A7C1
        slot = (code ^ (code >> 29)) & (size - 1)
        while True:
            k = table[slot] - 1
            if k < 0:
                first[count] = i
                number[i] = count
                count += 1
                table[slot] = count
                break
            same = True
            for axis in range(cells.shape[1]):
                same = same and cells[first[k], axis] == cells[i, axis]
            if same:
                number[i] = k
                break
            slot = (slot + 1) & (size - 1)
    return first[:count], number


def count_points(
    points: AnyFloatArray,
    grid_T_points: Collection[Transform],
    spec: GridSpec,
    counts: Int32Array | None = None,
) -> Int32Array:
    """Return the number of points per voxel, (V,), which are in several places.

    Same result as with `GridSpec.flat_index`, with less memory.

    Args:
        points: (N, 3) metres.
        grid_T_points: (4, 4), from the frame of the points to that of the grid, for each place.
        spec: geometry of the grid.
        counts: (V,) numbers to which these are added; None: zeros.
    """
    counts = np.zeros(spec.num_voxels, np.int32) if counts is None else counts
    poses = np.array([*map(as_pose, grid_T_points)]).reshape(-1, 12)
    _count(np.ascontiguousarray(points.T), poses, Cells.of(spec), counts)
    return counts


@cached
def _count(points: AnyFloatArray, poses: FloatArray, cells: Cells, counts: Int32Array) -> None:
    voxels = np.empty(_BLOCK, np.int32)
    for place in range(len(poses)):
        pose = pose_of(poses, place)
        for begin in range(0, points.shape[1], _BLOCK):
            end = min(begin + _BLOCK, points.shape[1])
            # Slices, because Numba looks for negative values of another index: not vectorised then.
            xs, ys, zs = points[0, begin:end], points[1, begin:end], points[2, begin:end]
            if cells.cylindrical:
                for i in range(len(xs)):
                    x, y, z = transform(pose, xs[i], ys[i], zs[i])
                    voxels[i] = find_voxel(x, y, z, cells)
            else:
                for i in range(len(xs)):
                    x, y, z = transform(pose, xs[i], ys[i], zs[i])
                    voxels[i] = find_in_box(x, y, z, cells)
            for voxel in voxels[: len(xs)]:
                if voxel < len(counts):
                    counts[voxel] += 1


@cached
def find_crossing(
    points: Float32Array,
    order: Int32Array,
    azimuth: Uint16Array,
    ends: IntArray,
    poses: FloatArray,
    box: FloatArray,
    turn: int,
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return the (M,) rays that intersect a box, the (K,) index after the last one of each origin,
    and (M, 3) where these rays end, metres, frame of the box.

    Args:
        points: (N, 3) metres, from the origins of the rays.
        order: (N,) the rays of each origin by increasing azimuth.
        azimuth: (N,) their azimuths, in steps.
        ends: (K,) index after the last ray of each origin.
        poses: (K, 12), from the frame at each origin to that in which the box is axis-aligned.
        box: (2, 3) lower and upper corner, metres.
        turn: number of steps of azimuth in a turn.
    """
    found = np.empty(len(points), np.int64)
    places = np.empty((len(points), 3))
    count = 0
    reached = np.empty(len(ends), np.int64)
    begin = 0
    for k in range(len(ends)):
        pose = pose_of(poses, k)
        own = azimuth[begin : ends[k]]
        middle, half = _seen_from(pose, box)
        # all rays, if the corners surround the origin
        low = 0.0
        high = turn - 1.0
        if half <= math.pi / 2:
            to_steps = turn / (2 * math.pi)
            low = math.floor((middle - half + math.pi) * to_steps) - 1.0
            high = math.ceil((middle + half + math.pi) * to_steps) + 1.0
        for more in (-turn, 0, turn):  # a full circle has an azimuth at both ends
            first = begin + np.searchsorted(own, low + more)
            for i in range(first, begin + np.searchsorted(own, high + more + 1.0)):
                x, y, z = points[order[i]]
                end = transform(pose, np.float64(x), np.float64(y), np.float64(z))
                if _intersects(end, pose, box):
                    found[count] = order[i]
                    places[count, 0], places[count, 1], places[count, 2] = end
                    count += 1
        begin = ends[k]
        reached[k] = count
    return found[:count], reached, places[:count]


@jit
def _seen_from(pose: Pose, box: FloatArray) -> tuple[float, float]:
    """Return the middle and half the width of the range of azimuths that a box covers, radians,
    from the origin of a frame; the width is infinite if the origin is above, below or inside.

    Args:
        pose: box_T_origin.
        box: (2, 3) lower and upper corner.
    """
    if box[0, 0] < pose[3] < box[1, 0] and box[0, 1] < pose[7] < box[1, 1]:
        return 0.0, math.inf
    angles = np.empty(8)
    sine = 0.0
    cosine = 0.0
    half = 0.0
    for corner in range(8):
        x = box[corner & 1, 0] - pose[3]
        y = box[corner >> 1 & 1, 1] - pose[7]
        z = box[corner >> 2, 2] - pose[11]
        along = pose[0] * x + pose[4] * y + pose[8] * z
        angles[corner] = math.atan2(pose[1] * x + pose[5] * y + pose[9] * z, along)
        sine = sine + math.sin(angles[corner])
        cosine = cosine + math.cos(angles[corner])
    middle = math.atan2(sine, cosine)
    for angle in angles:
        half = max(half, abs((angle - middle + math.pi) % (2 * math.pi) - math.pi))
    return middle, half + 1e-6


@jit
def _intersects(end: Triple, pose: Pose, box: FloatArray) -> bool:
    """Return whether a ray intersects a box, from the origin of a pose to its end."""
    enter = -math.inf
    leave = math.inf
    for axis in range(3):
        origin = pose[4 * axis + 3]
        along = end[axis] - origin
        one = (box[0, axis] - origin) / along
        other = (box[1, axis] - origin) / along
        # A ray in the plane of a face gives 0/0: fmin and fmax ignore the NaN.
        enter = max(enter, np.fmin(one, other))
        leave = min(leave, np.fmax(one, other))
    return (enter <= leave) & (leave >= 0.0) & (enter <= 1.0)


def warped_voxels(
    points: AnyFloatArray, spec: GridSpec, warps: FloatArray, later_s: float = 0.0
) -> IntArray:
    """Return (W, N) voxels of (N, 3) points under (W, 3, 5) maps p' = A p + b + c dt, as columns A,
    b, c, where `later_s` is dt in seconds; outside, the number of voxels.
    """
    voxels = np.empty((len(warps), len(points)), np.int64)
    _find_warped(points, np.ascontiguousarray(warps), later_s, Cells.of(spec), voxels)
    return voxels


@cached
def _find_warped(points, maps, later_s, cells, voxels):  # type: ignore[no-untyped-def]
    for w in range(len(maps)):
        m = maps[w]
        for i in range(len(points)):
            x = points[i, 0]
            y = points[i, 1]
            z = points[i, 2]
            voxels[w, i] = find_voxel(
                m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3] + m[0, 4] * later_s,
                m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3] + m[1, 4] * later_s,
                m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3] + m[2, 4] * later_s,
                cells,
            )
