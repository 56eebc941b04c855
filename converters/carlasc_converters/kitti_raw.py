"""KITTI's raw data: scans, poses of the navigation system, and tracked boxes (tracklets).

See `docs/sets/kitti-raw.md`.
"""

from __future__ import annotations

import re
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
from carlasc_converters.kitti_boxes import KITTI, KITTI_TO_CARLA, ONLY_IN_VIEW
from carlasc_converters.kitti_cameras import rectified_cameras
from carlasc_converters.kitti_files import (
    HEIGHT_M,
    Calibration,
    FrameTimes,
    KittiConverter,
    SweepFrame,
    frames_of,
    read_stamps,
)
from carlasc_converters.oxts import read_packets, world_T_imu
from carlasc_converters.tracklets import read_tracklets

_DRIVE = re.compile(r"(\d{4}_\d\d_\d\d)_drive_(\d{4})_sync")
_SCANS = "velodyne_points"


class KittiRaw(KittiConverter):
    """Reads KITTI's raw data (the "synced+rectified" drives): all dates, one date, or one drive."""

    title: ClassVar[str] = "KITTI raw data: synced drives, with tracklets where they exist"
    citation = (
        "A. Geiger, P. Lenz, C. Stiller, R. Urtasun, Vision meets Robotics: The KITTI Dataset, "
        "IJRR 2013"
    )
    classes = KITTI
    to_carla = KITTI_TO_CARLA

    def sequences(self) -> list[Recording]:
        """Return the drives, by date and number.

        Raises:
            MissingDataError: none exists.
        """
        for pattern in (f"{_SCANS}/data", f"*/{_SCANS}/data", f"*/*/{_SCANS}/data"):
            if drives := sorted(
                path.parents[1].resolve() for path in self.source.glob(pattern) if path.is_dir()
            ):
                return [RawDrive(folder) for folder in drives]
        raise no_data(
            self.source,
            f"2011_09_26/2011_09_26_drive_0001_sync/{_SCANS}/data/ and so on, one date, "
            f"or one drive",
            "give the folder that holds the dates",
        )


class RawDrive(Recording):
    """One drive: a folder with velodyne_points/, oxts/ and tracklet_labels.xml, in the folder of
    its date. The LiDAR is its vehicle.

    Attributes:
        folder: this folder.
    """

    split: Split = "Train"
    sensors = (Sensor("velodyne", deskewed=False, height_m=HEIGHT_M),)

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.location = str(folder)
        match = _DRIVE.fullmatch(folder.name)
        self.name = f"KITTI_{match[1]}_{match[2]}" if match else f"KITTI_{folder.name}"

    @cached_property
    def frames(self) -> Sequence[FrameHandle]:  # type: ignore[override]
        """The frames that have a scan."""
        if not self._numbers:
            return []
        scans = self.folder / _SCANS / "data"
        period_s = self._times.period_s
        return [SweepFrame(f"{scans}/{n:010d}.bin", n, period_s) for n in self._numbers]

    @cached_property
    def _numbers(self) -> list[int]:
        return frames_of(self.folder / _SCANS / "data", ".bin")

    @cached_property
    def _times(self) -> FrameTimes:
        return FrameTimes.read(self.folder / _SCANS / "timestamps.txt", self._numbers)

    @cached_property
    def _packets(self) -> list[int]:
        """The numbers of the frames that have a packet of the navigation system."""
        return frames_of(self.folder / "oxts" / "data", ".txt")

    def poses(self, *, force: bool = False) -> Trajectory | None:
        """Return the poses of the LiDAR at the times of the packets in oxts/; packets whose time
        does not increase are left out.
        """
        if not self._packets:
            return None
        path = self.folder / "oxts" / "timestamps.txt"
        stamps = read_stamps(path)
        if self._packets[-1] >= len(stamps) or np.isnat(stamps[self._packets]).any():
            found = f"{len(stamps)} lines" if self._packets[-1] >= len(stamps) else "an empty line"
            raise FormatError(
                path, expected=f"a time for each packet up to {self._packets[-1]}", found=found
            )
        seconds = self._times.of(stamps[self._packets])
        world_T_lidar = world_T_imu(np.stack([self._packet(n) for n in self._packets])) @ invert(
            self._lidar_T_imu(force)
        )
        later = seconds > np.concatenate([[-np.inf], np.maximum.accumulate(seconds)[:-1]])
        return Trajectory(world_T_lidar[later], seconds[later], str(path))

    def _packet(self, number: int) -> FloatArray:
        path = self.folder / "oxts" / "data" / f"{number:010d}.txt"
        packets = read_packets(path)
        if len(packets) != 1:
            raise FormatError(path, expected="one line", found=len(packets), advice="copy it again")
        return packets[0]

    def _lidar_T_imu(self, force: bool) -> Transform:
        path = self.folder.parent / "calib_imu_to_velo.txt"
        if force and not path.is_file():
            return np.eye(4)
        expected = (
            "R and T, which take points of the IMU to the LiDAR: the poses in oxts/ are those of "
            "the IMU"
        )
        return Calibration.read(path, expected).rotation_and_translation()

    def times(self) -> FloatArray | None:
        """Return the times at which the scanner looked forward, seconds after the first."""
        return self._times.seconds

    def cameras(self) -> Sequence[CameraModel]:
        """Return the rectified cameras; none without the date's calib_cam_to_cam.txt and
        calib_velo_to_cam.txt.
        """
        paths = [self.folder.parent / f"calib_{name}.txt" for name in ("cam_to_cam", "velo_to_cam")]
        if not all(path.is_file() for path in paths):
            return ()
        cameras, lidar = map(Calibration.read, paths)
        rectified_T_lidar = cameras.rotation("R_rect_00") @ lidar.rotation_and_translation()

        def image_of(name: str, frame: int) -> Path:
            return self.folder / name / "data" / f"{frame:010d}.png"

        projections = {f"image_0{number}": f"P_rect_0{number}" for number in range(4)}
        return rectified_cameras(cameras, rectified_T_lidar, projections, image_of, self._numbers)

    def boxes(self) -> Mapping[int, Boxes] | None:
        """Return the boxes of tracklet_labels.xml. They exist only in the view of the camera."""
        path = self.folder / "tracklet_labels.xml"
        return read_tracklets(path, self._numbers) if path.is_file() else None

    def notes(self) -> list[str]:
        """Return notes on missing packets, and on the area that the boxes cover."""
        notes = []
        if self._packets and (without := sorted(set(self._numbers) - set(self._packets))):
            notes.append(
                f"{len(without)} frames have no packet in oxts/ (first {without[0]}): their poses "
                f"are interpolated"
            )
        return notes + ([ONLY_IN_VIEW] if (self.folder / "tracklet_labels.xml").is_file() else [])
