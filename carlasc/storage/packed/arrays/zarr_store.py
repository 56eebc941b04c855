"""Packed stores in zarr v3: sharded arrays, consolidated metadata, codecs of the core specification.

zarr-python writes them, and any zarr v3 library reads them. Here, the shards' indices and chunks are read directly (zarr specification
v3, "sharding_indexed" and "crc32c"), which takes a tenth of zarr-python's time per chunk.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import FormatError, MissingDataError, import_extra
from carlasc.storage.files import parse_json
from carlasc.storage.folders.trees import LocalTree, RemoteTree, Tree
from carlasc.storage.packed.arrays.chunks import BITSHUFFLE, BLOCK, NO_SHUFFLE, SHUFFLE, Encoding, StoredArray, crc32c
from carlasc.storage.packed.arrays.reading import SEQUENCE, ArraySource, ArrayStore
from carlasc.storage.packed.arrays.writing import ArraySink, ArrayStoreWriter, ChunkWriter
from carlasc.storage.packed.output import remove
from carlasc.storage.packed.protocol import Options

METADATA = "zarr.json"
_SHARD = 32 << 20  # bytes of a shard before compression: they are kept in memory until it is full
_MOST_CHUNKS = 256  # per shard, because the shard's index is read as a whole
_CHECKSUM = 4  # bytes
_RESIDUE = 0x48674BC7  # crc32c of any bytes followed by their own crc32c
_SHUFFLES = {"noshuffle": NO_SHUFFLE, "shuffle": SHUFFLE, "bitshuffle": BITSHUFFLE}


class ZarrSource(ArraySource):
    """A packed zarr store: a folder, a URL, or a zip of either."""

    def __init__(self, tree: Tree) -> None:
        """Read the store's metadata.

        Raises:
            DependencyError: zarr's codecs are not installed.
            FormatError: it is another zarr store, unfinished, or of a newer version.
        """
        for module in ("numcodecs", "google_crc32c"):
            import_extra(module, "zarr")
        super().__init__(ZarrStore(tree))


class ZarrSink(ArraySink):
    """Writes a packed zarr store."""

    def __init__(self, path: str | os.PathLike[str], options: Options | None = None, overwrite: bool = False) -> None:
        """Start a store, or continue one whose packing was interrupted: its finished sequences are kept.

        Raises:
            ConflictError: something exists at `path`, and `overwrite` is not given.
            DependencyError: zarr is not installed.
        """
        options = options or Options()
        super().__init__(Path(path), lambda part: ZarrStoreWriter(part, options), options, overwrite)


class ZarrStore(ArrayStore):
    """The nodes of a zarr store."""

    def __init__(self, tree: Tree) -> None:
        self.tree = tree
        self.location = tree.location
        self.local = not isinstance(tree, RemoteTree)

    @cached_property
    def _root(self) -> dict[str, Any]:
        return parse_json(bytes(self.tree.read(METADATA)), self.tree.where(METADATA))

    def attributes(self, node: str) -> dict[str, Any] | None:
        """Return a node's attributes."""
        metadata = self._metadata(node)
        return None if metadata is None else metadata.get("attributes", {})

    def read_small(self, node: str) -> NDArray[Any]:
        """Return an array of one chunk."""
        array = self.array(node)
        if 0 in array.shape:
            return np.empty(array.shape, array.dtype)
        try:
            return array.read_chunk(0)[tuple(slice(n) for n in array.shape)]
        except FormatError as error:
            raise error.within(f"{self.location}/{node}") from error

    def array(self, node: str) -> ZarrArray:
        """Return an array whose chunks can be read."""
        metadata = self._metadata(node)
        if metadata is None or metadata.get("node_type") != "array":
            raise FormatError(
                f"{self.location}/{node}",
                expected="an array",
                found="none" if metadata is None else "a group",
                advice="the store is damaged",
            )
        return ZarrArray.from_metadata(self.tree, node, metadata)

    def stored_bytes(self, node: str) -> int:
        """Return the bytes of the files below a node; for a local folder only."""
        files = os.walk(f"{self.location}/{node}")
        return sum((Path(folder) / name).stat().st_size for folder, _, names in files for name in names)

    def _metadata(self, node: str) -> dict[str, Any] | None:
        if not node:
            return self._root
        consolidated = self._root.get("consolidated_metadata")
        if consolidated:
            return consolidated["metadata"].get(node)
        path = f"{node}/{METADATA}"
        return parse_json(bytes(self.tree.read(path)), self.tree.where(path)) if self.tree.is_file(path) else None

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "_root"}


