"""Files of poses and of times: TUM, KITTI, KITTI-360, EuRoC, CSV with a header, NumPy, the folders
of hdl_graph_slam; times in any unit, as whole nanoseconds.
"""

from __future__ import annotations

import re
from calendar import timegm
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from time import strptime
from typing import Literal, TypeVar

import numpy as np

from carlasc.core.arrays import FloatArray, IntArray
from carlasc.core.geometry import check_rigid
from carlasc.core.tables import lines_of
from carlasc.errors import FormatError
from carlasc.storage.arrays import NUMBERS, ArrayFormat, read_npy
from carlasc_converters.files import opening, read_text
from carlasc_converters.transforms import BAD_SHARE, are_poses, poses_of

PoseOf = Literal["sensor", "vehicle"]
_Row = TypeVar("_Row")
_Value = TypeVar("_Value")

# numbers in a line
_TUM = 8
_KITTI = 12
_KITTI360 = (13, 17)
_NAME = re.compile(
    r"(?:.*?[^\d.])??(?:(?:(?P<date>(?:19|20)\d\d(?:[-_]?\d\d){2}[-_T ]?\d\d(?:[-_:]?\d\d){2})"
    r"|(?P<seconds>[1-9]\d{8,9})(?=[-_]))(?:(?:(?P<point>\.)|[-_])(?P<rest>\d{1,9}))?"
    r"|(?P<number>[1-9]\d{9,}(?:\.\d+)?|\d+\.\d{6,}))\D*"
)
_PLACES = lines_of("""
    x y z
    tx ty tz
    px py pz
    p_rs_r_x p_rs_r_y p_rs_r_z
""")
_TURNS = lines_of("""
    qw qx qy qz
    q_rs_w q_rs_x q_rs_y q_rs_z
""")
_TIMES = "timestamp time t stamp seconds sec nsec timestamp_ns time_ns".split()
# A number above one of these is in milliseconds, microseconds or nanoseconds; in seconds, it would
# be a recording of years.
_UNITS = ((Decimal(10) ** 17, 1), (Decimal(10) ** 14, 10**3), (Decimal(10) ** 11, 10**6))


@dataclass(frozen=True)
class PoseRows:
    """The poses of a file.

    Attributes:
        world_T_body: (K, 4, 4) float64.
        stamps: (K,) int64 nanoseconds, None if the file has no times.
        of: whose poses these are, if the format defines it.
        numbers: (K,) increasing numbers of their scans, None if the file does not name them.
        notes: what was left out.
        other: (K, 4, 4) the poses if w is the first number of quaternions; None if their order is
            certain.
    """

    world_T_body: FloatArray
    stamps: IntArray | None
    of: PoseOf
    numbers: IntArray | None = None
    notes: tuple[str, ...] = ()
    other: FloatArray | None = None


