"""Reading packed stores in HDF5: groups and chunked data sets, compressed by the Blosc filter.

Any HDF5 reader with hdf5plugin can open them. This module looks up the offsets of chunks with h5py
once per data set, and reads and decodes the chunks directly.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyArray, Uint32Array
from carlasc.errors import FormatError, import_extra, reading
from carlasc.storage.arrays import check_ratio
from carlasc.storage.files import damaged, parse_json_value
from carlasc.storage.packed.array_source import ArraySource, ArrayStore
from carlasc.storage.packed.chunks import Encoding, StoredArray, crc32c
from carlasc.storage.transport.remote_tree import RemoteTree
from carlasc.storage.transport.trees import Tree

_BLOSC = 32001  # registered number of the filter
# filters of HDF5 itself
_GZIP = 1
_SHUFFLE = 2
_FLETCHER32 = 3
_SMALL_FILTERS = {_GZIP, _SHUFFLE, _FLETCHER32}
_UNTRUSTED = "carlasc did not write this: do not use this store"
CRC = "_crc32c"  # suffix of the data set with the checksums of the chunks


class HDF5Source(ArraySource):
    """A packed HDF5 file."""

    def __init__(self, tree: Tree, path: str) -> None:
        """Read the attributes of the file's root.

        Raises:
            DependencyError: h5py or the codecs are not installed.
            FormatError: it is not a packed store, is unfinished, or has another version.
        """
        for module in ("h5py", "numcodecs", "google_crc32c"):
            import_extra(module, "hdf5")
        super().__init__(HDF5Store(tree, path))


class HDF5Store(ArrayStore):
    """The nodes of an HDF5 file. The file is opened and closed in each call."""

    def __init__(self, tree: Tree, path: str) -> None:
        self.tree = tree
        self.path = path
        self.location = tree.where(path)
        self.local = not isinstance(tree, RemoteTree)

    def attributes(self, node: str) -> dict[str, Any] | None:
        """Return a node's attributes."""
        with self._open() as file:
            group = find_node(file, node, self.location)
            return None if group is None else _read_attributes(group, f"{self.location}/{node}")

    def read_small(self, node: str) -> AnyArray:
        """Return a whole data set."""
        with self._open() as file:
            return self._read_small(file, node)

    def _read_small(self, file: Any, node: str) -> AnyArray:
        dataset = self._dataset(file, node)
        check_small(dataset, f"{self.location}: {dataset.name}")
        return np.asarray(dataset[...])

    def read_document(self, node: str) -> bytes:
        """Return the bytes of a text file, which is a data set of bytes."""
        return self.read_small(node).tobytes()

    def array(self, node: str) -> StoredArray:
        """Return a data set whose chunks can be read."""
        with self._open() as file:
            return HDF5Array.from_dataset(
                self.tree, self.path, self._dataset(file, node), self._read_small(file, node + CRC)
            )

    def stored_bytes(self, node: str) -> int:
        """Return the stored bytes of the data sets below a node; for the root, the size of the
        file.
        """
        if not node:
            return Path(self.location).stat().st_size
        h5py = import_extra("h5py", "hdf5")
        total = 0

        def add(_: str, item: Any) -> None:
            nonlocal total
            total += item.id.get_storage_size() if isinstance(item, h5py.Dataset) else 0

        with self._open() as file:
            if (group := find_node(file, node, self.location)) is not None:
                group.visititems(add)
        return total

    def _dataset(self, file: Any, node: str) -> Any:
        dataset = find_node(file, node, self.location)
        if not isinstance(dataset, import_extra("h5py", "hdf5").Dataset):
            raise damaged(self.location, f"the data set {node}", "none")
        return dataset

    @contextmanager
    def _open(self) -> Iterator[Any]:
        h5py = import_extra("h5py", "hdf5")
        with reading(self.location, "an HDF5 file", "the file may be truncated or corrupted"):
            if isinstance(self.tree, RemoteTree):
                with self.tree.open(self.path) as remote, h5py.File(remote, "r") as file:
                    yield file
            else:
                with h5py.File(self.location, "r", locking=False) as file:
                    yield file


