"""How a field's frames become columns of arrays, and come back; numbers in fewer bytes.

Every rule is lossless to the last bit, negative zeros and NaN payloads included, except for `scale_m`, which the user asks for.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from carlasc.core.boxes import BOXES_DTYPE
from carlasc.errors import FormatError
from carlasc.storage import field_files
from carlasc.storage.packed.chunks import BITSHUFFLE, NO_SHUFFLE, SHUFFLE, Encoding
from carlasc.storage.packed.stores import PackOptions

# Points per chunk: PCodec's bins fit the scene better than in a whole scan, and padding takes bits.
_PCODEC_STEP = 8192
LEAST = 1 << 14  # elements per chunk, at least
FEW = 256  # the same of boxes, and of the distinct vectors of a flow
WIDE = "_wide"  # ending of the name of a second column
_GEOMETRY = tuple(name for name in BOXES_DTYPE.names or () if BOXES_DTYPE[name].kind == "f")
_WIDE_CELLS = {"<u4": ("u1", "<u4"), "<f4": ("<u2", "<f4")}  # labels and counts of grids, by their published type
Columns = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Column:
    """One array of a field.

    Attributes:
        name: name of the array.
        dtype: type of its elements.
        encoding: how its chunks are written.
        unit: unit of its values.
        rows: leading dimension of a (rows, N) column; None for a flat one.
        scratch: whether a decoded frame is copied at once, so that the next frame may be decoded into the same memory.
        step: elements per chunk; None chooses it so that a typical frame fills one chunk.
        least: smallest value chosen for `step`: a first scan of three points must not lead to chunks of three.
        wide: type of the column `<name>_wide`, which takes the frames that do not fit this one; None: there is no second column.
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
        """This column, and the wide one if there is one."""
        if self.wide is None:
            return (self,)
        return self, replace(self, name=f"{self.name}{WIDE}", dtype=self.wide, least=LEAST, wide=None)


class Packing(ABC):
    """The columns of one kind of field.

    Attributes:
        kind: name of this kind in the store.
        entry: the field in the layout.
        columns: its arrays.
        attributes: what a reader needs to know besides the arrays; written to the store.
    """

    kind: ClassVar[str]
    columns: tuple[Column, ...]

    def __init__(self, entry: field_files.Field, options: PackOptions, attributes: Mapping[str, Any]) -> None:
        self.entry = entry
        self.attributes = attributes
        self.columns = self._columns(options)

    @abstractmethod
    def _columns(self, options: PackOptions) -> tuple[Column, ...]: ...

    @abstractmethod
    def split(self, array: NDArray[Any]) -> Columns:
        """Return a frame's columns, without those that it does not need."""

    @abstractmethod
    def join(self, columns: Columns, into: NDArray[Any] | None = None) -> NDArray[Any]:
        """Return a frame's array, written to `into` if that is given; columns that the frame did not need are empty."""

    def published_bytes(self, counts: Mapping[str, int]) -> int:
        """Return the bytes of the published files that have these numbers of elements in the columns, the wide ones included."""
        main = self.columns[0].name
        elements = counts.get(main, 0) + counts.get(f"{main}{WIDE}", 0)
        row = np.dtype(self.entry.dtype or BOXES_DTYPE).itemsize * (self.entry.columns or 1)
        return elements * row

    def allocate(self, counts: list[int]) -> list[NDArray[Any] | None]:
        """Return an array for each frame of `counts` elements, for `join` to write to; None where `join` allocates it."""
        return [None] * len(counts)


