"""SemanticKITTI data sets of a few random points, for tests that do not depend on the content of a
scan.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from helpers.datasets.kitti import write_calibration, write_poses, write_voxels

CLASSES = np.array([0, 10, 40, 50, 70, 72, 252, 254], np.uint32)


def write_tiny_kitti(
    root: Path,
    sequence: str = "00",
    frames: int = 3,
    *,
    labels: bool = True,
    voxels: bool = False,
    points: int = 60,
) -> Path:
    """Write one sequence and return its folder."""
    folder = root / "sequences" / sequence
    (folder / "velodyne").mkdir(parents=True)
    rng = np.random.default_rng(int(sequence))
    for frame in range(frames):
        scan = rng.uniform(-20, 20, (points, 4)).astype("<f4")
        scan.tofile(folder / "velodyne" / f"{frame:06d}.bin")
        if labels:
            classes = rng.choice(CLASSES, points)
            actors = np.where(classes >= 252, rng.integers(1, 4, points), 0).astype(np.uint32)
            write_labels(folder, frame, classes | actors << 16)
            if voxels:
                write_voxels(folder, frame, scan[:, :3], classes)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = np.arange(frames) * 0.5
    write_poses(folder / "poses.txt", poses)
    write_calibration(folder / "calib.txt")
    np.savetxt(folder / "times.txt", np.arange(frames) * 0.1)
    return folder


def write_labels(folder: Path, frame: int, labels: np.ndarray) -> None:
    (folder / "labels").mkdir(exist_ok=True)
    labels.astype("<u4").tofile(folder / "labels" / f"{frame:06d}.label")