@dataclass(eq=False)
class HDF5Array(StoredArray):
    """A chunked data set with the Blosc filter.

    Attributes:
        path: the HDF5 file.
        places: the first byte and the end of each existing chunk.
        checksums: the checksum of each existing chunk.
    """

    path: str
    places: dict[int, tuple[int, int]]
    checksums: dict[int, int]

    @classmethod
    def from_dataset(cls, tree: Tree, path: str, dataset: Any, checksums: Uint32Array) -> HDF5Array:
        """Look up the offsets of the chunks of a data set.

        Args:
            tree: the tree of files that holds the HDF5 file.
            path: the file.
            dataset: the open data set.
            checksums: (n,) checksums of the existing chunks, in the order of chunk numbers.

        Raises:
            FormatError: it is not chunked, has other filters, or another number of chunks.
        """
        where = f"{tree.where(path)}: {dataset.name}"
        shape = dataset.shape
        chunk = dataset.chunks
        if (
            chunk is None
            or _filters(dataset) != [_BLOSC]
            or dataset.dtype.kind not in "uif"
            or checksums.ndim != 1
        ):
            raise damaged(
                where, "a chunked data set with the Blosc filter", "other filters or no chunks"
            )
        rooms = [-(-n // step) for n, step in zip(shape, chunk, strict=True)]
        places: dict[int, tuple[int, int]] = {}

        def note(info: Any) -> None:
            number = 0
            for first, step, room in zip(info.chunk_offset, chunk, rooms, strict=True):
                number = number * room + first // step
            places[number] = info.byte_offset, info.byte_offset + info.size

        dataset.id.chunk_iter(note)
        if len(places) != len(checksums):
            raise damaged(where, f"{len(checksums)} chunks", str(len(places)))
        sums = dict(zip(sorted(places), checksums.tolist(), strict=True))
        about = (dataset.name, dataset.dtype, shape, chunk, Encoding())
        return cls(tree, *about, path, places, sums)

    def locate(self, numbers: Sequence[int]) -> list[tuple[str, int, int]]:
        """Return the file, the first byte and the end of each chunk."""
        for number in numbers:
            if number not in self.places:
                raise damaged(self.tree.where(self.path), f"chunk {number} of {self.name}", "none")
        return [(self.path, *self.places[number]) for number in numbers]

    def files(self, numbers: Sequence[int]) -> list[str]:
        """Return the HDF5 file."""
        return [self.path]

    def verify(self, data: memoryview, number: int) -> memoryview:
        """Compare a chunk with the data set of checksums."""
        if crc32c(data) != self.checksums[number]:
            raise FormatError(
                f"chunk {number} of {self.name}",
                problem="the checksum does not match",
                advice="the store is corrupted: fetch or pack it again",
            )
        return data


def find_node(file: Any, node: str, where: str) -> Any:
    """Return a group or a data set of a file; None if it does not exist.

    Only hard links inside the file are followed.

    In HDF5, a link or a data set can refer to another file. An untrusted store must not give access
    to other files of this machine.

    Raises:
        FormatError: a link on the path refers to another file, or is symbolic.
    """
    h5py = import_extra("h5py", "hdf5")
    place = file
    for name in filter(None, node.split("/")):
        link = place.get(name, getlink=True) if isinstance(place, h5py.Group) else None
        if link is None:
            return None
        if not isinstance(link, h5py.HardLink):
            kind = (
                "a link to another file"
                if isinstance(link, h5py.ExternalLink)
                else "a symbolic link"
            )
            raise damaged(f"{where}: {node}", "data in the file itself", kind, _UNTRUSTED)
        place = place[name]
    if isinstance(place, h5py.Dataset) and (place.is_virtual or place.external):
        raise damaged(
            f"{where}: {node}", "values in the file itself", "values in other files", _UNTRUSTED
        )
    return place


def check_small(dataset: Any, what: str) -> None:
    """Check that a data set that is read whole has a plausible size in memory, compared with its
    stored size.

    Raises:
        FormatError: it is too large, or has values or filters that carlasc does not write.
    """
    size = dataset.size * dataset.dtype.itemsize
    stored = dataset.id.get_storage_size()
    filters = _filters(dataset)
    if dataset.dtype.kind not in "uif" or not set(filters) <= _SMALL_FILTERS:
        raise damaged(what, "numbers without filters or with gzip", "other data", _UNTRUSTED)
    check_ratio(size, stored, what)
    if dataset.chunks is None or not size:
        if size > stored:  # HDF5 would fill the rest with zeros
            raise damaged(what, f"{size} bytes", f"{stored}")
        return
    if dataset.chunks != dataset.shape or dataset.id.get_num_chunks() != 1:
        raise damaged(what, "one chunk", "several chunks")
    if _GZIP in filters:  # HDF5 decompresses a whole chunk without a limit
        packed = dataset.id.read_direct_chunk((0,) * len(dataset.shape))[1]
        unpacked = zlib.decompressobj().decompress(packed, size + 1)
        if len(unpacked) != size:
            raise damaged(what, f"{size} bytes", "another size", _UNTRUSTED)


def _filters(dataset: Any) -> list[int]:
    plist = dataset.id.get_create_plist()
    return [plist.get_filter(number)[0] for number in range(plist.get_nfilters())]


def _read_attributes(node: Any, where: str) -> dict[str, Any]:
    attributes = {}
    for name, stored in node.attrs.items():
        value = stored.item() if hasattr(stored, "item") else stored
        value = value.decode() if isinstance(value, bytes) else value
        if name.endswith(":json"):
            attributes[name.removesuffix(":json")] = parse_json_value(value, f"{where}: {name}")
        else:
            attributes[name] = value
    return attributes
