"""Packed stores of arrays: what zarr and HDF5 have in common, writing. The format is docs/storage.md, section "Arrays"."""

from __future__ import annotations

import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import ArgumentError, CarlascError, ConflictError, FormatError
from carlasc.storage import layout
from carlasc.storage.packed.arrays import COLUMN, DOCUMENT, FIELD, SEQUENCE, STORE, document_node, field_node
from carlasc.storage.packed.chunks import Encoding, StoredArray
from carlasc.storage.packed.store import (
    VERSION,
    Column,
    Options,
    PackedSink,
    PackedWriter,
    Packing,
    common_type,
    packing_of,
)
from carlasc.storage.protocol import identity_of

TABLES_MARK = "carlasc-tables.json"  # the file that makes a folder a store of tables
UNFINISHED_MARK = "unfinished.json"  # the one beside it until the store is whole
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_HEADROOM = 1.125  # a chunk holds the first frame and this much more: later frames seldom need a second chunk


class ChunkWriter(ABC):
    """An array that grows by chunks."""

    @abstractmethod
    def append(self, chunk: NDArray[Any]) -> None:
        """Add a chunk."""

    @abstractmethod
    def close(self) -> None:
        """Write what is held back; the array is whole then."""


class ArrayStoreWriter(ABC):
    """A tree of groups and arrays, to be written beside its place.

    Attributes:
        location: where it will be.
    """

    location: str

    @abstractmethod
    def write_group(self, node: str, attributes: dict[str, Any]) -> None:
        """Make a group, or give it other attributes."""

    @abstractmethod
    def write_small(self, node: str, array: NDArray[Any], attributes: dict[str, Any]) -> None:
        """Write a whole array as one chunk, over what is there."""

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
        """Return a closed array, to read it again."""

    @abstractmethod
    def move(self, node: str, target: str) -> None:
        """Put an array in the place of another."""

    @abstractmethod
    def remove(self, node: str) -> None:
        """Remove a node and what is below, if there is one."""

    @abstractmethod
    def finished(self) -> dict[str, str]:
        """Return the sequences that an earlier run, cut off later on, has finished: group by path."""

    @abstractmethod
    def close(self, attributes: dict[str, Any]) -> Path:
        """Write the root's attributes; return the file or folder, whole now."""


class ArraySink(PackedSink):
    """Writes a packed store of arrays, as a whole: it stands in its place when the sink is closed, and not before."""

    def __init__(
        self, path: Path, writer: Callable[[Path], ArrayStoreWriter], options: Options, overwrite: bool
    ) -> None:
        """Start a store, or go on with one that was cut off.

        Raises:
            ConflictError: something is in its place, and `overwrite` is not given.
        """
        self.path = path
        self.location = str(path)
        self.options = options
        self.overwrite = overwrite
        refuse_existing(path, overwrite)
        self._store = writer(path.with_name(f"{path.name}.part"))
        self._sequences = dict(self._store.finished())

    def finished(self, path: str) -> bool:
        """Whether an earlier run, cut off later on, has written this sequence whole."""
        return path in self._sequences

    def sequence(self, path: str) -> ArrayWriter:
        """Start a sequence; what a run that was cut off left of it is removed."""
        group = path.replace("\\", "/").strip("/") or "sequence"
        self._sequences.pop(path, None)
        self._store.remove(group)
        return ArrayWriter(self._store, path, group, self.options, self._sequences)

    def close(self) -> None:
        """Finish the store and put it in its place."""
        root = {"type": STORE, "version": VERSION, "complete": True, "sequences": self._sequences}
        root |= {"lossy_mm": self.options.lossy_mm} if self.options.lossy_mm else {}
        put_in_place(self._store.close(root), self.path, self.overwrite)


