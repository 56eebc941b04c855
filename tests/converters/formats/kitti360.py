"""A simulated drive as KITTI-360."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
from converters.formats.kitti_drive import KittiDrive, numbers, write_scan, write_stamps
from numpy.typing import NDArray

from carlasc.core.geometry import invert, rotation_z, translation
from carlasc.testing.drives import KINDS, MOVABLE, DriveScan

CLASSES = {
    "road": 7,
    "building": 11,
    "vegetation": 21,
    "pole": 17,
    "car": 26,
    "van": 27,
    "pedestrian": 24,
    "cyclist": 25,
}
CLASS_OF = np.array([CLASSES.get(kind, 0) for kind in KINDS], np.int32)
IMU_T_CAMERA = translation((1.57, 0.05, -0.1)) @ np.array(
    [[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
)
LIDAR_T_CAMERA = translation((0.77, 0.01, -0.12)) @ rotation_z(0.02) @ IMU_T_CAMERA
DRIVE = "2013_05_28_drive_0003_sync"
_STATIC = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
_STATIC += [("semantic", "<i4"), ("instance", "<i4"), ("visible", "u1")]
STATIC = np.dtype([*_STATIC, ("confidence", "<f4")])
DYNAMIC = np.dtype([*_STATIC, ("timestamp", "<i4"), ("confidence", "<f4")])
_TYPES = {"<f4": "float", "|u1": "uchar", "<i4": "int"}


def write_kitti360(
    root: Path,
    drive: KittiDrive,
    *,
    without_pose: Collection[int] = (),
    windows: Collection[tuple[int, int]] = (),
    name: str = DRIVE,
) -> Path:
    """Write a drive, and return the folder of its scans.

    Clouds are written for `windows`: their first and last frames.
    """
    scans, poses = root / "data_3d_raw" / name / "velodyne_points", root / "data_poses" / name
    for frame in range(drive.frames):
        write_scan(scans / f"data/{frame:010d}.bin", drive.scan(frame).points)
    write_stamps(scans / "timestamps.txt", drive.times)
    poses.mkdir(parents=True, exist_ok=True)
    world_T_imu = drive.world_T_lidar(drive.times) @ LIDAR_T_CAMERA @ invert(IMU_T_CAMERA)
    rows = [
        f"{frame} {numbers(pose)}\n"
        for frame, pose in enumerate(world_T_imu)
        if frame not in without_pose
    ]
    (poses / "poses.txt").write_text("".join(rows))
    (root / "calibration").mkdir(exist_ok=True)
    cameras = "".join(f"image_0{number}: {numbers(IMU_T_CAMERA)}\n" for number in range(4))
    (root / "calibration/calib_cam_to_pose.txt").write_text(cameras)
    (root / "calibration/calib_cam_to_velo.txt").write_text(f"{numbers(LIDAR_T_CAMERA)}\n")
    for window in windows:
        write_window(root / "data_3d_semantics/train" / name, drive, window)
    return scans


def instances_of(scan: DriveScan) -> NDArray[np.uint32]:
    """Return the instance of each point as KITTI-360 numbers it: 1000 * class + number."""
    classes = CLASS_OF[scan.kinds].astype(np.uint32)
    return np.where(scan.instances > 0, classes * 1000 + scan.instances, 0).astype(np.uint32)


def write_window(folder: Path, drive: KittiDrive, window: tuple[int, int]) -> None:
    """Write the clouds of a window: everything that stands, and, with its frame, everything that
    moves.
    """
    movable = [thing for thing in drive.drive.things if thing.kind in MOVABLE]
    moving = np.array([False, *(thing.speed != 0 for thing in movable)])
    parts: dict[str, list[NDArray[np.void]]] = {"static": [], "dynamic": []}
    for frame in range(window[0], min(window[1], drive.frames - 1) + 1):
        scan = drive.scan(frame)
        rows = np.zeros(len(scan.points), DYNAMIC)
        places = np.einsum(
            "nij,nj->ni", scan.world_T_sensor[:, :3, :3], scan.points[:, :3].astype(np.float64)
        )
        for axis, values in zip("xyz", (places + scan.world_T_sensor[:, :3, 3]).T, strict=True):
            rows[axis] = values
        classes = CLASS_OF[scan.kinds]
        rows["semantic"] = classes
        rows["instance"] = np.where(scan.instances > 0, instances_of(scan), classes * 1000)
        rows["timestamp"] = frame
        moves = moving[scan.instances]
        parts["dynamic"].append(rows[moves])
        parts["static"].append(rows[~moves][list(STATIC.names or ())])
    for kind, dtype in (("static", STATIC), ("dynamic", DYNAMIC)):
        rows = np.concatenate(parts[kind])
        packed = np.zeros(len(rows), dtype)
        for column in dtype.names or ():
            packed[column] = rows[column]
        write_ply(folder / kind / f"{window[0]:010d}_{window[1]:010d}.ply", packed)


def write_ply(path: Path, rows: NDArray[np.void]) -> None:
    names = rows.dtype.names or ()
    properties = "".join(f"property {_TYPES[rows.dtype[name].str]} {name}\n" for name in names)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(header.encode() + rows.tobytes())
