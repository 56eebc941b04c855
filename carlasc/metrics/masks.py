"""Which voxels count. Masks are (X, Y, Z) bool and combine with `&`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.grids import GridSpec
from carlasc.core.tables import remap_named
from carlasc.errors import ArgumentError, FormatError


def known(counts: NDArray[Any]) -> NDArray[np.bool_]:
    """Return the voxels that somebody saw: count > 0, the data set's own rule."""
    return counts > 0


def semantickitti(labels: NDArray[np.integer], invalid: NDArray[Any] | None = None) -> NDArray[np.bool_]:
    """Return the voxels that SemanticKITTI's completion benchmark scores (FORMAT section 6).

    A raw 0 is empty and counts; a class outside the benchmark's 19 does not, nor does an invalid voxel.

    Args:
        labels: (X, Y, Z) raw SemanticKITTI ids.
        invalid: (X, Y, Z), non-zero where no merged scan saw the voxel.

    Raises:
        FormatError: an id that SemanticKITTI does not have, or shapes that differ.
    """
    scored = (labels == 0) | (remap_named("semantickitti19")(labels) != 0)
    if invalid is None:
        return scored
    if invalid.shape != labels.shape:
        raise FormatError("invalid voxels", expected=f"the labels' shape {labels.shape}", found=f"{invalid.shape}")
    return scored & (invalid == 0)


def distance_band(spec: GridSpec, near_m: float = 0.0, far_m: float = math.inf) -> NDArray[np.bool_]:
    """Return the voxels whose centre is at a horizontal distance of `near_m <= r < far_m` from the sensor.

    Raises:
        ArgumentError: an empty band.
    """
    if not 0 <= near_m < far_m:
        raise ArgumentError("distance band", expected="0 <= near < far", found=f"{near_m} and {far_m} m")
    centers = spec.from_axes(spec.centers())
    distance = np.hypot(centers[..., 0], centers[..., 1])
    return np.asarray((distance >= near_m) & (distance < far_m))


def field_of_view(
    spec: GridSpec,
    horizontal_rad: float = 2 * math.pi,
    vertical_rad: tuple[float, float] = (-math.pi / 2, math.pi / 2),
) -> NDArray[np.bool_]:
    """Return the voxels whose centre the sensor at the origin could look at.

    Args:
        spec: the grid, in the sensor's frame.
        horizontal_rad: opening angle about the x axis (forward): a camera of 90 degrees is pi / 2.
        vertical_rad: lowest and highest elevation; the data set's LiDAR: -25 to +2 degrees.

    Raises:
        ArgumentError: angles that open nothing.
    """
    low, high = vertical_rad
    if not (0 < horizontal_rad <= 2 * math.pi and low < high):
        raise ArgumentError(
            "field of view",
            expected="an angle in (0, 2 pi] and low < high",
            found=f"{horizontal_rad}, {low} and {high} rad",
        )
    x, y, z = np.moveaxis(spec.from_axes(spec.centers()), -1, 0)
    elevation = np.arctan2(z, np.hypot(x, y))
    seen = (np.abs(np.arctan2(y, x)) <= horizontal_rad / 2) & (elevation >= low) & (elevation <= high)
    return np.asarray(seen)
