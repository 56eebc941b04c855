"""A simulated drive as a sequence of SemanticKITTI."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from converters.formats.kitti_drive import KittiDrive, write_scan
from helpers.datasets.kitti import write_calibration, write_poses

from carlasc.testing.drives import KINDS

CLASSES = {
    "road": 40, "building": 50, "vegetation": 70, "pole": 80, "car": 252, "van": 18, "pedestrian": 254, "cyclist": 253,
}  # fmt: skip
"""Classes of what moves are those of moving objects; the van stands."""


def write_semantickitti(root: Path, drive: KittiDrive) -> Path:
    """Write a drive whose scans are instantaneous, and return the folder of the sequence."""
    folder = root / "sequences/00"
    lookup = np.array([CLASSES.get(kind, 0) for kind in KINDS], np.uint32)
    for frame in range(drive.frames):
        scan = drive.scan(frame)
        write_scan(folder / f"velodyne/{frame:06d}.bin", scan.points)
        (folder / "labels").mkdir(exist_ok=True)
        (lookup[scan.kinds] | scan.instances << 16).astype("<u4").tofile(
            folder / f"labels/{frame:06d}.label"
        )
    world = drive.world_T_lidar(drive.times)
    write_poses(folder / "poses.txt", np.linalg.inv(world[0]) @ world)
    write_calibration(folder / "calib.txt")
    np.savetxt(folder / "times.txt", drive.times)
    return folder
