"""Operators that change any bytes, whatever they are."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from random import Random

Operator = Callable[[bytes, Random], bytes]
"""A function of the bytes and of a random number generator."""

_INTEGERS = (
    0,
    1,
    -1,
    2,
    7,
    8,
    16,
    127,
    128,
    255,
    256,
    4096,
    65535,
    65536,
    2**31 - 1,
    -(2**31),
    2**32 - 1,
    2**63 - 1,
    -(2**63),
)
_STRUCTURE = re.compile(
    rb"OHDR|OCHK|TREE|SNOD|HEAP|GCOL|FRHP|FHDB|FADB|FAHD|EAHD|EAIB|BTHD|BTLF|BTIN|PK\x03\x04|PK\x01\x02|PK\x05\x06|PAR1"
)
_NUMBER = re.compile(rb"-?[0-9][0-9.e+-]*")


def _place(data: bytes, rng: Random) -> int:
    """Return an offset: often in the head or the tail, or where a structure of a container begins."""
    which = rng.random()
    if which < 0.3:
        return rng.randrange(min(len(data), 128))
    if which < 0.45:
        return len(data) - 1 - rng.randrange(min(len(data), 128))
    if which < 0.75 and (found := [match.start() for match in _STRUCTURE.finditer(data)]):
        return min(len(data) - 1, rng.choice(found) + rng.randrange(160))
    return rng.randrange(len(data))


def flip(data: bytes, rng: Random) -> bytes:
    """Flip some bits."""
    changed = bytearray(data or b"\0")
    for _ in range(rng.choice((1, 1, 1, 2, 4, 16))):
        changed[_place(changed, rng)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def put(data: bytes, rng: Random) -> bytes:
    """Set some bytes."""
    changed = bytearray(data or b"\0")
    for _ in range(rng.choice((1, 1, 2, 4))):
        changed[_place(changed, rng)] = rng.choice((0, 1, 127, 128, 255, rng.randrange(256)))
    return bytes(changed)


def number(data: bytes, rng: Random) -> bytes:
    """Write a number with two, four or eight bytes over others."""
    code = rng.choice("Hiq")
    width = struct.calcsize(f"<{code}")
    value = rng.choice(_INTEGERS) % (1 << 8 * width)
    if len(data) < width:
        return value.to_bytes(width, "little")
    start = min(_place(data, rng), len(data) - width)
    if rng.random() < 0.3:  # a value near the one that is there
        value = (int.from_bytes(data[start : start + width], "little") + rng.randint(-3, 3)) % (
            1 << 8 * width
        )
    order = "little" if rng.random() < 0.8 else "big"
    return data[:start] + value.to_bytes(width, order) + data[start + width :]


def truncate(data: bytes, rng: Random) -> bytes:
    """Cut the end off."""
    return data[
        : rng.choice((0, 1, len(data) // 2, max(0, len(data) - 1), rng.randint(0, len(data))))
    ]


def extend(data: bytes, rng: Random) -> bytes:
    """Add bytes."""
    count = rng.choice((1, 3, 4, 16, 100, 5000))
    return data + (rng.randbytes(count) if rng.random() < 0.5 else bytes(count))


def zero(data: bytes, rng: Random) -> bytes:
    """Fill a range with zeros or ones."""
    start = _place(data, rng) if data else 0
    count = min(len(data) - start, rng.choice((1, 4, 16, 64, 512, 4096)))
    return (
        data[:start]
        + (bytes(count) if rng.random() < 0.7 else b"\xff" * count)
        + data[start + count :]
    )


def copy(data: bytes, rng: Random) -> bytes:
    """Copy a block over another one, or between two bytes; or take one out."""
    if not data:
        return b"\0"
    start, to = _place(data, rng), _place(data, rng)
    block = data[start : start + rng.choice((1, 4, 8, 24, 64, 512))]
    kind = rng.randrange(3)
    if kind == 0:
        return (data[:to] + block + data[to + len(block) :])[: len(data)]
    return data[:to] + block + data[to:] if kind == 1 else data[:start] + data[start + len(block) :]


def digits(data: bytes, rng: Random) -> bytes:
    """Change a number that is written in digits, without moving what follows it."""
    found = list(_NUMBER.finditer(data[:100_000]))
    if not found:
        return flip(data, rng)
    match = rng.choice(found)
    width = match.end() - match.start()
    text = rng.choice(
        (
            "9" * width,
            "0" * width,
            "-" + "1" * (width - 1),
            "1" + "0" * (width - 1),
            str(rng.randrange(10 ** min(width, 9))),
        )
    )
    return data[: match.start()] + text.ljust(width)[:width].encode() + data[match.end() :]


ANY: tuple[Operator, ...] = (flip, put, number, truncate, extend, zero, copy, digits)
