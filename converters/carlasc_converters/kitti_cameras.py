"""The cameras of KITTI's car: rectified pinholes, whose projections P0 to P3 are from the rectified
frame of the first one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from carlasc.core import CameraModel
from carlasc.core.geometry import Transform, invert, translation
from carlasc.errors import FormatError
from carlasc_converters.kitti_files import Calibration

SIZE = (1242, 375)
"""Columns and rows of most of KITTI's rectified images, which differ by a few pixels from day to
day.
"""


def rectified_cameras(
    calibration: Calibration,
    rectified_T_lidar: Transform,
    projections: Mapping[str, str],
    image_of: Callable[[str, int], Path],
    frames: Sequence[int],
    size: tuple[int, int] = SIZE,
) -> list[CameraModel]:
    """Return the cameras whose projections a calibration has, in the frame of the LiDAR.

    Scans and images have the same times, because the scanner triggers the cameras. The size of the
    images is that of the first existing one.

    Args:
        calibration: a file with lines of 12 numbers.
        rectified_T_lidar: (4, 4) to the rectified frame of the first camera.
        projections: name of each camera -> name of its projection.
        image_of: returns the path of a camera's image of a frame.
        frames: numbers of the frames.
        size: columns and rows of the images, if none exists.

    Raises:
        FormatError: a projection is not valid.
    """
    models = []
    for name, key in projections.items():
        if key not in calibration.values:
            continue
        numbers = calibration.values[key]
        if len(numbers) != 12:
            raise FormatError(
                calibration.path, expected=f"12 numbers after {key}", found=len(numbers)
            )
        rows = np.reshape(numbers, (3, 4))
        if rows[0, 0] <= 0 or rows[1, 1] <= 0 or (rows[2, :3] != (0, 0, 1)).any():
            expected = f"fx 0 cx, 0 fy cy, 0 0 1 and a translation after {key}"
            raise FormatError(calibration.path, expected=expected, found=numbers)
        rectified_T_camera = translation(-np.linalg.solve(rows[:, :3], rows[:, 3]))
        paths = {frame: image_of(name, frame) for frame in frames}
        existing = [path for path in paths.values() if path.is_file()]
        width, height = _size_of(existing[0]) if existing else size
        last = max(frames)
        there = {frame: str(path.absolute()) for frame, path in paths.items() if path.is_file()}
        models.append(
            CameraModel(
                name=name,
                width=width,
                height=height,
                matrix=rows[:, :3],
                sensor_T_camera=invert(rectified_T_lidar) @ rectified_T_camera,
                images=tuple(there.get(frame, "") for frame in range(last + 1))
                if existing
                else None,
            )
        )
    return models


def _size_of(path: Path) -> tuple[int, int]:
    """Return columns and rows of a PNG from its header.

    Raises:
        FormatError: the file is not a PNG.
    """
    head = path.open("rb").read(24) if path.stat().st_size >= 24 else b""
    if not head.startswith(b"\x89PNG\r\n\x1a\n"):
        raise FormatError(path, expected="a PNG", found="something else", advice="copy it again")
    return int.from_bytes(head[16:20]), int.from_bytes(head[20:24])
