"""Writing packed stores in HDF5 by appending: one writer, frames in ascending order."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyArray
from carlasc.errors import import_extra
from carlasc.storage.files import AnyPath, sync_tree
from carlasc.storage.hdf5.hdf5_source import CRC
from carlasc.storage.packed.array_layout import (
    DOCUMENT,
    SEQUENCE,
    FieldLayout,
    document_node,
    field_node,
    index_arrays,
    typical_size,
)
from carlasc.storage.packed.chunks import crc32c, in_threads
from carlasc.storage.packed.columns import Column
from carlasc.storage.packed.output import DeferredErrorFile, put_in_place
from carlasc.storage.packed.stores import (
    VERSION,
    FieldWriter,
    PackedSink,
    PackedWriter,
    PackOptions,
    node_of,
)

_AHEAD = 16  # chunks that are encoded in parallel


class HDF5Sink(PackedSink):
    """Writes a packed HDF5 file."""

    def __init__(
        self,
        path: AnyPath,
        options: PackOptions | None = None,
        overwrite: bool = False,
    ) -> None:
        """Start a file. The file of an interrupted run is removed, and is not continued.

        Raises:
            ArgumentError: `small` is given.
            ConflictError: something exists at `path`, and `overwrite` is not given.
            DependencyError: h5py, hdf5plugin, numcodecs or google-crc32c is not installed.
        """
        super().__init__(path, options, overwrite)
        self._file = HDF5Output(self.part, self.path)

    def sequence(self, path: str) -> HDF5Writer:
        """Start a sequence."""
        node = node_of(path, self.location)
        self.nodes.pop(path, None)
        self._file.remove(node)
        return HDF5Writer(self, self._file, path, node)

    def finish(self, *, incomplete: bool = False) -> None:
        """Finish the store and give it its name."""
        lossy = {"lossy_mm": self.options.lossy_mm} if self.options.lossy_mm else {}
        self._file.close(self.root() | lossy)
        sync_tree(self.part)
        put_in_place(self.part, self.path, self.overwrite)


class HDF5Writer(PackedWriter["HDF5FieldWriter"]):
    """Writes one sequence of a packed HDF5 file.

    Attributes:
        rows: number of elements of a typical frame, by field.
    """

    def __init__(self, sink: HDF5Sink, output: HDF5Output, path: str, node: str) -> None:
        super().__init__(sink, path, node)
        self.rows: dict[str, int] = {}
        self._output = output

    def expect(
        self, frames: Mapping[str, Iterable[int]], rows: Mapping[str, int] | None = None
    ) -> None:
        """Record the size of a typical frame, which determines the size of chunks."""
        self.rows.update(rows or {})

    def _start_field(self, field: str) -> HDF5FieldWriter:
        return HDF5FieldWriter(self, self._output, field)

    def _finish(self) -> None:
        for name, data in self.contents.items():
            attributes = {
                "type": DOCUMENT,
                "version": VERSION,
                "dtype": "uint8",
                "unit": "bytes",
                "name": name,
            }
            self._output.write_small(
                f"{self.node}/{document_node(name)}", np.frombuffer(data, np.uint8), attributes
            )
        layouts = {name: field.layout for name, field in self.writers.items()}
        tables = {name: field.frames for name, field in self.writers.items()}
        for name, values, attributes in index_arrays(layouts, tables, self.read_document):
            self._output.write_small(f"{self.node}/{name}", values, attributes)
        self._output.write_group(self.node, {"type": SEQUENCE, "version": VERSION, **self.about()})


class HDF5FieldWriter(FieldWriter):
    """Writes the columns of a field.

    Attributes:
        layout: layout of the field, determined by the first frame that is not empty.
    """

    layout: FieldLayout

    def __init__(self, writer: HDF5Writer, output: HDF5Output, field: str) -> None:
        super().__init__(field)
        self._writer = writer
        self._output = output
        self._node = f"{writer.node}/{field_node(field)}"
        self._planned = False
        self._columns: dict[str, HDF5ColumnWriter] = {}

    def write(self, frame: int, array: AnyArray) -> dict[str, int]:
        """Divide one frame into chunks. Chunks of several frames are written together."""
        if not self._planned and array.size:
            self._plan([array])
        counts, parts = self.layout.divide(array, limited=False) if self._planned else ({}, {})
        for name, chunks in parts.items():
            if name not in self._columns:
                self._columns[name] = HDF5ColumnWriter(
                    self._output, f"{self._node}/{name}", self.layout, name
                )
            self._columns[name].append(frame, chunks)
        return counts

    def close(self) -> None:
        """Write buffered frames, and the group of the field."""
        if not self._planned:
            self._plan([])
        for column in self._columns.values():
            column.close(max(self.frames) + 1)
        self._output.write_group(self._node, dict(self.layout.attributes))

    def _plan(self, arrays: list[AnyArray]) -> None:
        writer = self._writer
        typical = typical_size(self.entry, arrays, writer.rows, writer.cells_of)
        self.layout = FieldLayout.plan(self.entry.name, writer.options, typical)
        self._planned = True


class HDF5ColumnWriter:
    """Writes the chunks of a column. Several chunks are encoded in parallel."""

    def __init__(self, output: HDF5Output, node: str, field_layout: FieldLayout, name: str) -> None:
        column = field_layout.columns[name]
        self._output = output
        self._node = node
        self._encoding = column.encoding
        self._held: list[tuple[int, int, AnyArray]] = []  # frame, number in the frame, chunk
        self._checksums: list[int] = []
        self._dataset = output.create(node, field_layout, column)

    def append(self, frame: int, chunks: list[AnyArray]) -> None:
        """Add a frame's chunks."""
        self._held += [(frame, number, chunk) for number, chunk in enumerate(chunks)]
        if len(self._held) >= _AHEAD:
            self._flush()

    def close(self, frames: int) -> None:
        """Write buffered chunks and the checksums of all chunks, and set the length of the data set
        to `frames`.
        """
        self._flush()
        self._dataset.resize(frames, axis=0)
        about = {"type": "carlasc.checksums", "version": VERSION, "dtype": "uint32"}
        about["unit"] = "crc32c of a chunk's stored bytes"
        self._output.write_small(self._node + CRC, np.array(self._checksums, np.uint32), about)

    def _flush(self) -> None:
        if not self._held:
            return
        encoded = in_threads(lambda one: self._encoding.encode(one[2]), self._held)
        step = self._dataset.chunks[-1]
        shape = self._dataset.shape
        needed = (max(number for _, number, _ in self._held) + 1) * step
        self._dataset.resize((self._held[-1][0] + 1, *shape[1:-1], max(shape[-1], needed)))
        for (frame, number, _), data in zip(self._held, encoded, strict=True):
            offset = (frame, *[0] * (len(shape) - 2), number * step)
            self._dataset.id.write_direct_chunk(offset, data)
            self._checksums.append(crc32c(data))
        self._held = []
        self._output.check()


