"""A simulated drive in the layout of KITTI's tracking benchmark."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from converters.formats.kitti_drive import (
    KittiDrive,
    numbers,
    packets_of,
    write_packets,
    write_scan,
)

from carlasc.core.geometry import Transform, rotation_z, translation

TYPES = {"car": "Car", "van": "Van", "pedestrian": "Pedestrian", "cyclist": "Cyclist"}
LIDAR_T_IMU = translation((-0.81, 0.32, -0.8)) @ rotation_z(0.01)
RECTIFY = np.eye(4)
RECTIFY[:3, :3] = [[np.cos(0.01), 0, np.sin(0.01)], [0, 1, 0], [-np.sin(0.01), 0, np.cos(0.01)]]
CAMERA_T_LIDAR = np.array(
    [[0.0, -1, 0, 0.004], [0, 0, -1, -0.076], [1, 0, 0, -0.272], [0, 0, 0, 1]]
)
OFFICIAL, OTHER = (
    ("R_rect", "Tr_velo_cam", "Tr_imu_velo", ""),
    ("R0_rect", "Tr_velo_to_cam", "Tr_imu_to_velo", ":"),
)


def write_tracking(
    root: Path,
    drive: KittiDrive,
    labels: dict[str, int],
    *,
    first: int = 0,
    oxts: bool = True,
    names: tuple[str, str, str, str] = OTHER,
    sequence: str = "0000",
) -> Path:
    """Write a drive as a sequence of the training part, whose frames begin at `first`, and return
    the folder of the part.

    Args:
        labels: the class ids of `drive.boxes`, by kind: the names of their types are written.
        names: of the calibrations, and what follows a name.
    """
    folder = root / "training"
    for part in ("calib", "label_02", "oxts"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    camera_T_lidar = RECTIFY @ CAMERA_T_LIDAR
    types = {labels[kind]: TYPES[kind] for kind in TYPES}
    lines = []
    for frame in range(drive.frames):
        write_scan(
            folder / f"velodyne/{sequence}/{frame + first:06d}.bin", drive.scan(frame).points
        )
        boxes = drive.boxes(frame, labels)
        lines.append(
            f"{frame + first} -1 DontCare -1 -1 -10 219 188 245 218 -1000 -1000 -1000 -10 -1 -1 -1"
        )
        for track, label, size, pose in zip(
            boxes.tracks, boxes.labels, boxes.sizes, boxes.sensor_T_box, strict=True
        ):
            row = _row(camera_T_lidar @ pose, *size.tolist())
            lines.append(
                f"{frame + first} {track - 1} {types[int(label)]} 0 0 -1.78 282.2 178.4 409.7 "
                f"281.3 {row}"
            )
    (folder / f"label_02/{sequence}.txt").write_text("\n".join(lines) + "\n")
    rectify, to_camera, to_lidar, after = names
    (folder / f"calib/{sequence}.txt").write_text(
        "P2: 721.5 0 609.6 44.9 0 721.5 172.9 0.2 0 0 1 0.003\n"
        f"{rectify}{after} {' '.join(map(repr, RECTIFY[:3, :3].reshape(-1).tolist()))}\n"
        f"{to_camera}{after} {numbers(CAMERA_T_LIDAR)}\n{to_lidar}{after} {numbers(LIDAR_T_IMU)}\n"
    )
    if oxts:
        seconds = (np.arange(first + drive.frames) - first) * drive.drive.period_s
        packets = packets_of(drive.world_T_lidar(seconds) @ LIDAR_T_IMU)
        write_packets(folder / f"oxts/{sequence}.txt", packets)
    return folder


def _row(camera_T_box: Transform, length: float, width: float, height: float) -> str:
    x, y, z = camera_T_box[:3, 3].tolist()
    turn = float(np.arctan2(-camera_T_box[2, 0], camera_T_box[0, 0]))
    return " ".join(map(repr, (height, width, length, x, y + height / 2, z, turn)))
