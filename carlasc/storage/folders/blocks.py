"""A remote file as a file object, for libraries that read one: h5py and pyarrow."""

from __future__ import annotations

import io
from collections.abc import Callable

_BLOCK = 1 << 18  # bytes
_KEPT = 64  # blocks


class RemoteFile(io.RawIOBase):
    """Reads a file block by block, and keeps the blocks that were used last."""

    def __init__(self, fetch: Callable[[int, int], bytes], size: int) -> None:
        """Remember how to fetch the bytes [start, end) of the file, and its size in bytes; nothing is fetched yet."""
        self._fetch, self._size, self._place = fetch, size, 0
        self._blocks: dict[int, bytes] = {}  # the one that was used last is the last one

    def readable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Move to a place, which is returned."""
        self._place = max(0, offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._place, io.SEEK_END: self._size}[whence])
        return self._place

    def tell(self) -> int:
        """Return the place in the file."""
        return self._place

    def readinto(self, buffer: bytearray | memoryview) -> int:  # type: ignore[override]
        """Read bytes into a buffer, and return how many there were."""
        view = memoryview(buffer).cast("B")
        start, end = self._place, min(self._place + len(view), self._size)
        if start >= end:
            return 0
        first, last = start // _BLOCK, (end - 1) // _BLOCK
        self._load(first, last)
        data = b"".join(self._blocks[number] for number in range(first, last + 1))
        view[: end - start] = data[start - first * _BLOCK : end - first * _BLOCK]
        self._place = end
        for number in range(first, last + 1):
            self._blocks[number] = self._blocks.pop(number)
        while len(self._blocks) > _KEPT:
            del self._blocks[next(iter(self._blocks))]
        return end - start

    def _load(self, first: int, last: int) -> None:
        """Fetch the blocks from `first` to `last` that are not kept, each run of them in one request."""
        number = first
        while number <= last:
            if number in self._blocks:
                number += 1
                continue
            stop = number + 1
            while stop <= last and stop not in self._blocks:
                stop += 1
            data = self._fetch(number * _BLOCK, min(stop * _BLOCK, self._size))
            for place in range(number, stop):
                offset = (place - number) * _BLOCK
                self._blocks[place] = data[offset : offset + _BLOCK]
            number = stop
