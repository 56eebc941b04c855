"""Foxglove's own messages of points and poses, as protobuf or JSON:
https://docs.foxglove.dev/docs/sdk/schemas.

Protobuf is decoded with a table of the needed fields and their published numbers, without a
library.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from struct import unpack_from
from types import SimpleNamespace
from typing import Any

# Fields by number: name and kind: a name of another table, with [] if repeated, or "text", "bytes",
# "number", "fixed32" or "double".
_STAMPED = {1: ("timestamp", "time")}
_MESSAGES: dict[str, dict[int, tuple[str, str]]] = {
    "time": {1: ("sec", "number"), 2: ("nsec", "number")},
    "vector": {1: ("x", "double"), 2: ("y", "double"), 3: ("z", "double")},
    "quaternion": {1: ("x", "double"), 2: ("y", "double"), 3: ("z", "double"), 4: ("w", "double")},
    "pose": {1: ("position", "vector"), 2: ("orientation", "quaternion")},
    "field": {1: ("name", "text"), 2: ("offset", "fixed32"), 3: ("type", "number")},
    "foxglove.PoseInFrame": _STAMPED | {2: ("frame_id", "text"), 3: ("pose", "pose")},
    "foxglove.FrameTransforms": {1: ("transforms", "foxglove.FrameTransform[]")},
    "foxglove.FrameTransform": _STAMPED
    | {
        2: ("parent_frame_id", "text"),
        3: ("child_frame_id", "text"),
        4: ("translation", "vector"),
        5: ("rotation", "quaternion"),
    },
    "foxglove.PointCloud": _STAMPED
    | {
        2: ("frame_id", "text"),
        3: ("pose", "pose"),
        4: ("point_stride", "fixed32"),
        5: ("fields", "field[]"),
        6: ("data", "bytes"),
    },
}
_EMPTY: dict[str, Any] = {"text": "", "bytes": b"", "number": 0, "fixed32": 0, "double": 0.0}
FIELD_TYPES = dict(enumerate("u1 i1 u2 i2 u4 i4 f4 f8".split(), 1))
"""Types of a PackedElementField by number."""


def read_message(data: bytes, kind: str, encoding: str) -> Any:
    """Return a message with its fields as attributes, by their names in Foxglove's JSON.

    Fields that are not set have empty values.

    Args:
        data: the message.
        kind: its type, such as "foxglove.PointCloud".
        encoding: "protobuf" or "json".

    Raises:
        ValueError, struct.error, LookupError: the data are not such a message.
    """
    return (
        _from_json(json.loads(data), kind)
        if encoding == "json"
        else _from_protobuf(memoryview(data), kind)
    )


def _from_json(value: Any, kind: str) -> Any:
    if kind == "bytes":
        return base64.b64decode(value)
    if kind not in _MESSAGES:
        return value
    message = _empty(kind)
    for name, of in _MESSAGES[kind].values():
        if name in value:
            inner = of.removesuffix("[]")
            given = value[name]
            setattr(
                message,
                name,
                [_from_json(one, inner) for one in given] if inner != of else _from_json(given, of),
            )
    return message


def _from_protobuf(data: memoryview, kind: str) -> Any:
    message = _empty(kind)
    table = _MESSAGES[kind]
    for number, value in _wire(data):
        if number in table:
            name, of = table[number]
            if of.endswith("[]"):
                getattr(message, name).append(_value(value, of.removesuffix("[]")))
            else:
                setattr(message, name, _value(value, of))
    return message


def _value(value: Any, kind: str) -> Any:
    if kind in _MESSAGES:
        return _from_protobuf(value, kind)
    if kind in ("fixed32", "double"):
        return unpack_from("<I" if kind == "fixed32" else "<d", value)[0]
    return bytes(value).decode() if kind == "text" else value


def _empty(kind: str) -> SimpleNamespace:
    fields = _MESSAGES[kind].values()
    return SimpleNamespace(
        **{
            name: [] if of.endswith("[]") else _EMPTY[of] if of in _EMPTY else _empty(of)
            for name, of in fields
        }
    )


def _wire(data: memoryview) -> Iterator[tuple[int, Any]]:
    """Yield the number of each field and its value: a number, or bytes.

    See https://protobuf.dev/programming-guides/encoding.
    """
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        if key & 7 == 0:
            value, at = _varint(data, at)
            yield key >> 3, value
            continue
        size = {1: 8, 5: 4}.get(key & 7)
        if size is None:
            size, at = _varint(data, at)
        if at + size > len(data):
            raise ValueError("a protobuf message that is cut short")
        yield key >> 3, data[at : at + size]
        at += size


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    """Return a number, and where the next value begins."""
    value = shift = 0
    while True:
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            return value, at
        if shift > 63:
            raise ValueError("a protobuf number of more than 64 bits")
