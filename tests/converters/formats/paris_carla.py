"""A simulated drive as a town of Paris-CARLA-3D."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from carlasc.testing.drives import KINDS, DriveScan, SimulatedDrive

TAGS = {
    "none": 0, "road": 7, "building": 1, "vegetation": 9, "pole": 5, "car": 10, "van": 10, "pedestrian": 4, "cyclist": 4,
}  # fmt: skip
TAG_OF_KIND = np.array([TAGS[kind] for kind in KINDS], np.uint32)
FIRST_ACTOR = 500
FIRST_SCAN = 3
"""index_frame of the first scan: the scans before it were taken while the vehicle stood, and left
out.
"""
ROW = np.dtype(
    [
        (name, "<f4")
        for name in ("x", "y", "z", "x_lidar_position", "y_lidar_position", "z_lidar_position")
    ]
    + [("cos_angle_lidar_surface", "<f4"), ("timestamp", "<f4")]
    + [(name, "<u4") for name in ("index_frame", "instance", "semantic", "semantic_image")]
    + [(name, "u1") for name in ("red", "green", "blue")]
)
_NAMES = {"<f4": "float", "<u4": "uint", "|u1": "uchar"}


def write_town(path: Path, drive: SimulatedDrive) -> Path:
    """Write a drive as one file."""
    write_rows(path, np.concatenate([scan_rows(drive, frame) for frame in range(drive.frames)]))
    return path


def write_rows(path: Path, rows: NDArray[np.void]) -> None:
    """Write a file of these rows."""
    path.write_bytes(header(len(rows)) + rows.tobytes())


def header(count: int) -> bytes:
    """Return the header of a file of `count` rows."""
    lines = "".join(f"property {_NAMES[ROW[name].str]} {name}\n" for name in ROW.names or ())
    return f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{lines}end_header\n".encode()


def scan_rows(drive: SimulatedDrive, frame: int) -> NDArray[np.void]:
    """Return the rows of a scan."""
    scan = drive.scan(frame)
    rows = np.zeros(len(scan.points), ROW)
    for axis, name in enumerate("xyz"):
        rows[name] = in_world(scan)[:, axis]
        rows[f"{name}_lidar_position"] = scan.world_T_sensor[:, axis, 3]
    rows["timestamp"] = frame * drive.period_s + scan.seconds
    rows["index_frame"] = frame + FIRST_SCAN
    rows["semantic"] = TAG_OF_KIND[scan.kinds]
    rows["instance"] = np.where(scan.instances > 0, scan.instances + FIRST_ACTOR, 0)
    rows["instance"][rows["semantic"] == TAGS["pole"]] = 7  # poles are actors of CARLA too
    return rows


def in_world(scan: DriveScan) -> NDArray[np.float64]:
    """Return the (N, 3) points of a scan in the world."""
    poses = scan.world_T_sensor
    return (
        np.einsum("nij,nj->ni", poses[:, :3, :3], scan.points[:, :3].astype(np.float64))
        + poses[:, :3, 3]
    )
