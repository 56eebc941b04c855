"""Compiled code that turns scans into dense arrays: it transforms, bins and counts points in one
pass, and maps labels in another.

The result is equal to that of `GridSpec` (`to_axes`, `index`). Points for which the fast arithmetic
may be wrong are binned by the exact rule. A scan is processed in blocks that fit into the CPU
cache: the columns are split first, and the other steps vectorise. Importing this module loads
Numba.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import numba
import numpy as np
from numpy.typing import NDArray

from carlasc.core.arrays import AnyArray, Float32Array, FloatArray, Int32Array, LabelArray
from carlasc.core.cells import AZIMUTH_ERROR, Cells, fast_azimuth, find_voxel
from carlasc.core.compiling import cached
from carlasc.core.grids import GridSpec

_BLOCK = 128  # points per block: their columns and cells take 6 KB of the first-level cache


def stack_scans(
    scans: Sequence[Float32Array | None],
    grid_T_scans: FloatArray,
    spec: GridSpec,
    what: Literal["occupancy", "density"] = "occupancy",
    min_range_m: float | None = None,
    max_range_m: float | None = None,
) -> AnyArray:
    """Bin scans into a stack of grids.

    Args:
        scans: T scans, each (N, 3) or (N, 4) float32 metres in its own sensor frame, as rows or as
            the transpose of contiguous x, y and z; None gives an empty grid.
        grid_T_scans: (T, 4, 4) transforms from the frame of each scan to the frame of the grid.
        spec: the grid.
        what: "occupancy" marks voxels with a point, "density" counts points per voxel.
        min_range_m: points nearer to their sensor than this are left out; None keeps all.
        max_range_m: points farther from their sensor than this are left out; None keeps all.

    Returns:
        (T, X, Y, Z) uint8 0 or 1, or int32 number of points per voxel.
    """
    stack = np.zeros((len(scans), *spec.size), np.uint8 if what == "occupancy" else np.int32)
    cells = Cells.of(spec)
    geometry = _geometry(spec)
    ranges = (min_range_m or 0.0, math.inf if max_range_m is None else float(max_range_m))
    rows = grid_T_scans[:, :3].reshape(-1, 12).tolist()
    for grid, points, row in zip(stack.reshape(len(scans), -1), scans, rows, strict=True):
        if points is not None and len(points):
            planes = points[:, :3].T
            if (
                planes.flags.aligned
                and planes.strides[1] == planes.itemsize
                and points.dtype == np.float32
            ):
                x, y, z = map(_read_only, planes)
                _bin_planes(x, y, z, tuple(row), cells, geometry, ranges, grid)
            else:
                _bin_rows(_as_words(points), tuple(row), cells, geometry, ranges, grid)
    return stack


def look_up(labels: LabelArray, table: Int32Array, dtype: np.dtype[Any]) -> AnyArray | None:
    """Return `table[labels]` as `dtype`, with the shape of `labels`; None if a label is not in the
    table (after its end, or its value is -1).
    """
    mapped = np.empty(labels.shape, dtype)
    flat = np.ascontiguousarray(labels).reshape(-1)
    return mapped if _look_up(_read_only(flat), table, mapped.reshape(-1)) else None


def _geometry(spec: GridSpec) -> tuple[Any, ...]:
    """Return the constants of the fast arithmetic: lower bounds, cells per metre or radian, sizes,
    and its maximum error in cells.
    """
    voxel = spec.voxel_size
    sizes = tuple(float(n) for n in spec.size)
    # 1e-6: rounding of a product and a difference of float64. 1e-7 a cell: voxel_size is a float32
    # difference, whose multiple is off from the bounds by up to 6e-8 of the size of the grid.
    doubt = 1e-6 + 1e-7 * max(sizes)
    doubt += AZIMUTH_ERROR / float(voxel[1]) if spec.coordinates == "cylindrical" else 0.0
    return spec.lower, tuple(1.0 / voxel), sizes, doubt


def _as_words(points: Float32Array) -> NDArray[np.uint64]:
    """Return the bytes of the points as (2 N,) words: x and y in one, z and the fourth number in
    the next.
    """
    if points.shape[1] != 4:
        points = np.column_stack([points[:, :3], np.zeros(len(points), np.float32)])
    words = np.ascontiguousarray(points, np.float32).reshape(-1).view(np.uint64)
    return _read_only(words if words.flags.aligned else words.copy())


def _read_only(array: AnyArray) -> AnyArray:
    """Return a read-only view, the only array type for which the kernels are compiled."""
    if array.flags.writeable:
        array = array.view()
        array.flags.writeable = False
    return array


# inlined into the loop over blocks, which does not vectorise otherwise
_step = numba.njit(nogil=True, inline="always")


@_step
def _split_columns(words, x, y, z):  # type: ignore[no-untyped-def]
    """Split points into x, y and z.

    Reading two 64-bit words per point vectorises; reading four floats does not.
    """
    # on little-endian machines the first of two numbers is in the lower half of its word
    for n in range(len(words) // 2):
        xy = words[2 * n]
        zw = words[2 * n + 1]
        x[n] = np.uint32(xy).view(np.float32)
        y[n] = np.uint32(xy >> np.uint64(32)).view(np.float32)
        z[n] = np.uint32(zw).view(np.float32)


@_step
def _leave_out(x, y, z, count, near_squared, far_squared):  # type: ignore[no-untyped-def]
    # A point is not removed, because blocks of a fixed length vectorise: NaN compares as false with
    # every bound, through the transform too, so that it is in no cell.
    for n in range(count):
        squared = x[n] * x[n] + y[n] * y[n] + z[n] * z[n]
        if squared < near_squared or squared > far_squared:
            x[n] = np.nan


@_step
def _move(x, y, z, count, rows):  # type: ignore[no-untyped-def]
    r00, r01, r02, t0, r10, r11, r12, t1, r20, r21, r22, t2 = rows
    for n in range(count):
        a = x[n]
        b = y[n]
        c = z[n]
        x[n] = a * r00 + b * r01 + c * r02 + t0
        y[n] = a * r10 + b * r11 + c * r12 + t1
        z[n] = a * r20 + b * r21 + c * r22 + t2


@_step
def _to_cylindrical(x, y, count, lower, upper, radius, azimuth):  # type: ignore[no-untyped-def]
    """Write the radius, and the azimuth within AZIMUTH_ERROR: `arctan2` does not vectorise."""
    for n in range(count):
        squared = x[n] * x[n] + y[n] * y[n]
        angle = fast_azimuth(x[n], y[n])
        # the grid may begin at any azimuth, such as 0 or -pi: one turn leads into its interval
        turned = (
            angle + 2 * np.pi if angle < lower else (angle - 2 * np.pi if angle >= upper else angle)
        )
        angle = turned if (turned >= lower) & (turned < upper) else angle
        # a point at the origin is on an edge, so the exact rule decides
        azimuth[n] = angle if squared > 0 else lower
        radius[n] = np.sqrt(squared)


@_step
def _find_cells(x, y, z, count, geometry, cells):  # type: ignore[no-untyped-def]
    """Write the flat voxel index of each point on the axes of the grid: -1 outside, -2 if it is
    uncertain.

    Three divisions per point would take half of the time. The code multiplies instead, and marks
    points near the edge of a cell as uncertain.
    """
    (l0, l1, l2), (w0, w1, w2), (s0, s1, s2), doubt = geometry
    clear = 0.5 - doubt
    doubtful = 0
    for n in range(count):
        # in cells from the lower corner of the grid; a point in doubt is at most `doubt` off
        a = (x[n] - l0) * w0
        b = (y[n] - l1) * w1
        c = (z[n] - l2) * w2
        i = np.floor(a)
        j = np.floor(b)
        k = np.floor(c)
        inside = (i >= 0) & (i < s0) & (j >= 0) & (j < s1) & (k >= 0) & (k < s2)
        # nearer than `doubt` to a face of its cell; outside of the grid too, since the exact rule
        # may put such a point into the outermost cell. `|`, not `or`: branches do not vectorise.
        edge = (
            (np.abs(a - i - 0.5) > clear)
            | (np.abs(b - j - 0.5) > clear)
            | (np.abs(c - k - 0.5) > clear)
        )
        doubtful += edge
        cell = (i * s1 + j) * s2 + k if inside else -1.0
        cells[n] = np.int32(-2.0 if edge else cell)
    return doubtful


@_step
def _mark(cells, count, grid):  # type: ignore[no-untyped-def]
    """Mark (uint8) or count (int32) the points of each voxel."""
    if grid.itemsize == 1:
        for n in range(count):
            if cells[n] >= 0:
                grid[cells[n]] = 1
    else:
        for n in range(count):
            if cells[n] >= 0:
                grid[cells[n]] += 1


@_step
def _bin_block(  # type: ignore[no-untyped-def]
    x, y, z, radius, azimuth, voxels, count, rows, cells, geometry, ranges, grid
):
    near, far = ranges
    # before the transform, because ranges are measured from the sensor of the scan
    if near > 0.0 or far < np.inf:
        _leave_out(x, y, z, count, near * near, far * far)
    _move(x, y, z, count, rows)
    if cells.cylindrical:
        _to_cylindrical(x, y, count, cells.lower[1], cells.upper[1], radius, azimuth)
        doubtful = _find_cells(radius, azimuth, z, count, geometry, voxels)
    else:
        doubtful = _find_cells(x, y, z, count, geometry, voxels)
    # Few blocks have a doubtful point, so that this loop, which does not vectorise, rarely runs. It
    # takes x and y, not radius and azimuth: those have the error of the fast azimuth.
    for n in range(count if doubtful else 0):
        if voxels[n] == -2:
            voxel = find_voxel(x[n], y[n], z[n], cells)
            voxels[n] = voxel if voxel < len(grid) else -1
    # here every entry is -1 or an index of the grid, as the exact rule has it
    _mark(voxels, count, grid)


@cached
def _bin_rows(words, rows, cells, geometry, ranges, grid):  # type: ignore[no-untyped-def]
    # the same buffers for all blocks: they stay in the first-level cache
    x = np.empty(_BLOCK)
    y = np.empty(_BLOCK)
    z = np.empty(_BLOCK)
    radius = np.empty(_BLOCK)
    azimuth = np.empty(_BLOCK)
    voxels = np.empty(_BLOCK, np.int32)
    for start in range(0, len(words), 2 * _BLOCK):
        block = words[start : start + 2 * _BLOCK]
        _split_columns(block, x, y, z)
        _bin_block(
            x, y, z, radius, azimuth, voxels, len(block) // 2, rows, cells, geometry, ranges, grid
        )


@cached
def _bin_planes(xs, ys, zs, rows, cells, geometry, ranges, grid):  # type: ignore[no-untyped-def]
    x = np.empty(_BLOCK)
    y = np.empty(_BLOCK)
    z = np.empty(_BLOCK)
    radius = np.empty(_BLOCK)
    azimuth = np.empty(_BLOCK)
    voxels = np.empty(_BLOCK, np.int32)
    for start in range(0, len(xs), _BLOCK):
        end = start + _BLOCK
        block_x = xs[start:end]
        block_y = ys[start:end]
        block_z = zs[start:end]
        count = len(block_x)
        # copied although they are contiguous: the steps work in place and in float64
        for n in range(count):
            x[n] = block_x[n]
            y[n] = block_y[n]
            z[n] = block_z[n]
        _bin_block(x, y, z, radius, azimuth, voxels, count, rows, cells, geometry, ranges, grid)


@cached(error_model="python")
def _look_up(labels, table, mapped):  # type: ignore[no-untyped-def]
    size = len(table)
    complete = True
    for n in range(len(labels)):
        label = labels[n]
        if label >= size or table[label] < 0:
            complete = False
        else:
            mapped[n] = table[label]
    return complete