class ZarrArray(StoredArray):
    """A zarr array whose codecs are bytes or PCodec, Blosc, and crc32c, sharded or not."""

    per_shard: int | None = None

    @classmethod
    def from_metadata(cls, tree: Tree, node: str, metadata: dict[str, Any]) -> ZarrArray:
        """Read the metadata of an array.

        Raises:
            FormatError: its codecs or its chunks are not those that carlasc writes.
        """
        where = tree.where(node)
        try:
            shape, dtype = tuple(metadata["shape"]), np.dtype(metadata["data_type"]).newbyteorder("<")
            outer = tuple(metadata["chunk_grid"]["configuration"]["chunk_shape"])
            codecs, chunk = metadata["codecs"], outer
            if sharded := codecs[0]["name"] == "sharding_indexed":
                chunk, codecs = tuple(codecs[0]["configuration"]["chunk_shape"]), codecs[0]["configuration"]["codecs"]
            encoding = _encoding_of(codecs)
            axis = next(
                (axis for axis in range(len(shape)) if chunk[axis] < outer[axis] or outer[axis] < shape[axis]),
                len(shape) - 1,
            )
            array = cls(tree, node, dtype, shape, chunk, axis, encoding, metadata.get("attributes", {}))
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise FormatError(
                where, expected="the codecs and chunks that carlasc writes", found=f"others ({error})"
            ) from error
        array.per_shard = outer[axis] // chunk[axis] if sharded else None
        array._indices = {}
        return array

    _indices: dict[int, NDArray[np.uint64]]

    def locate(self, numbers: Sequence[int]) -> list[tuple[str, int, int]]:
        """Look up chunks in the indices of their shards, which are read once."""
        if self.per_shard is None:
            return [(self._file(number), 0, -1) for number in numbers]
        places = []
        for number in numbers:
            shard, slot = divmod(number, self.per_shard)
            offset, length = self._index(shard)[slot].tolist()
            if offset == 2**64 - 1:
                raise FormatError(
                    self.tree.where(self._file(shard)),
                    expected=f"chunk {number}",
                    found="none",
                    advice="the store is damaged",
                )
            places.append((self._file(shard), offset, offset + length))
        return places

    def fetch(self, numbers: Sequence[int]) -> list[memoryview]:
        """Read chunks as they are stored."""
        try:
            if self.per_shard is None:
                return [memoryview(data) for data in self.tree.read_many([self._file(number) for number in numbers])]
            return super().fetch(numbers)
        except MissingDataError as error:
            raise FormatError(
                error.where, expected=error.expected, found=error.found, advice="the store is damaged"
            ) from error

    def verify(self, data: memoryview, number: int) -> memoryview:
        """Verify the crc32c at the end of a chunk."""
        return _verified(data, f"chunk {number} of {self.name}")

    def _file(self, number: int) -> str:
        key = ["0"] * len(self.shape)
        key[self.axis] = str(number)
        return f"{self.name}/c/{'/'.join(key)}"

    def _index(self, shard: int) -> NDArray[np.uint64]:
        if shard not in self._indices:
            size = 16 * (self.per_shard or 1) + _CHECKSUM
            data = memoryview(self.tree.read_range(self._file(shard), -size, 0))
            self._indices[shard] = np.frombuffer(_verified(data, f"the index of {self._file(shard)}"), "<u8").reshape(
                -1, 2
            )
        return self._indices[shard]


