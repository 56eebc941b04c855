"""The files of a field: their content, and how it is decoded, checked and encoded."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from carlasc.core.arrays import AnyArray, Float32Array
from carlasc.core.boxes import BOXES_DTYPE
from carlasc.core.classes import ClassTable
from carlasc.errors import FormatError
from carlasc.storage.arrays import ArrayFormat, npz_bytes, open_npz
from carlasc.storage.files import damaged

VOTES_DTYPE = np.dtype([("voxel", "<i4"), ("label", "u1"), ("votes", "<u2")])
WIDE_VOTES_DTYPE = np.dtype([("voxel", "<i4"), ("label", "<u2"), ("votes", "<u2")])
VELOCITY_DTYPE = np.dtype([("voxel", "<i4"), ("velocity", "<f2", (3,))])


def votes_dtype(classes: ClassTable) -> np.dtype[np.void]:
    """Return the type of a row of votes for the classes of a table."""
    return VOTES_DTYPE if classes.dtype == np.uint8 else WIDE_VOTES_DTYPE


TABLES = {
    "votes": (VOTES_DTYPE, WIDE_VOTES_DTYPE),
    "velocities": (VELOCITY_DTYPE,),
    "boxes": (BOXES_DTYPE,),
}
"""The types of a row of a table, by the kind of the field."""
# Level 6, the default of zlib, takes 6 times as long and saves only 3%: the voxels of votes are
# sorted, so repeats are always four bytes apart.
_LEVELS = {"votes": (1, 4, 4), "velocities": (4, 4)}  # of the columns
_READ_FIRST = ("label", "voxel", "velocity", "votes")  # the order in which columns are read
_MOST_CLASSES = 256

Per = Literal["point", "voxel", "vote", "moving voxel", "box", "scan"]
Kind = Literal[
    "position",
    "vector",
    "class",
    "pairs",
    "id",
    "value",
    "count",
    "probability",
    "flags",
    "votes",
    "velocities",
    "boxes",
    "picture",
]


@dataclass(frozen=True)
class Field:
    """The content of one file per frame.

    Stores, packing, converting, `info` and `validate` use `per` and `kind` to decide how to handle
    a field, not its name.

    Attributes:
        name: name of the field in a Source and a Sink.
        folder: folder under `<coordinates>/`.
        suffix: ending of the file name.
        per: unit of one row of the file: "point" (one row per point of the scan), "voxel" (one
            value per voxel of the grid), "vote" (one row per vote), "moving voxel" (one row per
            moving voxel), "box" (one row per box), or "scan" (one file per scan).
        kind: kind of the values: "position" and "vector" (these change with the axes), "class" (ids
            of the class table), "pairs" (class and probability), "id" (unsigned integers, such as
            actors), "value" (any number), "count", "probability" (0 to 1), "flags" (bits), "votes",
            "velocities" and "boxes" (tables), "picture" (the bytes of a file).
        dtype: NumPy type on disk, little-endian; "" for tables, whose columns have different types.
        names: name of each value of a row.
        unit: unit of the values.
        meaning: one line for the documentation.
        published: whether the published download contains the field.
    """

    name: str
    folder: str
    suffix: str
    per: Per
    kind: Kind
    dtype: str
    names: tuple[str, ...]
    unit: str
    meaning: str
    published: bool = False

    @property
    def columns(self) -> int | None:
        """Number of values per row; None for a flat array."""
        return len(self.names) if self.kind in ("position", "vector", "pairs") else None

    @property
    def row_bytes(self) -> int:
        """Size of a row of the file; not for tables in an .npz file."""
        return np.dtype(self.dtype or BOXES_DTYPE).itemsize * (self.columns or 1)

    def file(self, frame: int) -> str:
        """Return the path of a frame's file under `<coordinates>/`."""
        return f"{self.folder}/{frame:06d}{self.suffix}"

    def decode(
        self, data: bytes | memoryview, where: str, shape: tuple[int, ...] | None = None
    ) -> AnyArray:
        """Return the content of a file as an array, without a copy if the type allows it.

        Args:
            data: the whole file.
            where: the file, for errors.
            shape: shape of the grid, for fields of a grid; None computes the number of rows from
                the size of the file.

        Raises:
            FormatError: the size of the file does not match.
        """
        if self.kind in _LEVELS:
            return _decode_npz(self.kind, data, where, shape)
        dtype = np.dtype(self.dtype or BOXES_DTYPE)
        size = len(data)
        if shape is not None and size != self.size_of(shape):
            expected = f"{self.size_of(shape)} bytes ({' x '.join(map(str, shape))} {dtype.name})"
            raise damaged(
                where, expected, str(size), "the file is cut short, or belongs to another grid"
            )
        columns = self.columns
        if size % (dtype.itemsize * (columns or 1)):
            row = f"{columns} {dtype.name} per row" if columns else f"one {self.per}"
            raise damaged(
                where,
                f"a multiple of {self.row_bytes} bytes ({row})",
                str(size),
                "the file may be cut short",
            )
        array = np.frombuffer(data, dtype)
        if shape is not None:
            return array.reshape(shape)
        return array if columns is None else array.reshape(-1, columns)

    def size_of(self, shape: tuple[int, ...] | None) -> int | None:
        """Return the size in bytes of a file of a grid with this shape; None if it is known only
        after reading.
        """
        return (
            None
            if shape is None or self.per != "voxel"
            else np.dtype(self.dtype).itemsize * math.prod(shape)
        )

    def encode(self, array: AnyArray, where: str) -> bytes | memoryview:
        """Return the bytes of a frame's file.

        Raises:
            FormatError: the shape or the type of the array does not match the field.
        """
        self.check(array, where)
        if self.kind in _LEVELS:
            levels = zip(self.names, _LEVELS[self.kind], strict=True)
            return npz_bytes({name: (np.ascontiguousarray(array[name]), n) for name, n in levels})
        dtype = np.dtype(self.dtype or BOXES_DTYPE)
        return np.ascontiguousarray(array, dtype).reshape(-1).view(np.uint8).data

    def check(self, array: AnyArray, where: str) -> None:
        """Check that an array has the shape and the type of a frame of the field.

        Raises:
            FormatError: the shape or the type does not match; the message names the file `where`.
        """
        if self.kind in TABLES:
            if array.dtype not in TABLES[self.kind] or array.ndim != 1:
                expected = f"a table of {self.kind}: {', '.join(self.names)}"
                found = f"{array.dtype}, shape {array.shape}"
                raise FormatError(where, expected=expected, found=found)
            return
        if self.columns is not None and (array.ndim != 2 or array.shape[1] != self.columns):
            raise FormatError(where, expected=f"shape (N, {self.columns})", found=f"{array.shape}")
        dtype = np.dtype(self.dtype)
        if dtype.kind == "u" and array.dtype.kind not in "ub":
            raise FormatError(where, expected="unsigned integers", found=array.dtype)
        if dtype.kind == "u" and array.dtype.itemsize > dtype.itemsize:
            raise FormatError(where, expected=f"{dtype.name} or a smaller type", found=array.dtype)


