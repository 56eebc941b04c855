"""The common parts of the KITTI data sets: the car and its scanner, and the files of scans,
calibrations and time stamps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.converting import Cloud, Converter, FrameHandle
from carlasc.core.arrays import AnyArray, AnyIntArray, Float32Array, FloatArray
from carlasc.core.geometry import Transform, check_rigid
from carlasc.errors import FormatError, MissingDataError
from carlasc.storage import layout
from carlasc_converters.files import is_number, opening, read_text

HEIGHT_M = 1.73  # of the scanner above the ground, on KITTI's car
_AGAIN = "copy it again"
_NANOSECOND = np.timedelta64(1, "ns")


class KittiConverter(Converter):
    """A data set that KITTI's car recorded."""

    license = "CC BY-NC-SA 3.0"
    sensor = "Velodyne HDL-64E"
    min_range_m = 2.5
    max_range_m = 70.0


def read_lines(path: Path, expected: str, content: str) -> list[str]:
    """Return the lines of a text file, without spaces at their ends and without empty lines at the
    end of the file.

    Args:
        path: the file.
        expected: purpose of the file, for the error if it does not exist.
        content: content of the file, for the error if it is not text.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: it is not text.
    """
    if not path.exists():
        raise MissingDataError(path, expected=expected, found="no such file", advice="copy it")
    return [line.strip() for line in read_text(path, content).rstrip().splitlines()]


def read_array(path: str, dtype: np.dtype[Any], columns: int) -> AnyArray:
    """Read a file of rows without a header, as (N, columns) of `dtype`.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: its size is not a whole number of rows.
    """
    with opening(path, "a file", _AGAIN):
        data = np.fromfile(path, np.uint8)
    row = dtype.itemsize * columns
    if len(data) % row:
        raise FormatError(
            path,
            expected=f"a multiple of {row} bytes",
            found=len(data),
            advice="the file is incomplete: copy it again",
        )
    return data.view(dtype).reshape(-1, columns)


def read_scan(path: str) -> Float32Array:
    """Read a scan: (N, 4) float32 x forward, y left, z up in metres, and reflectance 0 to 1, in the
    frame of the scanner.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: the file is empty, or its size is not a whole number of points.
    """
    points = read_array(path, np.dtype("<f4"), 4)
    if not len(points):
        raise FormatError(path, expected="points", found="an empty file", advice=_AGAIN)
    return points


def sweep_seconds(points: Float32Array, period_s: float) -> Float32Array:
    """Return (N,) the time of each point after the time of its scan, from its azimuth.

    The scanner turns once in `period_s`. A sweep begins behind the car and passes the left side,
    the front (at the time of the scan) and the right side: clockwise, seen from above. KITTI-360's
    tools correct scans for motion in the same way (`CurlVelodyneData`). The documentation of
    KITTI's raw data says that the scanner turns counter-clockwise; with that direction, the scans
    of a drive agree less than without any correction, and with this one they agree best.
    """
    return (np.arctan2(points[:, 1], points[:, 0]) * (-period_s / (2 * np.pi))).astype(np.float32)


@dataclass(frozen=True)
class SweepFrame(FrameHandle):
    """One scan of the raw data or of the tracking benchmark.

    Attributes:
        location: the file of its points.
        number: its number.
        period_s: time of one turn of the scanner, seconds.
    """

    location: str
    number: int
    period_s: float

    def read(self) -> Sequence[Cloud]:
        """Read the points, and find their times from their azimuths."""
        points = read_scan(self.location)
        return [Cloud(points, seconds=sweep_seconds(points, self.period_s))]


def frames_of(folder: Path, suffix: str) -> list[int]:
    """Return the sorted frame numbers of a folder's files; none if the folder does not exist."""
    if not folder.is_dir():
        return []
    numbers = (layout.frame_of(path.name, suffix) for path in folder.iterdir())
    return sorted(number for number in numbers if number is not None)


