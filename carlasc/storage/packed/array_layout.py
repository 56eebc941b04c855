"""The layout of the frames of a field in a store of arrays, zarr or HDF5.

See `docs/packed-format.md#arrays`.

The position of a frame depends only on its number: frame i of a column is entry i of its array. Any
block of frames can therefore be written independently of the others, and found without an index.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyArray
from carlasc.errors import FormatError
from carlasc.storage import field_files, layout
from carlasc.storage.files import damaged
from carlasc.storage.packed.chunks import StoredArray
from carlasc.storage.packed.columns import FEW, LEAST, Column, Packing, packing_of
from carlasc.storage.packed.stores import VERSION, PackOptions, check_scale

SEQUENCE = "carlasc.sequence"
FIELD = "carlasc.field"
COLUMN = "carlasc.column"
DOCUMENT = "carlasc.document"
_SLOTS = 16  # a frame has room for this many typical frames
_PCODEC = "pcodec"  # value of the attribute `codec` of points that PCodec compressed
_HEADROOM = (
    1.125  # a chunk is this much larger than a typical frame, so that few frames need a second one
)
# A frame has room for four votes per voxel, and for one moving voxel in four.
_CELLS_PER_ROW = {"vote": 4, "moving voxel": 64}
_PICTURE = 1 << 18  # bytes of a picture, unless the first pictures are larger
FrameTable = dict[int, dict[str, int]]
"""The frames of a field: for each, the number of elements by column."""


class FieldLayout:
    """The layout of the frames of a field, from the attributes of its group.

    Attributes:
        packing: converts arrays to columns and back.
        attributes: attributes of the group of the field in the store.
        columns: the columns by name, including wide columns.
        is_grid: whether the field has one value per voxel.
    """

    def __init__(self, packing: Packing, attributes: Mapping[str, Any]) -> None:
        self.packing = packing
        self.attributes = attributes
        self.columns = {column.name: column for family in packing.columns for column in family.both}
        self.is_grid = packing.kind == "grid"

    @classmethod
    def read(cls, where: str, field: str, attributes: Mapping[str, Any] | None) -> FieldLayout:
        """Return the layout of an existing field.

        Args:
            where: group of the field, for errors.
            field: name of the field.
            attributes: attributes of the group; None if the group does not exist.

        Raises:
            FormatError: the attributes are missing or do not fit the field.
        """
        if attributes is None or attributes.get("type") != FIELD:
            raise damaged(where, "the field that the sequence lists", "none")
        check_scale(attributes, where)
        options = PackOptions(small=attributes.get("codec") == _PCODEC)
        packing = packing_of(layout.field_named(field), options, attributes)
        if attributes.get("kind") != packing.kind:
            raise FormatError(
                where,
                expected=f"a field of kind {packing.kind}",
                found=repr(attributes.get("kind")),
            )
        size = attributes.get("shape" if packing.kind == "grid" else "chunk")
        numbers = size if isinstance(size, list) else [size]
        if not all(type(number) is int and 0 < number < 2**31 for number in numbers) or (
            len(numbers) != 3 if packing.kind == "grid" else isinstance(size, list)
        ):
            raise damaged(where, "a chunk size above 0", repr(size))
        return cls(packing, attributes)

    @classmethod
    def plan(cls, field: str, options: PackOptions, typical: tuple[int, ...]) -> FieldLayout:
        """Return the layout of a new field.

        Args:
            field: name of the field.
            options: options of the store.
            typical: the shape of a grid, or (number of elements of a typical frame,).
        """
        entry = layout.field_named(field)
        packing = packing_of(entry, options)
        if packing.kind == "grid":
            size: dict[str, Any] = {"shape": list(typical)}
        else:
            # a multiple of 256
            size = {"chunk": max(-(-int(typical[0] * _HEADROOM) // 256) * 256, LEAST)}
        about = {
            "type": FIELD,
            "version": VERSION,
            "field": entry.name,
            "kind": packing.kind,
            "dtype": np.dtype(entry.dtype).name if entry.dtype else "table",
            "unit": entry.unit,
        }
        codec = (
            {"codec": _PCODEC}
            if any(column.encoding.codec == _PCODEC for column in packing.columns)
            else {}
        )
        return cls(packing, about | size | codec | dict(packing.attributes))

    def frame_shape(self, column: Column) -> tuple[int, ...]:
        """Return the shape of one entry of the array of a column: (X, Y, Z) for a grid, otherwise
        ([rows,] most elements of a frame).
        """
        if self.is_grid:
            return tuple(self.attributes["shape"])
        typical = self._typical(column)
        step = self._step(column)
        return (*((column.rows,) if column.rows else ()), -(-_SLOTS * typical // step) * step)

    def chunk_shape(self, column: Column) -> tuple[int, ...]:
        """Return the shape of a chunk of the array of a column. A chunk belongs to one frame."""
        shape = self.frame_shape(column)
        return (1, *shape) if self.is_grid else (1, *shape[:-1], self._step(column))

    def column_attributes(self, column: Column) -> dict[str, Any]:
        """Return the attributes of a column's array."""
        return {
            "type": COLUMN,
            "version": VERSION,
            "dtype": np.dtype(column.dtype).name,
            "unit": column.unit,
        }

    def _step(self, column: Column) -> int:
        return column.step or self._typical(column)

    def _typical(self, column: Column) -> int:
        return FEW if column.least == FEW else int(self.attributes["chunk"])

    def check(self, array: StoredArray, column: Column, last: int, most: int, where: str) -> None:
        """Check that a stored array fits a column, and has room for the frames that the store
        lists.

        Args:
            array: the stored array.
            column: the column.
            last: largest frame number.
            most: largest number of elements of a frame.
            where: name of the array in errors.

        Raises:
            FormatError: the array does not fit, or is too small.
        """
        rest = (
            tuple(self.attributes["shape"])
            if self.is_grid
            else (column.rows,)
            if column.rows
            else ()
        )
        rest += () if self.is_grid else (array.step,)
        fits = array.dtype == np.dtype(column.dtype) and array.chunk == (1, *rest)
        fits = fits and last < array.shape[0] < 2**63 // max(1, array.slots)
        fits = fits and array.shape[1:] == (rest if self.is_grid else (*rest[:-1], array.shape[-1]))
        if not fits or not (self.is_grid or most <= array.shape[-1]):
            raise damaged(
                where,
                f"{column.dtype} with room for frame {last}",
                f"{array.dtype.str} of shape {array.shape} in chunks {array.chunk}",
            )

    def divide(
        self, array: AnyArray, *, limited: bool = True
    ) -> tuple[dict[str, int], dict[str, list[AnyArray]]]:
        """Divide a frame into chunks.

        Args:
            array: the array of the frame.
            limited: whether the number of elements is limited to the reserved room. If not, the
                last column grows.

        Returns:
            The number of elements and the chunks, both by column, of the columns that the frame
            uses.

        Raises:
            FormatError: the array does not fit the field.
        """
        self.packing.entry.check(array, "its array")
        if self.is_grid and list(array.shape) != self.attributes["shape"]:
            raise FormatError(
                "its array", expected=f"shape {tuple(self.attributes['shape'])}, as in earlier "
                                      f"frames",
                found=array.shape,
            )  # fmt: skip
        counts = {}
        chunks = {}
        parts = self.packing.split(array)
        for family in self.packing.columns:
            values = parts.get(family.name)
            if values is None or not values.size:
                continue
            column = self._column_for(family, values, limited)
            counts[column.name] = values.size if self.is_grid else values.shape[-1]
            chunks[column.name] = list(self._chunks(column, values))
        return counts, chunks

    def _column_for(self, family: Column, values: AnyArray, limited: bool) -> Column:
        """Return the column for the values of a frame: the first whose type and size hold them."""
        *narrower, widest = family.both
        for column in (*(one for one in narrower if np.can_cast(values.dtype, one.dtype)), widest):
            if self.is_grid or values.shape[-1] <= self.frame_shape(column)[-1]:
                return column
        if not limited:
            return widest
        raise FormatError(
            "its array",
            expected=f"at most {self.frame_shape(widest)[-1]} elements ({_SLOTS} times a typical "
            f"frame)",
            found=values.shape[-1],
            advice="leave the frame out, or pack to an .h5 store",
        )

    def _chunks(self, column: Column, values: AnyArray) -> Iterator[AnyArray]:
        if self.is_grid:
            yield values[None].astype(column.dtype, copy=False)
            return
        step = self._step(column)
        for first in range(0, values.shape[-1], step):
            part = values[..., first : first + step]
            chunk = np.zeros((1, *values.shape[:-1], step), column.dtype)
            chunk[0, ..., : part.shape[-1]] = part
            yield chunk