def _decode_npz(
    kind: Kind, data: bytes | memoryview, where: str, shape: tuple[int, ...] | None
) -> AnyArray:
    """Return the table of an .npz file: that one of its kind which has the types of the columns."""
    # The largest possible table: one row per voxel, and per class for votes.
    most = None if shape is None else math.prod(shape) * (_MOST_CLASSES if kind == "votes" else 1)
    tables = TABLES[kind]
    columns = dict[str, AnyArray]()
    count: int | None = None
    with open_npz(data, where) as archive:
        for name in sorted(tables[0].names or (), key=_READ_FIRST.index):
            dtypes = tuple(table[name].base.str for table in tables)
            wanted = ArrayFormat(dtypes, (count, *tables[0][name].shape), most)
            columns[name] = archive.read(name, wanted)
            count = len(columns[name])
            most = None
    found = next(
        table for table in tables if all(table[n].base == c.dtype for n, c in columns.items())
    )
    return join_table(found, columns)


def join_table(dtype: np.dtype[Any], columns: Mapping[str, AnyArray]) -> AnyArray:
    """Return the table of some columns."""
    table = np.empty(len(next(iter(columns.values()))), dtype)
    for name, column in columns.items():
        table[name] = column
    return table


def check_velocity(velocity: AnyArray, count: int, where: str) -> None:
    """Check a field `<grid>/velocity`, (M,) rows of voxel and velocity, of a grid of `count`
    voxels.

    Raises:
        FormatError: a voxel is not in the grid, or a velocity is not finite; the message names
            `where`.
    """
    voxel = velocity["voxel"]
    if len(outside := voxel[(voxel < 0) | (voxel >= count)]):
        raise FormatError(where, expected=f"voxels 0 to {count - 1}", found=outside[0])
    if not np.isfinite(velocity["velocity"]).all():
        raise FormatError(where, expected="finite velocities", found="NaN or infinity")


def dense_velocity(velocity: AnyArray, size: tuple[int, ...], where: str) -> Float32Array:
    """Return (X, Y, Z, 3) float32 m/s of a grid of shape `size`; zero where nothing moves.

    Checks `velocity` with `check_velocity`.
    """
    check_velocity(velocity, math.prod(size), where)
    dense = np.zeros((*size, 3), np.float32)
    dense.reshape(-1, 3)[velocity["voxel"]] = velocity["velocity"]
    return dense
