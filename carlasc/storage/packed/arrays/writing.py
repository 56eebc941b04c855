"""Writing packed stores of arrays: what zarr and HDF5 have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import FormatError
from carlasc.storage import layout
from carlasc.storage.packed.arrays.chunks import Encoding, StoredArray
from carlasc.storage.packed.arrays.columns import Column, packing_of
from carlasc.storage.packed.arrays.reading import COLUMN, DOCUMENT, FIELD, SEQUENCE, document_node, field_node
from carlasc.storage.packed.numbers import common_type
from carlasc.storage.packed.output import put_in_place, refuse_existing, unfinished
from carlasc.storage.packed.protocol import STORE, VERSION, FieldWriter, Options, PackedSink, PackedWriter, node_of

_HEADROOM = 1.125  # a chunk is this much larger than the first frame, so that later frames seldom need a second chunk


class ChunkWriter(ABC):
    """An array that grows by chunks."""

    @abstractmethod
    def append(self, chunk: NDArray[Any]) -> None:
        """Add a chunk."""

    @abstractmethod
    def close(self) -> None:
        """Write the chunks that are held back; the array is whole then."""


class ArrayStoreWriter(ABC):
    """A tree of groups and arrays to write to.

    Attributes:
        location: where it is written, for errors.
    """

    location: str

    @abstractmethod
    def write_group(self, node: str, attributes: dict[str, Any]) -> None:
        """Create a group, or replace its attributes."""

    @abstractmethod
    def write_small(self, node: str, array: NDArray[Any], attributes: dict[str, Any]) -> None:
        """Write a whole array as one chunk; an older one is replaced."""

    @abstractmethod
    def create(
        self,
        node: str,
        dtype: np.dtype[Any],
        chunk: tuple[int, ...],
        axis: int,
        encoding: Encoding,
        attributes: dict[str, Any],
    ) -> ChunkWriter:
        """Start an array that grows along `axis`."""

    @abstractmethod
    def array(self, node: str) -> StoredArray:
        """Return a closed array, whose chunks can be read."""

    @abstractmethod
    def move(self, node: str, target: str) -> None:
        """Rename an array; another one of that name is replaced."""

    @abstractmethod
    def remove(self, node: str) -> None:
        """Remove a node and those below it, if it exists."""

    @abstractmethod
    def finished(self) -> dict[str, str]:
        """Return the groups of the sequences that an interrupted run has finished, by path."""

    @abstractmethod
    def close(self, attributes: dict[str, Any]) -> Path:
        """Write the root's attributes and return the file or folder, which is whole then."""


class ArraySink(PackedSink):
    """Writes a packed store of arrays, which gets its name when the sink is closed, and not before."""

    def __init__(
        self, path: Path, writer: Callable[[Path], ArrayStoreWriter], options: Options, overwrite: bool
    ) -> None:
        """Start a store, or continue one whose packing was interrupted.

        Raises:
            ConflictError: something exists at `path`, and `overwrite` is not given.
        """
        self.path = path
        self.location = str(path)
        self.options = options
        self.overwrite = overwrite
        refuse_existing(path, overwrite)
        self._store = writer(unfinished(path))
        self._sequences = dict(self._store.finished())

    def finished(self, path: str) -> bool:
        """Whether an earlier run that was interrupted has written this sequence whole."""
        return path in self._sequences

    def sequence(self, path: str) -> ArrayWriter:
        """Start a sequence; what an interrupted run left of it is removed."""
        group = node_of(path, self.location)
        self._sequences.pop(path, None)
        self._store.remove(group)
        return ArrayWriter(self._store, path, group, self.options, self._sequences)

    def close(self) -> None:
        """Finish the store and give it its name."""
        root = {"type": STORE, "version": VERSION, "complete": True, "sequences": self._sequences}
        root |= {"lossy_mm": self.options.lossy_mm} if self.options.lossy_mm else {}
        put_in_place(self._store.close(root), self.path, self.overwrite)


class ArrayWriter(PackedWriter):
    """Writes one sequence of a packed store of arrays."""

    def __init__(
        self, store: ArrayStoreWriter, path: str, group: str, options: Options, finished: dict[str, str]
    ) -> None:
        super().__init__(f"{store.location}/{group}", path)
        self._store = store
        self._group = group
        self._options = options
        self._finished = finished

    def _start_field(self, field: str) -> FieldWriter:
        return _ArrayFieldWriter(self._store, f"{self._group}/{field_node(field)}", field, self._options)

    def close(self) -> None:
        """Write what is held back and mark the sequence as whole."""
        for writer in self.writers.values():
            writer.close()
        for name, data in self.contents.items():
            attributes = {"type": DOCUMENT, "version": VERSION, "dtype": "uint8", "unit": "bytes", "name": name}
            self._store.write_small(f"{self._group}/{document_node(name)}", np.frombuffer(data, np.uint8), attributes)
        self._write_numbers()
        attributes = {"type": SEQUENCE, "version": VERSION, **self.about(), "complete": True}
        self._store.write_group(self._group, attributes)
        self._finished[self.path] = self._group

    def _write_numbers(self) -> None:
        """Write poses and times as arrays too, for programs that do not read the text files."""
        for name, document, unit in (("poses", layout.POSES, "m"), ("times", layout.TIMES, "s")):
            if document not in self.contents:
                continue
            with suppress(FormatError):  # not numbers: the text is kept as it is, and its reader reports the error
                decode = layout.decode_poses if name == "poses" else layout.decode_times
                numbers = decode(self.contents[document], document)
                attributes = {
                    "type": "carlasc.numbers",
                    "version": VERSION,
                    "dtype": "float64",
                    "unit": unit,
                    "document": document,
                }
                self._store.write_small(f"{self._group}/{name}", numbers, attributes)


