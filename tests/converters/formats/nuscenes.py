"""A simulated drive as a scene of nuScenes: tables, points, point labels and panoptic labels."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from carlasc_converters.nuscenes_classes import CLASS_IDS
from numpy.typing import NDArray

from carlasc.converting.protocol import Sensor
from carlasc.core.geometry import Transform, quaternions_of, rotation_z, translation
from carlasc.testing.drives import KINDS, DriveScan, SimulatedDrive

START_US = 1532402927647951
# x of the LiDAR points to the right, y forward
MOUNT = translation((0.94, 0.0, 1.84)) @ rotation_z(-np.pi / 2)
MATRIX = [[1266.4, 0.0, 816.3], [0.0, 1266.4, 491.5], [0.0, 0.0, 1.0]]
VEHICLE_T_CAMERA = translation((1.7, 0.0, 1.5)) @ np.array(
    [[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
)
IMAGE_LATER_US = 10_000
GLOBAL_T_WORLD = translation((411.3, 1180.9, 0.0)) @ rotation_z(-1.1)
CATEGORIES = {
    "none": "noise", "road": "flat.driveable_surface", "building": "static.manmade", "vegetation": "static.vegetation",
    "pole": "static.manmade", "car": "vehicle.car", "van": "vehicle.truck", "pedestrian": "human.pedestrian.adult",
    "cyclist": "vehicle.bicycle",
}  # fmt: skip
CLASS_OF_KIND = np.array([CLASS_IDS[CATEGORIES[kind]] for kind in KINDS], np.uint8)


def drive(frames: int = 7, *, channels: int = 12, columns: int = 90) -> SimulatedDrive:
    """Return a small drive with the LiDAR of the data set."""
    return SimulatedDrive(
        frames, 0.05, (Sensor("LIDAR_TOP", MOUNT),), channels=channels, columns=columns
    )


def microseconds(drive: SimulatedDrive, frame: int) -> int:
    """Return the timestamp of a scan."""
    return START_US + round(drive.times[frame] * 1e6)


def rows_of(scan: DriveScan) -> NDArray[np.float32]:
    """Return (N, 5) rows of the file of a scan: x, y, z, intensity 0 to 255, and a ring."""
    points = scan.points
    rings = np.arange(len(points)) % 32
    return np.column_stack([points[:, :3], np.round(points[:, 3] * 255), rings]).astype(np.float32)


def panoptic_number(track: int) -> int:
    """Return the number of an object in panoptic labels, which is not that of its track."""
    return 200 - track


def write_nuscenes(
    root: Path,
    drives: dict[str, SimulatedDrive],
    *,
    version: str = "v1.0-mini",
    every: int = 3,
    lidarseg: bool = True,
    panoptic: bool = True,
    annotated: bool = True,
) -> Path:
    """Write scenes by name into a folder, and return the folder of the tables; every so many scans
    are key frames, and the last one.
    """
    tables: dict[str, list[dict[str, Any]]] = {
        name: [] for name in ("scene", "sample", "sample_data", "ego_pose")
    }
    tables |= {
        name: []
        for name in ("calibrated_sensor", "sample_annotation", "instance", "lidarseg", "panoptic")
    }
    tables["sensor"] = [
        {"token": "sensor-camera", "channel": "CAM_FRONT", "modality": "camera"},
        {"token": "sensor-lidar", "channel": "LIDAR_TOP", "modality": "lidar"},
    ]
    tables["category"] = [
        {"token": f"category-{index}", "name": name, "description": "", "index": index}
        for name, index in reversed(CLASS_IDS.items())
        if lidarseg or panoptic or not name.startswith(("noise", "flat", "static.", "vehicle.ego"))
    ]
    if not (lidarseg or panoptic):
        tables["category"] = [
            {key: row[key] for key in row if key != "index"} for row in tables["category"]
        ]
    for scene, drive in drives.items():
        _write_scene(root, tables, version, scene, drive, every, (lidarseg, panoptic, annotated))
    folder = root / version
    folder.mkdir(parents=True)
    for name, wanted in (("lidarseg", lidarseg), ("panoptic", panoptic)):
        if not wanted:
            del tables[name]
    for name, rows in tables.items():
        write_table(folder / f"{name}.json", rows)
    return folder


def _write_scene(
    root: Path,
    tables: dict[str, list[dict[str, Any]]],
    version: str,
    scene: str,
    drive: SimulatedDrive,
    every: int,
    written: tuple[bool, bool, bool],
) -> None:
    """Write the files of one scene, and add its rows to the tables."""
    lidarseg, panoptic, annotated = written
    tables["scene"].append({"token": scene, "name": scene, "log_token": "log"})
    mounts = {"lidar": drive.sensors[0].vehicle_T_sensor, "camera": VEHICLE_T_CAMERA}
    for name, mount in mounts.items():
        token = f"{scene}-mount-{name}"
        row = {
            "token": token,
            "sensor_token": f"sensor-{name}",
            "camera_intrinsic": MATRIX if name == "camera" else [],
        }
        tables["calibrated_sensor"].append(row | pose_keys(mount))
    for frame in reversed(range(drive.frames)):  # rows of tables have no order
        key, at = frame % every == 0, microseconds(drive, frame)
        sample, token = f"{scene}-sample-{-(-frame // every)}", f"{scene}-scan-{frame}"
        folder = Path("samples" if key else "sweeps") / "LIDAR_TOP"
        row = {
            "token": token,
            "sample_token": sample,
            "ego_pose_token": f"{token}-pose",
            "timestamp": at,
            "is_key_frame": key,
            "width": 0,
            "height": 0,
        }
        row |= {
            "calibrated_sensor_token": f"{scene}-mount-lidar",
            "filename": str(folder / f"{scene}__{at}.pcd.bin"),
        }
        camera = {
            "token": f"{token}-picture",
            "calibrated_sensor_token": f"{scene}-mount-camera",
            "filename": f"samples/CAM_FRONT/{scene}__{at}.jpg",
            "timestamp": at + IMAGE_LATER_US,
            "width": 1600,
            "height": 900,
        }
        tables["sample_data"] += [row | camera | {"ego_pose_token": f"{token}-other"}, row]
        pose = GLOBAL_T_WORLD @ drive.world_T_vehicle(drive.times[frame])
        tables["ego_pose"] += [
            {"token": f"{token}-other", "timestamp": at - 3000, **pose_keys(np.eye(4))},
            {"token": f"{token}-pose", "timestamp": at, **pose_keys(pose)},
        ]
        scan = drive.scan(frame)
        _write_bytes(root / row["filename"], rows_of(scan).tobytes())
        if not key:
            continue
        tables["sample"].append({"token": sample, "timestamp": at, "scene_token": scene})
        labels = CLASS_OF_KIND[scan.kinds]
        if lidarseg:
            file = f"lidarseg/{version}/{token}_lidarseg.bin"
            tables["lidarseg"].append(
                {"token": token, "sample_data_token": token, "filename": file}
            )
            _write_bytes(root / file, labels.tobytes())
        if panoptic:
            file = f"panoptic/{version}/{token}_panoptic.npz"
            tables["panoptic"].append(
                {"token": token, "sample_data_token": token, "filename": file}
            )
            (root / file).parent.mkdir(parents=True, exist_ok=True)
            objects = np.where(
                scan.instances > 0, panoptic_number(scan.instances.astype(np.int64)), 0
            )
            np.savez_compressed(
                root / file, data=(labels.astype(np.int64) * 1000 + objects).astype(np.uint16)
            )
        if annotated:
            _annotate(tables, drive, frame, scene, sample)


def _annotate(
    tables: dict[str, list[dict[str, Any]]],
    drive: SimulatedDrive,
    frame: int,
    scene: str,
    sample: str,
) -> None:
    """Add the boxes of a key frame to the tables."""
    boxes = drive.boxes(frame)
    poses = GLOBAL_T_WORLD @ drive.world_T_vehicle(drive.times[frame]) @ boxes.sensor_T_box
    known = {row["token"] for row in tables["instance"]}
    for track, kind, pose, (length, width, height) in zip(
        boxes.tracks.tolist(), boxes.labels.tolist(), poses, boxes.sizes.tolist(), strict=True
    ):
        instance = f"{scene}-object-{track}"
        if instance not in known:
            tables["instance"].append(
                {"token": instance, "category_token": f"category-{CLASS_OF_KIND[kind]}"}
            )
        keys = {"token": f"{instance}-{frame}", "sample_token": sample, "instance_token": instance}
        tables["sample_annotation"].append(
            keys | {"size": [width, length, height], **pose_keys(pose)}
        )


def pose_keys(pose: Transform) -> dict[str, list[float]]:
    """Return the keys of a pose."""
    return {
        "translation": pose[:3, 3].tolist(),
        "rotation": quaternions_of(pose[None, :3, :3])[0].tolist(),
    }


def write_table(path: Path, rows: Sequence[Any]) -> None:
    """Write a table as the data set does: a key per line."""
    path.write_text(json.dumps(rows, indent=0))


def change_table(path: Path, **values: Any) -> None:
    """Write a table with other values in the first row; None removes a key."""
    rows = json.loads(path.read_text())
    rows[0] = {key: value for key, value in (rows[0] | values).items() if value is not None}
    write_table(path, rows)


def _write_bytes(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
