"""How a field's frames become columns of a Parquet table, and come back.

Parquet's own dictionaries and byte-stream split make them small: values keep their published types.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.boxes import BOXES_DTYPE
from carlasc.errors import FormatError
from carlasc.storage import layout
from carlasc.storage.packed.columns import narrow, quantise

Attributes = Mapping[str, Any]
Columns = dict[str, NDArray[Any]]


class TableField(ABC):
    """The columns of one kind of field.

    Attributes:
        split_bytes: columns with Parquet's byte-stream split, which suits numbers that seldom repeat.
    """

    split_bytes: frozenset[str] = frozenset()

    def describe(self, array: NDArray[Any], scale_m: float | None) -> dict[str, Any]:
        """Return what a reader needs to know besides the columns, from the first frame."""
        return {}

    @abstractmethod
    def columns(self, attributes: Attributes) -> dict[str, str]:
        """Return the name of each column's type in pyarrow."""

    @abstractmethod
    def split(self, array: NDArray[Any], attributes: Attributes) -> Columns:
        """Return a frame's columns."""

    @abstractmethod
    def join(self, columns: Columns, attributes: Attributes) -> NDArray[Any]:
        """Return a frame's array."""


class PointsTable(TableField):
    """`x`, `y`, `z` and `fourth`; quantised coordinates are integers, in steps of `scale_m`."""

    split_bytes = frozenset("xyz")

    def describe(self, array: NDArray[Any], scale_m: float | None) -> dict[str, Any]:
        """Return the step of quantised coordinates."""
        return {"scale_m": scale_m} if scale_m else {}

    def columns(self, attributes: Attributes) -> dict[str, str]:
        """Return one column per axis."""
        return dict.fromkeys("xyz", "int32" if "scale_m" in attributes else "float32") | {"fourth": "float32"}

    def split(self, array: NDArray[Any], attributes: Attributes) -> Columns:
        """Return one column per axis."""
        columns = {name: np.ascontiguousarray(array[:, k], "<f4") for k, name in enumerate(("x", "y", "z", "fourth"))}
        if scale := attributes.get("scale_m"):
            columns |= {name: quantise(columns[name], scale) for name in "xyz"}
        return columns

    def join(self, columns: Columns, attributes: Attributes) -> NDArray[Any]:
        """Return (N, 4) float32 rows."""
        points = np.empty((len(columns["x"]), 4), np.float32)
        scale = attributes.get("scale_m")
        for axis, name in enumerate("xyz"):
            points[:, axis] = columns[name] if scale is None else columns[name] * scale
        points[:, 3] = columns["fourth"]
        return points


class VectorTable(TableField):
    """A column per axis: `vx`, `vy`, `vz`."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names = names

    def columns(self, attributes: Attributes) -> dict[str, str]:
        """Return one column per axis."""
        return dict.fromkeys(self.names, "float32")

    def split(self, array: NDArray[Any], attributes: Attributes) -> Columns:
        """Return one column per axis."""
        return {name: np.ascontiguousarray(array[:, k], "<f4") for k, name in enumerate(self.names)}

    def join(self, columns: Columns, attributes: Attributes) -> NDArray[Any]:
        """Return (N, 3) float32."""
        return np.stack([columns[name] for name in self.names], axis=1)


class ValuesTable(TableField):
    """One column of numbers in their published type; the voxels of a grid in C order."""

    def __init__(self, entry: layout.Field) -> None:
        (self.name,) = entry.names
        self.dtype = np.dtype(entry.dtype).name
        self.narrow = entry.kind == "class"

    def columns(self, attributes: Attributes) -> dict[str, str]:
        """Return the one column."""
        return {self.name: self.dtype}

    def split(self, array: NDArray[Any], attributes: Attributes) -> Columns:
        """Return the flat values."""
        return {self.name: np.ascontiguousarray(array, self.dtype).reshape(-1)}

    def join(self, columns: Columns, attributes: Attributes) -> NDArray[Any]:
        """Return the flat values; labels in the narrowest type that holds them."""
        values = columns[self.name]
        return narrow(values) if self.narrow else values


class PictureTable(TableField):
    """`jpeg`: one row per frame, the bytes of the file."""

    def columns(self, attributes: Attributes) -> dict[str, str]:
        """Return the one column."""
        return {"jpeg": "binary"}

    def split(self, array: NDArray[Any], attributes: Attributes) -> Columns:
        """Return one value."""
        picture = np.empty(1, object)
        picture[0] = array.tobytes()
        return {"jpeg": picture}

    def join(self, columns: Columns, attributes: Attributes) -> NDArray[Any]:
        """Return (B,) uint8."""
        return np.frombuffer(columns["jpeg"][0], np.uint8)


class VotesTable(TableField):
    """`voxel`, `label` and `votes`: the columns of the field's own table."""

    def describe(self, array: NDArray[Any], scale_m: float | None) -> dict[str, Any]:
        """Return the bytes per label."""
        return {"label_bytes": array.dtype["label"].itemsize}

    def columns(self, attributes: Attributes) -> dict[str, str]:
        """Return the table's columns."""
        return {"voxel": "int32", "label": f"uint{8 * attributes['label_bytes']}", "votes": "uint16"}

    def split(self, array: NDArray[Any], attributes: Attributes) -> Columns:
        """Return the columns of the table."""
        if array.dtype["label"].itemsize != attributes["label_bytes"]:
            raise FormatError(
                "its labels",
                expected=f"{attributes['label_bytes']} bytes each, as in the first frame",
                found=str(array.dtype["label"].itemsize),
            )
        return {name: np.ascontiguousarray(array[name]) for name in self.columns(attributes)}

    def join(self, columns: Columns, attributes: Attributes) -> NDArray[Any]:
        """Return the table."""
        wide = attributes["label_bytes"] > 1
        votes = np.empty(len(columns["voxel"]), layout.WIDE_VOTES_DTYPE if wide else layout.VOTES_DTYPE)
        for name, column in columns.items():
            votes[name] = column
        return votes


class BoxesTable(TableField):
    """The columns of the field's own table: `track`, `label`, `x`, `y`, `z`, ..."""

    def columns(self, attributes: Attributes) -> dict[str, str]:
        """Return the table's columns."""
        return {name: BOXES_DTYPE[name].name for name in BOXES_DTYPE.names or ()}

    def split(self, array: NDArray[Any], attributes: Attributes) -> Columns:
        """Return the columns of the table."""
        return {name: np.ascontiguousarray(array[name]) for name in self.columns(attributes)}

    def join(self, columns: Columns, attributes: Attributes) -> NDArray[Any]:
        """Return the table."""
        boxes = np.empty(len(columns["track"]), BOXES_DTYPE)
        for name, column in columns.items():
            boxes[name] = column
        return boxes


def table_field(name: str) -> TableField:
    """Return how a field is stored in a table.

    Raises:
        FormatError: the layout has no such field.
    """
    entry = layout.field_named(name)
    match entry.kind:
        case "position":
            return PointsTable()
        case "vector":
            return VectorTable(entry.names)
        case "picture":
            return PictureTable()
        case "votes":
            return VotesTable()
        case "boxes":
            return BoxesTable()
        case _:
            return ValuesTable(entry)


def statistics(field: str, array: NDArray[Any]) -> dict[str, Any]:
    """Return what frames.parquet tells about one frame of a field."""
    if field == "points":
        finite = array[np.isfinite(array).all(axis=1), :3]
        reach = float(np.sqrt((finite.astype(np.float64) ** 2).sum(axis=1).max())) if len(finite) else None
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
