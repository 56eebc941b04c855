"""The labels of the voxels in which points lie: what `validate`, `audit` and held-out scores count
is counted in them.
"""

from __future__ import annotations

import math

import numpy as np

from carlasc.core.arrays import AnyFloatArray, AnyIntArray, BoolArray, FloatArray, IntArray
from carlasc.core.cells import Cells, find_voxel
from carlasc.core.compiling import cached
from carlasc.core.grids import GridSpec

UNKNOWN, OUTSIDE = -1, -2
"""What `labels_at` returns for points in unknown voxels, and for points outside of the grid."""
_UNSHIFTED = np.zeros((1, 3), np.int64)


def labels_at(
    points: AnyFloatArray,
    spec: GridSpec,
    labels: AnyIntArray | BoolArray,
    known: BoolArray | None = None,
    *,
    warps: FloatArray | None = None,
    later_s: float = 0.0,
    shifts: IntArray = _UNSHIFTED,
) -> IntArray:
    """Return the labels of the voxels of points, under corrections of the points and of the grid.

    Args:
        points: (N, 3) metres, in the frame of the grid.
        spec: geometry of the grid.
        labels: (X, Y, Z) class ids, or whether a voxel is occupied.
        known: (X, Y, Z) known voxels; None for all.
        warps: (W, 3, 5) maps of points, p' = A p + b + c dt, as columns A, b, c; None for the
            points as they are.
        later_s: dt, seconds.
        shifts: (S, 3) cells by which the labels are too far along the axes. The azimuth of a full
            turn is periodic. A point whose shifted voxel is outside has that of no shift.

    Returns:
        (W, S, N) class ids, 0 is free; `UNKNOWN` in unknown voxels, and `OUTSIDE`.
    """
    values = labels.reshape(-1).astype(np.int64)
    if known is not None:
        values[~known.reshape(-1)] = UNKNOWN
    is_cylindrical = spec.coordinates == "cylindrical"
    full_turn = is_cylindrical and spec.upper[1] - spec.lower[1] > 2 * math.pi - 1e-3
    maps = np.eye(3, 5)[None] if warps is None else np.ascontiguousarray(warps)
    at_points = np.empty((len(maps), len(shifts), len(points)), np.int64)
    exact, moves, cells = points.astype(np.float64), warps is not None, Cells.of(spec)
    _look_up(exact, moves, maps, later_s, shifts, cells, full_turn, values, at_points)
    return at_points


@cached
def _look_up(  # type: ignore[no-untyped-def]
    points, moves, maps, later_s, shifts, cells, full_turn, values, at_points
):
    depth, width, height = cells.size
    for w in range(len(maps)):
        m = maps[w]
        for i in range(len(points)):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            if moves:  # a map that changes nothing would make -0.0 of an azimuth of -pi to 0.0
                x, y, z = (
                    m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3] + m[0, 4] * later_s,
                    m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3] + m[1, 4] * later_s,
                    m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3] + m[2, 4] * later_s,
                )
            voxel = find_voxel(x, y, z, cells)
            if voxel == len(values):
                at_points[w, :, i] = OUTSIDE
                continue
            for s in range(len(shifts)):
                a = voxel // (width * height) + shifts[s, 0]
                b = voxel // height % width + shifts[s, 1]
                c = voxel % height + shifts[s, 2]
                if full_turn:
                    b %= width
                inside = 0 <= a < depth and 0 <= b < width and 0 <= c < height
                at_points[w, s, i] = values[(a * width + b) * height + c if inside else voxel]
