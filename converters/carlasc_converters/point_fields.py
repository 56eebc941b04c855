"""The fields of points: unpacked from the layouts of ROS' PointCloud2 and Foxglove's PointCloud,
named as files and messages of any origin name them, and the times of points in any unit.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Literal

import numpy as np

from carlasc.core.arrays import AnyArray, FloatArray, Uint8Array, Uint32Array
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
    height, width, step = message.height, message.width, message.point_step
    row_step, data = message.row_step or width * step, np.asarray(message.data, np.uint8)
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
            expected, found = (
                f"points of {step} bytes",
                f"the field {name} up to byte {offset + kind.itemsize}",
            )
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

# The usual names, in lower case, of each field; the first that exists is taken.
_NAMES: dict[str, tuple[str, ...]] = {
    "x": ("x", "x_m"),
    "y": ("y", "y_m"),
    "z": ("z", "z_m"),
    "intensity": (
        "intensity",
        "intensities",
        "i",
        "reflectivity",
        "reflectance",
        "remission",
        "scalar_intensity",
    ),
    "time": (
        "t",
        "time",
        "timestamp",
        "time_stamp",
        "times",
        "offset_time",
        "gps_time",
        "scalar_time",
    ),
    "ring": ("ring", "channel", "line", "laser_id", "row"),
    "label": ("label", "labels", "class", "semantic", "classification", "scalar_label"),
    "instance": ("instance", "instances", "instance_id", "object_id", "track_id"),
}
_NANOSECONDS: dict[TimeUnit, int] = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
_SCAN_S = (0.004, 0.6)  # duration of a scan: 2 to 200 Hz; fact: scan-duration
_ABSOLUTE_S = 1e6  # a time of a clock, not one within a scan


def named_fields(columns: Mapping[str, AnyArray], where: str) -> dict[str, AnyArray]:
    """Return the fields of some points by one name each.

    Args:
        columns: (N,) values by the names of a file or a message, in any case.
        where: the file or the message, for errors.

    Returns:
        `points` (N, 4) float32, x, y, z and the intensity (0 without one); if they exist, `time`
        and `ring` (N,), unchanged, and `label` and `instance` (N,) uint32.

    Raises:
        FormatError: x, y or z does not exist, or a class or an instance is not a whole number from
            0 to 2^32 - 1.
    """
    lower = {name.lower(): values for name, values in columns.items()}
    given = {
        field: next((lower[name] for name in names if name in lower), None)
        for field, names in _NAMES.items()
    }
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
    fields: dict[str, AnyArray] = {"points": points}
    for field in ("time", "ring"):
        if (values := given[field]) is not None:
            fields[field] = values
    for field in ("label", "instance"):
        if (values := given[field]) is not None:
            fields[field] = whole_numbers(values, f"{where}: {field}")
    return fields


def whole_numbers(values: AnyArray, where: str) -> Uint32Array:
    """Return (N,) ids as uint32.

    Raises:
        FormatError: a value is not a whole number from 0 to 2^32 - 1.
    """
    with np.errstate(invalid="ignore"):
        whole = values.astype(np.uint32)
    if not np.array_equal(whole, values):
        worst = values[np.flatnonzero(whole != values)[0]]
        raise FormatError(where, expected="whole numbers from 0 to 4294967295", found=str(worst))
    return whole


def point_seconds(
    times: AnyArray, unit: TimeUnit, where: str
) -> tuple[FloatArray, int | None, TimeUnit]:
    """Return the times of the points of a scan in seconds.

    Args:
        times: (N,) times in the unit of the file: after the time of the scan, or times of a clock.
        unit: "auto" finds the unit from the duration of the scan: 4 ms to 0.6 s.
        where: the file or the message, for errors.

    Returns:
        (N,) float64 seconds; the nanoseconds of the clock after which these are, None if they are
        after the time of the scan; the unit.

    Raises:
        FormatError: a time is not finite, or the scan has no usual duration in any unit.
    """
    if not len(times):
        return np.empty(0), None, "s" if unit == "auto" else unit
    if times.dtype.kind == "f" and not np.isfinite(times).all():
        raise FormatError(
            f"{where}: times of points", expected="finite numbers", found="NaN or infinity"
        )
    first, last = times.min(), times.max()
    span = int(last) - int(first) if times.dtype.kind in "iu" else float(last) - float(first)
    if span == 0 and first == 0:
        # a column that was not filled in
        return (
            np.zeros(len(times)),
            None,
            "s" if unit == "auto" else unit,
        )
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
                found=f"times from {first} to {last}",
                advice="give their unit with `time_unit`",
            )
        unit = usual
    scale = _NANOSECONDS[unit]
    if abs(float(first)) * scale / 1e9 < _ABSOLUTE_S:
        return np.asarray(times, np.float64) * (scale / 1e9), None, unit
    # A clock's float64 seconds keep 0.2 microseconds; whole numbers keep all.
    after = (times - first).astype(np.float64) * (scale / 1e9)
    start = int(first) * scale if times.dtype.kind in "iu" else round(float(first) * scale)
    return after, start, unit
