"""Odometry: the poses of scans, estimated by KISS-ICP (Vizzo et al., RA-L 2023) through its Python API."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import invert
from carlasc.errors import ArgumentError, import_extra

MIN_POINTS = 100  # scans with fewer points do not determine the motion
_GROUND_M, _NEAR_M = 1.5, 8.0  # points this far below the sensor, and farther away than this, are ground


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

    Scans are not deskewed: CarlaSC's are instantaneous, and SemanticKITTI's are deskewed already. Far ground is left out, because its
    rings move with the sensor and hide the first metres of a drive. On a straight street without structure the distance driven is
    not determined, and the estimate is too short.

    Args:
        scans: (N, 3) points of each scan, metres, sensor frame, right-handed or left-handed; the poses are in the same frame.
        max_range_m: farther points are not used.
        min_range_m: nearer points are not used.
        voxel_size_m: voxel size of the map; None for a hundredth of the range, as in KISS-ICP.
        total: number of scans, for `progress`.
        progress: called with the number of finished scans and the number of all scans.

    Returns:
        (F, 4, 4) first_T_sensor.

    Raises:
        DependencyError: kiss-icp is not installed.
        ArgumentError: one of several scans has fewer than `MIN_POINTS` points.
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
        if number and min(sizes) < MIN_POINTS:  # a single scan has not moved, however few points it has
            raise ArgumentError(
                "scans",
                expected=f"at least {MIN_POINTS} points in every scan",
                found=f"{min(sizes)} in scan {sizes.index(min(sizes))}",
                advice="leave it out",
            )
        used = (points[:, 2] > -_GROUND_M) | (np.hypot(points[:, 0], points[:, 1]) < _NEAR_M)
        odometry.register_frame(np.ascontiguousarray(points[used, :3], np.float64), np.zeros(0))
        poses.append(np.array(odometry.last_pose))
        if progress:
            progress(number + 1, total or number + 1)
    return invert(poses[0]) @ np.stack(poses) if poses else np.empty((0, 4, 4))