def read_poses(path: Path) -> PoseRows:
    """Read a file of poses.

    The format is found by its suffix (.npy), its header, or the number of values in its lines.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: the format is unknown, a pose is not rigid, a quaternion does not have length
            1, or times do not increase.
    """
    if path.suffix.lower() == ".npy":
        poses = read_npy(path, ArrayFormat(NUMBERS, None)).astype(np.float64)
        with opening(path, "an array (N, 4, 4) of poses"):
            poses = poses.reshape(-1, *poses.shape[-2:])
        return PoseRows(_whole(poses, path), None, "sensor")
    lines = [line.strip() for line in read_text(path, "poses as text").splitlines() if line.strip()]
    comments = [line for line in lines if line.startswith("#")]
    rows = [_split(line) for line in lines if not line.startswith("#")]
    header = [word.lower().partition("[")[0].strip() for word in rows[0]] if rows else []
    if any(map(str.isidentifier, header)):
        return _read_named(header, rows[1:], path)
    if comments and "q_RS_w" in comments[0]:
        header = [
            word.lstrip("#").partition("[")[0].strip().lower() for word in comments[0].split(",")
        ]
        return _read_named(header, rows, path, of="vehicle")
    if rows and len(rows[0]) == _TUM:
        table = _numbers(rows, _TUM, path)
        stamps = _stamps([row[0] for row in rows], path)
        return _rows_of(table[:, [1, 2, 3, 7, 4, 5, 6]], stamps, path, "sensor", ordered=False)
    if rows and len(rows[0]) in (_KITTI, *_KITTI360):
        width = len(rows[0])
        table = _numbers(rows, width, path)
        numbers = None
        if width != _KITTI:
            numbers = table[:, 0].astype(np.int64)
            table = table[:, 1:13]
            if (np.diff(numbers) <= 0).any():
                raise FormatError(path, expected="numbers of scans that increase", found="others")
        return PoseRows(_whole(table.reshape(-1, 3, 4), path), None, "sensor", numbers)
    raise FormatError(
        path,
        expected="poses: lines of 8 numbers (TUM: t x y z qx qy qz qw), of 12 (KITTI) or of 13 "
        "(KITTI-360: number of the scan, and 12), a header "
        "with x, y, z, qw, qx, qy, qz, or .npy",
        found=f"lines of {len(rows[0])} values" if rows else "no lines",
    )


def read_stamps(path: Path) -> IntArray:
    """Return the (F,) nanoseconds of a file of times: one number per line, or the first of several;
    seconds, or a unit by its magnitude.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: a line is not a number.
    """
    lines = [line.strip() for line in read_text(path, "a time per line").splitlines()]
    return _stamps(
        [_split(line)[0] for line in lines if line and not line.startswith("#")],
        path,
        increasing=False,
    )


def nanoseconds(word: str) -> int:
    """Return the nanoseconds of a number: seconds, or, if it is too large for these, milliseconds,
    microseconds or nanoseconds.

    Raises:
        ValueError: it is not a finite number.
    """
    try:
        value = Decimal(word)
        scale = next((scale for least, scale in _UNITS if abs(value) >= least), 10**9)
        return int(value * scale)
    except (InvalidOperation, OverflowError):
        raise ValueError(word) from None


def _read_named(
    header: Sequence[str], rows: Sequence[list[str]], path: Path, of: PoseOf = "sensor"
) -> PoseRows:
    def columns(choices: Sequence[list[str]], what: str) -> list[int]:
        for names in choices:
            if all(name in header for name in names):
                return [header.index(name) for name in names]
        raise FormatError(
            path, expected=f"the columns {', '.join(choices[0])} of {what}", found=", ".join(header)
        )

    places = columns(_PLACES, "the position")
    turns = columns(_TURNS, "the rotation")
    times = next((header.index(name) for name in _TIMES if name in header), None)
    table = _numbers(rows, len(header), path)
    stamps = None if times is None else _stamps([row[times] for row in rows], path)
    return _rows_of(table[:, places + turns], stamps, path, of)


def _rows_of(
    table: FloatArray, stamps: IntArray | None, path: Path, of: PoseOf, *, ordered: bool = True
) -> PoseRows:
    """Return the poses of a table (K, 7) of x, y, z and a quaternion w, x, y, z.

    With times, a few rows that are no poses are left out, and of rows with one time the last is
    taken.
    """
    notes = list[str]()
    where = str(path)
    if stamps is not None:
        bad = ~are_poses(table)
        if bad.sum() > BAD_SHARE * len(table):
            bad[:] = False  # the first one is named below
        again = np.append(np.diff(stamps) == 0, False)
        for left, what in ((bad, "are no poses"), (again, "have the time of the next one")):
            if left.any():
                notes.append(f"{where}: {left.sum()} of {len(left)} rows {what}, and are left out")
        table = table[~(bad | again)]
        stamps = stamps[~(bad | again)]
    poses = poses_of(table[:, 3:], table[:, :3], where)
    other = None if ordered else poses_of(table[:, [4, 5, 6, 3]], table[:, :3], where)
    return PoseRows(poses, stamps, of, notes=tuple(notes), other=other)


