"""Packed points, as in ROS' PointCloud2 and in Foxglove's PointCloud: any layout, to a column per
field.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import FormatError

# Types of sensor_msgs/PointField:
# https://docs.ros.org/en/noetic/api/sensor_msgs/html/msg/PointField.html
ROS_TYPES = dict(enumerate("i1 u1 i2 u2 i4 u4 f4 f8".split(), 1))


def read_columns(message: Any, where: str) -> dict[str, NDArray[Any]]:
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
    data: NDArray[np.uint8], fields: Iterable[tuple[str, int, str, int]], step: int, where: str
) -> dict[str, NDArray[Any]]:
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