class ArrayWriter(PackedWriter):
    """Writes one sequence of a packed store, each field's frames in rising order."""

    def __init__(
        self, store: ArrayStoreWriter, path: str, group: str, options: Options, finished: dict[str, str]
    ) -> None:
        self.location = f"{store.location}/{group}"
        self._store = store
        self._path = path
        self._group = group
        self._options = options
        self._finished = finished
        self._fields: dict[str, _FieldWriter] = {}
        self._documents: dict[str, bytes] = {}
        self.identity = identity_of(path)

    def has(self, field: str, frame: int) -> bool:
        """Whether this run has written it."""
        return field in self._fields and frame in self._fields[field].frames

    def write(self, field: str, frame: int, array: NDArray[Any]) -> None:
        """Append one frame to a field's columns.

        Raises:
            FormatError: it does not fit the field, or an earlier frame.
        """
        if field not in self._fields:
            packing = packing_of(layout.field_named(field), self._options)
            self._fields[field] = _FieldWriter(self._store, f"{self._group}/{field_node(field)}", packing)
        try:
            self._fields[field].append(frame, array)
        except FormatError as error:
            raise FormatError(f"{self.location}: field {field}, frame {frame}: {error}") from error

    def write_document(self, name: str, data: bytes) -> None:
        """Keep a text file's bytes."""
        self._documents[name] = data

    def read_document(self, name: str) -> bytes | None:
        """Return a text file's bytes, None if it is not there."""
        return self._documents.get(name)

    def close(self) -> None:
        """Write what is held back and mark the sequence as whole."""
        for writer in self._fields.values():
            writer.close()
        for name, data in self._documents.items():
            attributes = {"type": DOCUMENT, "version": VERSION, "dtype": "uint8", "unit": "bytes", "name": name}
            self._store.write_small(f"{self._group}/{document_node(name)}", np.frombuffer(data, np.uint8), attributes)
        self._write_numbers()
        split, name, coordinates = self.identity
        attributes = {
            "type": SEQUENCE,
            "version": VERSION,
            "path": self._path,
            "split": split,
            "name": name,
            "coordinates": coordinates,
        }
        attributes |= {"fields": sorted(self._fields), "documents": sorted(self._documents), "complete": True}
        self._store.write_group(self._group, attributes)
        self._finished[self._path] = self._group

    def _write_numbers(self) -> None:
        """Write poses and times as numbers too, for programs that know arrays and not these text files."""
        for name, document, unit in (("poses", layout.POSES, "m"), ("times", layout.TIMES, "s")):
            if document not in self._documents:
                continue
            with suppress(FormatError):  # not numbers: the text is kept as it is, and reading it says what is wrong
                decode = layout.decode_poses if name == "poses" else layout.decode_times
                numbers = decode(self._documents[document], document)
                attributes = {
                    "type": "carlasc.numbers",
                    "version": VERSION,
                    "dtype": "float64",
                    "unit": unit,
                    "document": document,
                }
                self._store.write_small(f"{self._group}/{name}", numbers, attributes)


class _FieldWriter:
    """The columns of a field, growing frame by frame."""

    def __init__(self, store: ArrayStoreWriter, node: str, packing: Packing) -> None:
        self.store = store
        self.node = node
        self.packing = packing
        self.frames: dict[int, None] = {}
        self.columns = {
            c.name: _ColumnWriter(store, f"{node}/{c.name}", c, packing.kind == "grid") for c in packing.columns
        }

    def append(self, frame: int, array: NDArray[Any]) -> None:
        if self.frames and frame <= next(reversed(self.frames)):
            raise FormatError(f"expected frames in rising order, found {frame} after {next(reversed(self.frames))}")
        self.packing.entry.check(array, "its array")
        parts = self.packing.split(array)
        for name, column in self.columns.items():
            column.append(parts.get(name))
        self.frames[frame] = None

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
        self.place = node  # where the array stands until it is closed
        self.column = column
        self.is_grid = is_grid
        self.dtype = np.dtype(column.dtype)
        self.step = column.step or 0  # elements a chunk; 0: not known before the first frame that has any
        self.chunks = 0
        self.spans: list[tuple[int, int]] = []
        self._writer: ChunkWriter | None = None
        self._shape: tuple[int, ...] | None = None  # of a grid

    def append(self, values: NDArray[Any] | None) -> None:
        """Add a frame's values; None where it has none of this column."""
        if values is None or (values.size == 0 and not self.is_grid):
            self.spans.append((0, 0))
            return
        self._fit_type(values.dtype)
        if self.is_grid:
            if self._shape not in (None, values.shape):
                raise FormatError(f"expected a grid of {self._shape}, as in the frames before, found {values.shape}")
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
        """Widen the array where a frame holds what its type does not: written again, chunk by chunk."""
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
    """Round a chunk's elements up to a multiple of 256, whole pages of memory in every type."""
    return -(-count // 256) * 256


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Refuse to write over something that is there, and over anything but a packed store even with `overwrite`."""
    if not path.name:
        raise ArgumentError(path, expected="the name of a store", found="none")
    if not path.exists():
        return
    kind = "folder" if path.is_dir() else "file"
    if not overwrite:
        raise ConflictError(
            path, expected="nothing there", found=f"a {kind}", advice="choose another place, or --overwrite"
        )
    if path.is_dir():
        is_store = any((path / mark).is_file() for mark in ("zarr.json", TABLES_MARK))
    else:
        with path.open("rb") as file:
            is_store = file.read(len(HDF5_SIGNATURE)) == HDF5_SIGNATURE
    if not is_store:
        raise ConflictError(
            path, expected="a packed store to overwrite", found=f"another {kind}", advice="choose another place"
        )


def put_in_place(finished: Path, path: Path, overwrite: bool) -> None:
    """Rename a finished store to its place; an older one makes way only then."""
    try:
        if path.exists():
            refuse_existing(path, overwrite)
            old = path.with_name(f"{path.name}.old")
            remove(old)
            path.rename(old)
            finished.rename(path)
            remove(old)
        else:
            finished.rename(path)
    except OSError as error:
        raise CarlascError(f"{path}: cannot be put in place: {error.strerror or error}") from error


def remove(path: Path) -> None:
    """Remove a file or a folder, if there is one."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