def typical_size(
    entry: field_files.Field,
    arrays: list[AnyArray],
    rows: Mapping[str, int],
    cells_of: Callable[[str], int | None],
) -> tuple[int, ...]:
    """Return the typical size of a new field, for `FieldLayout.plan`.

    Args:
        entry: the field.
        arrays: the first frames.
        rows: the announced number of elements of a typical frame, by field.
        cells_of: returns the number of voxels of a grid, None if it is not known.

    Returns:
        The shape of a grid, or (number of elements of a typical frame,): as announced, otherwise
        the maximum of the first frames.
    """
    if entry.per == "voxel":
        return arrays[0].shape
    announced = rows.get("points") if entry.per == "point" else None
    announced = rows.get(entry.name) if announced is None else announced
    if announced is None and entry.per in _CELLS_PER_ROW:
        announced = (cells_of(entry.folder) or 0) // _CELLS_PER_ROW[entry.per]
    if announced is None:
        announced = max(map(len, arrays), default=0)
        announced = (
            1 << (max(announced, _PICTURE) - 1).bit_length()
            if entry.kind == "picture"
            else announced
        )
    return (announced,)


def index_arrays(
    layouts: Mapping[str, FieldLayout],
    tables: Mapping[str, FrameTable],
    read_document: Callable[[str], bytes | None],
) -> Iterator[tuple[str, AnyArray, dict[str, Any]]]:
    """Yield the arrays of a sequence beside its fields: name, values and attributes.

    `frames` has the (N,) sorted frame numbers. `counts` has the (N, C) number of elements per frame
    and column, -1 if the field lacks the frame, and the nodes of the C columns; readers find frames
    by it. `poses` and `times` are for programs that do not read the text files.

    Args:
        layouts: the layout of each field.
        tables: the frames of each field.
        read_document: returns a text file of the sequence, None if it does not exist.
    """
    frames = sorted({frame for table in tables.values() for frame in table})
    columns: dict[str, list[int]] = {}
    for name in sorted(tables):
        table = tables[name]
        firsts = {family.name for family in layouts[name].packing.columns}
        for column in layouts[name].columns:
            counts = [table[frame].get(column, 0) if frame in table else -1 for frame in frames]
            if max(counts) > 0 or column in firsts:
                columns[f"{field_node(name)}/{column}"] = counts
    counts_of = np.array(list(columns.values()), "<i8").reshape(len(columns), len(frames)).T
    about = {"version": VERSION, "dtype": "int64"}
    yield "frames", np.array(frames, "<i8"), about | {"type": "carlasc.frames", "unit": "frame"}
    about |= {"type": "carlasc.counts", "unit": "element", "columns": list(columns)}
    yield "counts", np.ascontiguousarray(counts_of), about
    for name, document, decode, unit in (
        ("poses", layout.POSES, layout.decode_poses, "m"),
        ("times", layout.TIMES, layout.decode_times, "s"),
    ):
        data = read_document(document)
        about = {"type": "carlasc.numbers", "version": VERSION, "dtype": "float64", "unit": unit}
        # not numbers: the text is kept unchanged, and its reader reports the error
        with suppress(FormatError):
            if data is not None:
                yield name, decode(data, document), about | {"document": document}


def field_node(field: str) -> str:
    """Return the node of a field in the group of its sequence."""
    return f"grids/{field}" if "/" in field else f"scans/{field}"


def document_node(name: str) -> str:
    """Return the node of a text file in the group of its sequence."""
    return f"documents/{name}"
