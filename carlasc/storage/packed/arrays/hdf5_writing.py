"""Writing packed stores in HDF5, by appending: one writer, frames in rising order."""

from __future__ import annotations

import json
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import ArgumentError, FormatError, import_extra
from carlasc.storage import layout
from carlasc.storage.durability import sync_tree
from carlasc.storage.packed.arrays.chunks import Encoding, StoredArray, crc32c, in_threads
from carlasc.storage.packed.arrays.columns import Column, packing_of
from carlasc.storage.packed.arrays.hdf5_store import CRC, HDF5Array
from carlasc.storage.packed.arrays.reading import COLUMN, DOCUMENT, FIELD, SEQUENCE, document_node, field_node
from carlasc.storage.packed.numbers import common_type
from carlasc.storage.packed.output import PatientFile, put_in_place, refuse_existing, unfinished
from carlasc.storage.packed.protocol import STORE, VERSION, FieldWriter, Options, PackedSink, PackedWriter, node_of
from carlasc.storage.transport.trees import LocalTree

_HEADROOM = 1.125  # a chunk is this much larger than the first frame, so that later frames seldom need a second chunk
_AHEAD = 16  # chunks that are encoded in parallel


class HDF5Sink(PackedSink):
    """Writes a packed HDF5 file, which gets its name when the sink is finished, and not before."""

    def __init__(self, path: str | os.PathLike[str], options: Options | None = None, overwrite: bool = False) -> None:
        """Start a file; what an interrupted run left is removed.

        Raises:
            ArgumentError: `small` is given, for which HDF5 has no filter.
            ConflictError: something exists at `path`, and `overwrite` is not given.
            DependencyError: h5py, hdf5plugin, numcodecs or google-crc32c is not installed.
        """
        options = options or Options()
        if options.small:
            raise ArgumentError(
                "small",
                expected="a .zarr store",
                found=f"{path}: HDF5 has no PCodec filter",
                advice="leave `small` out",
            )
        self.path = Path(path)
        self.location = str(path)
        self.options = options
        self.overwrite = overwrite
        refuse_existing(self.path, overwrite)
        self._file = _File(unfinished(self.path), self.path)
        self._sequences: dict[str, str] = {}

    def finished(self, path: str) -> bool:
        """Whether this run has written the sequence whole: what an interrupted run left is not continued."""
        return path in self._sequences

    def sequence(self, path: str) -> HDF5Writer:
        """Start a sequence."""
        group = node_of(path, self.location)
        self._sequences.pop(path, None)
        self._file.remove(group)
        return HDF5Writer(self._file, path, group, self.options, self._sequences)

    def finish(self, *, incomplete: bool = False) -> None:
        """Finish the store and give it its name."""
        root = {"type": STORE, "version": VERSION, "complete": True, "sequences": self._sequences}
        root |= {"lossy_mm": self.options.lossy_mm} if self.options.lossy_mm else {}
        self._file.close(root)
        sync_tree(self._file.path)
        put_in_place(self._file.path, self.path, self.overwrite)


class HDF5Writer(PackedWriter):
    """Writes one sequence of a packed HDF5 file."""

    def __init__(self, store: _File, path: str, group: str, options: Options, finished: dict[str, str]) -> None:
        super().__init__(f"{store.location}/{group}", path)
        self._store = store
        self._group = group
        self._options = options
        self._finished = finished

    def _start_field(self, field: str) -> FieldWriter:
        return _FieldWriter(self._store, f"{self._group}/{field_node(field)}", field, self._options)

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


class _FieldWriter(FieldWriter):
    """Writes the columns of a field."""

    def __init__(self, store: _File, node: str, field: str, options: Options) -> None:
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

    def __init__(self, store: _File, node: str, column: Column, is_grid: bool) -> None:
        self.store = store
        self.node = node
        self.place = node  # the array's node until it is closed
        self.column = column
        self.is_grid = is_grid
        self.dtype = np.dtype(column.dtype)
        self.step = column.step or 0  # elements per chunk; 0 until the first frame with any elements
        self.chunks = 0
        self.spans: list[tuple[int, int]] = []
        self._writer: _ChunkWriter | None = None
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

    def _create(self, chunk: tuple[int, ...]) -> _ChunkWriter:
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


