"""Ranges of bytes of files: mapping them into memory, and checking that they are whole."""

from __future__ import annotations

import mmap

from carlasc.errors import FormatError
from carlasc.storage.folders.bodies import WrongAnswerError


def map_range(descriptor: int, start: int, end: int) -> memoryview:
    """Map the bytes [start, end) of an open file, which has as many, into memory."""
    skipped = start % mmap.ALLOCATIONGRANULARITY
    flags = mmap.MAP_SHARED | getattr(mmap, "MAP_POPULATE", 0)  # read all pages at once (Linux only)
    mapped = mmap.mmap(descriptor, end - start + skipped, flags, mmap.PROT_READ, offset=start - skipped)
    return memoryview(mapped)[skipped:]


def check_length(data: bytes, expected: int, where: str) -> bytes:
    """Return `data` if it has the expected length; else the file is truncated, or a server sent another range."""
    if len(data) != expected:
        raise shorter(expected, len(data), where)
    return data


def shorter(expected: int, found: int, where: str) -> FormatError:
    """Return the error of a range of which only `found` bytes exist."""
    return FormatError(
        where, expected=f"{expected} bytes in this range", found=str(found), advice="is the file truncated?"
    )


def check_size(expected: int, data: bytes) -> None:
    """Raise a WrongAnswerError if a server sent other than `expected` bytes."""
    if len(data) != expected:
        raise WrongAnswerError(f"{len(data)} bytes instead of {expected}")