@dataclass(frozen=True)
class Calibration:
    """A file of calibrations: a name and numbers per line.

    Attributes:
        path: the file.
        values: the numbers by name; "" for lines without a name.
    """

    path: Path
    values: dict[str, list[float]]

    @classmethod
    def read(cls, path: Path, expected: str = "a name and numbers per line") -> Calibration:
        """Read a file.

        Names may end in a colon or not. Lines with other values, such as a date, are ignored.

        Args:
            path: the file.
            expected: purpose of the file, for the error if it does not exist.

        Raises:
            MissingDataError: the file does not exist.
            FormatError: it is not text.
        """
        values: dict[str, list[float]] = {}
        for line in read_lines(path, expected, "NAME: and 12 numbers per line"):
            name, colon, rest = line.partition(":")
            if not colon:
                name, _, rest = line.partition(" ")
                name, rest = ("", line) if is_number(name) else (name, rest)
            if all(map(is_number, rest.split())):
                values[name.strip()] = [float(value) for value in rest.split()]
        return cls(path, values)

    def transform(self, *names: str) -> Transform:
        """Return the (4, 4) transform of the first of some names that exists: three rows of four
        numbers.

        Raises:
            FormatError: no name exists, the number of its values is wrong, or the transform is not
                rigid.
        """
        return self._rigid(np.reshape(self._numbers(12, *names), (3, 4)), names[0])

    def rotation(self, *names: str) -> Transform:
        """Return the same for three rows of three numbers: a rotation, as a (4, 4) transform."""
        return self._rigid(np.reshape(self._numbers(9, *names), (3, 3)), names[0])

    def rotation_and_translation(self) -> Transform:
        """Return the same for KITTI's raw data, whose files have a rotation `R` and a translation
        `T`.
        """
        rotation = np.reshape(self._numbers(9, "R"), (3, 3))
        place = np.reshape(self._numbers(3, "T"), (3, 1))
        return self._rigid(np.hstack([rotation, place]), "R, T")

    def _numbers(self, count: int, *names: str) -> list[float]:
        name = next((name for name in names if name in self.values), None)
        if name is None:
            found = ", ".join(filter(None, self.values)) or "other lines"
            expected = " or ".join(names) or f"a line of {count} numbers"
            raise FormatError(self.path, expected=expected, found=f"only {found}", advice=_AGAIN)
        values = self.values[name]
        if len(values) != count:
            where = f"after {name}:" if name else "in a line"
            raise FormatError(
                self.path,
                expected=f"{count} numbers {where}",
                found=len(values),
                advice=_AGAIN,
            )
        return values

    def _rigid(self, rows: FloatArray, name: str) -> Transform:
        transform = np.eye(4)
        transform[:3, : rows.shape[1]] = rows
        return check_rigid(transform, f"{self.path}: {name}" if name else str(self.path))


def read_stamps(path: Path) -> NDArray[np.datetime64]:
    """Read timestamps.txt: (F,) datetime64[ns], a line "2011-09-26 13:02:25.964389445" per frame.

    An empty line is no time (NaT).

    Raises:
        MissingDataError: the file does not exist.
        FormatError: a line is not a time.
    """
    lines = read_lines(path, "a time per frame", "a time per line")
    stamps = np.full(len(lines), np.datetime64("NaT"), "datetime64[ns]")
    for number, line in enumerate(lines):
        try:
            stamps[number] = np.datetime64(line, "ns") if line else stamps[number]
        except ValueError as error:
            raise FormatError(
                path,
                expected="a time such as 2011-09-26 13:02:25.964389445 per line",
                found=f"{line!r} in line {number + 1}",
                advice=_AGAIN,
            ) from error
    return stamps


@dataclass(frozen=True)
class FrameTimes:
    """The times of the frames of a drive.

    Attributes:
        start: the time stamp of time 0.
        seconds: (F,) seconds by frame number, increasing.
    """

    start: np.datetime64
    seconds: FloatArray

    @classmethod
    def read(cls, path: Path, frames: Sequence[int]) -> FrameTimes:
        """Read a file of time stamps, of which line i belongs to frame i. Time 0 is the first one.

        In a file with exactly one line per scan, lines are in the order of the scans. Missing times
        of frames without a scan are interpolated.

        Args:
            path: timestamps.txt.
            frames: numbers of the frames that have a scan, increasing.

        Raises:
            MissingDataError: the file does not exist.
            FormatError: a frame with a scan has no time, or times do not increase.
        """
        stamps = read_stamps(path)
        by_order = len(stamps) == len(frames) <= frames[-1]
        numbers = np.asarray(frames) if by_order else np.arange(len(stamps))
        known = ~np.isnat(stamps)
        if without := sorted(set(frames) - set(numbers[known].tolist())):
            found = f"none for frame {without[0]}"
            raise FormatError(
                path,
                expected=f"a time for each frame up to {frames[-1]}",
                found=found,
                advice=_AGAIN,
            )
        numbers = numbers[known]
        stamps = stamps[known]
        seconds = cls(stamps[0], np.empty(0)).of(stamps)
        if not (np.diff(seconds) > 0).all():
            found = f"none at frame {numbers[int(np.argmin(np.diff(seconds))) + 1]}"
            raise FormatError(path, expected="times that increase", found=found, advice=_AGAIN)
        every = np.arange(max(int(numbers[-1]), frames[-1]) + 1)
        # frames before the first time
        before = np.clip(numbers[0] - every, 0, None) * _period(numbers, seconds)
        return cls(stamps[0], np.interp(every, numbers, seconds) - before)

    def of(self, stamps: NDArray[np.datetime64]) -> FloatArray:
        """Return the seconds of other time stamps by the same clock."""
        return np.asarray((stamps - self.start) / _NANOSECOND, np.float64) * 1e-9

    @property
    def period_s(self) -> float:
        """The usual time between frames; 0.1 s if there is only one."""
        return _period(np.arange(len(self.seconds)), self.seconds)


def _period(numbers: AnyIntArray, seconds: FloatArray) -> float:
    return (
        float(np.median(np.diff(seconds) / np.diff(numbers)))
        if len(seconds) > 1
        else layout.FRAME_PERIOD_S
    )