def read_folders(folders: Sequence[Path]) -> PoseRows:
    """Read the poses and times of the folders that hdl_graph_slam writes: one for each scan, with a
    text file `data`.

    Raises:
        MissingDataError: a file does not exist.
        FormatError: it has no time or pose.
    """
    stamps = list[int]()
    poses = list[FloatArray]()
    for folder in folders:
        path = folder / "data"
        with opening(path, "the time and the pose of a scan: stamp and estimate"):
            words = path.read_text("utf-8").split()
            at = words.index("stamp")
            stamps.append(int(words[at + 1]) * 10**9 + int(words[at + 2]))
            at = words.index("estimate") + 1
            poses.append(np.array(words[at : at + 16], np.float64).reshape(4, 4))
    return PoseRows(_whole(np.array(poses), folders[0].parent), np.array(stamps), "sensor")


def stamps_of_names(names: Sequence[str]) -> IntArray | None:
    """Return the (F,) nanoseconds of names that are the times of scans; None if they are not.

    They end with a date, with seconds and nanoseconds, or with a number of at least ten digits, or
    with decimals, that does not begin with 0.
    """
    matches = [match for name in names if (match := _NAME.fullmatch(name))]
    if len(matches) < len(names):
        return None
    # parts of a second that are not decimals have the same width, or are nanoseconds
    widths = {len(match["rest"] or "") for match in matches}
    stamps = []
    for match in matches:
        if match["number"]:
            stamps.append(nanoseconds(match["number"]))
            continue
        try:
            date = strptime(re.sub(r"\D", "", match["date"] or "19700101000000"), "%Y%m%d%H%M%S")
        except ValueError:
            return None
        rest = match["rest"] or ""
        width = len(rest) if match["point"] or len(widths) == 1 else 9
        seconds = int(match["seconds"] or timegm(date))
        stamps.append(seconds * 10**9 + int(rest or 0) * 10 ** (9 - width))
    return np.array(stamps, np.int64) if (np.diff(stamps) > 0).all() else None


def _split(line: str) -> list[str]:
    mark = next((mark for mark in ";," if mark in line), None)
    return [word.strip(' "') for word in line.split(mark)]


def _numbers(rows: Sequence[list[str]], columns: int, path: Path) -> FloatArray:
    return np.array(
        _each(rows, lambda row: _floats(row, columns), f"{columns} numbers", path)
    ).reshape(-1, columns)


def _floats(row: list[str], columns: int) -> list[float]:
    if len(row) != columns:
        raise ValueError(f"{len(row)} values")
    return list(map(float, row))


def _stamps(words: Sequence[str], path: Path, *, increasing: bool = True) -> IntArray:
    stamps = np.array(_each(words, nanoseconds, "a time", path), np.int64)
    if increasing and (np.diff(stamps) < 0).any():
        line = int(np.argmax(np.diff(stamps) < 0)) + 2
        raise FormatError(
            path,
            expected="times that increase",
            found=f"{words[line - 1]} in row {line}, after {words[line - 2]}",
        )
    return stamps


def _each(
    rows: Sequence[_Row], parse: Callable[[_Row], _Value], expected: str, path: Path
) -> list[_Value]:
    values = []
    for number, row in enumerate(rows, 1):
        try:
            values.append(parse(row))
        except ValueError as error:
            raise FormatError(f"{path}: row {number}", expected=expected, found=error) from None
    return values


def _whole(poses: FloatArray, path: Path) -> FloatArray:
    """Return (K, 4, 4) poses from (K, 3, 4) or (K, 4, 4)."""
    if poses.ndim != 3 or poses.shape[1:] not in ((3, 4), (4, 4)):
        raise FormatError(path, expected="an array (N, 4, 4) of poses", found=f"{poses.shape}")
    whole = np.tile(np.eye(4), (len(poses), 1, 1))
    whole[:, :3] = poses[:, :3]
    return check_rigid(whole, str(path))
