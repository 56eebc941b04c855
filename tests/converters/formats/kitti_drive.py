"""What the data sets of the KITTI family would have recorded of a simulated drive, with a LiDAR
that turns clockwise.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from carlasc.core.boxes import Boxes
from carlasc.core.geometry import Transform, invert
from carlasc.testing.drives import DriveScan, SimulatedDrive

PERIOD_S = 0.1033


@dataclass(frozen=True)
class KittiDrive:
    """A simulated drive with one LiDAR, in the frame of the LiDAR."""

    drive: SimulatedDrive
    _scans: dict[int, DriveScan] = field(default_factory=dict)

    @property
    def frames(self) -> int:
        return self.drive.frames

    @property
    def times(self) -> NDArray[np.float64]:
        return self.drive.times

    def scan(self, frame: int) -> DriveScan:
        if frame not in self._scans:
            self._scans[frame] = self.drive.scan(frame)
        return self._scans[frame]

    def world_T_lidar(self, seconds: NDArray[np.float64] | float) -> NDArray[np.float64]:
        return self.drive.world_T_vehicle(seconds) @ self.drive.sensors[0].vehicle_T_sensor

    def boxes(self, frame: int, labels: dict[str, int]) -> Boxes:
        """Return the boxes in front of the LiDAR: what the camera sees."""
        boxes = self.drive.boxes(frame, labels).transform(
            invert(self.drive.sensors[0].vehicle_T_sensor)
        )
        return boxes.select(boxes.centers[:, 0] > 1.0)


def small_drive(frames: int = 6, period_s: float = PERIOD_S) -> KittiDrive:
    return KittiDrive(
        SimulatedDrive(frames, period_s, rolling=True, clockwise=True, channels=10, columns=90)
    )


def write_scan(path: Path, points: NDArray[np.float32]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    points.astype("<f4").tofile(path)


def write_stamps(path: Path, seconds: NDArray[np.float64]) -> None:
    """Write timestamps.txt as KITTI does: with nanoseconds."""
    path.parent.mkdir(parents=True, exist_ok=True)
    stamps = np.datetime64("2011-09-26T13:02:25.9", "ns") + np.round(
        np.asarray(seconds) * 1e9
    ).astype("timedelta64[ns]")
    path.write_text("".join(f"{str(stamp).replace('T', ' ')}\n" for stamp in stamps))


def packets_of(world_T_imu: NDArray[np.float64], latitude: float = 49.0) -> NDArray[np.float64]:
    """Return the (K, 30) packets of OXTS whose poses are these: the inverse of the Mercator
    projection of KITTI's development kit.
    """
    earth = 6378137.0
    scale = np.cos(np.radians(latitude))
    # the first place: its latitude gives the scale
    begin = scale * earth * np.log(np.tan(np.pi * (90 + latitude) / 360))
    places = world_T_imu[:, :3, 3] - world_T_imu[0, :3, 3]
    packets = np.zeros((len(world_T_imu), 30))
    packets[:, 0] = 360 / np.pi * np.arctan(np.exp((places[:, 1] + begin) / (scale * earth))) - 90
    packets[:, 1] = 8.43 + np.degrees(places[:, 0] / (scale * earth))
    packets[:, 2] = 112.0 + places[:, 2]
    r = world_T_imu[:, :3, :3]
    packets[:, 3] = np.arctan2(r[:, 2, 1], r[:, 2, 2])
    packets[:, 4] = -np.arcsin(r[:, 2, 0])
    packets[:, 5] = np.arctan2(r[:, 1, 0], r[:, 0, 0])
    return packets


def write_packets(path: Path, packets: NDArray[np.float64]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        "".join(" ".join(f"{value!r}" for value in row) + "\n" for row in packets.tolist())
    )


def numbers(transform: Transform) -> str:
    return " ".join(f"{value!r}" for value in transform[:3].reshape(-1).tolist())