class _ArrayFieldWriter(FieldWriter):
    """Writes the columns of a field."""

    def __init__(self, store: ArrayStoreWriter, node: str, field: str, options: Options) -> None:
        super().__init__(field)
        self.store = store
        self.node = node
        self.packing = packing_of(self.entry, options)
        is_grid = self.packing.kind == "grid"
        self.columns = {c.name: _ColumnWriter(store, f"{node}/{c.name}", c, is_grid) for c in self.packing.columns}

    def write(self, frame: int, array: NDArray[Any]) -> None:
        """Append one frame to the columns."""
        parts = self.packing.split(array)
        for name, column in self.columns.items():
            column.append(parts.get(name))

    def close(self) -> None:
        entry = self.packing.entry
        common = {
            "version": VERSION,
            "dtype": np.dtype(entry.dtype).name if entry.dtype else "table",
            "unit": entry.unit,
        }
        self.store.write_group(
            self.node,
            {"type": FIELD, "field": entry.name, "kind": self.packing.kind, **common, **self.packing.attributes},
        )
        attributes = {"type": "carlasc.frames", "version": VERSION, "dtype": "int64", "unit": "frame"}
        self.store.write_small(f"{self.node}/frames", np.fromiter(self.frames, np.int64), attributes)
        for column in self.columns.values():
            column.close()


class _ColumnWriter:
    """One array of a field, in chunks that start where a frame starts."""

    def __init__(self, store: ArrayStoreWriter, node: str, column: Column, is_grid: bool) -> None:
        self.store = store
        self.node = node
        self.place = node  # the array's node until it is closed
        self.column = column
        self.is_grid = is_grid
        self.dtype = np.dtype(column.dtype)
        self.step = column.step or 0  # elements per chunk; 0 until the first frame with any elements
        self.chunks = 0
        self.spans: list[tuple[int, int]] = []
        self._writer: ChunkWriter | None = None
        self._shape: tuple[int, ...] | None = None  # of a grid

    def append(self, values: NDArray[Any] | None) -> None:
        """Add a frame's values; None if it does not need this column."""
        if values is None or (values.size == 0 and not self.is_grid):
            self.spans.append((0, 0))
            return
        self._fit_type(values.dtype)
        if self.is_grid:
            if self._shape not in (None, values.shape):
                raise FormatError(
                    "its array", expected=f"shape {self._shape}, as in earlier frames", found=str(values.shape)
                )
            self._shape = values.shape
            self._put(values[None].astype(self.dtype, copy=False))
            return
        count = values.shape[-1]
        self.step = self.step or _round_up(max(int(count * _HEADROOM), self.column.least))
        start = self.chunks * self.step
        for first in range(0, count, self.step):
            part = values[..., first : first + self.step]
            chunk = np.zeros((*values.shape[:-1], self.step), self.dtype)
            chunk[..., : part.shape[-1]] = part
            self._put(chunk)
        self.spans.append((start, start + count))

    def close(self) -> None:
        if self._writer is None:
            return  # no frame needed it
        self._writer.close()
        if self.place != self.node:
            self.store.move(self.place, self.node)
        if not self.is_grid:
            attributes = {"type": "carlasc.offsets", "version": VERSION, "dtype": "int64", "unit": "element"}
            self.store.write_small(f"{self.node}_offsets", np.array(self.spans, np.int64).reshape(-1, 2), attributes)

    def _put(self, chunk: NDArray[Any]) -> None:
        if self._writer is None:
            self._writer = self._create(chunk.shape)
        self._writer.append(chunk)
        self.chunks += 1

    def _create(self, chunk: tuple[int, ...]) -> ChunkWriter:
        attributes = {"type": COLUMN, "version": VERSION, "dtype": self.dtype.name, "unit": self.column.unit}
        axis = 0 if self.is_grid else len(chunk) - 1
        return self.store.create(self.place, self.dtype, chunk, axis, self.column.encoding, attributes)

    def _fit_type(self, dtype: np.dtype[Any]) -> None:
        """Widen the array if its type does not hold a frame's values: it is written again, chunk by chunk."""
        wider = common_type(self.dtype, dtype)
        if wider == self.dtype:
            return
        self.dtype = wider
        if self._writer is None:
            return
        self._writer.close()
        narrow, place = self.store.array(self.place), self.place
        self.place = f"{self.node}.{wider.name}"
        self._writer = self._create(narrow.chunk)
        for number in range(self.chunks):
            self._writer.append(narrow.read_chunk(number).astype(wider))
        self.store.remove(place)


def _round_up(count: int) -> int:
    """Round the elements of a chunk up to a multiple of 256."""
    return -(-count // 256) * 256
