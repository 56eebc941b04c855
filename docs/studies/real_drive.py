"""A drive of KITTI's tracking benchmark, written as a sequence of the layout: for `real.py`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from carlasc import Boxes
from carlasc.core import CARLA, Transform, invert
from carlasc.motion.odometry import estimate_poses
from carlasc.storage import FolderSink, Metadata, layout

PERIOD_S = 0.1033  # of the drive's time stamps, which the archive does not have
RANGE_M = 50.0  # the archive's scans are cut to it
MIN_RANGE_M = 2.5  # some forty returns of every scan are on the roof of the recording car
FLOOR_M = 0.15  # points below this height in a box are taken for the ground
MARGIN_M = 0.1  # boxes are tight
_CLASSES = {
    "Car": 10,
    "Van": 10,
    "Truck": 10,
    "Tram": 10,
    "Pedestrian": 4,
    "Person": 4,
    "Person_sitting": 4,
    "Cyclist": 4,
}


def write_drive(archive: Path, out: Path, *, labelled: bool, poses: NDArray[np.float64] | None = None) -> None:
    """Write the drive as a sequence: right-handed axes, poses by KISS-ICP, frames with their own numbers.

    Args:
        archive: the folder of the unpacked archive.
        out: the sequence's folder is `out/cartesian`.
        labelled: whether boxes, and the labels and instances of the points in them, are written too. Other points are then of the
            class for geometry without labels.
        poses: (F, 4, 4) first_T_sensor, if they are known already.
    """
    scans = read_scans(archive)
    boxes = read_boxes(archive, list(scans)) if labelled else {}
    poses = find_poses(scans) if poses is None else poses
    with FolderSink(out).sequence("cartesian") as writer:
        writer.write_document(layout.POSES, layout.encode_poses(poses))
        writer.write_document(layout.TIMES, layout.encode_times(np.arange(len(poses), dtype=np.float64) * PERIOD_S))
        source = f"KITTI tracking 0000, frames {min(scans)} to {max(scans)}"
        metadata = Metadata("right", sensor="HDL-64E, 1.73 m above the ground", min_range_m=MIN_RANGE_M, source=source)
        writer.write_document(layout.METADATA, metadata.to_json())
        for frame, scan in scans.items():
            if labelled:
                labels, instances = label_points(scan[:, :3], boxes[frame])
                writer.write("labels", frame, labels)
                writer.write("instances", frame, instances)
                writer.write("boxes", frame, boxes[frame].to_table())
            writer.write("points", frame, scan)


def read_scans(archive: Path) -> dict[int, NDArray[np.float32]]:
    """Return (N, 4) points of each frame, without the one return of every scan that lies in the sensor."""
    scans = {}
    for file in sorted((archive / "training/velodyne/0000").glob("*.bin")):
        points = np.fromfile(file, np.float32).reshape(-1, 4)
        scans[int(file.stem)] = points[(points[:, :3] != 0).any(axis=1)]
    return scans


def find_poses(scans: Mapping[int, NDArray[np.float32]]) -> NDArray[np.float64]:
    """Return (F, 4, 4) first_T_sensor of the scans, in their order, by KISS-ICP; two runs differ by fractions of a millimetre."""
    return estimate_poses((scan[:, :3] for scan in scans.values()), max_range_m=RANGE_M, min_range_m=MIN_RANGE_M)


def read_boxes(archive: Path, frames: list[int]) -> dict[int, Boxes]:
    """Return the boxes of each frame, in the frame of the LiDAR. They are those in the view of the camera; tracks count from 1."""
    lidar_T_camera = invert(_camera_T_lidar(archive / "training/calib/0000.txt"))
    rows: dict[int, list[list[str]]] = {frame: [] for frame in frames}
    for line in (archive / "training/label_02/0000.txt").read_text().splitlines():
        row = line.split()
        if row[2] in _CLASSES and int(row[0]) in rows:
            rows[int(row[0])].append(row)
    return {frame: _boxes_of(found, lidar_T_camera) for frame, found in rows.items()}


def label_points(points: NDArray[np.float32], boxes: Boxes) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Return the class and the track of each point, by the box that it is in; points on the ground are in none."""
    labels = np.full(len(points), CARLA.geometry_only, np.uint32)
    instances = np.zeros(len(points), np.uint32)
    owners = boxes.owners(points, MARGIN_M)
    for row, pose in enumerate(boxes.sensor_T_box):
        own = np.flatnonzero(owners == row)
        height = (points[own] - pose[:3, 3]) @ pose[:3, 2] + boxes.sizes[row, 2] / 2
        own = own[height > FLOOR_M]
        labels[own], instances[own] = boxes.labels[row], boxes.tracks[row]
    return labels, instances


def _camera_T_lidar(file: Path) -> Transform:
    lines = (line.split() for line in file.read_text().splitlines() if line.strip())
    values = {name.rstrip(":"): np.array(numbers, np.float64) for name, *numbers in lines}
    rectify, lidar = np.eye(4), np.eye(4)
    rectify[:3, :3] = next(values[name] for name in ("R0_rect", "R_rect") if name in values).reshape(3, 3)
    lidar[:3] = next(values[name] for name in ("Tr_velo_to_cam", "Tr_velo_cam") if name in values).reshape(3, 4)
    return rectify @ lidar


def _boxes_of(rows: list[list[str]], lidar_T_camera: Transform) -> Boxes:
    """Return the boxes of a frame's lines: h, w, l, bottom centre (camera: x right, y down, z forward), turn about y."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    sizes = np.zeros((len(rows), 3))
    for pose, size, row in zip(poses, sizes, rows, strict=True):
        height, width, length, x, y, z, turn = map(float, row[10:17])
        forward, up = np.array([np.cos(turn), 0, -np.sin(turn)]), np.array([0.0, -1.0, 0.0])
        pose[:3, :3] = np.stack([forward, np.cross(up, forward), up], axis=1)
        pose[:3, 3] = x, y - height / 2, z
        size[:] = length, width, height
    tracks = np.array([int(row[1]) + 1 for row in rows], np.uint32)
    labels = np.array([_CLASSES[row[2]] for row in rows], np.uint32)
    return Boxes.from_poses(tracks, labels, lidar_T_camera @ poses, sizes)
