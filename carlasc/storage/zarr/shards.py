"""The objects of a zarr store: shards of chunks, each with an index, and their metadata.

See the zarr specification v3, "sharding_indexed" and "crc32c".
"""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyArray
from carlasc.errors import FormatError, MissingDataError, reading
from carlasc.storage.files import damaged
from carlasc.storage.packed.array_layout import FieldLayout
from carlasc.storage.packed.chunks import (
    BITSHUFFLE,
    BLOCK,
    NO_SHUFFLE,
    SHUFFLE,
    Encoding,
    StoredArray,
    crc32c,
)
from carlasc.storage.packed.columns import Column
from carlasc.storage.transport.trees import Tree

METADATA = "zarr.json"
_SHUFFLES = {"noshuffle": NO_SHUFFLE, "shuffle": SHUFFLE, "bitshuffle": BITSHUFFLE}
_LITTLE = {"name": "bytes", "configuration": {"endian": "little"}}
_CRC = {"name": "crc32c"}
_CHECKSUM = 4  # bytes
# A cyclic checksum leaves the same remainder for every message that is followed by its own
# checksum. So one pass over both verifies the message, without cutting the checksum off first.
_RESIDUE = 0x48674BC7  # crc32c of any bytes followed by their crc32c
# The specification of "sharding_indexed" fixes this number for both fields of a missing chunk.
_ABSENT = 2**64 - 1  # offset and length of a missing chunk