class _File:
    """Writes an HDF5 file with h5py; chunks are encoded here, in parallel, as the Blosc filter would encode them."""

    def __init__(self, path: Path, place: Path) -> None:
        h5py = import_extra("h5py", "hdf5")
        self._filters = import_extra("hdf5plugin", "hdf5")
        for module in ("numcodecs", "google_crc32c"):
            import_extra(module, "hdf5")
        self.location = str(path)
        self.path = path
        self._output = PatientFile(path, place)
        self._file = h5py.File(self._output, "w", libver=("v110", "v110"), track_order=False)
        self.check()

    def check(self) -> None:
        """Raise the error of a write that failed."""
        self._output.check()

    def write_group(self, node: str, attributes: dict[str, Any]) -> None:
        """Create a group."""
        _write_attributes(self._file.require_group(node), attributes)
        self.check()

    def write_small(self, node: str, array: NDArray[Any], attributes: dict[str, Any]) -> None:
        """Write a data set of one chunk."""
        self.remove(node)
        compact = (
            {"chunks": array.shape, "shuffle": True, "compression": "gzip", "fletcher32": True} if array.size else {}
        )
        dataset = self._file.create_dataset(node, data=array, **compact)
        _write_attributes(dataset, attributes)
        self.check()

    def create(
        self,
        node: str,
        dtype: np.dtype[Any],
        chunk: tuple[int, ...],
        axis: int,
        encoding: Encoding,
        attributes: dict[str, Any],
    ) -> _ChunkWriter:
        """Create a data set that grows along an axis."""
        empty = tuple(0 if a == axis else n for a, n in enumerate(chunk))
        most = tuple(None if a == axis else n for a, n in enumerate(chunk))
        blosc = self._filters.Blosc(cname="zstd", clevel=encoding.level, shuffle=encoding.shuffle)
        dataset = self._file.create_dataset(node, empty, dtype, chunks=chunk, maxshape=most, **blosc)
        _write_attributes(dataset, attributes)
        self.check()
        return _ChunkWriter(self, node, dataset, axis, encoding)

    def array(self, node: str) -> StoredArray:
        """Return a closed data set."""
        self._file.flush()
        self.check()
        return HDF5Array.from_dataset(
            LocalTree(self.path.parent), self.path.name, self._file[node], self._file[node + CRC][...]
        )

    def move(self, node: str, target: str) -> None:
        """Rename a data set and its checksums."""
        self.remove(target)
        for ending in ("", CRC):
            self._file.move(node + ending, target + ending)

    def remove(self, node: str) -> None:
        """Remove a node; the file uses its space again."""
        for name in (node, node + CRC):
            if name in self._file:
                del self._file[name]

    def close(self, attributes: dict[str, Any]) -> None:
        """Write the root's attributes and close the file."""
        _write_attributes(self._file, attributes)
        self._file.close()
        self._output.close()
        self.check()


class _ChunkWriter:
    """A data set that grows by chunks."""

    def __init__(self, store: _File, node: str, dataset: Any, axis: int, encoding: Encoding) -> None:
        self.store = store
        self.node = node
        self.dataset = dataset
        self.axis = axis
        self.encoding = encoding
        self.checksums: list[int] = []
        self.held: list[NDArray[Any]] = []

    def append(self, chunk: NDArray[Any]) -> None:
        self.held.append(chunk)
        if len(self.held) == _AHEAD:
            self._flush()

    def close(self) -> None:
        self._flush()
        attributes = {
            "type": "carlasc.checksums",
            "version": VERSION,
            "dtype": "uint32",
            "unit": "crc32c of a chunk's stored bytes",
        }
        self.store.write_small(self.node + CRC, np.array(self.checksums, np.uint32), attributes)

    def _flush(self) -> None:
        encoded = in_threads(lambda chunk: self.encoding.encode(chunk, "hdf5"), self.held)
        step, shape = self.dataset.chunks[self.axis], list(self.dataset.shape)
        for data in encoded:
            start = len(self.checksums) * step
            shape[self.axis] = start + step
            self.dataset.resize(shape)
            self.dataset.id.write_direct_chunk(tuple(start if a == self.axis else 0 for a in range(len(shape))), data)
            self.checksums.append(crc32c(data, "hdf5"))
        self.held = []
        self.store.check()


def _write_attributes(node: Any, attributes: dict[str, Any]) -> None:
    """Replace a node's attributes: text and numbers are written as they are, other values as JSON under `<name>:json`.

    Text has a fixed length. HDF5 would keep text of variable length in its global heaps, the only part of a file's structure that has no
    checksum: with a few zeros there, HDF5 2.0 searches for ever.
    """
    for name in list(node.attrs):
        del node.attrs[name]
    for name, value in attributes.items():
        if isinstance(value, int | float):
            node.attrs[name] = value
        elif isinstance(value, str):
            node.attrs.create(name, _fixed_text(value))
        else:
            node.attrs.create(f"{name}:json", _fixed_text(json.dumps(value)))


def _fixed_text(text: str) -> NDArray[Any]:
    h5py, data = import_extra("h5py", "hdf5"), text.encode()
    return np.array(data, h5py.string_dtype("utf-8", max(1, len(data))))
