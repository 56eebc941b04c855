"""KITTI-360: scans without motion correction, poses of some frames, labels from accumulated clouds.

See `docs/sets/kitti360.md`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np

from carlasc.converting import Cloud, FrameHandle, Recording, Sensor, Split, Trajectory
from carlasc.core import CameraModel
from carlasc.core.arrays import Float32Array, FloatArray, IntArray
from carlasc.core.geometry import Transform, check_rigid, invert
from carlasc.errors import FormatError
from carlasc_converters.files import Version, no_data, read_text, version_of
from carlasc_converters.kitti360_classes import KITTI360, KITTI360_TO_CARLA
from carlasc_converters.kitti360_labels import MAX_DISTANCE_M, label_points, window_at, windows_of
from carlasc_converters.kitti_cameras import rectified_cameras
from carlasc_converters.kitti_files import (
    Calibration,
    FrameTimes,
    KittiConverter,
    frames_of,
    read_scan,
    sweep_seconds,
)

# drives whose labels are not published
_TEST = (
    "2013_05_28_drive_0008_sync",
    "2013_05_28_drive_0018_sync",
)
_SCANS = "velodyne_points"
_IMAGE_SIZE = (1408, 376)  # of the rectified images
_TICK_S = 1e-4  # points within this time share a pose


class Kitti360(KittiConverter):
    """Reads KITTI-360: the whole data set, or one of its drives."""

    title: ClassVar[str] = (
        "KITTI-360: Velodyne scans, with labels of the accumulated clouds where they exist"
    )
    citation = "Y. Liao, J. Xie, A. Geiger, KITTI-360, PAMI 2022"
    classes = KITTI360
    to_carla = KITTI360_TO_CARLA

    def sequences(self) -> list[Recording]:
        """Return the drives, by number.

        Raises:
            MissingDataError: none exists.
        """
        source = self.source.resolve()
        if (source / _SCANS).is_dir():
            return [Kitti360Drive(Kitti360Files(str(source.parents[1]), source.name))]
        folders = sorted(
            path.parents[1].name
            for path in source.glob(f"data_3d_raw/*/{_SCANS}/data")
            if path.is_dir()
        )
        if not folders:
            raise no_data(
                self.source,
                f"data_3d_raw/2013_05_28_drive_0000_sync/{_SCANS}/data/ and so on",
                "give the folder that holds data_3d_raw/, data_poses/ and calibration/",
            )
        return [Kitti360Drive(Kitti360Files(str(source), name)) for name in folders]


@dataclass(frozen=True)
class Kitti360Files:
    """Where the files of a drive are.

    Attributes:
        root: folder of the data set.
        drive: name of the drive, such as "2013_05_28_drive_0000_sync".
    """

    root: str
    drive: str

    @property
    def scans(self) -> Path:
        """Folder of velodyne_points."""
        return Path(self.root, "data_3d_raw", self.drive, _SCANS)

    @property
    def poses(self) -> Path:
        """File of the poses of the IMU."""
        return Path(self.root, "data_poses", self.drive, "poses.txt")

    @property
    def labels(self) -> Path:
        """Folder of the accumulated clouds."""
        return Path(self.root, "data_3d_semantics", "train", self.drive)

    @property
    def calibration(self) -> Path:
        """Folder of the calibrations."""
        return Path(self.root, "calibration")


class Kitti360Drive(Recording):
    """One drive. The LiDAR is its vehicle.

    Attributes:
        files: where its files are.
    """

    sensors = (Sensor("velodyne", deskewed=False),)

    def __init__(self, files: Kitti360Files) -> None:
        self.files = files
        self.location = str(files.scans.parent)
        self.name = (
            f"KITTI360_{files.drive.removeprefix('2013_05_28_drive_').removesuffix('_sync')}"
        )
        self.split: Split = "Test" if files.drive in _TEST else "Train"
        self._windows = windows_of(files.labels / "static")
        self.has_labels = self.has_instances = bool(self._windows) and files.poses.is_file()

    @cached_property
    def frames(self) -> Sequence[FrameHandle]:  # type: ignore[override]
        """The frames that have a scan."""
        if not self._numbers:
            return []
        period_s = self._times.period_s
        windows = self._windows if self.has_labels else {}
        return [
            Kitti360Frame(self.files, n, period_s, window_at(windows, n), self.has_labels)
            for n in self._numbers
        ]

    @cached_property
    def _numbers(self) -> list[int]:
        return frames_of(self.files.scans / "data", ".bin")

    @cached_property
    def _times(self) -> FrameTimes:
        return FrameTimes.read(self.files.scans / "timestamps.txt", self._numbers)

    def poses(self, *, force: bool = False) -> Trajectory | None:
        """Return the poses of the LiDAR at the times of frames with a pose; the car is at rest in
        the others.
        """
        return (
            read_trajectory(self.files, self._times.seconds, force=force)
            if self.files.poses.is_file()
            else None
        )

    def times(self) -> FloatArray | None:
        """Return the times at which the scanner looked forward, seconds after the first."""
        return self._times.seconds

    def cameras(self) -> Sequence[CameraModel]:
        """Return the two rectified front cameras; empty without their calibration.

        The layout has no model of the fisheye cameras.
        """
        folder = self.files.calibration
        if (
            not (folder / "perspective.txt").is_file()
            or not (folder / "calib_cam_to_velo.txt").is_file()
        ):
            return ()
        calibration = Calibration.read(folder / "perspective.txt", "the cameras")
        lidar_T_camera = Calibration.read(
            folder / "calib_cam_to_velo.txt", "the place of the LiDAR"
        ).transform("")
        rectify = calibration.values.get("R_rect_00", ())
        if len(rectify) != 9:
            raise FormatError(
                calibration.path, expected="9 numbers after R_rect_00", found=len(rectify)
            )
        rectified_T_camera = np.eye(4)
        rectified_T_camera[:3, :3] = np.reshape(rectify, (3, 3))
        images = Path(self.files.root, "data_2d_raw", self.files.drive)
        return rectified_cameras(
            calibration,
            rectified_T_camera @ invert(lidar_T_camera),
            {"image_00": "P_rect_00", "image_01": "P_rect_01"},
            lambda name, frame: images / name / "data_rect" / f"{frame:010d}.png",
            self._numbers,
            _IMAGE_SIZE,
        )

    def notes(self) -> list[str]:
        """Return notes on missing labels, and on how labels were found."""
        if not self.has_labels:
            return (
                [f"labels cannot be given to scans without {self.files.poses}"]
                if self._windows
                else []
            )
        without = sum(window_at(self._windows, number) is None for number in self._numbers)
        found = (
            [f"{without} frames are in no labelled window: their points are unlabelled"]
            if without
            else []
        )
        return [
            *found,
            f"labels are those of the nearest point of the accumulated clouds within "
            f"{MAX_DISTANCE_M} m",
        ]


@dataclass(frozen=True)
class Kitti360Frame(FrameHandle):
    """One scan, and the window of frames whose cloud has its labels."""

    files: Kitti360Files
    number: int
    period_s: float
    window: str | None
    labelled: bool

    @property
    def location(self) -> str:  # type: ignore[override]
        """The file of the points."""
        return str(self.files.scans / "data" / f"{self.number:010d}.bin")

    def read(self) -> Sequence[Cloud]:
        """Read the points, find their times from their azimuths, and take labels from the
        accumulated clouds.
        """
        points = read_scan(self.location)
        seconds = sweep_seconds(points, self.period_s)
        if not self.labelled:
            return [Cloud(points, seconds=seconds)]
        if self.window is None:
            return [
                Cloud(
                    points,
                    np.zeros(len(points), np.uint16),
                    np.zeros(len(points), np.uint32),
                    seconds,
                )
            ]
        world = self._in_world(points, seconds)
        labels, instances = label_points(self.files.labels, self.window, self.number, world)
        return [Cloud(points, labels, instances, seconds)]

    def _in_world(self, points: Float32Array, seconds: Float32Array) -> FloatArray:
        """Return (N, 3) points in the frame of the world, each by the pose at its time."""
        times, trajectory = _motion(self.files, version_of(self.files.poses, "poses"))
        ticks, tick_of = np.unique(np.round(seconds / _TICK_S), return_inverse=True)
        poses = trajectory.at(times[self.number] + ticks * _TICK_S)[tick_of]
        return np.einsum("nij,nj->ni", poses[:, :3, :3], points[:, :3]) + poses[:, :3, 3]


@lru_cache(maxsize=2)  # drives per process
def _motion(files: Kitti360Files, version: Version) -> tuple[FloatArray, Trajectory]:
    """Return the times of a drive's frames, and its poses."""
    times = FrameTimes.read(
        files.scans / "timestamps.txt", frames_of(files.scans / "data", ".bin")
    ).seconds
    return times, read_trajectory(files, times)


