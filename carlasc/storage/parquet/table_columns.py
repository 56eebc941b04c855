"""Conversion of the frames of a field to columns of a Parquet table and back.

Values keep their published types. Dictionaries and byte-stream split of Parquet make them small.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyArray
from carlasc.core.boxes import BOXES_DTYPE
from carlasc.errors import FormatError
from carlasc.storage.field_files import TABLES, VELOCITY_DTYPE, Field, join_table
from carlasc.storage.packed.columns import narrow, quantise

AXES = frozenset("xyz")
"""Columns of points that can be quantised.

Otherwise they use byte-stream split, because their values rarely repeat.
"""

_VELOCITY = ("vx", "vy", "vz")


def describe(entry: Field, array: AnyArray, scale_m: float | None) -> dict[str, Any]:
    """Return the attributes that a reader needs in addition to the columns.

    Args:
        entry: the field.
        array: the first frame.
        scale_m: rounding step of coordinates, metres; None does not round.
    """
    if entry.kind == "position" and scale_m:
        return {"scale_m": scale_m}
    return {"label_bytes": array.dtype["label"].itemsize} if entry.kind == "votes" else {}


def column_types(entry: Field, attributes: Mapping[str, Any]) -> dict[str, str]:
    """Return the pyarrow type name of each column. `attributes` is the result of `describe`."""
    match entry.kind:
        case "position":
            return {
                name: "int32" if "scale_m" in attributes and name in AXES else "float32"
                for name in entry.names
            }
        case "picture":
            return {"jpeg": "binary"}
        case "votes":
            return {
                "voxel": "int32",
                "label": f"uint{8 * attributes['label_bytes']}",
                "votes": "uint16",
            }
        case "velocities":
            return {"voxel": "int32"} | dict.fromkeys(_VELOCITY, "float16")
        case "boxes":
            return {name: BOXES_DTYPE[name].name for name in entry.names}
        case _:
            return dict.fromkeys(entry.names, np.dtype(entry.dtype).name)


def split_columns(
    entry: Field, array: AnyArray, attributes: Mapping[str, Any]
) -> dict[str, AnyArray]:
    """Return the columns of a frame: of a table, of (N, K) rows, of the values of a grid in C
    order, or of one picture.

    Raises:
        FormatError: labels of votes are wider than those of the first frame, or coordinates cannot
            be quantised.
    """
    types = column_types(entry, attributes)
    if entry.kind == "picture":
        picture = np.empty(1, object)
        picture[0] = array.tobytes()
        return {"jpeg": picture}
    if entry.kind == "votes" and array.dtype["label"].itemsize != attributes["label_bytes"]:
        raise FormatError(
            "its labels",
            expected=f"{attributes['label_bytes']} bytes each, as in the first frame",
            found=array.dtype["label"].itemsize,
        )
    if entry.kind == "velocities":
        velocity = dict(zip(_VELOCITY, np.ascontiguousarray(array["velocity"].T), strict=True))
        return {"voxel": np.ascontiguousarray(array["voxel"]), **velocity}
    if array.dtype.names:
        return {name: np.ascontiguousarray(array[name]) for name in types}
    rows = array.reshape(-1, len(types))
    scale = attributes.get("scale_m")
    return {
        name: quantise(rows[:, k], scale)
        if scale and name in AXES
        else np.ascontiguousarray(rows[:, k], np.dtype(entry.dtype).newbyteorder("="))
        for k, name in enumerate(types)
    }


def join_columns(
    entry: Field, columns: Mapping[str, AnyArray], attributes: Mapping[str, Any]
) -> AnyArray:
    """Return the array of a frame: a table, (N, K) rows, (N,) values (classes in the narrowest
    type), or the bytes of a picture.
    """
    first = next(iter(columns.values()))
    if entry.kind == "picture":
        return np.frombuffer(first[0], np.uint8)
    if entry.kind == "velocities":
        velocity = np.column_stack([columns[name] for name in _VELOCITY])
        return join_table(VELOCITY_DTYPE, {"voxel": first, "velocity": velocity})
    if entry.kind in TABLES:
        return join_table(TABLES[entry.kind][attributes["label_bytes"] - 1], columns)
    if len(columns) == 1:
        return narrow(first) if entry.kind == "class" else first
    rows = np.empty((len(first), len(columns)), entry.dtype)
    scale = attributes.get("scale_m")
    for k, (name, column) in enumerate(columns.items()):
        rows[:, k] = column * scale if scale and name in AXES else column
    return rows


def statistics(field: str, array: AnyArray) -> dict[str, Any]:
    """Return the columns of frames.parquet for one frame of a field."""
    if field == "points":
        finite = array[np.isfinite(array).all(axis=1), :3]
        reach = (
            float(np.sqrt((finite.astype(np.float64) ** 2).sum(axis=1).max()))
            if len(finite)
            else None
        )
        return {"points": len(array), "farthest_m": reach}
    if field == "labels":
        return {"labelled_points": int(np.count_nonzero(array))}
    if field == "flow":
        return {"moving_points": int((array != 0).any(axis=1).sum())}
    if field == "boxes":
        return {"boxes": len(array)}
    if field.endswith("/labels"):
        return {f"{field.removesuffix('/labels')}_occupied_voxels": int(np.count_nonzero(array))}
    if field.endswith("/counts"):
        return {f"{field.removesuffix('/counts')}_known_voxels": int(np.count_nonzero(array))}
    return {}
