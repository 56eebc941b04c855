"""Where the frames of a field are in a zarr store of version 2, and how they are encoded and read. See `docs/storage.md#zarr`.

A frame has a place that depends on its number alone, so that any process can write any block of frames.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import FormatError
from carlasc.storage import layout
from carlasc.storage.packed.array_reading import COLUMN, FIELD, ArrayField, StoredColumn, check_attributes
from carlasc.storage.packed.columns import FEW, LEAST, Column, Packing, packing_of
from carlasc.storage.packed.stores import PackOptions
from carlasc.storage.zarr.shards import ZarrArray, encode_chunk
from carlasc.storage.zarr.zarr_metadata import array_metadata

VERSION = 2  # of the format in docs/storage.md
SLOTS = 16  # a frame has room for this many typical frames
_PCODEC = "pcodec"  # value of the attribute `codec` of points that are packed smaller
_HEADROOM = 1.125  # a chunk is this much larger than a typical frame, so that few frames need a second one


@dataclass(frozen=True)
class Encoded:
    """A frame of a field as it is stored: its chunks in each column that it needs, and their number of elements."""

    counts: dict[str, int]
    chunks: dict[str, list[bytes]]


class FieldLayout:
    """Where the frames of a field are, from the attributes of its group.

    Attributes:
        packing: how an array becomes columns.
        columns: the columns by name, with the wide ones.
    """

    def __init__(self, packing: Packing, attributes: Mapping[str, Any], block: int) -> None:
        self.packing = packing
        self.attributes = attributes
        self.block = block
        self.columns = {column.name: column for family in packing.columns for column in family.fixed}
        self.is_grid = packing.kind == "grid"

    @classmethod
    def read(cls, where: str, field: str, attributes: Mapping[str, Any] | None, block: int) -> FieldLayout:
        """Return the layout of a field that exists.

        Raises:
            FormatError: the attributes are not those of this field.
        """
        if attributes is None or attributes.get("type") != FIELD:
            raise FormatError(
                where, expected="the field that the sequence lists", found="none", advice="the store is damaged"
            )
        check_attributes(attributes, where)
        options = PackOptions(small=attributes.get("codec") == _PCODEC)
        packing = packing_of(layout.field_named(field), options, attributes)
        if attributes.get("kind") != packing.kind:
            raise FormatError(where, expected=f"a field of kind {packing.kind}", found=repr(attributes.get("kind")))
        size = attributes.get("shape" if packing.kind == "grid" else "chunk")
        numbers = size if isinstance(size, list) else [size]
        if not all(type(number) is int and 0 < number < 2**31 for number in numbers) or (
            len(numbers) != 3 if packing.kind == "grid" else isinstance(size, list)
        ):
            raise FormatError(where, expected="the size of its chunks", found=repr(size), advice="the store is damaged")
        return cls(packing, attributes, block)

    @classmethod
    def plan(cls, field: str, options: PackOptions, typical: tuple[int, ...]) -> FieldLayout:
        """Return the layout of a new field.

        Args:
            field: its name.
            options: those of the store.
            typical: the shape of a grid, or (number of elements of a typical frame,).
        """
        entry = layout.field_named(field)
        packing = packing_of(entry, options)
        if packing.kind == "grid":
            size: dict[str, Any] = {"shape": list(typical)}
        else:
            size = {"chunk": max(_round_up(int(typical[0] * _HEADROOM)), LEAST)}
        about = {"type": FIELD, "version": VERSION, "field": entry.name, "kind": packing.kind}
        about |= {"dtype": np.dtype(entry.dtype).name if entry.dtype else "table", "unit": entry.unit}
        codec = {"codec": _PCODEC} if any(column.encoding.codec == _PCODEC for column in packing.columns) else {}
        return cls(packing, about | size | codec | dict(packing.attributes), options.block)

    def step(self, column: Column) -> int:
        """Return the number of elements of a chunk."""
        return column.step or self._typical(column)

    def slots(self, column: Column) -> int:
        """Return the number of chunks that a frame has room for."""
        return 1 if self.is_grid else -(-SLOTS * self._typical(column) // self.step(column))

    def _typical(self, column: Column) -> int:
        return FEW if column.least == FEW else int(self.attributes["chunk"])

    def metadata(self, column: Column, frames: int) -> dict[str, Any]:
        """Return the metadata of a column's array with room for some frames, a multiple of the block."""
        dtype = np.dtype(column.dtype)
        about = {"type": COLUMN, "version": VERSION, "dtype": dtype.name, "unit": column.unit}
        if self.is_grid:
            cells = tuple(self.attributes["shape"])
            shape, shard, chunk = (frames, *cells), (self.block, *cells), (1, *cells)
        else:
            step, room = self.step(column), self.slots(column) * self.step(column)
            rows = (column.rows,) if column.rows else ()
            shape, shard, chunk = (*rows, frames * room), (*rows, self.block * room), (*rows, step)
        return array_metadata(dtype, shape, chunk, column.encoding, about, shard)

    def check(self, array: ZarrArray, column: Column, last: int, most: int, where: str) -> None:
        """Check that a stored array is that of a column, and has room for frame number `last` and for frames of `most` elements.

        Raises:
            FormatError: it is another one; names the array `where`.
        """
        slots = (array.per_shard or 0) // self.block
        rest = tuple(self.attributes["shape"]) if self.is_grid else (column.rows,) if column.rows else ()
        fits = array.dtype == np.dtype(column.dtype) and array.axis == (0 if self.is_grid else len(rest))
        fits = fits and rest == tuple(n for axis, n in enumerate(array.chunk) if axis != array.axis)
        fits = fits and slots > 0 and (last + 1) * slots * array.step <= array.shape[array.axis]
        if not fits or not (self.is_grid or most <= slots * array.step):
            raise FormatError(
                where,
                expected=f"{column.dtype} with room for frame {last}",
                found=f"{array.dtype.str} of shape {array.shape} in chunks {array.chunk}",
                advice="the store is damaged",
            )

    def encode(self, array: NDArray[Any]) -> Encoded:
        """Return a frame as it is stored.

        Raises:
            FormatError: it does not fit the field.
        """
        self.packing.entry.check(array, "its array")
        if self.is_grid and list(array.shape) != self.attributes["shape"]:
            raise FormatError(
                "its array", expected=f"shape {tuple(self.attributes['shape'])}, as in earlier frames",
                found=str(array.shape),
            )  # fmt: skip
        counts, chunks = {}, {}
        parts = self.packing.split(array)
        for family in self.packing.columns:
            values = parts.get(family.name)
            if values is None or not values.size:
                continue
            column = self._column_for(family, values)
            counts[column.name] = values.size if self.is_grid else values.shape[-1]
            chunks[column.name] = self._encode(column, values)
        return Encoded(counts, chunks)

    def _column_for(self, family: Column, values: NDArray[Any]) -> Column:
        """Return the column that takes the values of a frame: the first with a type and a size that hold them."""
        *narrower, widest = family.fixed
        for column in (*(one for one in narrower if np.can_cast(values.dtype, one.dtype)), widest):
            if self.is_grid or values.shape[-1] <= self.slots(column) * self.step(column):
                return column
        most = self.slots(widest) * self.step(widest)
        raise FormatError(
            "its array",
            expected=f"at most {most} elements ({SLOTS} times a typical frame)",
            found=str(values.shape[-1]),
            advice="leave the frame out, or pack to an .h5 store",
        )

    def _encode(self, column: Column, values: NDArray[Any]) -> list[bytes]:
        if self.is_grid:
            return [encode_chunk(values[None].astype(column.dtype, copy=False), column.encoding)]
        step, found = self.step(column), []
        for first in range(0, values.shape[-1], step):
            part = values[..., first : first + step]
            chunk = np.zeros((*values.shape[:-1], step), column.dtype)
            chunk[..., : part.shape[-1]] = part
            found.append(encode_chunk(chunk, column.encoding))
        return found


