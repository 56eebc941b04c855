"""Packed stores in HDF5: groups and chunked data sets, compressed by the Blosc filter.

Any HDF5 reader with hdf5plugin opens them. Here, h5py looks up the places of the chunks in the file, once per data set; the chunks
themselves are read and decoded directly.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import ArgumentError, CarlascError, FormatError, import_extra
from carlasc.storage.folders.trees import LocalTree, RemoteTree, Tree
from carlasc.storage.packed.arrays.chunks import Encoding, StoredArray, crc32c, parallel
from carlasc.storage.packed.arrays.reading import ArraySource, ArrayStore
from carlasc.storage.packed.arrays.writing import ArraySink, ArrayStoreWriter, ChunkWriter
from carlasc.storage.packed.output import remove
from carlasc.storage.packed.protocol import VERSION, Options

_BLOSC = 32001  # the filter's registered number
_AHEAD = 16  # chunks that are encoded in parallel
_CRC = "_crc32c"  # suffix of the data set with the checksums of another one's chunks


class HDF5Source(ArraySource):
    """A packed HDF5 file."""

    def __init__(self, tree: Tree, path: str) -> None:
        """Read the attributes of the file's root.

        Raises:
            DependencyError: h5py or the codecs are not installed.
            FormatError: it is another HDF5 file, unfinished, or of a newer version.
        """
        for module in ("h5py", "numcodecs", "google_crc32c"):
            import_extra(module, "hdf5")
        super().__init__(HDF5Store(tree, path))


class HDF5Sink(ArraySink):
    """Writes a packed HDF5 file."""

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
        super().__init__(Path(path), HDF5StoreWriter, options, overwrite)


class HDF5Store(ArrayStore):
    """The nodes of an HDF5 file, which is opened for each call and closed again."""

    def __init__(self, tree: Tree, path: str) -> None:
        self.tree = tree
        self.path = path
        self.location = tree.where(path)
        self.local = not isinstance(tree, RemoteTree)

    def attributes(self, node: str) -> dict[str, Any] | None:
        """Return a node's attributes."""
        with self._open() as file:
            return _read_attributes(file[node or "/"]) if not node or node in file else None

    def read_small(self, node: str) -> NDArray[Any]:
        """Return a whole data set."""
        with self._open() as file:
            return np.asarray(self._dataset(file, node)[...])

    def array(self, node: str) -> StoredArray:
        """Return a data set whose chunks can be read."""
        with self._open() as file:
            return HDF5Array.from_dataset(
                self.tree, self.path, self._dataset(file, node), self._dataset(file, node + _CRC)[...]
            )

    def stored_bytes(self, node: str) -> int:
        """Return the bytes of the data sets below a node; for the root, those of the file."""
        if not node:
            return Path(self.location).stat().st_size
        h5py = import_extra("h5py", "hdf5")
        total = 0

        def add(_: str, item: Any) -> None:
            nonlocal total
            total += item.id.get_storage_size() if isinstance(item, h5py.Dataset) else 0

        with self._open() as file:
            if node in file:
                file[node].visititems(add)
        return total

    def _dataset(self, file: Any, node: str) -> Any:
        if node not in file:
            raise FormatError(
                self.location, expected=f"the data set {node}", found="none", advice="the store is damaged"
            )
        return file[node]

    @contextmanager
    def _open(self) -> Iterator[Any]:
        h5py = import_extra("h5py", "hdf5")
        try:
            if isinstance(self.tree, RemoteTree):
                with self.tree.open(self.path) as remote, h5py.File(remote, "r") as file:
                    yield file
            else:
                with h5py.File(self.location, "r", locking=False) as file:
                    yield file
        except CarlascError:
            raise
        except (OSError, RuntimeError, KeyError, ValueError) as error:
            raise FormatError(
                self.location, problem=f"cannot be read as HDF5: {error}", advice="is it truncated or corrupted?"
            ) from error


class HDF5Array(StoredArray):
    """A chunked data set with the Blosc filter, and the place and the checksum of each chunk."""

    extra = "hdf5"
    _places: NDArray[np.int64]
    _checksums: NDArray[np.uint32]

    @classmethod
    def from_dataset(cls, tree: Tree, path: str, dataset: Any, checksums: NDArray[np.uint32]) -> HDF5Array:
        """Look up the places of a data set's chunks.

        Raises:
            FormatError: it is not chunked, has other filters, or lacks chunks.
        """
        shape, chunk = dataset.shape, dataset.chunks
        plist = dataset.id.get_create_plist()
        if chunk is None or plist.get_nfilters() != 1 or plist.get_filter(0)[0] != _BLOSC:
            raise FormatError(
                f"{tree.where(path)}: {dataset.name}",
                expected="a chunked data set with the Blosc filter",
                found="another",
                advice="the store is damaged",
            )
        axis = next((axis for axis in range(len(shape)) if dataset.maxshape[axis] is None), len(shape) - 1)
        places = np.full((len(checksums), 2), -1, np.int64)

        def note(info: Any) -> None:
            number = info.chunk_offset[axis] // chunk[axis]
            if number < len(places):
                places[number] = info.byte_offset, info.byte_offset + info.size

        dataset.id.chunk_iter(note)
        if shape[axis] != len(checksums) * chunk[axis] or (places < 0).any():
            raise FormatError(
                f"{tree.where(path)}: {dataset.name}",
                expected=f"{len(checksums)} chunks",
                found="others",
                advice="the store is damaged",
            )
        array = cls(tree, dataset.name, dataset.dtype, shape, chunk, axis, Encoding(), _read_attributes(dataset))
        array._path, array._places, array._checksums = path, places, checksums
        return array

    _path: str

    def locate(self, numbers: Sequence[int]) -> list[tuple[str, int, int]]:
        """Return the places of chunks."""
        return [(self._path, *self._places[number].tolist()) for number in numbers]

    def verify(self, data: memoryview, number: int) -> memoryview:
        """Compare a chunk with the data set of checksums."""
        if crc32c(data, "hdf5") != self._checksums[number]:
            raise FormatError(
                f"chunk {number} of {self.name}",
                problem="the checksum does not match",
                advice="the store is corrupted: fetch or pack it again",
            )
        return data