def read_trajectory(files: Kitti360Files, times: FloatArray, *, force: bool = False) -> Trajectory:
    """Return the poses of the LiDAR from the poses of the IMU in poses.txt.

    Args:
        files: of the drive.
        times: (F,) seconds by frame number.
        force: if a calibration is missing, take the poses as those of the LiDAR.

    Raises:
        MissingDataError: a calibration is missing.
        FormatError: a line is not a frame number and 12 numbers of a pose, or frames do not
            increase or have no time.
    """
    frames, world_T_imu = _read_poses(files.poses)
    if not len(frames) or frames[-1] >= len(times) or not (np.diff(frames) > 0).all():
        raise FormatError(
            files.poses,
            expected=f"increasing frames 0..{len(times) - 1}, which have a time",
            found=f"{frames[-1]} as the last" if len(frames) else "no lines",
            advice="copy it and timestamps.txt again",
        )
    world_T_lidar = world_T_imu @ _imu_T_lidar(files.calibration, force)
    # Frames have no pose while the car is at rest, also at the beginning and the end of a drive.
    before = frames[:1] - 1 if frames[0] > 1 else frames[:0]
    after = frames[-1:] + 1 if frames[-1] < len(times) - 2 else frames[:0]
    held = np.concatenate(
        [world_T_lidar[: len(before)], world_T_lidar, world_T_lidar[-1:][: len(after)]]
    )
    return Trajectory(held, times[np.concatenate([before, frames, after])], str(files.poses))


