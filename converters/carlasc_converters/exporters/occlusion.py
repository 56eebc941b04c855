"""Occluded voxels: those that a sensor at the origin cannot see because of occupied voxels before them."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from carlasc.core.grids import GridSpec


def occluded_voxels(occupied: NDArray[np.bool_], spec: GridSpec) -> NDArray[np.bool_]:
    """Return the occupied voxels, and the voxels whose line to the sensor passes through an occupied one.

    The line goes from the centre of a voxel to the sensor, which is at the origin, from voxel to voxel (Amanatides and Woo 1987).
    It ends at the sensor, or where it leaves the grid.

    Args:
        occupied: (X, Y, Z) bool.
        spec: geometry of the grid, Cartesian.

    Returns:
        (X, Y, Z) bool.
    """
    sensor = -np.array(spec.lower) / spec.voxel_size
    occluded: NDArray[np.bool_] = _occlude(np.ascontiguousarray(occupied), sensor)
    return occluded


@numba.njit(cache=True)
def _occlude(occupied: NDArray[np.bool_], sensor: NDArray[np.float64]) -> NDArray[np.bool_]:
    occluded = np.zeros(occupied.shape, np.bool_)
    for x in range(occupied.shape[0]):
        for y in range(occupied.shape[1]):
            for z in range(occupied.shape[2]):
                occluded[x, y, z] = _meets(occupied, sensor, x, y, z)
    return occluded


@numba.njit(cache=True)
def _meets(occupied: NDArray[np.bool_], sensor: NDArray[np.float64], x: int, y: int, z: int) -> bool:
    """Return whether the line from a voxel to the sensor meets an occupied voxel. Coordinates are in voxels."""
    cell = (x, y, z)
    rx, ry, rz = sensor[0] - x - 0.5, sensor[1] - y - 0.5, sensor[2] - z - 0.5
    sx, sy, sz = (1 if rx > 0 else -1), (1 if ry > 0 else -1), (1 if rz > 0 else -1)
    # Per axis: the fraction of the line between two faces (d), and the fraction at which the next face comes (t).
    # The first face is half a voxel away.
    dx = 1 / abs(rx) if rx != 0 else np.inf
    dy = 1 / abs(ry) if ry != 0 else np.inf
    dz = 1 / abs(rz) if rz != 0 else np.inf
    tx, ty, tz = dx / 2, dy / 2, dz / 2
    while True:
        if occupied[cell[0], cell[1], cell[2]]:
            return True
        if tx <= ty and tx <= tz:
            if tx >= 1:
                return False
            x += sx
            tx += dx
        elif ty <= tz:
            if ty >= 1:
                return False
            y += sy
            ty += dy
        else:
            if tz >= 1:
                return False
            z += sz
            tz += dz
        if x < 0 or y < 0 or z < 0 or x >= occupied.shape[0] or y >= occupied.shape[1] or z >= occupied.shape[2]:
            return False
        cell = (x, y, z)