class PointsPacking(Packing):
    """(N, 4) points: `xyz` as (3, N), and `fourth` only in frames where a bit of the 4th column is set."""

    kind = "points"

    def _columns(self, options: PackOptions) -> tuple[Column, ...]:
        encoding = Encoding("pcodec", 8) if options.small else Encoding(shuffle=SHUFFLE)
        scale = self.attributes.get("scale_m")
        dtype, unit = ("<i4", f"{scale} m") if scale else ("<f4", "m")
        return (
            Column("xyz", dtype, encoding, unit, rows=3, scratch=True, step=_PCODEC_STEP if options.small else None),
            Column("fourth", "<f4", Encoding(shuffle=BITSHUFFLE)),
        )

    def split(self, array: NDArray[Any]) -> Columns:
        """Return the coordinates as planes, and the 4th column where a bit of it is set."""
        xyz = array[:, :3].T
        if scale := self.attributes.get("scale_m"):
            xyz = quantise(xyz, scale)
        fourth = np.ascontiguousarray(array[:, 3], "<f4")
        return {"xyz": xyz} | ({"fourth": fourth} if fourth.view(np.uint32).any() else {})

    def join(self, columns: Columns, into: NDArray[Any] | None = None) -> NDArray[Any]:
        """Return (N, 4) float32 rows, as the published file has them."""
        xyz, fourth = columns["xyz"], columns["fourth"]
        points = np.empty((xyz.shape[1], 4), np.float32) if into is None else into
        points[:, 0], points[:, 1], points[:, 2] = self.to_metres(xyz)  # all three at once take five times as long
        points[:, 3] = fourth if fourth.size else 0
        return points

    def to_metres(self, xyz: NDArray[Any]) -> NDArray[np.float32]:
        """Return stored coordinates as (3, N) float32 metres."""
        scale = self.attributes.get("scale_m")
        return xyz if scale is None else (xyz * scale).astype(np.float32)

    def allocate(self, counts: list[int]) -> list[NDArray[Any] | None]:
        """Return the scans of a stack as parts of one block of memory.

        The operating system allocates large blocks in large pages. Touching the small pages of sixteen separate arrays for the first
        time takes longer than decoding the scans.
        """
        ends = np.cumsum(counts).tolist()
        block = np.empty((ends[-1] if ends else 0, 4), np.float32)
        return [block[end - count : end] for count, end in zip(counts, ends, strict=True)]


class ValuesPacking(Packing):
    """A flat array of numbers, as `values`; classes as bytes where they fit."""

    kind = "values"

    def _columns(self, options: PackOptions) -> tuple[Column, ...]:
        incompressible = self.entry.kind == "picture"
        encoding = Encoding(level=1) if incompressible else Encoding(shuffle=SHUFFLE)
        dtype, wide = ("u1", "<u4") if self.entry.kind == "class" else (self.entry.dtype, None)
        return (Column("values", dtype, encoding, self.entry.unit, wide=wide),)

    def split(self, array: NDArray[Any]) -> Columns:
        """Narrow the values."""
        return {"values": narrow(array)}

    def join(self, columns: Columns, into: NDArray[Any] | None = None) -> NDArray[Any]:
        """Return (N,) values in the field's type, or classes in the narrowest one."""
        values = columns["values"]
        return values if self.entry.kind in ("class", "picture") else values.astype(self.entry.dtype, copy=False)


class PairsPacking(Packing):
    """(N, K) numbers as `values` (K, N): classes and probabilities, each column of which is much like itself."""

    kind = "pairs"

    def _columns(self, options: PackOptions) -> tuple[Column, ...]:
        rows = self.entry.columns
        return (Column("values", self.entry.dtype, Encoding(shuffle=SHUFFLE), self.entry.unit, rows=rows),)

    def split(self, array: NDArray[Any]) -> Columns:
        """Return the columns as planes."""
        return {"values": array.T}

    def join(self, columns: Columns, into: NDArray[Any] | None = None) -> NDArray[Any]:
        """Return (N, K) rows."""
        return np.ascontiguousarray(columns["values"].T)