@dataclass(eq=False)
class ZarrArray(StoredArray):
    """A zarr array whose codecs are bytes or PCodec, Blosc, and crc32c, in shards along its first
    axis or in one chunk.

    Attributes:
        per_shard: number of chunks of a shard; None if the array is not sharded.
    """

    per_shard: int | None = None
    _index_first: bool = False
    _indices: dict[int, ShardIndex] = field(default_factory=dict)

    @classmethod
    def from_metadata(cls, tree: Tree, node: str, metadata: Mapping[str, Any]) -> ZarrArray:
        """Read the metadata of an array.

        Raises:
            FormatError: carlasc does not write such codecs or chunks.
        """
        with reading(tree.where(node), "the codecs and chunks that carlasc writes"):
            shape = _numbers(metadata["shape"], 0)
            dtype = np.dtype(metadata["data_type"]).newbyteorder("<")
            if dtype.kind not in "uif":
                raise ValueError(f"elements of {dtype.name}")
            outer = _numbers(metadata["chunk_grid"]["configuration"]["chunk_shape"], 1)
            codecs = metadata["codecs"]
            chunk = outer
            if sharded := codecs[0]["name"] == "sharding_indexed":
                chunk = _numbers(codecs[0]["configuration"]["chunk_shape"], 1)
                codecs = codecs[0]["configuration"]["codecs"]
            if not len(shape) == len(outer) == len(chunk) > 0:
                raise ValueError(f"shape {shape}, chunks {outer} of {chunk}")
            encoding = encoding_of(codecs)
            # A shard holds whole frames, so the number of a shard follows from the first axis
            # alone: `file` and `locate` rest on this.
            if any(n > limit for n, limit in zip(shape[1:], outer[1:], strict=True)):
                raise ValueError(
                    f"shape {shape} in shards of {outer}, which divide other axes than the first"
                )
            opened = cls(tree, node, dtype, shape, chunk, encoding)
            opened.per_shard = outer[0] // chunk[0] * opened.slots if sharded else None
            opened._index_first = (
                sharded and metadata["codecs"][0]["configuration"].get("index_location") == "start"
            )
        return opened

    def locate(self, numbers: Sequence[int]) -> list[tuple[str, int, int]]:
        """Look up chunks in the indices of their shards.

        Each index is read once; all indices of one call are read together.
        """
        per_shard = self.per_shard
        if per_shard is None:
            return [(self.file(number), 0, -1) for number in numbers]
        # Most calls ask for shards whose index is known: they make no set, and sort nothing.
        if any(number // per_shard not in self._indices for number in numbers):
            self._read_indices({number // per_shard for number in numbers})
        places = []
        for number in numbers:
            shard, slot = divmod(number, per_shard)
            place = self._indices[shard].place(slot)
            if place is None:
                raise damaged(self.tree.where(self.file(shard)), f"chunk {number}", "none")
            places.append((self.file(shard), *place))
        return places

    def fetch(self, numbers: Sequence[int]) -> list[memoryview]:
        """Read encoded chunks."""
        try:
            if self.per_shard is None:
                return [
                    memoryview(data)
                    for data in self.tree.read_many([self.file(number) for number in numbers])
                ]
            return super().fetch(numbers)
        except MissingDataError as error:
            raise damaged(error.where, error.expected, error.found) from error

    def files(self, numbers: Sequence[int]) -> list[str]:
        """Return the shards that hold some chunks."""
        return [
            self.file(shard)
            for shard in dict.fromkeys(number // (self.per_shard or 1) for number in numbers)
        ]

    def verify(self, data: memoryview, number: int) -> memoryview:
        """Verify the crc32c at the end of a chunk."""
        return without_checksum(data, f"chunk {number} of {self.name}")

    def file(self, number: int) -> str:
        """Return the path of a shard, or of a chunk of an array without shards."""
        return f"{self.name}/c/{'/'.join([str(number), *['0'] * (len(self.shape) - 1)])}"

    def _read_indices(self, shards: set[int]) -> None:
        # Another thread may read the same index meanwhile: it stores equal values, so no lock is
        # needed. Sorted, so that requests do not depend on the order of a set.
        missing = sorted(shards - self._indices.keys())
        if not missing:
            return
        # All indices have one size, because also a missing chunk has its row. An index at the end
        # is therefore found from the end of the file, without asking for the size of the file.
        size = index_bytes(self.per_shard or 1)
        start, end = (0, size) if self._index_first else (-size, 0)
        files = [self.file(shard) for shard in missing]
        indices = self.tree.read_ranges([(file, start, end) for file in files])
        for shard, file, data in zip(missing, files, indices, strict=True):
            self._indices[shard] = ShardIndex(
                memoryview(data), self.per_shard or 1, f"the index of {file}"
            )


class ShardIndex:
    """The positions of the existing chunks of a shard in its file."""

    def __init__(self, data: memoryview, per_shard: int, what: str) -> None:
        """Read an index.

        Args:
            data: the bytes of the index, with its checksum.
            per_shard: maximum number of chunks of the shard.
            what: name of the index in errors.

        Raises:
            FormatError: the index is cut short, or its checksum does not match.
        """
        if len(data) != index_bytes(per_shard):
            raise damaged(what, f"{index_bytes(per_shard)} bytes", str(len(data)))
        table = np.frombuffer(without_checksum(data, what), "<u8").reshape(-1, 2)
        # Only existing chunks are kept, in rising order of their slots: `place` searches by
        # halving, and a shard of a field with few frames takes little memory.
        slots = np.flatnonzero(table[:, 0] != _ABSENT)
        # access to one number is faster than in a NumPy array
        self.slots = array("q", slots.astype("=i8").tobytes())
        self._offsets, self._lengths = (
            array("Q", column.astype("=u8").tobytes()) for column in table[slots].T
        )

    def place(self, slot: int) -> tuple[int, int] | None:
        """Return the first byte and the end of a chunk in the file; None if the chunk does not
        exist.
        """
        position = bisect_left(self.slots, slot)
        if position == len(self.slots) or self.slots[position] != slot:
            return None
        offset = self._offsets[position]
        return offset, offset + self._lengths[position]


def encode_chunk(chunk: AnyArray, encoding: Encoding) -> bytes:
    """Return the encoded bytes of a chunk, with its checksum."""
    return _with_checksum(encoding.encode(chunk))


def join_shard(chunks: Mapping[int, bytes | memoryview], per_shard: int) -> bytes:
    """Return the bytes of a shard: its index, then its chunks.

    Args:
        chunks: results of `encode_chunk` by their number in the shard.
        per_shard: maximum number of chunks of the shard.
    """
    # The index comes first, so that a reader that fetches a whole shard, or its beginning, needs no
    # second request. Chunks follow in the order of their slots, whatever the order in which they
    # were made: equal chunks give equal bytes.
    table = np.full((per_shard, 2), _ABSENT, "<u8")
    offset = index_bytes(per_shard)
    for slot in sorted(chunks):
        table[slot] = offset, len(chunks[slot])
        offset += len(chunks[slot])
    return b"".join([_with_checksum(table.tobytes()), *(chunks[slot] for slot in sorted(chunks))])


def split_shard(data: bytes | memoryview, per_shard: int, what: str) -> dict[int, memoryview]:
    """Return the encoded chunks of a shard by their number in it.

    Raises:
        FormatError: the index is damaged.
    """
    view = memoryview(data)
    index = ShardIndex(view[: index_bytes(per_shard)], per_shard, what)
    places = {slot: place for slot in index.slots if (place := index.place(slot)) is not None}
    # Offsets are unsigned, so that a chunk can lie outside of the file only beyond its end.
    if any(end > len(view) for _, end in places.values()):
        raise damaged(what, "chunks inside the file", "a chunk outside of it")
    return {slot: view[start:end] for slot, (start, end) in places.items()}


def index_bytes(per_shard: int) -> int:
    """Return the size of the index of a shard, with its checksum."""
    return 16 * per_shard + _CHECKSUM


def without_checksum(data: memoryview, what: str) -> memoryview:
    """Verify the checksum at the end of some bytes, and return the bytes without it.

    Raises:
        FormatError: the checksum does not match.
    """
    if len(data) < _CHECKSUM or crc32c(data) != _RESIDUE:
        raise FormatError(
            what,
            problem="the checksum does not match",
            advice="the store is corrupted: fetch or pack it again",
        )
    return data[:-_CHECKSUM]


def _numbers(values: Any, least: int) -> tuple[int, ...]:
    """Return a list of integers from JSON.

    Raises:
        ValueError: it is not a list of integers, or a number is below `least` or does not fit into
            an int64.
    """
    if not isinstance(values, list) or not all(
        type(value) is int and least <= value < 2**63 for value in values
    ):
        raise ValueError(f"{values!r} for a shape")
    return tuple(values)


def _with_checksum(data: bytes) -> bytes:
    return data + crc32c(data).to_bytes(_CHECKSUM, "little")


def group_metadata(
    attributes: Mapping[str, Any], nodes: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Return the metadata of a group.

    Args:
        attributes: the group's attributes.
        nodes: the metadata of all nodes below it by path, to consolidate in this group; None does
            not consolidate.
    """
    metadata: dict[str, Any] = {
        "attributes": dict(attributes),
        "zarr_format": 3,
        "node_type": "group",
    }
    if nodes is not None:
        metadata["consolidated_metadata"] = {
            "kind": "inline",
            "must_understand": False,
            "metadata": dict(nodes),
        }
    return metadata


def array_metadata(
    dtype: np.dtype[Any],
    shape: tuple[int, ...],
    chunk: tuple[int, ...],
    encoding: Encoding,
    attributes: Mapping[str, Any],
    shard: tuple[int, ...] | None = None,
) -> dict[str, Any]:
    """Return the metadata of an array.

    Args:
        dtype: type of the elements.
        shape: shape of the array.
        chunk: shape of a chunk.
        encoding: encoding of a chunk; its crc32c is appended.
        attributes: attributes of the array.
        shard: shape of a shard; None for an array without shards.
    """
    codecs = codecs_of(encoding, dtype)
    if shard is not None:
        sharding = {
            "chunk_shape": list(chunk),
            "codecs": codecs,
            "index_codecs": [_LITTLE, _CRC],
            "index_location": "start",
        }
        codecs = [{"name": "sharding_indexed", "configuration": sharding}]
    return {
        "attributes": dict(attributes),
        "shape": list(shape),
        "data_type": dtype.name,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(shard or chunk)}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": 0.0 if dtype.kind == "f" else 0,
        "codecs": codecs,
        "zarr_format": 3,
        "node_type": "array",
        "storage_transformers": [],
    }


def codecs_of(encoding: Encoding, dtype: np.dtype[Any]) -> list[dict[str, Any]]:
    """Return the codecs of a chunk: the codecs of its encoding, and crc32c."""
    if encoding.codec == "pcodec":
        return [{"name": "numcodecs.pcodec", "configuration": {"level": encoding.level}}, _CRC]
    shuffle = next(name for name, number in _SHUFFLES.items() if number == encoding.shuffle)
    blosc = {
        "typesize": dtype.itemsize,
        "cname": "zstd",
        "clevel": encoding.level,
        "shuffle": shuffle,
        "blocksize": BLOCK,
    }
    return [
        _LITTLE if dtype.itemsize > 1 else {"name": "bytes"},
        {"name": "blosc", "configuration": blosc},
        _CRC,
    ]


def encoding_of(codecs: list[dict[str, Any]]) -> Encoding:
    """Return the encoding that the (inner) codecs in an array's metadata describe.

    Raises:
        ValueError: no `Encoding` has these codecs.
    """
    names = [codec["name"] for codec in codecs]
    if names == ["numcodecs.pcodec", "crc32c"]:
        return Encoding("pcodec", codecs[0]["configuration"]["level"])
    if (
        names == ["bytes", "blosc", "crc32c"]
        and codecs[0].get("configuration", {}).get("endian", "little") == "little"
    ):
        settings = codecs[1]["configuration"]
        return Encoding("blosc", settings["clevel"], _SHUFFLES[settings["shuffle"]])
    raise ValueError(f"codecs {', '.join(names)}")


def column_metadata(
    field_layout: FieldLayout, column: Column, block: int, frames: int
) -> dict[str, Any]:
    """Return the metadata of a column's array.

    Args:
        field_layout: the layout of its field.
        column: the column.
        block: number of frames per shard.
        frames: length of the array in frames, a multiple of `block`.
    """
    shape = field_layout.frame_shape(column)
    return array_metadata(
        np.dtype(column.dtype),
        (frames, *shape),
        field_layout.chunk_shape(column),
        column.encoding,
        field_layout.column_attributes(column),
        (block, *shape),
    )
