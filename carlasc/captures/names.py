"""The file names of a raw capture, and what the files hold. Paths are relative to the folder raw/.

velodyne{s}/{f}.npy  labels{s}/  instances{s}/  velocities{s}/  pose{s}/  times{s}.txt  bev/{f}.jpg
"""

from __future__ import annotations

import re

from carlasc.errors import FormatError
from carlasc.storage.arrays import ArrayFormat

RAW = "raw"
"""Name of the folder that holds a capture, in the folder of its sequence."""

FOLDERS = {  # value -> folder, to which the sensor's number is appended
    "points": "velodyne",
    "labels": "labels",
    "instances": "instances",
    "velocities": "velocities",
    "pose": "pose",
}
FORMATS = {
    "points": ArrayFormat(("<f4",), (None, 3)),
    "labels": ArrayFormat(("<u4",), (None,)),
    "instances": ArrayFormat(("<u4",), (None,)),
    "velocities": ArrayFormat(("<f8",), (None, 4)),
    "pose": ArrayFormat(("<f8",), (4, 4)),
}
_BEV = "bev"


def array_path(name: str, sensor: int, frame: int) -> str:
    """Return the path of one value, such as "points", of a sensor in a frame."""
    return f"{FOLDERS[name]}{sensor}/{frame}.npy"


def times_path(sensor: int) -> str:
    """Return the path of a sensor's times file."""
    return f"times{sensor}.txt"


def bev_path(frame: int) -> str:
    """Return the path of a frame's bird's-eye picture."""
    return f"{_BEV}/{frame}.jpg"


def parse_times(data: bytes | memoryview, where: str) -> dict[int, tuple[float, str]]:
    """Return the time in seconds and the line of each frame of a times file. Where a frame has several lines, the last one is valid.

    Raises:
        FormatError: a line of the file is not in CARLA's form; `where` names the file.
    """
    found: dict[int, tuple[float, str]] = {}
    for number, line in enumerate(bytes(data).decode(errors="replace").splitlines(), 1):
        match = re.match(r"\s*([0-9]{1,18})\s*,.*\belapsed_seconds=([-+0-9.eE]+)", line)
        try:
            if match is None:
                raise ValueError("another form")
            found[int(match[1])] = float(match[2]), line
        except ValueError as error:
            raise FormatError(
                where,
                expected="'<frame>, Timestamp(...,elapsed_seconds=...)'",
                found=f"{line[:60]!r} in line {number}",
            ) from error
    return found
