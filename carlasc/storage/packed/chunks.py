"""Chunked arrays, read directly from the files that hold the chunks.

A chunk is a range of bytes in a file, in zarr shards and in chunked data sets of HDF5. It is
fetched, its checksum is verified, and numcodecs decodes it. This takes about a millisecond per
scan; the zarr and HDF5 libraries take several. No handle stays open, so these objects can be
pickled, and used on both sides of a fork.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import struct
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, Literal, TypeVar

import numpy as np

from carlasc.core.arrays import AnyArray, Uint8Array
from carlasc.errors import CarlascError, FormatError, describe, import_extra, postponed_interrupts
from carlasc.running import count_cores
from carlasc.storage.arrays import check_size
from carlasc.storage.transport.trees import Tree

# opening an HDF5 store checks that its own extra is installed; only zarr has PCodec
_EXTRA = "zarr"
_T = TypeVar("_T")
_R = TypeVar("_R")

NO_SHUFFLE = 0
SHUFFLE = 1
BITSHUFFLE = 2
_BLOSC_HEADER = struct.Struct("<4B3I")
# bytes that Blosc compresses together: a whole scan, because smaller blocks compress less
BLOCK = 1 << 21


@dataclass(frozen=True)
class Encoding:
    """How chunks are encoded as bytes.

    Attributes:
        codec: "blosc" (Zstandard after a shuffle) or "pcodec".
        level: compression level of Zstandard or PCodec.
        shuffle: NO_SHUFFLE, SHUFFLE (bytes) or BITSHUFFLE.
    """

    codec: Literal["blosc", "pcodec"] = "blosc"
    level: int = 5
    shuffle: int = NO_SHUFFLE

    def encode(self, chunk: AnyArray) -> bytes:
        """Return the encoded bytes of a chunk, without the checksum."""
        if self.codec == "pcodec":
            return bytes(_pcodec(self.level).encode(np.ascontiguousarray(chunk).reshape(-1)))
        blosc = import_extra("numcodecs.blosc", _EXTRA)
        return bytes(
            blosc.compress(np.ascontiguousarray(chunk), b"zstd", self.level, self.shuffle, BLOCK)
        )

    def decode(self, data: bytes | memoryview, out: AnyArray) -> None:
        """Decode the bytes of a chunk into `out`, a contiguous array with the shape and dtype of
        the chunk.

        Raises:
            FormatError: the bytes cannot be decoded, or have another number of elements.
        """
        try:
            if self.codec == "pcodec":
                # numcodecs does not report the number of decoded values: with too few, the rest of
                # `out` would be unset. PCodec before 1.1 has `standalone` as a module alone, not as
                # an attribute of the package.
                progress = import_extra("pcodec.standalone", _EXTRA).simple_decompress_into(
                    bytes(data), out.reshape(-1)
                )
                if progress.n_processed != out.size or not progress.finished:
                    raise ValueError(f"{progress.n_processed} elements instead of {out.size}")
            else:
                _check_blosc(data, out.nbytes)
                import_extra("numcodecs.blosc", _EXTRA).decompress(data, out)
        except (CarlascError, KeyboardInterrupt, SystemExit):
            raise
        except (
            BaseException
        ) as error:  # each codec raises other types; a Rust panic in PCodec is not an Exception
            raise FormatError(
                "its bytes", problem=f"cannot be decoded: {describe(error)}"
            ) from error


def _check_blosc(data: bytes | memoryview, size: int) -> None:
    """Check a Blosc header as `blosc_cbuffer_validate` of C-Blosc does, because the Blosc decoder
    does not check it.

    The header of Blosc 1 (README_CHUNK_FORMAT.rst) has the version, the version of the codec, flags
    and the type size, followed by three 32-bit numbers: uncompressed bytes, bytes per block and
    compressed bytes.

    Raises:
        ValueError: the header does not fit the data.
    """
    if len(data) < _BLOSC_HEADER.size:
        raise ValueError(f"{len(data)} bytes are not a Blosc chunk")
    *_, decoded, block, encoded = _BLOSC_HEADER.unpack_from(data)
    if (decoded, encoded) != (size, len(data)) or not 0 < block <= max(decoded, 1):
        raise ValueError(
            f"{decoded} bytes from {encoded}, in blocks of {block}, instead of {size} from "
            f"{len(data)}"
        )


@cache
def _pcodec(level: int) -> Any:
    return import_extra("numcodecs.pcodec", _EXTRA).PCodec(level=level)


@dataclass(eq=False)
class StoredArray(ABC):
    """A chunked array of a store.

    Chunks are numbered in C order. The array of a column has one entry per frame along its first
    axis.

    Attributes:
        tree: the tree of files that holds the chunks.
        name: name of the array, for errors.
        dtype: type of the elements, little-endian.
        shape: shape of the whole array.
        chunk: shape of a chunk.
        encoding: how chunks are encoded.
    """

    tree: Tree
    name: str
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    chunk: tuple[int, ...]
    encoding: Encoding

    @cached_property
    def slots(self) -> int:
        """Number of chunks per entry of the first axis."""
        rest = zip(self.shape[1:], self.chunk[1:], strict=True)
        return math.prod(-(-n // step) for n, step in rest)

    @property
    def step(self) -> int:
        """Length of a chunk along the last axis."""
        return self.chunk[-1]

    @abstractmethod
    def locate(self, numbers: Sequence[int]) -> list[tuple[str, int, int]]:
        """Return the file, the first byte and the end of each chunk."""

    @abstractmethod
    def files(self, numbers: Sequence[int]) -> list[str]:
        """Return the files that hold some chunks, each once."""

    @abstractmethod
    def verify(self, data: memoryview, number: int) -> memoryview:
        """Verify the checksum of a chunk, and return its encoded bytes without it.

        Raises:
            FormatError: the checksum does not match.
        """

    def fetch(self, numbers: Sequence[int]) -> list[memoryview]:
        """Read encoded chunks; all at once from a remote store."""
        return [memoryview(data) for data in self.tree.read_ranges(self.locate(numbers))]

    def decode(self, data: memoryview, number: int, out: AnyArray) -> None:
        """Verify a fetched chunk and decode it into `out`."""
        self.encoding.decode(self.verify(data, number), out)

    def read_chunk(self, number: int) -> AnyArray:
        """Fetch, verify and decode one chunk."""
        check_size(self.chunk, self.dtype, f"a chunk of {self.name}")
        out = np.empty(self.chunk, self.dtype)
        self.decode(self.fetch([number])[0], number, out)
        return out


def parallel(function: Callable[[_T], _R], items: Iterable[_T]) -> list[_R]:
    """Apply a function to several items in threads.

    The function should mostly run decoders, which release the GIL.

    A worker process, such as one of a DataLoader, uses one thread, because the user has chosen the
    number of processes.
    """
    items = list(items)
    if len(items) < 2 or multiprocessing.parent_process() is not None:
        return [function(item) for item in items]
    return in_threads(function, items)


def in_threads(function: Callable[[_T], _R], items: Iterable[_T]) -> list[_R]:
    """Apply a function in threads other than the main thread.

    In the main thread, Blosc compresses the blocks of a large chunk in several threads and writes
    them in the order of completion, so the bytes would differ from run to run.
    """
    with postponed_interrupts():
        results = _pool(os.getpid()).map(function, items)
    return list(results)


def crc32c(data: bytes | memoryview) -> int:
    """Return the CRC-32C of some bytes.

    CPUs have an instruction for it, which makes it six times as fast as CRC-32.
    """
    source = data.obj if isinstance(data, memoryview) else data
    # the library takes bytes only
    whole = source if isinstance(source, bytes) and len(source) == len(data) else bytes(data)
    return int(import_extra("google_crc32c", _EXTRA).value(whole))


def scratch(shape: tuple[int, ...], dtype: np.dtype[Any]) -> AnyArray:
    """Return uninitialised memory of this thread. The next call in the thread reuses it."""
    size = math.prod(shape) * dtype.itemsize
    if _scratch.memory.size < size:
        _scratch.memory = np.empty(size, np.uint8)
    return _scratch.memory[:size].view(dtype).reshape(shape)


class _Scratch(threading.local):
    memory: Uint8Array = np.empty(0, np.uint8)


_scratch = _Scratch()


@cache
def _pool(_pid: int) -> ThreadPoolExecutor:
    """Return the thread pool of this process.

    It is created per process, because threads do not survive a fork.
    """
    threads = 1 if multiprocessing.parent_process() is not None else min(8, count_cores())
    return ThreadPoolExecutor(threads, thread_name_prefix="carlasc-codec")