class HDF5StoreWriter(ArrayStoreWriter):
    """Writes an HDF5 file with h5py; chunks are encoded here, in parallel, as the Blosc filter would encode them."""

    def __init__(self, path: Path) -> None:
        h5py = import_extra("h5py", "hdf5")
        self._filters = import_extra("hdf5plugin", "hdf5")
        for module in ("numcodecs", "google_crc32c"):
            import_extra(module, "hdf5")
        self.location = str(path)
        self._path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        remove(path)
        self._file = h5py.File(path, "w", libver=("v110", "v110"), track_order=False)

    def write_group(self, node: str, attributes: dict[str, Any]) -> None:
        """Create a group."""
        _write_attributes(self._file.require_group(node), attributes)

    def write_small(self, node: str, array: NDArray[Any], attributes: dict[str, Any]) -> None:
        """Write a data set of one chunk."""
        self.remove(node)
        compact = (
            {"chunks": array.shape, "shuffle": True, "compression": "gzip", "fletcher32": True} if array.size else {}
        )
        dataset = self._file.create_dataset(node, data=array, **compact)
        _write_attributes(dataset, attributes)

    def create(
        self,
        node: str,
        dtype: np.dtype[Any],
        chunk: tuple[int, ...],
        axis: int,
        encoding: Encoding,
        attributes: dict[str, Any],
    ) -> ChunkWriter:
        """Create a data set that grows along an axis."""
        empty = tuple(0 if a == axis else n for a, n in enumerate(chunk))
        most = tuple(None if a == axis else n for a, n in enumerate(chunk))
        blosc = self._filters.Blosc(cname="zstd", clevel=encoding.level, shuffle=encoding.shuffle)
        dataset = self._file.create_dataset(node, empty, dtype, chunks=chunk, maxshape=most, **blosc)
        _write_attributes(dataset, attributes)
        return _HDF5ChunkWriter(self, node, dataset, axis, encoding)

    def array(self, node: str) -> StoredArray:
        """Return a closed data set."""
        self._file.flush()
        return HDF5Array.from_dataset(
            LocalTree(self._path.parent), self._path.name, self._file[node], self._file[node + _CRC][...]
        )

    def move(self, node: str, target: str) -> None:
        """Rename a data set and its checksums."""
        self.remove(target)
        for ending in ("", _CRC):
            self._file.move(node + ending, target + ending)

    def remove(self, node: str) -> None:
        """Remove a node; the file uses its space again."""
        for name in (node, node + _CRC):
            if name in self._file:
                del self._file[name]

    def finished(self) -> dict[str, str]:
        """Return nothing: what an interrupted run left is not continued."""
        return {}

    def close(self, attributes: dict[str, Any]) -> Path:
        """Write the root's attributes and close the file."""
        _write_attributes(self._file, attributes)
        self._file.close()
        return self._path


class _HDF5ChunkWriter(ChunkWriter):
    def __init__(self, store: HDF5StoreWriter, node: str, dataset: Any, axis: int, encoding: Encoding) -> None:
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
        self.store.write_small(self.node + _CRC, np.array(self.checksums, np.uint32), attributes)

    def _flush(self) -> None:
        encoded = parallel(lambda chunk: self.encoding.encode(chunk, "hdf5"), self.held)
        step, shape = self.dataset.chunks[self.axis], list(self.dataset.shape)
        for data in encoded:
            start = len(self.checksums) * step
            shape[self.axis] = start + step
            self.dataset.resize(shape)
            self.dataset.id.write_direct_chunk(tuple(start if a == self.axis else 0 for a in range(len(shape))), data)
            self.checksums.append(crc32c(data, "hdf5"))
        self.held = []


def _write_attributes(node: Any, attributes: dict[str, Any]) -> None:
    """Replace a node's attributes: text and numbers are written as they are, other values as JSON under `<name>:json`."""
    for name in list(node.attrs):
        del node.attrs[name]
    for name, value in attributes.items():
        if isinstance(value, str | int | float):
            node.attrs[name] = value
        else:
            node.attrs[f"{name}:json"] = json.dumps(value)


def _read_attributes(node: Any) -> dict[str, Any]:
    found = {}
    for name, value in node.attrs.items():
        if name.endswith(":json"):
            found[name.removesuffix(":json")] = json.loads(value)
        else:
            found[name] = value.item() if hasattr(value, "item") else value
    return found
