"""Masks of voxels to score, (X, Y, Z) bool, which can be combined with `&`; and separate scores by
distance, height, visibility and motion.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from carlasc.core.arrays import BoolArray
from carlasc.core.grids import Grid, GridSpec
from carlasc.core.scans import Scan
from carlasc.errors import ArgumentError
from carlasc.metrics.casting import cast_rays
from carlasc.metrics.confusion import ConfusionMatrix

Masks = Mapping[str, BoolArray]


def distance_band(spec: GridSpec, near_m: float = 0.0, far_m: float = math.inf) -> BoolArray:
    """Return the voxels whose centre is at a horizontal distance of `near_m <= r < far_m` from the
    sensor.

    Args:
        spec: geometry of the grid.
        near_m: inner radius of the band, metres.
        far_m: outer radius of the band, metres.

    Returns:
        A mask of shape (X, Y, Z).

    Raises:
        ArgumentError: `near_m` is negative, or `far_m` is not greater than `near_m`.
    """
    if not near_m >= 0:
        raise ArgumentError("near_m", expected="0 or more", found=f"{near_m:g}")
    if not far_m > near_m:
        raise ArgumentError(
            "far_m", expected=f"more than {near_m:g}, the value of `near_m`", found=f"{far_m:g}"
        )
    centers = spec.from_axes(spec.centers())
    distance = np.hypot(centers[..., 0], centers[..., 1])
    return np.asarray((distance >= near_m) & (distance < far_m))


def field_of_view(
    spec: GridSpec,
    horizontal_rad: float = 2 * math.pi,
    vertical_rad: tuple[float, float] = (-math.pi / 2, math.pi / 2),
) -> BoolArray:
    """Return the voxels whose centre is in the field of view of a sensor at the origin.

    Args:
        spec: geometry of the grid, in the sensor frame.
        horizontal_rad: horizontal opening angle, centred on the x axis (forward), radians; pi / 2
            for a camera of 90 degrees.
        vertical_rad: lowest and highest elevation, radians. The LiDAR of the data set has -25 to +2
            degrees.

    Raises:
        ArgumentError: `horizontal_rad` is not in (0, 2 pi], or the lowest elevation is not below
            the highest.
    """
    low, high = vertical_rad
    if not 0 < horizontal_rad <= 2 * math.pi:
        raise ArgumentError(
            "horizontal_rad", expected="an angle in (0, 2 pi]", found=f"{horizontal_rad:g}"
        )
    if not low < high:
        raise ArgumentError(
            "vertical_rad", expected="(lowest, highest) elevation", found=f"({low:g}, {high:g})"
        )
    x, y, z = np.moveaxis(spec.from_axes(spec.centers()), -1, 0)
    elevation = np.arctan2(z, np.hypot(x, y))
    seen = (
        (np.abs(np.arctan2(y, x)) <= horizontal_rad / 2) & (elevation >= low) & (elevation <= high)
    )
    return np.asarray(seen)


def distance_bands(spec: GridSpec, edges_m: Sequence[float] = (0, 10, 20, 30)) -> Masks:
    """Return a mask for each band of horizontal distance from the sensor, between consecutive
    edges, metres.
    """
    return {
        f"{near:g}-{far:g} m": distance_band(spec, near, far) for near, far in pairwise(edges_m)
    }


def height_bands(spec: GridSpec, edges_m: Sequence[float]) -> Masks:
    """Return a mask for each band of height of voxel centres, between consecutive edges, metres in
    the sensor frame.

    Raises:
        ArgumentError: the edges are not increasing.
    """
    if len(edges_m) < 2 or any(low >= high for low, high in pairwise(edges_m)):
        raise ArgumentError(
            "edges_m", expected="two or more increasing heights", found=list(edges_m)
        )
    height = spec.centers()[..., 2]
    return {
        f"{low:g}-{high:g} m up": (height >= low) & (height < high)
        for low, high in pairwise(edges_m)
    }


def visibility(truth: Grid, origin: ArrayLike = (0.0, 0.0, 0.0), *, free: int = 0) -> Masks:
    """Return masks of the voxels that are visible and hidden from the sensor in this frame,
    according to the true grid.

    A voxel is visible if no occupied voxel of the ground truth is between the sensor and the centre
    of the voxel. Hidden voxels are not observed by the scan of the frame, so a network has to
    complete them.

    Args:
        truth: the true grid, Cartesian.
        origin: (3,) metres, position of the sensor in the frame of the grid.
        free: id of free space.

    Returns:
        Masks "visible" and "hidden", (X, Y, Z) bool.
    """
    start = np.asarray(origin, np.float64)
    ways = truth.spec.centers().reshape(-1, 3) - start
    distance = np.linalg.norm(ways, axis=1)
    directions = ways / np.maximum(distance, 1e-9)[:, None]
    labels = np.where(truth.known, truth.labels, free)
    _, (depth,) = cast_rays(labels[None], truth.spec, start[None], directions, free=free)
    visible = (distance <= depth + 1e-6).reshape(truth.spec.size)
    return {"visible": visible, "hidden": ~visible}


def motion(truth: Grid, scan: Scan, movable: Sequence[int], *, min_speed_m_s: float = 0.3) -> Masks:
    """Return masks of the voxels of moving objects, and of movable objects at rest, from the flow
    of the scan of the frame.

    Args:
        truth: the true grid.
        scan: points of the frame with flow, in the frame of the grid.
        movable: ids of the classes that can move.
        min_speed_m_s: minimum speed of moving points, m/s.

    Returns:
        Masks "moving" and "standing", (X, Y, Z) bool. Voxels of movable classes without a point are
        in neither.

    Raises:
        ArgumentError: the scan has no flow.
    """
    if scan.flow is None:
        raise ArgumentError("scan", expected="points with flow", found="none")
    fast = np.linalg.norm(scan.flow, axis=1) >= min_speed_m_s
    voxel = truth.spec.flat_index(np.asarray(scan.points, np.float64))
    holds_fast, holds_slow = np.zeros((2, truth.spec.num_voxels), np.bool_)
    holds_fast[voxel[fast & (voxel >= 0)]] = True
    holds_slow[voxel[~fast & (voxel >= 0)]] = True
    may_move = np.isin(truth.labels, list(movable))
    moving = holds_fast.reshape(truth.spec.size) & may_move
    return {"moving": moving, "standing": holds_slow.reshape(truth.spec.size) & may_move & ~moving}


class Breakdown:
    """Accumulates one confusion matrix per region."""

    def __init__(self, num_classes: int, *, free: int = 0) -> None:
        self.num_classes = num_classes
        self.free = free
        self.matrices: dict[str, ConfusionMatrix] = {}

    def update(
        self,
        prediction: ArrayLike,
        truth: ArrayLike,
        masks: Masks,
        counted: ArrayLike | None = None,
    ) -> Self:
        """Add a frame: for each region, the scored voxels of its mask.

        Args:
            prediction: predicted classes, shape (X, Y, Z).
            truth: true classes, same shape.
            masks: mask of each region by name, bool, same shape.
            counted: mask of scored voxels, bool, same shape; None for all.
        """
        for name, mask in masks.items():
            inside = mask if counted is None else mask & np.asarray(counted, np.bool_)
            self._matrix(name).update(np.asarray(prediction), np.asarray(truth), inside)
        return self

    def compute(self) -> Mapping[str, ConfusionMatrix]:
        """Return the confusion matrix of each region by name."""
        return dict(self.matrices)

    def reset(self) -> None:
        """Set all sums to zero."""
        self.matrices = {}

    def merge(self, other: Breakdown) -> Self:
        """Add the matrices of another breakdown. Regions of only one of them are kept."""
        for name, matrix in other.matrices.items():
            self._matrix(name).merge(matrix)
        return self

    def _matrix(self, name: str) -> ConfusionMatrix:
        return self.matrices.setdefault(name, ConfusionMatrix(self.num_classes, free=self.free))
