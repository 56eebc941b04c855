"""Poses from scans alone: KISS-ICP (Vizzo et al., RA-L 2023), through its own Python API."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import invert
from carlasc.errors import ArgumentError, import_extra

MIN_POINTS = 100  # fewer say nothing about the motion
_GROUND_M, _NEAR_M = 1.5, 8.0  # far points so deep below the sensor are ground


def estimate_poses(
    scans: Iterable[NDArray[np.floating]],
    *,
    max_range_m: float = 100.0,
    min_range_m: float = 0.0,
    voxel_size_m: float | None = None,
    total: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> NDArray[np.float64]:
    """Estimate the pose of every scan of a drive, in order.

    Scans are taken as instantaneous (no deskewing): so CarlaSC's are, and SemanticKITTI's are deskewed. Far ground is left out: its
    rings move along with the sensor and hide the first metres of a drive. On a plain straight street nothing tells how far one has
    driven, and the estimate slips.

    Args:
        scans: (N, 3) points each, metres, sensor frame; right-handed or left-handed, the poses are in the same frame.
        max_range_m: farther points are not used.
        min_range_m: nearer points are not used.
        voxel_size_m: of the map; None takes a hundredth of the range, as KISS-ICP does.
        total: number of scans, for the progress.
        progress: called with the number of finished scans and of all.

    Returns:
        (F, 4, 4) first_T_sensor.

    Raises:
        DependencyError: kiss-icp is not installed.
        ArgumentError: a scan of several has hardly any points.
    """
    pipeline: Any = import_extra("kiss_icp.kiss_icp", "kitti")
    config: Any = import_extra("kiss_icp.config", "kitti").KISSConfig()
    config.data.deskew = False
    config.data.max_range, config.data.min_range = max_range_m, min_range_m
    config.mapping.voxel_size = voxel_size_m if voxel_size_m is not None else max_range_m / 100.0
    odometry = pipeline.KissICP(config)
    poses: list[NDArray[np.float64]] = []
    sizes: list[int] = []
    for number, points in enumerate(scans):
        sizes.append(len(points))
        if number and min(sizes) < MIN_POINTS:  # a scan alone has moved nowhere, however few its points
            raise ArgumentError(
                "odometry",
                expected=f"at least {MIN_POINTS} points in every scan",
                found=f"{min(sizes)} in scan {sizes.index(min(sizes))}",
                advice="leave it out",
            )
        standing = (points[:, 2] > -_GROUND_M) | (np.hypot(points[:, 0], points[:, 1]) < _NEAR_M)
        odometry.register_frame(np.ascontiguousarray(points[standing, :3], np.float64), np.zeros(0))
        poses.append(np.array(odometry.last_pose))
        if progress:
            progress(number + 1, total or number + 1)
    return invert(poses[0]) @ np.stack(poses) if poses else np.empty((0, 4, 4))
