"""How a field's frames become columns of numbers, and come back: docs/storage.md in code, shared by all packed stores.

Every rule is lossless to the last bit, negative zeros and NaN payloads included, but for `scale_m`, which is asked for.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from carlasc.core.grids import Coordinates
from carlasc.errors import ArgumentError, FormatError
from carlasc.storage import layout
from carlasc.storage.packed.chunks import BITSHUFFLE, NO_SHUFFLE, SHUFFLE, Encoding
from carlasc.storage.protocol import SequenceWriter, Sink, Source

VERSION = 1
_PCODEC_STEP = (
    8192  # points a chunk: PCodec's bins follow the scene better than in a whole scan, and padding costs it bits
)
Columns = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Options:
    """How a store is packed.

    Attributes:
        small: PCodec for the points: a twentieth smaller, but only readers with that numcodecs extension open it.
        lossy_mm: quantise points to this many millimetres; None keeps every bit.
    """

    small: bool = False
    lossy_mm: float | None = None

    def __post_init__(self) -> None:
        if self.lossy_mm is not None and not 0 < self.lossy_mm <= 1000:
            raise ArgumentError("lossy_mm", expected="millimetres above 0, up to 1000", found=f"{self.lossy_mm}")


@dataclass(frozen=True)
class Column:
    """One array of a field.

    Attributes:
        name: of the array.
        dtype: type it starts with; unsigned integers widen when a frame needs it.
        encoding: how its chunks are written.
        unit: of its values.
        rows: leading dimension of a (rows, N) column; None for a flat one.
        scratch: whether a frame is decoded only to be copied on: into memory that the next frame takes again.
        step: elements of a chunk; None takes them from the first frame that has any, which then fills one chunk.
        least: the least of that: a first scan of three points must not make chunks of three.
    """

    name: str
    dtype: str
    encoding: Encoding
    unit: str = ""
    rows: int | None = None
    scratch: bool = False
    step: int | None = None
    least: int = 1 << 14


class Packing(ABC):
    """The columns of one kind of field.

    Attributes:
        kind: its name in the store.
        entry: the field.
        columns: its arrays.
        attributes: what a reader needs to know beside them, kept in the store.
    """

    kind: ClassVar[str]
    columns: tuple[Column, ...]

    def __init__(self, entry: layout.Field, options: Options, attributes: Mapping[str, Any]) -> None:
        self.entry = entry
        self.attributes = attributes
        self.columns = self._columns(options)

    @abstractmethod
    def _columns(self, options: Options) -> tuple[Column, ...]: ...

    @abstractmethod
    def split(self, array: NDArray[Any]) -> Columns:
        """Return a frame's columns; those it does not need are left out."""

    @abstractmethod
    def join(self, columns: Columns, into: NDArray[Any] | None = None) -> NDArray[Any]:
        """Return a frame's array, in `into` if it has made room; columns that the frame did not need are empty."""

    def make_room(self, counts: list[int]) -> list[NDArray[Any] | None]:
        """Return arrays that `join` may write frames of so many elements to; None where it makes its own."""
        return [None] * len(counts)


