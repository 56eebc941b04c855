"""Small data sets in the formats of other benchmarks, by the name of their converter."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from carlasc_converters.kitti_boxes import KITTI

from carlasc.testing import SimulatedDrive

if TYPE_CHECKING:
    from converters.formats.kitti_drive import KittiDrive

_BOXES = {kind: KITTI.id_of(kind.capitalize()) for kind in ("car", "van", "pedestrian", "cyclist")}
_FEW = {"channels": 3, "columns": 24}


def _kitti_drive(frames: int = 3) -> KittiDrive:
    from converters.formats.kitti_drive import KittiDrive

    return KittiDrive(SimulatedDrive(frames, 0.1033, rolling=True, clockwise=True, **_FEW))


def _kitti(root: Path) -> None:
    from helpers.datasets.tiny_kitti import write_tiny_kitti

    write_tiny_kitti(root, frames=2, points=8, voxels=False)


def _poss(root: Path) -> None:
    from helpers.datasets.tiny_kitti import write_labels, write_tiny_kitti

    folder = write_tiny_kitti(root, frames=2, points=5)
    for frame in range(2):
        write_labels(folder, frame, np.array([4, 7 | 3 << 16, 22, 15, 0], np.uint32))
    (folder / "calib.txt").unlink()


def _kitti_raw(root: Path) -> None:
    from converters.formats.kitti_raw import write_raw

    write_raw(root, _kitti_drive(), _BOXES)


def _kitti_tracking(root: Path) -> None:
    from converters.formats.kitti_tracking import write_tracking

    write_tracking(root, _kitti_drive(), _BOXES)


def _kitti360(root: Path) -> None:
    from converters.formats.kitti360 import write_kitti360

    write_kitti360(root, _kitti_drive(), windows=((0, 2),))


def _nuscenes(root: Path) -> None:
    from converters.formats.nuscenes import drive, write_nuscenes

    write_nuscenes(root, {"scene-0103": drive(2, channels=3, columns=24)}, every=1)


def _argoverse2(root: Path) -> None:
    from converters.formats.argoverse2 import SENSORS, write_argoverse2

    write_argoverse2(root, SimulatedDrive(2, 0.1, SENSORS, **_FEW))


def _carlaocc(root: Path) -> None:
    from converters.formats.carlaocc import write_carlaocc

    write_carlaocc(root, SimulatedDrive(2, **_FEW))


def _paris_carla(root: Path) -> None:
    from converters.formats.paris_carla import write_town

    root.mkdir(parents=True)
    write_town(root / "Town03.ply", SimulatedDrive(2, rolling=True, **_FEW))


def _synthcity(root: Path) -> None:
    from converters.formats.synthcity import write_area

    root.mkdir(parents=True)
    write_area(root / "area_3.parquet", SimulatedDrive(2, **_FEW), rows=30)


def _scans(root: Path) -> None:
    from helpers.converters.scan_writers import write_with_open3d

    root.mkdir()
    # enough points to find the motion
    drive = SimulatedDrive(2, rolling=True, channels=6, columns=40)
    for frame in range(drive.frames):
        scan = drive.scan(frame)
        fields = dict(zip(("x", "y", "z", "intensity"), scan.points.T, strict=True))
        write_with_open3d(root / f"{frame}.pcd", {**fields, "time": scan.seconds}, compressed=True)


def _bag(root: Path) -> None:
    from helpers.converters.bags import Messages, drive_messages, write_bag

    store = Messages("mcap")
    drive = SimulatedDrive(2, rolling=True, channels=2, columns=6)
    write_bag(root, "mcap", drive_messages(store, drive), store=store)


def _ncore(root: Path) -> None:
    from helpers.converters.ncore_files import write_store

    root.mkdir()
    write_store(root, SimulatedDrive(2, rolling=True, channels=2, columns=6))


DATA_SETS: dict[str, Callable[[Path], None]] = {
    "kitti": _kitti,
    "poss": _poss,
    "kitti-raw": _kitti_raw,
    "kitti-tracking": _kitti_tracking,
    "kitti360": _kitti360,
    "nuscenes": _nuscenes,
    "argoverse2": _argoverse2,
    "carlaocc": _carlaocc,
    "paris-carla-3d": _paris_carla,
    "synthcity": _synthcity,
    "scans": _scans,
    "bag": _bag,
    "ncore": _ncore,
}
"""Writers by the name of the converter that reads what they write."""

PACKAGES = {
    "argoverse2": ("pyarrow",),
    "synthcity": ("pyarrow",),
    "scans": ("open3d", "kiss_icp"),
    "bag": ("rosbags",),
    "ncore": ("cbor2", "numcodecs"),
}
"""What a converter needs besides carlasc."""