class HDF5Output:
    """Writes an HDF5 file with h5py.

    Chunks are encoded here in parallel, in the same way as by the Blosc filter.
    """

    def __init__(self, path: Path, place: Path) -> None:
        h5py = import_extra("h5py", "hdf5")
        self._filters = import_extra("hdf5plugin", "hdf5")
        for module in ("numcodecs", "google_crc32c"):
            import_extra(module, "hdf5")
        self._output = DeferredErrorFile(path, place)
        self._file = h5py.File(self._output, "w", libver=("v110", "v110"), track_order=False)
        self.check()

    def check(self) -> None:
        """Raise the error of a write that failed."""
        self._output.check()

    def write_group(self, node: str, attributes: dict[str, Any]) -> None:
        """Create a group."""
        _write_attributes(self._file.require_group(node), attributes)
        self.check()

    def write_small(self, node: str, array: AnyArray, attributes: dict[str, Any]) -> None:
        """Write a data set of one chunk."""
        compact = (
            {"chunks": array.shape, "shuffle": True, "compression": "gzip", "fletcher32": True}
            if array.size
            else {}
        )
        dataset = self._file.create_dataset(node, data=array, **compact)
        _write_attributes(dataset, attributes)
        self.check()

    def create(self, node: str, field_layout: FieldLayout, column: Column) -> Any:
        """Create the data set of a column, without frames."""
        shape = field_layout.frame_shape(column)
        encoding = column.encoding
        # rarely, a frame is longer, and the axis grows
        most = shape if field_layout.is_grid else (*shape[:-1], None)
        blosc = self._filters.Blosc(cname="zstd", clevel=encoding.level, shuffle=encoding.shuffle)
        dataset = self._file.create_dataset(
            node,
            (0, *shape),
            column.dtype,
            chunks=field_layout.chunk_shape(column),
            maxshape=(None, *most),
            **blosc,
        )
        _write_attributes(dataset, field_layout.column_attributes(column))
        self.check()
        return dataset

    def remove(self, node: str) -> None:
        """Remove a node. The file reuses its space."""
        if node in self._file:
            del self._file[node]

    def close(self, attributes: dict[str, Any]) -> None:
        """Write the root's attributes and close the file."""
        _write_attributes(self._file, attributes)
        self._file.close()
        self._output.close()
        self.check()


def _write_attributes(node: Any, attributes: dict[str, Any]) -> None:
    """Write the attributes of a new node.

    Text and numbers are written unchanged, other values as JSON under `<name>:json`.

    Text has a fixed length. HDF5 stores text of variable length in global heaps, the only structure
    of a file without a checksum. If a heap is damaged by a few zeros, HDF5 2.0 hangs.
    """
    for name, value in attributes.items():
        if isinstance(value, int | float):
            node.attrs[name] = value
        elif isinstance(value, str):
            node.attrs.create(name, _fixed_text(value))
        else:
            node.attrs.create(f"{name}:json", _fixed_text(json.dumps(value)))


def _fixed_text(text: str) -> AnyArray:
    h5py = import_extra("h5py", "hdf5")
    data = text.encode()
    return np.array(data, h5py.string_dtype("utf-8", max(1, len(data))))