class Points(Packing):
    """(N, 4) points: `xyz` as (3, N), and `fourth` only in frames where a bit of the 4th column is set."""

    kind = "points"

    def _columns(self, options: Options) -> tuple[Column, ...]:
        encoding = Encoding("pcodec", 8) if options.small else Encoding(shuffle=SHUFFLE)
        scale = self.attributes.get("scale_m")
        dtype, unit = ("<i4", f"{scale} m") if scale else ("<f4", "m")
        return (
            Column("xyz", dtype, encoding, unit, rows=3, scratch=True, step=_PCODEC_STEP if options.small else None),
            Column("fourth", "<f4", Encoding(shuffle=BITSHUFFLE)),
        )

    def split(self, array: NDArray[Any]) -> Columns:
        """Turn rows into columns, and leave zeros out."""
        xyz = array[:, :3].T
        if scale := self.attributes.get("scale_m"):
            xyz = quantise(xyz, scale)
        fourth = np.ascontiguousarray(array[:, 3], "<f4")
        return {"xyz": xyz} | ({"fourth": fourth} if fourth.view(np.uint32).any() else {})

    def join(self, columns: Columns, into: NDArray[Any] | None = None) -> NDArray[Any]:
        """Return (N, 4) float32 rows, as the published file has them."""
        xyz, fourth = columns["xyz"], columns["fourth"]
        points = np.empty((xyz.shape[1], 4), np.float32) if into is None else into
        points[:, :3] = self.to_metres(xyz).T
        points[:, 3] = fourth if fourth.size else 0
        return points

    def to_metres(self, xyz: NDArray[Any]) -> NDArray[np.float32]:
        """Return (3, N) metres of what is stored."""
        scale = self.attributes.get("scale_m")
        return xyz if scale is None else (xyz * scale).astype(np.float32)

    def make_room(self, counts: list[int]) -> list[NDArray[Any] | None]:
        """Return a stack's scans as parts of one block.

        The system hands out large blocks in large pages: touching the small pages of sixteen arrays takes longer than decoding what
        goes there.
        """
        ends = np.cumsum(counts).tolist()
        block = np.empty((ends[-1] if ends else 0, 4), np.float32)
        return [block[end - count : end] for count, end in zip(counts, ends, strict=True)]


class Values(Packing):
    """A flat array of numbers, as `values` of the narrowest type that holds them all."""

    kind = "values"

    def _columns(self, options: Options) -> tuple[Column, ...]:
        incompressible = self.entry.kind == "picture"
        encoding = Encoding(level=1) if incompressible else Encoding(shuffle=SHUFFLE)
        return (Column("values", "u1", encoding, self.entry.unit),)

    def split(self, array: NDArray[Any]) -> Columns:
        """Narrow the values."""
        return {"values": narrow(array)}

    def join(self, columns: Columns, into: NDArray[Any] | None = None) -> NDArray[Any]:
        """Return (N,) values in the field's type, or classes in the narrowest one."""
        values = columns["values"]
        return values if self.entry.kind in ("class", "picture") else values.astype(self.entry.dtype, copy=False)


class Flow(Packing):
    """(N, 3) vectors as a `palette` (3, K) of the frame's distinct ones, told apart by their bits, and an `index` of each point."""

    kind = "flow"

    def _columns(self, options: Options) -> tuple[Column, ...]:
        encoding = Encoding(shuffle=SHUFFLE)
        return Column("index", "u1", encoding), Column("palette", "<f4", encoding, self.entry.unit, rows=3, least=256)

    def split(self, array: NDArray[Any]) -> Columns:
        """Tell the vectors apart; most repeat the one before, so only the first of each run is looked at."""
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
            raise FormatError(f"expected an index below {palette.shape[1]}, found {int(index.max())}")
        return np.ascontiguousarray(palette.T)[index]


class Cells(Packing):
    """A grid's labels or counts: `values` (F, X, Y, Z), a frame a chunk."""

    kind = "grid"

    def _columns(self, options: Options) -> tuple[Column, ...]:
        shuffle = BITSHUFFLE if self.entry.kind == "count" else NO_SHUFFLE
        return (Column("values", "u1", Encoding(level=8, shuffle=shuffle), self.entry.unit),)

    def split(self, array: NDArray[Any]) -> Columns:
        """Narrow the values."""
        return {"values": narrow(array)}

    def join(self, columns: Columns, into: NDArray[Any] | None = None) -> NDArray[Any]:
        """Return (X, Y, Z), unsigned integers, or float32 where counts are no whole numbers."""
        return columns["values"]


