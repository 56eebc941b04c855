"""KITTI's tracking benchmark: scans and tracked boxes, and poses from OXTS files if they exist.

See `docs/sets/kitti-tracking.md`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np

from carlasc.converting import FrameHandle, Recording, Sensor, Split, Trajectory
from carlasc.core.arrays import FloatArray
from carlasc.core.boxes import Boxes
from carlasc.core.cameras import CameraModel
from carlasc.core.geometry import Transform, invert
from carlasc.errors import FormatError
from carlasc_converters.files import no_data
from carlasc_converters.kitti_boxes import KITTI, KITTI_TO_CARLA, ONLY_IN_VIEW, BoxRows, class_of
from carlasc_converters.kitti_cameras import rectified_cameras
from carlasc_converters.kitti_files import (
    HEIGHT_M,
    Calibration,
    KittiConverter,
    SweepFrame,
    frames_of,
    read_lines,
)
from carlasc_converters.oxts import read_packets, world_T_imu

# fact: kitti-tracking-period
PERIOD_S = 0.1033  # mean time between the scans of KITTI's raw data: the benchmark has no times
_SPLITS: tuple[tuple[str, Split, str], ...] = (
    ("training", "Train", ""),
    ("testing", "Test", "test"),
)
_IGNORED = "DontCare"  # a region of the image without a box in space
_MAX_TRACK = 2**32 - 1  # tracks are kept as uint32, and count from 1
# frame, track, type, truncated, occluded, alpha, box in the image (4), h w l, x y z, rotation about
# y
_COLUMNS = 17


class KittiTracking(KittiConverter):
    """Reads KITTI's tracking benchmark: both parts, or one of them."""

    title: ClassVar[str] = "KITTI tracking benchmark, with or without oxts"
    citation = "A. Geiger, P. Lenz, R. Urtasun, Are we ready for Autonomous Driving?, CVPR 2012"
    classes = KITTI
    to_carla = KITTI_TO_CARLA

    def sequences(self) -> list[Recording]:
        """Return the sequences, by part and number.

        Raises:
            MissingDataError: none exists.
        """
        recordings: list[Recording] = []
        for part, split, prefix in _SPLITS:
            folder = self.source if self.source.name == part else self.source / part
            scans = folder.resolve() / "velodyne"
            names = (
                sorted(path.name for path in scans.iterdir() if path.is_dir())
                if scans.is_dir()
                else []
            )
            recordings += [
                TrackingSequence(scans.parent, name, f"KITTI_tracking_{prefix}{name}", split)
                for name in names
            ]
        if not recordings:
            raise no_data(
                self.source,
                "training/velodyne/0000/ and so on, or one of the folders training and testing",
                "give the folder that holds training/",
            )
        return recordings


