"""The labels of the voxels in which points lie: what `validate`, `audit` and held-out scores count
is counted in them.
"""

from __future__ import annotations

import math

import numpy as np

from carlasc.core.arrays import AnyFloatArray, AnyIntArray, BoolArray, FloatArray, IntArray
from carlasc.core.cells import warped_voxels
from carlasc.core.grids import GridSpec

UNKNOWN, OUTSIDE = -1, -2
"""What `labels_at` returns for points in unknown voxels, and for points outside of the grid."""


def labels_at(
    points: AnyFloatArray,
    spec: GridSpec,
    labels: AnyIntArray | BoolArray,
    known: BoolArray | None = None,
    *,
    warps: FloatArray | None = None,
    later_s: float = 0.0,
    shifts: IntArray | None = None,
) -> IntArray:
    """Return the labels of the voxels of points, under corrections of the points or of the grid.

    Args:
        points: (N, 3) metres, in the frame of the grid.
        spec: geometry of the grid.
        labels: (X, Y, Z) class ids, or whether a voxel is occupied.
        known: (X, Y, Z) known voxels; None for all.
        warps: (W, 3, 5) maps of points, p' = A p + b + c dt, as columns A, b, c.
        later_s: dt, seconds.
        shifts: (S, 3) cells by which the labels are too far along the axes. The azimuth of a full
            turn is periodic. A point whose shifted voxel is outside has that of no shift.

    Returns:
        (N,) class ids, (W, N) with warps, or (S, N) with shifts. 0 is free; `UNKNOWN` in unknown
        voxels, and `OUTSIDE`.
    """
    exact = points.astype(np.float64)
    values = np.append(labels.astype(np.int64), OUTSIDE)
    if known is not None:
        values[:-1][~known.reshape(-1)] = UNKNOWN
    if warps is None:
        voxels = spec.flat_index(exact)
        return values[voxels if shifts is None else _shifted(voxels, spec, shifts)]
    return values[warped_voxels(exact, spec, warps, later_s)]


def _shifted(voxels: IntArray, spec: GridSpec, shifts: IntArray) -> IntArray:
    """Return (S, N) the voxels that are some cells away from (N,) voxels."""
    cells = np.stack(np.unravel_index(np.maximum(voxels, 0), spec.size), axis=-1)
    moved = cells + shifts[:, None]
    if spec.coordinates == "cylindrical" and spec.upper[1] - spec.lower[1] > 2 * math.pi - 1e-3:
        moved[..., 1] %= spec.size[1]
    inside = (voxels >= 0) & ((moved >= 0) & (moved < spec.size)).all(axis=2)
    flat = np.ravel_multi_index(tuple(np.moveaxis(moved, 2, 0)), spec.size, mode="clip")
    return np.where(inside, flat, voxels)
