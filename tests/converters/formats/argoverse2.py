"""A simulated drive as a log of Argoverse 2's sensor data set."""

from __future__ import annotations

import uuid
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from carlasc.converting.protocol import Sensor
from carlasc.core.geometry import (
    Transform,
    quaternions_of,
    rotation_z,
    transform_points,
    translation,
)
from carlasc.testing.drives import KINDS, SimulatedDrive

START_NS = 315966253660357001  # no float64 holds it
LOG = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
CATEGORIES = {
    "car": "REGULAR_VEHICLE",
    "van": "BOX_TRUCK",
    "pedestrian": "PEDESTRIAN",
    "cyclist": "BICYCLIST",
}
CITY_T_WORLD = translation((5172.7, 2419.1, 66.9)) @ rotation_z(0.8)
_LOWER = translation((1.35, 0.005, 1.53)) @ np.diag([1.0, -1.0, -1.0, 1.0])  # it hangs upside down
SENSORS = (
    Sensor("up_lidar", translation((1.35, 0.0, 1.64)) @ rotation_z(0.01), points_in="vehicle"),
    Sensor("down_lidar", _LOWER, points_in="vehicle"),
)
_QUATERNION, _TRANSLATION = ("qw", "qx", "qy", "qz"), ("tx_m", "ty_m", "tz_m")


def drive(frames: int = 4) -> SimulatedDrive:
    """Return a small drive with the two LiDARs of the data set, which turn while the vehicle moves."""
    return SimulatedDrive(
        frames, sensors=SENSORS, rolling=True, axle_m=0.33, channels=12, columns=90
    )


def timestamps(drive: SimulatedDrive) -> list[int]:
    """Return the timestamp of each sweep in nanoseconds."""
    return [START_NS + round(seconds * 1e9) for seconds in drive.times]


def sweep(
    drive: SimulatedDrive, frame: int
) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.uint8]]:
    """Return (N, 4) points in the frame of the vehicle with intensity 0 to 255, their offsets in
    ns, and laser numbers.

    Points are in the order in which they were taken, as in the data set: those of both LiDARs are
    mixed.
    """
    points, offsets, lasers = [], [], []
    for k, sensor in enumerate(drive.sensors):
        scan = drive.scan(frame, k)
        place = transform_points(sensor.vehicle_T_sensor, scan.deskewed[:, :3])
        points.append(
            np.column_stack([place, np.round(scan.points[:, 3] * 255)]).astype(np.float32)
        )
        offsets.append(np.round(scan.seconds * 1e9).astype(np.int32))
        lasers.append((32 * k + np.arange(len(scan.points)) % 32).astype(np.uint8))
    order = np.argsort(np.concatenate(offsets), kind="stable")
    return (
        np.concatenate(points)[order],
        np.concatenate(offsets)[order],
        np.concatenate(lasers)[order],
    )


def track_uuid(track: int) -> str:
    """Return a name of a track. The order of these names is not that of the numbers."""
    return str(uuid.uuid5(uuid.NAMESPACE_URL, f"track {track}"))


def write_argoverse2(
    root: Path, drive: SimulatedDrive, *, log: str = LOG, half: bool = False
) -> Path:
    """Write a log into a folder and return its folder; `half` writes float16 points."""
    folder = root / log
    (folder / "sensors" / "lidar").mkdir(parents=True)
    (folder / "calibration").mkdir()
    rows = []
    for frame, at in enumerate(timestamps(drive)):
        points, offsets, lasers = sweep(drive, frame)
        columns: dict[str, Any] = dict(
            zip("xyz", points[:, :3].astype(np.float16 if half else np.float32).T, strict=True)
        )
        columns |= {
            "intensity": points[:, 3].astype(np.uint8),
            "laser_number": lasers,
            "offset_ns": offsets,
        }
        write_table(folder / "sensors" / "lidar" / f"{at}.feather", columns)
        boxes = drive.boxes(frame)
        for track, label, pose, size in zip(
            boxes.tracks, boxes.labels, boxes.sensor_T_box, boxes.sizes, strict=True
        ):
            row = {
                "timestamp_ns": at,
                "track_uuid": track_uuid(track),
                "category": CATEGORIES[KINDS[label]],
            }
            rows.append(
                row
                | dict(zip(("length_m", "width_m", "height_m"), size, strict=True))
                | pose_row(pose)
            )
    rows = [rows[row] for row in np.random.default_rng(5).permutation(len(rows))]
    write_rows(folder / "annotations.feather", [row | {"num_interior_pts": 1} for row in rows])
    times = np.unique(
        np.concatenate([np.arange(-0.05, drive.times[-1] + 0.15, 0.01), drive.times]).round(9)
    )
    poses = CITY_T_WORLD @ drive.world_T_vehicle(times)
    named = [
        {"timestamp_ns": START_NS + round(at * 1e9)} | pose_row(pose)
        for at, pose in zip(times, poses, strict=True)
    ]
    write_rows(folder / "city_SE3_egovehicle.feather", named)
    camera = {"sensor_name": "ring_front_center"} | pose_row(translation((1.6, 0.0, 1.4)))
    lidars = [
        {"sensor_name": sensor.name} | pose_row(sensor.vehicle_T_sensor) for sensor in drive.sensors
    ]
    write_rows(
        folder / "calibration" / "egovehicle_SE3_sensor.feather", [camera, *reversed(lidars)]
    )
    return folder


def pose_row(pose: Transform) -> dict[str, float]:
    """Return the columns of a pose."""
    numbers = [*quaternions_of(pose[None, :3, :3])[0], *pose[:3, 3]]
    return dict(zip((*_QUATERNION, *_TRANSLATION), numbers, strict=True))


def write_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write rows, of the same keys each, as a Feather file."""
    write_table(path, {name: [row[name] for row in rows] for name in rows[0]})


def write_table(path: Path, columns: dict[str, Any]) -> None:
    """Write columns as a Feather file."""
    pyarrow = pytest.importorskip("pyarrow")
    feather = pytest.importorskip("pyarrow.feather")
    feather.write_feather(pyarrow.table(columns), str(path), compression="uncompressed")


def read_table(path: Path) -> dict[str, Any]:
    """Return the columns of a Feather file, to be changed and written again."""
    feather = pytest.importorskip("pyarrow.feather")
    table = feather.read_table(str(path))
    return {name: table.column(name).to_numpy() for name in table.column_names}
