"""Arrays in chunks, read straight from the files that hold them.

A chunk is a range of bytes in some file: zarr's shards and HDF5's chunked data sets both come down to that. It is fetched, its
checksum is checked, and numcodecs decodes it: a whole scan in about a millisecond, where the stores' own libraries take several.
No handle stays open, so all of this may be pickled and used on both sides of a fork.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import CarlascError, FormatError, import_extra
from carlasc.running import count_workers
from carlasc.storage.folders.trees import Tree

_T = TypeVar("_T")
_R = TypeVar("_R")

NO_SHUFFLE, SHUFFLE, BITSHUFFLE = 0, 1, 2
BLOCK = 1 << 21  # bytes that Blosc compresses in one go: a whole scan, where smaller blocks cost size


@dataclass(frozen=True)
class Encoding:
    """How chunks become bytes.

    Attributes:
        codec: "blosc" (Zstandard after a shuffle) or "pcodec".
        level: effort, of Zstandard or of PCodec.
        shuffle: NO_SHUFFLE, SHUFFLE (bytes) or BITSHUFFLE.
    """

    codec: Literal["blosc", "pcodec"] = "blosc"
    level: int = 5
    shuffle: int = NO_SHUFFLE

    def encode(self, chunk: NDArray[Any], extra: str) -> bytes:
        """Return a chunk's bytes, as the store keeps them (less its checksum)."""
        if self.codec == "pcodec":
            return bytes(_pcodec(self.level, extra).encode(np.ascontiguousarray(chunk).reshape(-1)))
        blosc = import_extra("numcodecs.blosc", extra)
        return bytes(blosc.compress(np.ascontiguousarray(chunk), b"zstd", self.level, self.shuffle, BLOCK))

    def decode(self, data: bytes | memoryview, out: NDArray[Any], extra: str) -> None:
        """Decode a chunk's bytes into `out`, which is contiguous and of its shape and dtype.

        Raises:
            FormatError: they decode to something else.
        """
        try:
            if self.codec == "pcodec":
                _pcodec(self.level, extra).decode(bytes(data), out.reshape(-1))
            else:
                import_extra("numcodecs.blosc", extra).decompress(data, out)
        except CarlascError:
            raise
        except Exception as error:  # each codec has its own kinds
            raise FormatError(f"cannot be decoded: {error}") from error


@cache
def _pcodec(level: int, extra: str) -> Any:
    return import_extra("numcodecs.pcodec", extra).PCodec(level=level)


class StoredArray:
    """An array of a store, chunked along one axis, whole along the others.

    Attributes:
        tree: holds the files with the chunks.
        name: what to call the array in errors.
        dtype: type of the elements, little-endian.
        shape: of the whole array.
        chunk: shape of a chunk.
        axis: the axis along which chunks follow each other.
        encoding: how chunks become bytes.
        attributes: what the store says of the array.
    """

    extra = "zarr"

    def __init__(
        self,
        tree: Tree,
        name: str,
        dtype: np.dtype[Any],
        shape: tuple[int, ...],
        chunk: tuple[int, ...],
        axis: int,
        encoding: Encoding,
        attributes: dict[str, Any],
    ) -> None:
        self.tree = tree
        self.name = name
        self.dtype = dtype
        self.shape = shape
        self.chunk = chunk
        self.axis = axis
        self.encoding = encoding
        self.attributes = attributes

    @property
    def step(self) -> int:
        """Elements of a chunk along the axis."""
        return self.chunk[self.axis]

    def locate(self, numbers: Sequence[int]) -> list[tuple[str, int, int]]:
        """Return where chunks are: file, first byte, end."""
        raise NotImplementedError

    def verify(self, data: memoryview, number: int) -> memoryview:
        """Return a chunk's encoded bytes without their checksum.

        Raises:
            FormatError: the checksum is another.
        """
        raise NotImplementedError

    def fetch(self, numbers: Sequence[int]) -> list[memoryview]:
        """Read chunks as they are stored; from a remote store all at once."""
        return [memoryview(data) for data in self.tree.read_ranges(self.locate(numbers))]

    def decode(self, data: memoryview, number: int, out: NDArray[Any]) -> None:
        """Check and decode a fetched chunk into `out`."""
        self.encoding.decode(self.verify(data, number), out, self.extra)

    def read_chunk(self, number: int) -> NDArray[Any]:
        """Fetch, check and decode one chunk."""
        out = np.empty(self.chunk, self.dtype)
        self.decode(self.fetch([number])[0], number, out)
        return out


def parallel(function: Callable[[_T], _R], items: Iterable[_T]) -> list[_R]:
    """Apply a function that spends its time in decoders (which let other threads run) to several items.

    A worker process of a DataLoader does so in one thread: there are as many workers as the user wants threads.
    """
    items = list(items)
    if len(items) < 2 or multiprocessing.parent_process() is not None:
        return [function(item) for item in items]
    return list(_pool(os.getpid()).map(function, items))


def crc32c(data: bytes | memoryview, extra: str) -> int:
    """Return the CRC-32C of some bytes, which processors have an instruction for: six times as fast as CRC-32."""
    source = data.obj if isinstance(data, memoryview) else data
    whole = (
        source if isinstance(source, bytes) and len(source) == len(data) else bytes(data)
    )  # the library takes bytes only
    return int(import_extra("google_crc32c", extra).value(whole))


def scratch(shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return memory of this thread, as it was left: the next call hands it out again."""
    size = math.prod(shape) * dtype.itemsize
    if _scratch.memory.size < size:
        _scratch.memory = np.empty(size, np.uint8)
    return _scratch.memory[:size].view(dtype).reshape(shape)


class _Scratch(threading.local):
    memory: NDArray[np.uint8] = np.empty(0, np.uint8)


_scratch = _Scratch()


@cache
def _pool(_pid: int) -> ThreadPoolExecutor:
    """Return the threads of this process: after a fork, the object exists in the child, but its threads do not."""
    return ThreadPoolExecutor(min(8, count_workers(None)), thread_name_prefix="carlasc-decode")
