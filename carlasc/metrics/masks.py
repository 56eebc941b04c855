"""Masks that say which voxels count: (X, Y, Z) bool, combined with `&`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError


def known(counts: NDArray[Any]) -> NDArray[np.bool_]:
    """Return the voxels that have votes (count > 0): the data set's own rule."""
    return counts > 0


def distance_band(spec: GridSpec, near_m: float = 0.0, far_m: float = math.inf) -> NDArray[np.bool_]:
    """Return the voxels whose centre is at a horizontal distance of `near_m <= r < far_m` from the sensor.

    Raises:
        ArgumentError: `near_m` is negative, or `far_m` is not greater than `near_m`.
    """
    if not near_m >= 0:
        raise ArgumentError("near_m", expected="0 or more", found=f"{near_m:g}")
    if not far_m > near_m:
        raise ArgumentError("far_m", expected=f"more than {near_m:g}, where the band starts", found=f"{far_m:g}")
    centers = spec.from_axes(spec.centers())
    distance = np.hypot(centers[..., 0], centers[..., 1])
    return np.asarray((distance >= near_m) & (distance < far_m))


def field_of_view(
    spec: GridSpec,
    horizontal_rad: float = 2 * math.pi,
    vertical_rad: tuple[float, float] = (-math.pi / 2, math.pi / 2),
) -> NDArray[np.bool_]:
    """Return the voxels whose centre is in the field of view of a sensor at the origin.

    Args:
        spec: the grid, in the sensor's frame.
        horizontal_rad: opening angle about the x axis (forward): a camera of 90 degrees is pi / 2.
        vertical_rad: lowest and highest elevation; the data set's LiDAR: -25 to +2 degrees.

    Raises:
        ArgumentError: `horizontal_rad` is not in (0, 2 pi], or the lowest elevation is not below the highest.
    """
    low, high = vertical_rad
    if not 0 < horizontal_rad <= 2 * math.pi:
        raise ArgumentError("horizontal_rad", expected="an angle in (0, 2 pi]", found=f"{horizontal_rad:g}")
    if not low < high:
        raise ArgumentError("vertical_rad", expected="(lowest, highest) elevation", found=f"({low:g}, {high:g})")
    x, y, z = np.moveaxis(spec.from_axes(spec.centers()), -1, 0)
    elevation = np.arctan2(z, np.hypot(x, y))
    seen = (np.abs(np.arctan2(y, x)) <= horizontal_rad / 2) & (elevation >= low) & (elevation <= high)
    return np.asarray(seen)
