"""OXTS: the packets of the inertial and satellite navigation system of KITTI's car, and the poses
from them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from carlasc.core.arrays import FloatArray
from carlasc.errors import FormatError
from carlasc_converters.kitti_files import read_lines

COLUMNS = 30
_EARTH_M = 6378137.0


def read_packets(path: Path) -> FloatArray:
    """Read the packets of a file, one per line.

    Returns:
        (K, 30) latitude and longitude in degrees, altitude in metres, roll, pitch and yaw in
        radians, and 24 columns that are not used.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: a line does not have 30 finite numbers.
    """
    lines = read_lines(path, "a packet of OXTS", "numbers")
    packets = np.empty((len(lines), COLUMNS))
    for number, line in enumerate(lines):
        try:
            values = np.array(line.split(), np.float64)
        except ValueError as error:
            raise _wrong(path, number, f"{error}") from error
        if len(values) != COLUMNS:
            raise _wrong(path, number, f"{len(values)} numbers")
        if not np.isfinite(values[:6]).all():
            raise _wrong(path, number, "a place that is not finite")
        packets[number] = values
    return packets


def world_T_imu(packets: FloatArray) -> FloatArray:
    """Return (K, 4, 4) poses of the IMU (x forward, y left, z up) in a world with x to the east, y
    to the north and z up, metres.

    As in KITTI's development kit: the Mercator projection, scaled by the cosine of the first
    latitude, and the rotation Rz(yaw) Ry(pitch) Rx(roll). The origin of the world is the position
    of the first packet.
    """
    latitude = packets[:, 0]
    longitude = packets[:, 1]
    altitude = packets[:, 2]
    scale = np.cos(np.radians(latitude[0])) * _EARTH_M
    east = scale * np.radians(longitude)
    north = scale * np.log(np.tan(np.pi / 4 + np.radians(latitude) / 2))
    poses = np.tile(np.eye(4), (len(packets), 1, 1))
    poses[:, :3, :3] = (
        _about(2, packets[:, 5]) @ _about(1, packets[:, 4]) @ _about(0, packets[:, 3])
    )
    poses[:, :3, 3] = np.stack([east - east[0], north - north[0], altitude - altitude[0]], axis=1)
    return poses


def _about(axis: int, angles: FloatArray) -> FloatArray:
    """Return (K, 3, 3) rotations about an axis."""
    one = (axis + 1) % 3
    other = (axis + 2) % 3
    rotations = np.tile(np.eye(3), (len(angles), 1, 1))
    rotations[:, one, one] = rotations[:, other, other] = np.cos(angles)
    rotations[:, other, one] = np.sin(angles)
    rotations[:, one, other] = -rotations[:, other, one]
    return rotations


def _wrong(path: Path, line: int, found: str) -> FormatError:
    return FormatError(
        path,
        expected=f"{COLUMNS} numbers per line",
        found=f"{found} in line {line + 1}",
        advice="copy it again",
    )