class FlowPacking(Packing):
    """(N, 3) vectors as a `palette` (3, K) of the frame's distinct vectors, compared bit by bit, and the `index` of each point's."""

    kind = "flow"

    def _columns(self, options: PackOptions) -> tuple[Column, ...]:
        encoding = Encoding(shuffle=SHUFFLE)
        return Column("index", "u1", encoding, wide="<u4"), Column(
            "palette", "<f4", encoding, self.entry.unit, rows=3, least=FEW, wide="<f4"
        )

    def split(self, array: NDArray[Any]) -> Columns:
        """Find the distinct vectors; most repeat the one before, so only the first of each run is compared."""
        bits = np.ascontiguousarray(array, "<f4").view(np.uint32).reshape(-1, 3)
        starts = np.flatnonzero((bits[1:] != bits[:-1]).any(axis=1)) + 1
        starts = np.concatenate([np.zeros(min(len(bits), 1), np.int64), starts])
        palette, of_run = np.unique(bits[starts], axis=0, return_inverse=True)
        index = np.repeat(of_run.reshape(-1), np.diff(starts, append=len(bits)))
        return {"index": narrow(index.astype(np.uint32)), "palette": palette.view("<f4").T}

    def join(self, columns: Columns, into: NDArray[Any] | None = None) -> NDArray[Any]:
        """Return (N, 3) float32."""
        index, palette = columns["index"], columns["palette"]
        if index.size and int(index.max()) >= palette.shape[1]:
            raise FormatError("its index", expected=f"indices below {palette.shape[1]}", found=str(int(index.max())))
        return np.ascontiguousarray(palette.T)[index]


class GridPacking(Packing):
    """A field with one value per voxel, (X, Y, Z): one chunk per frame of `values`."""

    kind = "grid"

    def _columns(self, options: PackOptions) -> tuple[Column, ...]:
        shuffle = BITSHUFFLE if self.entry.kind == "count" else NO_SHUFFLE
        dtype, wide = _WIDE_CELLS.get(self.entry.dtype, (self.entry.dtype, None))
        return (Column("values", dtype, Encoding(level=8, shuffle=shuffle), self.entry.unit, wide=wide),)

    def split(self, array: NDArray[Any]) -> Columns:
        """Narrow the values, except probabilities: they are whole numbers in few frames, and float32 would take more space."""
        return {"values": array.astype(self.entry.dtype) if self.entry.kind == "probability" else narrow(array)}

    def join(self, columns: Columns, into: NDArray[Any] | None = None) -> NDArray[Any]:
        """Return (X, Y, Z) unsigned integers, float32 where counts are not whole numbers, or float16 for probabilities."""
        return columns["values"]


class VotesPacking(Packing):
    """Votes or probabilities by class: the columns of the table, as `voxel`, `label` and `votes`."""

    kind = "votes"

    def _columns(self, options: PackOptions) -> tuple[Column, ...]:
        return (
            Column("voxel", "<i4", Encoding(shuffle=SHUFFLE), "index"),
            Column("label", "u1", Encoding(), "class", wide="<u2"),
            Column("votes", "<u2", Encoding(shuffle=SHUFFLE), self.entry.unit),
        )

    def published_bytes(self, counts: Mapping[str, int]) -> int:
        """Return the bytes of tables with this many rows."""
        wide = counts.get(f"label{WIDE}", 0)
        narrow_rows = counts.get("voxel", 0) - wide
        return narrow_rows * field_files.VOTES_DTYPE.itemsize + wide * field_files.WIDE_VOTES_DTYPE.itemsize

    def split(self, array: NDArray[Any]) -> Columns:
        """Return the columns of the table."""
        return {column.name: np.ascontiguousarray(array[column.name]) for column in self.columns}

    def join(self, columns: Columns, into: NDArray[Any] | None = None) -> NDArray[Any]:
        """Return the table."""
        wide = columns["label"].dtype.itemsize > 1
        votes = np.empty(len(columns["voxel"]), field_files.WIDE_VOTES_DTYPE if wide else field_files.VOTES_DTYPE)
        for name, column in columns.items():
            votes[name] = column
        return votes


class VelocitiesPacking(Packing):
    """Velocities of the voxels that move: the columns of the table, as `voxel`, and `velocity` as (3, N)."""

    kind = "velocities"

    def _columns(self, options: PackOptions) -> tuple[Column, ...]:
        encoding = Encoding(shuffle=SHUFFLE)
        return Column("voxel", "<i4", encoding, "index"), Column("velocity", "<f2", encoding, self.entry.unit, rows=3)

    def published_bytes(self, counts: Mapping[str, int]) -> int:
        """Return the bytes of tables with this many rows."""
        return counts.get("voxel", 0) * field_files.VELOCITY_DTYPE.itemsize

    def split(self, array: NDArray[Any]) -> Columns:
        """Return the columns of the table."""
        return {"voxel": np.ascontiguousarray(array["voxel"]), "velocity": array["velocity"].T}

    def join(self, columns: Columns, into: NDArray[Any] | None = None) -> NDArray[Any]:
        """Return the table."""
        table = np.empty(len(columns["voxel"]), field_files.VELOCITY_DTYPE)
        table["voxel"], table["velocity"] = columns["voxel"], columns["velocity"].T
        return table