def open_field(
    where: str,
    field_layout: FieldLayout,
    frames: NDArray[np.int64],
    counts: Mapping[str, NDArray[np.int64]],
    array_of: Callable[[str], ZarrArray],
    *,
    local: bool,
) -> ArrayField:
    """Return a field whose frames can be read.

    Args:
        where: its name in errors.
        field_layout: where its frames are.
        frames: (n,) numbers of frames, in rising order.
        counts: (n,) elements of each in each column; -1 in frames that the field does not have.
        array_of: returns the array of a column.
        local: whether its bytes are on this machine.
    """
    exists = np.zeros(len(frames), np.bool_)
    for column in counts.values():
        exists |= column >= 0
    frames = frames[exists]
    own = {name: column[exists] for name, column in counts.items()}

    def open_columns() -> dict[str, StoredColumn]:
        found = {}
        for name, numbers in own.items():
            if not (numbers > 0).any():
                continue  # no frame needed it
            column, array = field_layout.columns[name], array_of(name)
            field_layout.check(array, column, int(frames[-1]), int(numbers.max()), f"{where}/{name}")
            slots = (array.per_shard or 0) // field_layout.block
            found[name] = StoredColumn(column, array, frames * slots, np.maximum(numbers, 0), field_layout.is_grid)
        return found

    return ArrayField(where, field_layout.packing, frames, open_columns, local)


def _round_up(count: int) -> int:
    """Round the elements of a chunk up to a multiple of 256."""
    return -(-count // 256) * 256
