"""Conversion of the frames of a field to columns of arrays and back, with numbers in fewer bytes.

Every rule is lossless to the last bit, including negative zeros and NaN payloads, except for the
option `scale_m`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from carlasc.core.arrays import AnyArray, Float32Array, Int32Array
from carlasc.core.boxes import BOXES_DTYPE
from carlasc.errors import FormatError
from carlasc.storage import field_files
from carlasc.storage.files import damaged
from carlasc.storage.packed.chunks import BITSHUFFLE, NO_SHUFFLE, SHUFFLE, Encoding
from carlasc.storage.packed.stores import PackOptions

# Points per chunk: the bins of PCodec fit better than for a whole scan, and padding takes space.
_PCODEC_STEP = 8192
LEAST = 1 << 14  # minimum number of elements per chunk
FEW = 256  # minimum for boxes, and for the distinct vectors of a flow
WIDE = "_wide"  # suffix of the name of a wide column
# a box in memory, with its ten real numbers as one column
_STORED_BOX = np.dtype(
    [("track", "<u4"), ("label", "<u4"), ("geometry", "<f8", (10,)), ("annotated", "u1")]
)
# narrow and wide type of grids, by the published type
_WIDE_CELLS = {
    "<u4": ("u1", "<u4"),
    "<f4": ("<u2", "<f4"),
}
_SHUFFLED = Encoding(shuffle=SHUFFLE)  # of nearly all columns
Columns = dict[str, AnyArray]


@dataclass(frozen=True)
class Column:
    """One array of a field.

    Attributes:
        name: name of the array.
        dtype: type of its elements.
        encoding: how its chunks are encoded.
        unit: unit of its values.
        rows: leading dimension of a (rows, N) column; None for a flat column.
        scratch: whether decoded frames may share memory, because each is copied before the next one
            is decoded.
        step: elements per chunk; None chooses it so that a typical frame fills one chunk.
        least: minimum of the chosen `step`, so that a very small first scan does not lead to tiny
            chunks.
        wide: type of the column `<name>_wide` for frames whose values do not fit this column; None
            if it does not exist.
    """

    name: str
    dtype: str
    encoding: Encoding
    unit: str = ""
    rows: int | None = None
    scratch: bool = False
    step: int | None = None
    least: int = LEAST
    wide: str | None = None

    @property
    def both(self) -> tuple[Column, ...]:
        """This column, and its wide column if it exists."""
        if self.wide is None:
            return (self,)
        return self, replace(
            self, name=f"{self.name}{WIDE}", dtype=self.wide, least=LEAST, wide=None
        )


class Packing(ABC):
    """The columns of one kind of field.

    Attributes:
        kind: name of this kind in the store.
        entry: the field in the layout.
        columns: its arrays.
        attributes: further information for readers; written to the store.
    """

    kind: ClassVar[str]
    columns: tuple[Column, ...]

    def __init__(
        self, entry: field_files.Field, options: PackOptions, attributes: Mapping[str, Any]
    ) -> None:
        self.entry = entry
        self.attributes = attributes
        self.columns = self._columns(options)

    @abstractmethod
    def _columns(self, options: PackOptions) -> tuple[Column, ...]: ...

    @abstractmethod
    def split(self, array: AnyArray) -> Columns:
        """Return the columns of a frame, without columns that it does not use."""

    @abstractmethod
    def join(self, columns: Columns, into: AnyArray | None = None) -> AnyArray:
        """Return the array of a frame, written to `into` if given.

        Columns that the frame does not use are empty.
        """

    def published_bytes(self, counts: Mapping[str, int]) -> int:
        """Return the size of the published files, from the number of elements by column, including
        wide columns.
        """
        main = self.columns[0].name
        elements = counts.get(main, 0) + counts.get(f"{main}{WIDE}", 0)
        return elements * self.entry.row_bytes

    def allocate(self, counts: list[int]) -> list[AnyArray | None]:
        """Return one array per frame, of `counts` elements, for `join` to write to; None if `join`
        allocates it.
        """
        return [None] * len(counts)


class PointsPacking(Packing):
    """(N, 4) points: `xyz` as (3, N), and `fourth` only in frames where the 4th column has a
    non-zero bit.
    """

    kind = "points"

    def _columns(self, options: PackOptions) -> tuple[Column, ...]:
        encoding = Encoding("pcodec", 8) if options.small else _SHUFFLED
        scale = self.attributes.get("scale_m")
        dtype, unit = ("<i4", f"{scale} m") if scale else ("<f4", "m")
        return (
            Column(
                "xyz",
                dtype,
                encoding,
                unit,
                rows=3,
                scratch=True,
                step=_PCODEC_STEP if options.small else None,
            ),
            Column("fourth", "<f4", Encoding(shuffle=BITSHUFFLE)),
        )

    def split(self, array: AnyArray) -> Columns:
        """Return the coordinates as planes, and the 4th column if it has a non-zero bit."""
        xyz = array[:, :3].T
        if scale := self.attributes.get("scale_m"):
            xyz = quantise(xyz, scale)
        fourth = np.ascontiguousarray(array[:, 3], "<f4")
        return {"xyz": xyz} | ({"fourth": fourth} if fourth.view(np.uint32).any() else {})

    def join(self, columns: Columns, into: AnyArray | None = None) -> AnyArray:
        """Return (N, 4) float32 rows, as in the published file."""
        xyz = columns["xyz"]
        fourth = columns["fourth"]
        points = np.empty((xyz.shape[1], 4), np.float32) if into is None else into
        # one assignment of all three takes five times as long
        points[:, 0], points[:, 1], points[:, 2] = self.to_metres(xyz)
        points[:, 3] = fourth if fourth.size else 0
        return points

    def to_metres(self, xyz: AnyArray) -> Float32Array:
        """Return stored coordinates as (3, N) float32 metres."""
        scale = self.attributes.get("scale_m")
        return xyz if scale is None else (xyz * scale).astype(np.float32)

    def allocate(self, counts: list[int]) -> list[AnyArray | None]:
        """Return the scans of a stack as parts of one block of memory.

        The operating system uses large pages for large blocks. The first access to the small pages
        of sixteen separate arrays takes longer than decoding the scans.
        """
        ends = np.cumsum(counts).tolist()
        block = np.empty((ends[-1] if ends else 0, 4), np.float32)
        return [block[end - count : end] for count, end in zip(counts, ends, strict=True)]


class ValuesPacking(Packing):
    """A flat array of numbers, as `values`; classes as bytes if they fit."""

    kind = "values"

    def _columns(self, options: PackOptions) -> tuple[Column, ...]:
        incompressible = self.entry.kind == "picture"
        encoding = Encoding(level=1) if incompressible else _SHUFFLED
        dtype, wide = ("u1", "<u4") if self.entry.kind == "class" else (self.entry.dtype, None)
        return (Column("values", dtype, encoding, self.entry.unit, wide=wide),)

    def split(self, array: AnyArray) -> Columns:
        """Narrow the values."""
        return {"values": narrow(array)}

    def join(self, columns: Columns, into: AnyArray | None = None) -> AnyArray:
        """Return (N,) values in the type of the field; classes in the narrowest type."""
        values = columns["values"]
        return (
            values
            if self.entry.kind in ("class", "picture")
            else values.astype(self.entry.dtype, copy=False)
        )


class PairsPacking(Packing):
    """(N, K) classes and probabilities, as `values` (K, N): values of one column are similar, and
    compress well together.
    """

    kind = "pairs"

    def _columns(self, options: PackOptions) -> tuple[Column, ...]:
        rows = self.entry.columns
        return (Column("values", self.entry.dtype, _SHUFFLED, self.entry.unit, rows=rows),)

    def split(self, array: AnyArray) -> Columns:
        """Return the columns as planes."""
        return {"values": array.T}

    def join(self, columns: Columns, into: AnyArray | None = None) -> AnyArray:
        """Return (N, K) rows."""
        return np.ascontiguousarray(columns["values"].T)


class FlowPacking(Packing):
    """(N, 3) vectors as a `palette` (3, K) of distinct vectors, compared bit by bit, and an `index`
    (N,) into it.
    """

    kind = "flow"

    def _columns(self, options: PackOptions) -> tuple[Column, ...]:
        return Column("index", "u1", _SHUFFLED, wide="<u4"), Column(
            "palette", "<f4", _SHUFFLED, self.entry.unit, rows=3, least=FEW, wide="<f4"
        )

    def split(self, array: AnyArray) -> Columns:
        """Find the distinct vectors.

        Most vectors repeat the previous one, so only the first of each run is compared.
        """
        bits = np.ascontiguousarray(array, "<f4").view(np.uint32).reshape(-1, 3)
        starts = np.flatnonzero((bits[1:] != bits[:-1]).any(axis=1)) + 1
        starts = np.concatenate([np.zeros(min(len(bits), 1), np.int64), starts])
        palette, of_run = np.unique(bits[starts], axis=0, return_inverse=True)
        index = np.repeat(of_run.reshape(-1), np.diff(starts, append=len(bits)))
        return {"index": narrow(index.astype(np.uint32)), "palette": palette.view("<f4").T}

    def join(self, columns: Columns, into: AnyArray | None = None) -> AnyArray:
        """Return (N, 3) float32."""
        index = columns["index"]
        palette = columns["palette"]
        if index.size and int(index.max()) >= palette.shape[1]:
            raise damaged("its index", f"indices below {palette.shape[1]}", str(int(index.max())))
        return np.ascontiguousarray(palette.T)[index]


class GridPacking(Packing):
    """A field with one value per voxel, (X, Y, Z): one chunk per frame of `values`."""

    kind = "grid"

    def _columns(self, options: PackOptions) -> tuple[Column, ...]:
        shuffle = BITSHUFFLE if self.entry.kind == "count" else NO_SHUFFLE
        dtype, wide = _WIDE_CELLS.get(self.entry.dtype, (self.entry.dtype, None))
        return (
            Column("values", dtype, Encoding(level=8, shuffle=shuffle), self.entry.unit, wide=wide),
        )

    def split(self, array: AnyArray) -> Columns:
        """Narrow the values, except probabilities: they are rarely integers, and float32 would take
        more space.
        """
        return {
            "values": array.astype(self.entry.dtype)
            if self.entry.kind == "probability"
            else narrow(array)
        }

    def join(self, columns: Columns, into: AnyArray | None = None) -> AnyArray:
        """Return (X, Y, Z): unsigned integers, float32 if counts are not integers, or float16 for
        probabilities.
        """
        return columns["values"]


class TablePacking(Packing):
    """A table: its columns, of which those of several numbers are stored as planes (K, N).

    Attributes:
        tables: the types of a row, with one-byte and with wide labels.
    """

    tables: ClassVar[tuple[np.dtype[Any], ...]]

    def published_bytes(self, counts: Mapping[str, int]) -> int:
        """Return the bytes of tables with this many rows."""
        columns = [column for family in self.columns for column in family.both]
        return sum(
            counts.get(one.name, 0) * np.dtype(one.dtype).itemsize * (one.rows or 1)
            for one in columns
        )

    def split(self, array: AnyArray) -> Columns:
        """Return the columns of the table."""
        return {column.name: np.ascontiguousarray(array[column.name].T) for column in self.columns}

    def join(self, columns: Columns, into: AnyArray | None = None) -> AnyArray:
        """Return the table."""
        wide = "label" in columns and columns["label"].dtype == np.uint16
        planes = {name: column.T for name, column in columns.items()}
        return field_files.join_table(self.tables[wide], planes)


class VotesPacking(TablePacking):
    """Votes or probabilities by class: `voxel`, `label`, `votes`."""

    kind = "votes"
    tables = field_files.TABLES["votes"]

    def _columns(self, options: PackOptions) -> tuple[Column, ...]:
        return (
            Column("voxel", "<i4", _SHUFFLED, "index"),
            Column("label", "u1", Encoding(), "class", wide="<u2"),
            Column("votes", "<u2", _SHUFFLED, self.entry.unit),
        )


class VelocitiesPacking(TablePacking):
    """Velocities of moving voxels: `voxel` (N,) and `velocity` (3, N)."""

    kind = "velocities"
    tables = field_files.TABLES["velocities"]

    def _columns(self, options: PackOptions) -> tuple[Column, ...]:
        return Column("voxel", "<i4", _SHUFFLED, "index"), Column(
            "velocity", "<f2", _SHUFFLED, self.entry.unit, rows=3
        )


class BoxesPacking(TablePacking):
    """Boxes: the real numbers as `geometry` (10, N), and the other columns unchanged."""

    kind = "boxes"
    tables = (_STORED_BOX,)

    def _columns(self, options: PackOptions) -> tuple[Column, ...]:
        return (
            Column(
                "geometry",
                "<f8",
                _SHUFFLED,
                self.entry.unit,
                rows=_STORED_BOX["geometry"].shape[0],
                least=FEW,
            ),
            Column("track", "<u4", _SHUFFLED, "object", least=FEW),
            Column("label", "<u4", _SHUFFLED, "class", least=FEW),
            Column("annotated", "u1", _SHUFFLED, least=FEW),
        )

    def split(self, array: AnyArray) -> Columns:
        """Return the columns of the table."""
        return super().split(array.view(_STORED_BOX))

    def join(self, columns: Columns, into: AnyArray | None = None) -> AnyArray:
        """Return the table."""
        return super().join(columns).view(BOXES_DTYPE)


def packing_of(
    entry: field_files.Field,
    options: PackOptions | None = None,
    attributes: Mapping[str, Any] | None = None,
) -> Packing:
    """Return the packing of a field: from `options` for writing, from the `attributes` of the store
    for reading.
    """
    options = options or PackOptions()
    if attributes is None:
        attributes = (
            {"scale_m": options.scale_m} if entry.kind == "position" and options.lossy_mm else {}
        )
    kind: Callable[..., Packing] = (
        GridPacking if entry.per == "voxel" else _BY_KIND.get(entry.kind, ValuesPacking)
    )
    return kind(entry, options, attributes)


_BY_KIND: dict[field_files.Kind, Callable[..., Packing]] = {
    "position": PointsPacking,
    "vector": FlowPacking,
    "pairs": PairsPacking,
    "votes": VotesPacking,
    "velocities": VelocitiesPacking,
    "boxes": BoxesPacking,
}


def quantise(metres: AnyArray, scale_m: float) -> Int32Array:
    """Return coordinates as integer multiples of `scale_m`.

    Raises:
        FormatError: a coordinate is NaN, infinite, or too large for an int32.
    """
    steps = np.rint(metres.astype(np.float64) / scale_m)
    if not (np.abs(steps) < 2**31).all():  # False for NaN too
        raise FormatError(
            "points",
            expected=f"finite coordinates within {2**31 * scale_m:.0f} m to quantise",
            found="NaN, infinity or larger values",
            advice="pack without `lossy_mm`",
        )
    return steps.astype(np.int32)


def narrow(array: AnyArray) -> AnyArray:
    """Return integers in the smallest unsigned type that holds them, and other numbers as float32,
    bit for bit.
    """
    if array.dtype.kind == "f":
        values = np.ascontiguousarray(array, "<f4")
        with np.errstate(invalid="ignore"):
            # False for NaN
            whole = values.astype(np.uint32) if values.size == 0 or values.max() < 2**32 else None
        exact = whole is not None and np.array_equal(
            whole.astype("<f4").view(np.uint32), values.view(np.uint32)
        )
        if whole is None or not exact:
            return values
        array = whole
    highest = int(array.max()) if array.size else 0
    return array.astype("u1" if highest < 2**8 else "<u2" if highest < 2**16 else "<u4", copy=False)