class TrackingSequence(Recording):
    """One sequence: the folder velodyne/0000, and the files 0000.txt of label_02/, calib/ and
    oxts/. The LiDAR is its vehicle.

    Attributes:
        folder: the folder training or testing.
        number: the name of the sequence in it, such as "0000".
    """

    sensors = (Sensor("velodyne", deskewed=False, height_m=HEIGHT_M),)

    def __init__(self, folder: Path, number: str, name: str, split: Split) -> None:
        self.folder = folder
        self.number = number
        self.name = name
        self.split = split
        self.location = str(folder / "velodyne" / number)

    @cached_property
    def frames(self) -> Sequence[FrameHandle]:  # type: ignore[override]
        """The frames that have a scan."""
        return [SweepFrame(f"{self.location}/{n:06d}.bin", n, PERIOD_S) for n in self._numbers]

    @cached_property
    def _numbers(self) -> list[int]:
        return frames_of(Path(self.location), ".bin")

    def _file(self, kind: str) -> Path:
        return self.folder / kind / f"{self.number}.txt"

    def _calibration(self, purpose: str) -> Calibration:
        return Calibration.read(self._file("calib"), purpose)

    def poses(self, *, force: bool = False) -> Trajectory | None:
        """Return the poses of the LiDAR from oxts/, of which line i belongs to frame i; None
        without that file.

        A file with exactly one line per scan goes by their order.
        """
        path = self._file("oxts")
        if not path.is_file():
            return None
        packets = read_packets(path)
        last = self._numbers[-1]
        by_order = len(packets) == len(self._numbers) <= last
        if len(packets) <= last and not by_order:
            raise FormatError(
                path,
                expected=f"a line for each frame up to {last}",
                found=f"{len(packets)} lines",
                advice='copy it again, or estimate poses from the scans with `poses="kiss-icp"`',
            )
        poses = world_T_imu(packets) @ invert(self._lidar_T_imu(force))
        if by_order:
            return Trajectory(poses, np.asarray(self._numbers) * PERIOD_S, str(path))
        return Trajectory(poses[: last + 1], where=str(path))

    def _lidar_T_imu(self, force: bool) -> Transform:
        if force and not self._file("calib").is_file():
            return np.eye(4)
        purpose = (
            "Tr_imu_to_velo, which takes points of the IMU to the LiDAR: the poses in oxts/ are "
            "those of the IMU"
        )
        return self._calibration(purpose).transform("Tr_imu_to_velo", "Tr_imu_velo")

    def times(self) -> FloatArray | None:
        """Return times at the mean rate of KITTI's raw data: the benchmark has none."""
        return np.arange(self._numbers[-1] + 1, dtype=np.float64) * PERIOD_S

    def cameras(self) -> Sequence[CameraModel]:
        """Return the rectified cameras of calib/; none without that file."""
        if not self._file("calib").is_file():
            return ()
        calibration = self._calibration("P0 to P3, R0_rect and Tr_velo_to_cam")

        def image_of(name: str, frame: int) -> Path:
            return self.folder / name / self.number / f"{frame:06d}.png"

        projections = {f"image_0{number}": f"P{number}" for number in range(4)}
        return rectified_cameras(
            calibration, _camera_T_lidar(calibration), projections, image_of, self._numbers
        )

    def boxes(self) -> Mapping[int, Boxes] | None:
        """Return the boxes of label_02/ in the frame of the LiDAR; tracks count from 1: those of
        the file plus 1.

        Boxes exist only in the view of the camera.
        """
        path = self._file("label_02")
        return self._read_boxes(path) if path.is_file() else None

    def _read_boxes(self, path: Path) -> dict[int, Boxes]:
        calibration = self._calibration(
            "R0_rect and Tr_velo_to_cam, which take LiDAR points to the camera of the boxes"
        )
        lidar_T_camera = invert(_camera_T_lidar(calibration))
        rows = BoxRows(str(path), self._numbers)
        for line, row in enumerate(
            map(str.split, filter(None, read_lines(path, "boxes", "a line per box"))), 1
        ):
            where = f"{path}: line {line}"
            if len(row) < _COLUMNS:
                raise FormatError(
                    where,
                    expected=f"{_COLUMNS} columns",
                    found=len(row),
                    advice="copy it again",
                )
            if row[2] == _IGNORED:
                continue
            try:
                frame = int(row[0])
                track = int(row[1])
                height, width, length, x, y, z, turn = map(float, row[10:_COLUMNS])
            except ValueError as error:
                raise FormatError(where, expected="numbers but in column 3", found=error) from error
            if not 0 <= track < _MAX_TRACK:
                raise FormatError(where, expected=f"a track 0..{_MAX_TRACK - 1}", found=track)
            camera_T_box = _camera_T_box(np.array([x, y - height / 2, z]), turn)
            size = np.array([length, width, height])
            rows.add(frame, track + 1, class_of(row[2], where), lidar_T_camera @ camera_T_box, size)
        return rows.boxes()

    def notes(self) -> list[str]:
        """Return notes on what was assumed, and on the area that the boxes cover."""
        times = (
            f"the benchmark has no times: {PERIOD_S} s between frames is assumed, the mean of "
            f"KITTI's raw data"
        )
        view = [ONLY_IN_VIEW] if self._file("label_02").is_file() else []
        return [times, *view]


def _camera_T_lidar(calibration: Calibration) -> Transform:
    """Return the (4, 4) transform from the LiDAR to the rectified frame of the first camera."""
    to_camera = calibration.transform("Tr_velo_to_cam", "Tr_velo_cam")
    return calibration.rotation("R0_rect", "R_rect") @ to_camera


def _camera_T_box(center: FloatArray, turn_rad: float) -> Transform:
    """Return the pose of a box in the camera's frame (x right, y down, z forward), from its
    rotation about y.
    """
    forward = np.array([np.cos(turn_rad), 0.0, -np.sin(turn_rad)])
    up = np.array([0.0, -1.0, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([forward, np.cross(up, forward), up], axis=1)
    pose[:3, 3] = center
    return pose