class ZarrStoreWriter(ArrayStoreWriter):
    """Writes a zarr store with zarr-python."""

    def __init__(self, path: Path, options: Options) -> None:
        self._zarr = import_extra("zarr", "zarr")
        self.location = str(path)
        self._path = path
        self._tree = LocalTree(path)
        run = {"type": "carlasc.unfinished", "small": options.small, "lossy_mm": options.lossy_mm}
        if not self._belongs_to(run):
            remove(path)
            path.parent.mkdir(parents=True, exist_ok=True)
            self._zarr.create_group(path, attributes=run)
        self._root = self._zarr.open_group(path, mode="r+", use_consolidated=False)

    def _belongs_to(self, run: dict[str, Any]) -> bool:
        """Whether what an interrupted run left was packed with the same options."""
        try:
            return ZarrStore(self._tree).attributes("") == run
        except (FormatError, MissingDataError):
            return False

    def write_group(self, node: str, attributes: dict[str, Any]) -> None:
        """Create a group."""
        group = self._root.require_group(node)
        group.attrs.put(attributes)

    def write_small(self, node: str, array: NDArray[Any], attributes: dict[str, Any]) -> None:
        """Write an array of one chunk."""
        chunk = tuple(max(1, n) for n in array.shape)
        with _quietly():
            stored = self._root.create_array(
                node, shape=array.shape, dtype=array.dtype, chunks=chunk, filters=None, attributes=attributes, overwrite=True,
                config={"write_empty_chunks": True}, **_codecs(Encoding(shuffle=SHUFFLE), array.dtype),
            )  # fmt: skip
        if array.size:
            stored[...] = array

    def create(
        self,
        node: str,
        dtype: np.dtype[Any],
        chunk: tuple[int, ...],
        axis: int,
        encoding: Encoding,
        attributes: dict[str, Any],
    ) -> ChunkWriter:
        """Start a sharded array."""
        nbytes = dtype.itemsize * math.prod(chunk)
        per_shard = min(max(1, _SHARD // nbytes), _MOST_CHUNKS)
        shard = tuple(n * per_shard if a == axis else n for a, n in enumerate(chunk))
        empty = tuple(0 if a == axis else n for a, n in enumerate(chunk))
        with _quietly():
            array = self._root.create_array(
                node, shape=empty, dtype=dtype, chunks=chunk, shards=shard, filters=None, attributes=attributes, overwrite=True,
                config={"write_empty_chunks": True}, **_codecs(encoding, dtype),
            )  # fmt: skip
        return _ZarrChunkWriter(array, axis, chunk[axis], per_shard)

    def array(self, node: str) -> StoredArray:
        """Return a closed array."""
        return ZarrStore(self._tree).array(node)

    def move(self, node: str, target: str) -> None:
        """Rename an array's folder."""
        remove(self._path / target)
        (self._path / node).rename(self._path / target)

    def remove(self, node: str) -> None:
        """Remove a node's folder."""
        remove(self._path / node)

    def finished(self) -> dict[str, str]:
        """Find the groups that are marked as complete."""
        found = {}
        for folder, _, files in os.walk(self._path):
            if METADATA in files:
                metadata = parse_json((Path(folder) / METADATA).read_bytes(), folder)
                attributes = metadata.get("attributes", {})
                if attributes.get("type") == SEQUENCE and attributes.get("complete"):
                    found[attributes["path"]] = Path(folder).relative_to(self._path).as_posix()
        return found

    def close(self, attributes: dict[str, Any]) -> Path:
        """Write the root's attributes and consolidate the metadata."""
        self._root.attrs.put(attributes)
        with _quietly():
            self._zarr.consolidate_metadata(self._path)
        return self._path


class _ZarrChunkWriter(ChunkWriter):
    """Keeps the chunks of a shard and writes them together, because a shard cannot be extended."""

    def __init__(self, array: Any, axis: int, step: int, per_shard: int) -> None:
        self.array = array
        self.axis = axis
        self.step = step
        self.per_shard = per_shard
        self.written = 0
        self.held: list[NDArray[Any]] = []

    def append(self, chunk: NDArray[Any]) -> None:
        self.held.append(chunk)
        if len(self.held) == self.per_shard:
            self._flush()

    def close(self) -> None:
        if self.held:
            self._flush()

    def _flush(self) -> None:
        block = np.concatenate(self.held, axis=self.axis)
        self.held = []
        end = self.written + block.shape[self.axis]
        self.array.resize(tuple(end if a == self.axis else n for a, n in enumerate(block.shape)))
        self.array[tuple(slice(self.written, end) if a == self.axis else slice(None) for a in range(block.ndim))] = (
            block
        )
        self.written = end


def _codecs(encoding: Encoding, dtype: np.dtype[Any]) -> dict[str, Any]:
    """Return zarr-python's arguments for an encoding with a crc32c after each chunk."""
    codecs = import_extra("zarr.codecs", "zarr")
    if encoding.codec == "pcodec":
        import_extra("pcodec", "zarr")
        serializer = import_extra("zarr.codecs.numcodecs", "zarr").PCodec(level=encoding.level)
        return {"serializer": serializer, "compressors": [codecs.Crc32cCodec()]}
    shuffle = next(name for name, number in _SHUFFLES.items() if number == encoding.shuffle)
    blosc = codecs.BloscCodec(
        cname="zstd", clevel=encoding.level, shuffle=shuffle, typesize=dtype.itemsize, blocksize=BLOCK
    )
    return {"compressors": [blosc, codecs.Crc32cCodec()]}


def _encoding_of(codecs: list[dict[str, Any]]) -> Encoding:
    """Return the encoding that the (inner) codecs in an array's metadata describe.

    Raises:
        ValueError: they are not those of an `Encoding`.
    """
    names = [codec["name"] for codec in codecs]
    if names == ["numcodecs.pcodec", "crc32c"]:
        return Encoding("pcodec", codecs[0]["configuration"]["level"])
    if names == ["bytes", "blosc", "crc32c"] and codecs[0].get("configuration", {}).get("endian", "little") == "little":
        settings = codecs[1]["configuration"]
        return Encoding("blosc", settings["clevel"], _SHUFFLES[settings["shuffle"]])
    raise ValueError(f"codecs {', '.join(names)}")


def _verified(data: memoryview, what: str) -> memoryview:
    """Return bytes without the checksum at their end.

    Raises:
        FormatError: the checksum does not match.
    """
    if len(data) < _CHECKSUM or crc32c(data, "zarr") != _RESIDUE:
        raise FormatError(
            what, problem="the checksum does not match", advice="the store is corrupted: fetch or pack it again"
        )
    return data[:-_CHECKSUM]


@contextmanager
def _quietly() -> Iterator[None]:
    """Suppress zarr-python's warnings that consolidated metadata and numcodecs' codecs are extensions of the specification."""
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", message=".*(Consolidated metadata|Numcodecs codecs|not have a Zarr V3 spec).*"
        )
        yield