class Votes(Packing):
    """Votes by class: the columns of the table, as `voxel`, `label` and `votes`."""

    kind = "votes"

    def _columns(self, options: Options) -> tuple[Column, ...]:
        return (
            Column("voxel", "<i4", Encoding(shuffle=SHUFFLE), "index"),
            Column("label", "u1", Encoding(), "class"),
            Column("votes", "<u2", Encoding(shuffle=SHUFFLE), "votes"),
        )

    def split(self, array: NDArray[Any]) -> Columns:
        """Take the table apart."""
        return {column.name: np.ascontiguousarray(array[column.name]) for column in self.columns}

    def join(self, columns: Columns, into: NDArray[Any] | None = None) -> NDArray[Any]:
        """Put the table together."""
        wide = columns["label"].dtype.itemsize > 1
        votes = np.empty(len(columns["voxel"]), layout.WIDE_VOTES_DTYPE if wide else layout.VOTES_DTYPE)
        for name, column in columns.items():
            votes[name] = column
        return votes


class PackedSource(Source):
    """A packed store."""

    @abstractmethod
    def stored_bytes(self) -> dict[str, int]:
        """Return the bytes that each field takes in the store; "documents" for the text files, "index" for all the rest."""


class PackedWriter(SequenceWriter):
    """Takes one sequence of a packed store.

    Attributes:
        identity: split, name and coordinates, from the path unless they are known better.
    """

    identity: tuple[str | None, str, Coordinates]


class PackedSink(Sink):
    """Takes a packed store."""

    @abstractmethod
    def finished(self, path: str) -> bool:
        """Whether an earlier run, cut off later on, has written this sequence whole."""

    @abstractmethod
    def sequence(self, path: str) -> PackedWriter:
        """Start a sequence, anew if an earlier run left a part of it."""


def packing_of(
    entry: layout.Field, options: Options | None = None, attributes: Mapping[str, Any] | None = None
) -> Packing:
    """Return how a field is packed: by `options` when it is written, by the store's `attributes` when it is read."""
    options = options or Options()
    if attributes is None:
        attributes = {"scale_m": options.lossy_mm / 1000} if entry.kind == "position" and options.lossy_mm else {}
    kind: Callable[..., Packing] = Cells if entry.per == "voxel" else _BY_KIND.get(entry.kind, Values)
    return kind(entry, options, attributes)


_BY_KIND: dict[layout.Kind, Callable[..., Packing]] = {"position": Points, "vector": Flow, "votes": Votes}


def quantise(metres: NDArray[Any], scale_m: float) -> NDArray[np.int32]:
    """Return whole steps of `scale_m`.

    Raises:
        FormatError: NaN, infinity, or too far away to count.
    """
    steps = np.rint(metres.astype(np.float64) / scale_m)
    if not (np.abs(steps) < 2**31).all():  # NaN is not less either
        raise FormatError(
            f"expected finite coordinates within {2**31 * scale_m:.0f} m to quantise, found others: pack without loss"
        )
    return steps.astype(np.int32)


def narrow(array: NDArray[Any]) -> NDArray[Any]:
    """Return unsigned whole numbers in the smallest unsigned type that holds them, anything else bit for bit as it is."""
    if array.dtype.kind == "f":
        values = np.ascontiguousarray(array, "<f4")
        with np.errstate(invalid="ignore"):
            whole = values.astype(np.uint32) if values.size == 0 or values.max() < 2**32 else None  # NaN is not less
        exact = whole is not None and np.array_equal(whole.astype("<f4").view(np.uint32), values.view(np.uint32))
        if whole is None or not exact:
            return values
        array = whole
    highest = int(array.max()) if array.size else 0
    return array.astype("u1" if highest < 2**8 else "<u2" if highest < 2**16 else "<u4", copy=False)


def common_type(first: np.dtype[Any], second: np.dtype[Any]) -> np.dtype[Any]:
    """Return a type that holds the values of both exactly: the wider integer, or float32 (whose whole numbers they are)."""
    if "f" in (first.kind, second.kind):
        return np.dtype("<f4")
    return max(first, second, key=lambda dtype: dtype.itemsize)
