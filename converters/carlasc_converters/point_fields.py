"""The fields of points: unpacked from the layouts of ROS' PointCloud2 and Foxglove's PointCloud,
named as files and messages of any origin name them, and the times of points in any unit.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from carlasc.core.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    Uint8Array,
    Uint32Array,
)
from carlasc.core.geometry import Transform, invert, transform_points
from carlasc.errors import FormatError

# Types of sensor_msgs/PointField:
# https://docs.ros.org/en/noetic/api/sensor_msgs/html/msg/PointField.html
ROS_TYPES = dict(enumerate("i1 u1 i2 u2 i4 u4 f4 f8".split(), 1))


def read_columns(message: Any, where: str) -> dict[str, AnyArray]:
    """Return the fields of a sensor_msgs/PointCloud2 by name; the points of all rows, one row after
    the other.

    Raises:
        FormatError: the data do not have the layout in the message.
    """
    order = ">" if message.is_bigendian else "<"
    fields = [
        (field.name, field.offset, f"{order}{ROS_TYPES.get(field.datatype, 'V')}", field.count)
        for field in message.fields
    ]
    height = message.height
    width = message.width
    step = message.point_step
    row_step = message.row_step
    data = np.asarray(message.data, np.uint8)
    if not row_step or len(data) == height * width * step:
        row_step = width * step  # some drivers fill it with other numbers
    if row_step < width * step or len(data) < height * row_step:
        raise FormatError(
            where,
            expected=f"{height} rows of {width} points of {step} bytes",
            found=f"{len(data)} bytes, {row_step} in a row",
        )
    rows = data[: height * row_step].reshape(height, row_step)[:, : width * step]
    return unpack_fields(np.ascontiguousarray(rows).reshape(-1), fields, step, where)


def unpack_fields(
    data: Uint8Array, fields: Iterable[tuple[str, int, str, int]], step: int, where: str
) -> dict[str, AnyArray]:
    """Return the fields of packed points by name.

    Args:
        data: the points, one after the other.
        fields: name, first byte, type and number of values per point of each field. Fields of
            several values, without a name or of an unknown type are left out.
        step: bytes of a point.
        where: the message, for errors.

    Raises:
        FormatError: a field lies outside of the point, or the points have no bytes.
    """
    usable: Mapping[str, tuple[int, np.dtype[Any]]] = {
        name: (offset, np.dtype(kind))
        for name, offset, kind, count in fields
        if name and count <= 1 and "V" not in kind
    }
    for name, (offset, kind) in usable.items():
        if offset + kind.itemsize > step:
            expected = f"points of {step} bytes"
            found = f"the field {name} up to byte {offset + kind.itemsize}"
            raise FormatError(where, expected=expected, found=found)
    if not step or len(data) % step:
        raise FormatError(where, expected=f"points of {step} bytes", found=f"{len(data)} bytes")
    points = data.view(
        np.dtype(
            {
                "names": list(usable),
                "offsets": [offset for offset, _ in usable.values()],
                "formats": [kind for _, kind in usable.values()],
                "itemsize": step,
            }
        )
    )
    return {name: points[name] for name in usable}


TimeUnit = Literal["auto", "s", "ms", "us", "ns"]
Columns = Mapping[str, AnyArray]
"""(N,) values of points by the names of a file or a message, in any case."""

# The usual names, in lower case, of each field; the first that exists is taken.
_NAMES = {
    "x": ["x", "x_m"],
    "y": ["y", "y_m"],
    "z": ["z", "z_m"],
    "intensity": (
        "intensity intensities i reflectivity reflectance remission scalar_intensity"
    ).split(),
    "ring": "ring channel line laser_id row".split(),
    "label": "label labels class semantic classification scalar_label".split(),
    "instance": "instance instances instance_id object_id track_id".split(),
}
TIMES = "t time timestamp time_stamp times offset_time gps_time scalar_time".split()
# Other names of times, and their unit; FAST-LIO puts milliseconds into `curvature`.
_TIME = re.compile(
    r"(?:scalar_)?(?P<base>curvature|\w*(?:time|stamp)\w*?|ts?|dt)?"
    r"(?:(?:^|_)(?P<unit>[mun]?s)(?:ec)?s?)?"
)
_NANOSECONDS: dict[TimeUnit, int] = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
_SCAN_S = (0.004, 0.6)  # duration of a scan: 2 to 200 Hz; fact: scan-duration
_LONGEST_S = 3.0  # no scan takes longer, whatever its unit is; fact: longest-scan
_CLOCK_S = 1.0  # a scan begins within this time of its own time: other times are those of a clock


@dataclass(frozen=True)
class PointClock:
    """The times of the points of a recording.

    Attributes:
        names: names of their columns, in lower case: one, or that of seconds and that of
            nanoseconds.
        unit: their unit.
        absolute: whether they are times of a clock; otherwise they are after the time of the scan.
        own: whether this clock was found to be another one than that of the scans.
        needed: whether other values are an error; otherwise they are no times.
    """

    names: tuple[str, ...]
    unit: TimeUnit
    absolute: bool = False
    own: bool = False
    needed: bool = True

    def of(self, columns: Columns) -> AnyArray | None:
        """Return the (N,) times of some points; None if they have no such columns."""
        lower = {name.lower(): values for name, values in columns.items()}
        given = [lower[name] for name in self.names if name in lower]
        if len(given) < len(self.names):
            return None
        if len(given) == 1:
            return given[0]
        return given[0].astype(np.int64) * 10**9 + given[1].astype(np.int64)

    def seconds(
        self, columns: Columns, returned: BoolArray, stamp_ns: int | None, where: str
    ) -> FloatArray | None:
        """Return the (N,) seconds of points after the time of their scan; None without times.

        Args:
            columns: the points.
            returned: (N,) whether a point is a return.
            stamp_ns: the time of the scan. If its clock is another one, or None, times are after
                the first point.
            where: the file or the message, for errors.

        Raises:
            FormatError: they are not times of a scan.
        """
        if (times := self.of(columns)) is None:
            return None
        try:
            seconds, start_ns, _ = point_seconds(times, self.unit, where, returned, self.absolute)
        except FormatError:
            if self.needed:
                raise
            return None
        after = 0.0 if start_ns is None or stamp_ns is None else (start_ns - stamp_ns) / 1e9
        return seconds + (after if abs(after) < _CLOCK_S else 0.0)


def find_clock(
    scans: Sequence[tuple[Columns, int | None]],
    unit: TimeUnit,
    where: str,
    *,
    needed: bool = True,
) -> PointClock | None:
    """Return how the times of points are found; None if they have none.

    Times that do not differ within a scan are no times.

    Args:
        scans: some scans of a recording, early and late ones, each with its time in nanoseconds.
        unit: their unit; "auto" for that of the name of the column, or of the duration of a scan.
        where: the recording, for errors.
        needed: whether values that are not times of a scan are an error, if there are no others.

    Raises:
        FormatError: a field of times does not contain those of a scan.
    """
    problem: FormatError | None = None
    for choice in _time_columns(scans[0][0]):
        clock = replace(choice, needed=needed, unit=choice.unit if unit == "auto" else unit)
        usual = choice.names[0] in TIMES
        found = False
        for columns, stamp_ns in scans:
            times = clock.of(columns)
            returned = returns(columns)
            if times is None:
                continue
            try:
                seconds, start, name = point_seconds(times, clock.unit, where, returned)
            except FormatError as error:
                problem = problem or (error if usual else None)
                continue
            duration = float(np.ptp(seconds)) if len(seconds) else 0.0
            if duration <= (0 if usual else _SCAN_S[0]):
                continue  # such as the curvature of a surface
            clock = replace(clock, unit=name)
            found = True
            if start is not None:
                own = stamp_ns is not None and abs(start - stamp_ns) > _CLOCK_S * 1e9
                clock = replace(clock, absolute=True, own=clock.own or own)
        if found:
            return clock
    if problem is not None and needed:
        raise problem
    return None


def _time_columns(columns: Columns) -> list[PointClock]:
    """Return the columns that may be times, the most usual first."""
    lower = [name.lower() for name in columns]
    usual = [PointClock((name,), "auto") for name in TIMES if name in lower]
    parts = {name: match for name in lower if (match := _TIME.fullmatch(name))}
    units: dict[str | None, Any] = {"curvature": "ms"}
    others = [
        PointClock((name,), units.get(match["base"], match["unit"]) or "auto")
        for name, match in parts.items()
        if match["base"] and name not in TIMES
    ]
    pairs = [
        PointClock((one, two), "ns")
        for one, first in parts.items()
        for two, second in parts.items()
        if first["base"] == second["base"] and (first["unit"], second["unit"]) == ("s", "ns")
    ]
    return usual + pairs + others


def named_fields(
    columns: Columns,
    where: str,
    clock: PointClock | None = None,
    world_T_scan: Transform | None = None,
) -> dict[str, AnyArray]:
    """Return the fields of some points by one name each.

    Args:
        columns: the points.
        where: the file or the message, for errors.
        clock: the times of points.
        world_T_scan: (4, 4) the pose of the scan, if its points are in the world frame, whose large
            numbers are no float32 numbers.

    Returns:
        `points` (N, 4) float32, x, y, z and the intensity (0 without one); if they exist, `time`
        and `ring` (N,), unchanged, and `label` and `instance` (N,) uint32.

    Raises:
        FormatError: x, y or z does not exist, or a class or an instance is not a whole number from
            0 to 2^32 - 1.
    """
    given = {field: _column(columns, field) for field in _NAMES}
    if missing := [field for field in ("x", "y", "z") if given[field] is None]:
        raise FormatError(
            where,
            expected=f"points with {', '.join(missing)}",
            found=f"only {', '.join(columns) or 'no fields'}",
        )
    count = len(given["x"])  # type: ignore[arg-type]
    points = np.zeros((count, 4), np.float32)
    for axis, field in enumerate(("x", "y", "z", "intensity")):
        if given[field] is not None:
            points[:, axis] = given[field]
    if world_T_scan is not None:
        places = np.column_stack([given[axis] for axis in "xyz"])  # type: ignore[misc]
        points[:, :3] = transform_points(invert(world_T_scan), places)
    fields: dict[str, AnyArray] = {"points": points}
    if clock is not None and (times := clock.of(columns)) is not None:
        fields["time"] = times
    if (rings := given["ring"]) is not None:
        fields["ring"] = rings
    for field in ("label", "instance"):
        if (values := given[field]) is not None:
            fields[field] = whole_numbers(values, f"{where}: {field}")
    return fields


def _column(columns: Columns, field: str) -> AnyArray | None:
    lower = {name.lower(): values for name, values in columns.items()}
    return next((lower[name] for name in _NAMES[field] if name in lower), None)


def returns(columns: Columns) -> BoolArray:
    """Return (N,) whether a point is a return: its position is finite, and not (0, 0, 0)."""
    axes = [_column(columns, axis) for axis in "xyz"]
    given = [axis for axis in axes if axis is not None]
    with np.errstate(invalid="ignore"):
        return np.logical_and.reduce([np.isfinite(axis) for axis in given]) & np.logical_or.reduce(
            [axis != 0 for axis in given]
        )


def unread(columns: Columns, clock: PointClock | None, *, classes: bool = False) -> list[str]:
    """Return the names of the columns that are not read."""
    lower = [name.lower() for name in columns]
    fields = _NAMES.keys() - {"ring"} - (set() if classes else {"label", "instance"})
    taken = {next((name for name in _NAMES[field] if name in lower), "") for field in fields}
    taken |= set() if clock is None else {*clock.names}
    return [name for name in columns if name.lower() not in taken]


def whole_numbers(values: AnyArray, where: str) -> Uint32Array:
    """Return (N,) ids as uint32.

    Raises:
        FormatError: a value is not a whole number from 0 to 2^32 - 1.
    """
    with np.errstate(invalid="ignore"):
        whole = values.astype(np.uint32)
    if not np.array_equal(whole, values):
        worst = values[np.flatnonzero(whole != values)[0]]
        raise FormatError(where, expected="whole numbers from 0 to 4294967295", found=worst)
    return whole


def point_seconds(
    times: AnyArray,
    unit: TimeUnit,
    where: str,
    returned: BoolArray | None = None,
    absolute: bool = False,
) -> tuple[FloatArray, int | None, TimeUnit]:
    """Return the times of the points of a scan in seconds.

    Args:
        times: (N,) times in the unit of the file: after the time of the scan, or times of a clock.
        unit: "auto" finds the unit from the duration of the scan: 4 ms to 0.6 s.
        where: the file or the message, for errors.
        returned: (N,) whether a point is a return; the times of others do not count. None: all.
        absolute: whether they are times of a clock. If not, those are that begin more than a second
            after or before 0.

    Returns:
        (N,) float64 seconds; the nanoseconds of the clock after which these are, None if they are
        after the time of the scan, or do not differ; the unit.

    Raises:
        FormatError: most times are not finite, or the scan takes too long, or has no usual duration
            in any unit.
    """
    times = _signed(times)
    known = np.isfinite(times) if returned is None else np.isfinite(times) & returned
    wanted = len(times) if returned is None else int(np.count_nonzero(returned))
    filled = known & (times != 0)
    if wanted < 2 * np.count_nonzero(filled) and (filled != known).any():
        least = float(times[filled].min())
        most = float(times[filled].max())
        if 10 * (most - least) < min(abs(least), abs(most)):
            known = filled  # the others were not filled in: a clock is not at 0
    if 0 < 2 * np.count_nonzero(known) <= wanted:
        raise FormatError(
            f"{where}: times of points", expected="finite numbers", found="NaN or infinity"
        )
    first = times[known].min() if known.any() else 0
    with np.errstate(invalid="ignore", over="ignore"):
        after = (times - first).astype(np.float64)
    span = after[known].max() if known.any() else 0.0
    if span == 0:
        # a column that was not filled in, or with the time of the scan
        return np.zeros(len(times)), None, "s" if unit == "auto" else unit
    if unit == "auto":
        low, high = _SCAN_S
        usual = next(
            (name for name, scale in _NANOSECONDS.items() if low <= span * scale / 1e9 <= high),
            None,
        )
        if usual is None:
            raise FormatError(
                f"{where}: times of points",
                expected="a scan of 4 ms to 0.6 s in seconds, milliseconds, microseconds or "
                "nanoseconds",
                found=f"times from {first} to {times[known].max()}",
                advice="give their unit with `time_unit`",
            )
        unit = usual
    scale = _NANOSECONDS[unit]
    if span * scale / 1e9 > _LONGEST_S:
        raise FormatError(
            f"{where}: times of points",
            expected=f"a scan of at most {_LONGEST_S:.0f} s",
            found=f"{span * scale / 1e9:.6g} s, from {first} to {times[known].max()} {unit}",
            advice="check `time_unit`, or leave them out with `deskewed`",
        )
    usable = known | (np.abs(after) * (scale / 1e9) <= _LONGEST_S)
    if absolute or abs(float(first)) * scale / 1e9 > _CLOCK_S:
        # A clock's float64 seconds keep 0.2 microseconds; whole numbers keep all.
        seconds = after * (scale / 1e9)
        whole = times.dtype.kind in "iu"
        start = int(first) * scale if whole else round(float(first) * scale)
    else:
        seconds = np.asarray(times, np.float64) * (scale / 1e9)
        start = None
    if not usable.all():
        places = np.flatnonzero(usable)
        seconds = np.interp(np.arange(len(times)), places, seconds[places])
    return seconds, start, unit


def _signed(times: AnyArray) -> AnyArray:
    """Return times without an overflow: those before 0 that were written as unsigned numbers, or a
    clock that began again.
    """
    if times.dtype.kind != "u" or not len(times):
        return times
    signed = times.view(times.dtype.str.replace("u", "i"))
    return min(times, signed, key=lambda values: int(values.max()) - int(values.min()))