def _read_poses(path: Path) -> tuple[IntArray, FloatArray]:
    """Return (K,) frame numbers and (K, 4, 4) poses."""
    try:
        rows = [
            [float(value) for value in line.split()]
            for line in read_text(path).splitlines()
            if line.strip()
        ]
    except ValueError as error:
        raise FormatError(
            path, expected="13 numbers per line", found=f"something else ({error})"
        ) from error
    for number, row in enumerate(rows, 1):
        if len(row) != 13 or row[0] < 0 or not row[0].is_integer():
            found = (
                f"{len(row)} numbers in line {number}"
                if len(row) != 13
                else f"{row[0]} in line {number}"
            )
            raise FormatError(path, expected="a frame number and 12 numbers per line", found=found)
    table = np.array(rows, np.float64).reshape(-1, 13)
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3] = table[:, 1:].reshape(-1, 3, 4)
    return table[:, 0].astype(np.int64), check_rigid(poses, str(path))


def _imu_T_lidar(folder: Path, force: bool) -> Transform:
    to_pose = folder / "calib_cam_to_pose.txt"
    to_lidar = folder / "calib_cam_to_velo.txt"
    if force and not (to_pose.is_file() and to_lidar.is_file()):
        return np.eye(4)
    purpose = "the place of the LiDAR on the car: poses.txt holds poses of the IMU"
    imu_T_camera = Calibration.read(to_pose, purpose).transform("image_00")
    return imu_T_camera @ invert(Calibration.read(to_lidar, purpose).transform(""))
