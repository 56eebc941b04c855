"""Scans to dense arrays, fast: moved, binned and counted in one pass of compiled code, and labels looked up in another.

The rules are those of `GridSpec` (`to_axes`, `index`) in the same float64 arithmetic, so every voxel is the same. A scan is
worked through in blocks that stay in the cache: the columns are split, and the rest vectorises. Loading this module loads Numba.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import numba
import numpy as np
from numpy.typing import NDArray

from carlasc.geometry import Transform
from carlasc.grids import GridSpec

_BLOCK = 256  # points at once: their float64 columns and cells take 7 KB of the first-level cache
_EDGE = 0.5 - 1e-6  # a product with 1 / voxel_size is off by less than 1e-6 cells: nearer to an edge, divide


def stack_scans(
    scans: Sequence[NDArray[np.float32] | None],
    grid_T_scans: NDArray[np.float64],
    spec: GridSpec,
    what: Literal["occupancy", "density"] = "occupancy",
    min_range_m: float | None = None,
    max_range_m: float | None = None,
) -> NDArray[Any]:
    """Bin scans into a stack of grids.

    Args:
        scans: T scans, each (N, 3) or (N, 4) float32 metres in its own sensor frame; None leaves its grid empty.
        grid_T_scans: (T, 4, 4) transforms from each scan's frame to the grid's.
        spec: the grid.
        what: "occupancy" marks voxels that hold a point, "density" counts their points (65535 at most).
        min_range_m: points nearer to their own sensor are left out; None keeps all.
        max_range_m: points farther from it are left out; None keeps all.

    Returns:
        (T, X, Y, Z) uint8 0 or 1, or uint16 points a voxel.
    """
    stack = np.zeros((len(scans), *spec.size), np.uint8 if what == "occupancy" else np.uint16)
    geometry = _geometry(spec)
    ranges = (min_range_m or 0.0, math.inf if max_range_m is None else float(max_range_m))
    for grid, points, grid_T_scan in zip(stack, scans, grid_T_scans, strict=True):
        if points is not None and len(points):
            _bin_scan(_as_words(points), _rows(grid_T_scan), geometry, ranges, grid.reshape(-1))
    return stack


def look_up(labels: NDArray[np.unsignedinteger], table: NDArray[np.int32], dtype: np.dtype[Any]) -> NDArray[Any] | None:
    """Return `table[labels]` as `dtype`, or None if a label is not in the table (beyond its end, or -1 there)."""
    found = np.empty(labels.shape, dtype)
    flat = np.ascontiguousarray(labels).reshape(-1)
    return found if _look_up(_read_only(flat), table, found.reshape(-1)) else None


def _geometry(spec: GridSpec) -> tuple[Any, ...]:
    voxel = spec.voxel_size
    sizes = tuple(float(n) for n in spec.size)
    return spec.lower, spec.upper, tuple(voxel), tuple(1.0 / voxel), sizes, spec.coordinates == "cylindrical"


def _rows(transform: Transform) -> tuple[float, ...]:
    return tuple(transform[:3].ravel().tolist())


def _as_words(points: NDArray[np.float32]) -> NDArray[np.uint64]:
    """Return the bytes of the points as (2 N,) words, x and y in one, z and a fourth number in the next."""
    if points.shape[1] != 4:
        points = np.column_stack([points[:, :3], np.zeros(len(points), np.float32)])
    words = np.require(points, np.float32, "C").reshape(-1).view(np.uint64)
    return _read_only(np.require(words, requirements="A"))


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    view = array.view()
    view.flags.writeable = False
    return view


_step = numba.njit(nogil=True, inline="always")  # pasted into the loop over blocks: only there does it vectorise


@_step
def _split_columns(words, x, y, z):  # type: ignore[no-untyped-def]
    """Take x, y and z of each point apart: two 64-bit words a point vectorise, four floats do not."""
    for n in range(len(words) // 2):
        xy, zw = words[2 * n], words[2 * n + 1]
        x[n] = np.uint32(xy).view(np.float32)
        y[n] = np.uint32(xy >> np.uint64(32)).view(np.float32)
        z[n] = np.uint32(zw).view(np.float32)


@_step
def _leave_out(x, y, z, count, near_squared, far_squared):  # type: ignore[no-untyped-def]
    for n in range(count):
        squared = x[n] * x[n] + y[n] * y[n] + z[n] * z[n]
        if squared < near_squared or squared > far_squared:
            x[n] = np.nan  # not a number is inside no grid


@_step
def _move(x, y, z, count, rows):  # type: ignore[no-untyped-def]
    r00, r01, r02, t0, r10, r11, r12, t1, r20, r21, r22, t2 = rows
    for n in range(count):
        a, b, c = x[n], y[n], z[n]
        x[n] = a * r00 + b * r01 + c * r02 + t0
        y[n] = a * r10 + b * r11 + c * r12 + t1
        z[n] = a * r20 + b * r21 + c * r22 + t2


@_step
def _to_cylindrical(x, y, count, lower, upper):  # type: ignore[no-untyped-def]
    for n in range(count):
        azimuth = np.arctan2(y[n], x[n])
        turned = azimuth
        if azimuth < lower:
            turned = azimuth + 2 * np.pi
        elif azimuth >= upper:
            turned = azimuth - 2 * np.pi
        x[n] = np.sqrt(x[n] * x[n] + y[n] * y[n])
        y[n] = turned if lower <= turned < upper else azimuth


@_step
def _find_cells(x, y, z, count, geometry, cells):  # type: ignore[no-untyped-def]
    """Write the flat index of each point's voxel, -1 outside.

    Three divisions a point would take half the time: multiply instead, and divide only where the result is so near to a
    cell's edge that the rounding could matter.
    """
    (l0, l1, l2), (u0, u1, u2), (v0, v1, v2), (w0, w1, w2), (s0, s1, s2), _ = geometry
    edges = 0
    for n in range(count):
        a, b, c = x[n], y[n], z[n]
        inside = (a >= l0) & (a < u0) & (b >= l1) & (b < u1) & (c >= l2) & (c < u2)
        a, b, c = (a - l0) * w0, (b - l1) * w1, (c - l2) * w2
        i, j, k = np.floor(a), np.floor(b), np.floor(c)
        edge = (np.abs(a - i - 0.5) > _EDGE) | (np.abs(b - j - 0.5) > _EDGE) | (np.abs(c - k - 0.5) > _EDGE)
        i = i if i < s0 else s0 - 1.0
        j = j if j < s1 else s1 - 1.0
        k = k if k < s2 else s2 - 1.0
        edges += edge & inside
        cell = -2.0 if edge else (i * s1 + j) * s2 + k
        cells[n] = np.int32(cell if inside else -1.0)
    for n in range(count if edges else 0):
        if cells[n] == -2:
            i = min(np.floor((x[n] - l0) / v0), s0 - 1.0)
            j = min(np.floor((y[n] - l1) / v1), s1 - 1.0)
            k = min(np.floor((z[n] - l2) / v2), s2 - 1.0)
            cells[n] = np.int32((i * s1 + j) * s2 + k)


@_step
def _mark(cells, count, grid):  # type: ignore[no-untyped-def]
    """Mark (uint8) or count (uint16) the points of each voxel."""
    if grid.itemsize == 1:
        for n in range(count):
            if cells[n] >= 0:
                grid[cells[n]] = 1
    else:
        for n in range(count):
            if cells[n] >= 0 and grid[cells[n]] < 65535:
                grid[cells[n]] += 1


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _bin_scan(words, rows, geometry, ranges, grid):  # type: ignore[no-untyped-def]
    x, y, z = np.empty(_BLOCK), np.empty(_BLOCK), np.empty(_BLOCK)
    cells = np.empty(_BLOCK, np.int32)
    near, far = ranges
    for start in range(0, len(words), 2 * _BLOCK):
        block = words[start : start + 2 * _BLOCK]
        count = len(block) // 2
        _split_columns(block, x, y, z)
        if near > 0.0 or far < np.inf:
            _leave_out(x, y, z, count, near * near, far * far)
        _move(x, y, z, count, rows)
        if geometry[5]:
            _to_cylindrical(x, y, count, geometry[0][1], geometry[1][1])
        _find_cells(x, y, z, count, geometry, cells)
        _mark(cells, count, grid)


@numba.njit(nogil=True, cache=True)
def _look_up(labels, table, found):  # type: ignore[no-untyped-def]
    size = len(table)
    complete = True
    for n in range(len(labels)):
        label = labels[n]
        if label >= size or table[label] < 0:
            complete = False
        else:
            found[n] = table[label]
    return complete
