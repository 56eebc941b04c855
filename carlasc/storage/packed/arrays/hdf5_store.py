"""Reading packed stores in HDF5: groups and chunked data sets, compressed by the Blosc filter.

Any HDF5 reader with hdf5plugin opens them. They are of version 1 of the format. Here, h5py looks up the places of the chunks in the file, once per data set; the chunks
themselves are read and decoded directly.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import CarlascError, FormatError, import_extra
from carlasc.storage.folders.trees import RemoteTree, Tree
from carlasc.storage.packed.arrays.chunks import Encoding, StoredArray, crc32c
from carlasc.storage.packed.arrays.reading import ArraySequence, ArraySource, ArrayStore
from carlasc.storage.packed.arrays.version1 import OffsetsSequence

_BLOSC = 32001  # the filter's registered number
CRC = "_crc32c"  # suffix of the data set with the checksums of another one's chunks


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

    def _sequence(self, path: str, group: str) -> ArraySequence:
        return OffsetsSequence(self.store, path, group)


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
                self.tree, self.path, self._dataset(file, node), self._dataset(file, node + CRC)[...]
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

    def files(self, numbers: Sequence[int]) -> list[str]:
        """Return the one file."""
        return [self._path]

    def verify(self, data: memoryview, number: int) -> memoryview:
        """Compare a chunk with the data set of checksums."""
        if crc32c(data, "hdf5") != self._checksums[number]:
            raise FormatError(
                f"chunk {number} of {self.name}",
                problem="the checksum does not match",
                advice="the store is corrupted: fetch or pack it again",
            )
        return data


def _read_attributes(node: Any) -> dict[str, Any]:
    found = {}
    for name, value in node.attrs.items():
        if name.endswith(":json"):
            found[name.removesuffix(":json")] = json.loads(value)
        else:
            found[name] = value.item() if hasattr(value, "item") else value
    return found