class BoxesPacking(Packing):
    """Boxes: the numbers of the table as `geometry` (10, N), and its other columns as they are."""

    kind = "boxes"

    def _columns(self, options: PackOptions) -> tuple[Column, ...]:
        encoding = Encoding(shuffle=SHUFFLE)
        return (
            Column("geometry", "<f8", encoding, self.entry.unit, rows=len(_GEOMETRY), least=FEW),
            Column("track", "<u4", encoding, "object", least=FEW),
            Column("label", "<u4", encoding, "class", least=FEW),
            Column("annotated", "u1", encoding, least=FEW),
        )

    def split(self, array: NDArray[Any]) -> Columns:
        """Return the columns of the table."""
        flat = {column.name: np.ascontiguousarray(array[column.name]) for column in self.columns[1:]}
        return {"geometry": np.stack([array[name] for name in _GEOMETRY])} | flat

    def join(self, columns: Columns, into: NDArray[Any] | None = None) -> NDArray[Any]:
        """Return the table."""
        boxes = np.empty(len(columns["track"]), BOXES_DTYPE)
        for name, row in zip(_GEOMETRY, columns["geometry"], strict=True):
            boxes[name] = row
        for column in self.columns[1:]:
            boxes[column.name] = columns[column.name]
        return boxes


def packing_of(
    entry: field_files.Field, options: PackOptions | None = None, attributes: Mapping[str, Any] | None = None
) -> Packing:
    """Return how a field is packed: by `options` when it is written, by the store's `attributes` when it is read."""
    options = options or PackOptions()
    if attributes is None:
        attributes = {"scale_m": options.scale_m} if entry.kind == "position" and options.lossy_mm else {}
    kind: Callable[..., Packing] = GridPacking if entry.per == "voxel" else _BY_KIND.get(entry.kind, ValuesPacking)
    return kind(entry, options, attributes)


_BY_KIND: dict[field_files.Kind, Callable[..., Packing]] = {
    "position": PointsPacking,
    "vector": FlowPacking,
    "pairs": PairsPacking,
    "votes": VotesPacking,
    "velocities": VelocitiesPacking,
    "boxes": BoxesPacking,
}


def quantise(metres: NDArray[Any], scale_m: float) -> NDArray[np.int32]:
    """Return coordinates as whole steps of `scale_m`.

    Raises:
        FormatError: a coordinate is NaN, infinite, or too large for an int32.
    """
    steps = np.rint(metres.astype(np.float64) / scale_m)
    if not (np.abs(steps) < 2**31).all():  # False for NaN too
        raise FormatError(
            "points",
            expected=f"finite coordinates within {2**31 * scale_m:.0f} m to quantise",
            found="others",
            advice="pack them without `lossy_mm`",
        )
    return steps.astype(np.int32)


def narrow(array: NDArray[Any]) -> NDArray[Any]:
    """Return whole numbers in the smallest unsigned type that holds them, and other numbers as float32, bit for bit."""
    if array.dtype.kind == "f":
        values = np.ascontiguousarray(array, "<f4")
        with np.errstate(invalid="ignore"):
            whole = values.astype(np.uint32) if values.size == 0 or values.max() < 2**32 else None  # False for NaN
        exact = whole is not None and np.array_equal(whole.astype("<f4").view(np.uint32), values.view(np.uint32))
        if whole is None or not exact:
            return values
        array = whole
    highest = int(array.max()) if array.size else 0
    return array.astype("u1" if highest < 2**8 else "<u2" if highest < 2**16 else "<u4", copy=False)
