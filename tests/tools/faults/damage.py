"""How files are damaged: a few operators for any bytes, and some for the containers that carlasc
reads.

All of them are functions of the bytes and of a random number generator, so that a seed repeats a
case.
"""

from __future__ import annotations

import io
import json
import re
import struct
import zipfile
from collections.abc import Sequence
from copy import deepcopy
from pathlib import PurePosixPath
from random import Random
from typing import Any

from faults.bytewise import ANY, Operator, copy, digits, extend, flip, number, put, truncate, zero

Files = dict[str, bytes]
"""The files of a data set by their path in its folder."""
Changes = dict[str, bytes | None]
"""New content by path; None removes the file, and a path that ends in "/" becomes a folder."""

_DEEP = "[" * 300 + "]" * 300
_VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 2, 255, 65536, 2**31 - 1, 2**31, 2**32, 2**63 - 1, 2**63, -(2**63), 2**64, 10**30, 10**400, 0.5,
    -0.0, 1e-320, 1e30, 1e308, -1e308, float("nan"), float("inf"), float("-inf"), "", "0", "x", "../x", "/", "a/b", "a\nb",
    "\x1b[31m", "\u202e<b>", "\ud800", "x" * 5000, [], {}, [[]], {"": 0}, [0] * 50, ["x"] * 3, json.loads(_DEEP),
)  # fmt: skip
_WORDS = (
    "0", "1", "-1", "-0", "2147483648", "4294967296", "9223372036854775808", "1" * 400, "1e308", "1e999", "-1e999", "nan", "-inf",
    "1e-320", "0x10", "1_0", "", "x", "\u0664", "\u202e", "\x00", "\x1b[2J", "1.5", "1,5", "'", '"', "None", "#",
)  # fmt: skip
_NAMES = (
    "999999999999999999999999.bin",
    "000000.bin",
    "-00001.label",
    "\u0664\u0664\u0664\u0664\u0664\u0664.bin",
    "x\ny.json",
    "x",
)


def damage(files: Files, rng: Random) -> Changes:
    """Return what one case changes: mostly the content of one file, sometimes of several, or which
    files exist.
    """
    changes: Changes = {}
    for _ in range(1 if rng.random() < 0.8 else rng.randint(2, 4)):
        path = _choose_file(files, rng)
        now = changes.get(path)
        data = files[path] if now is None else now
        if rng.random() < 0.04:
            changes |= _rearrange(files, path, rng)
        elif rng.random() < 0.06:
            changes[path] = _from_others(data, files, path, rng)
        else:
            changes[path] = change(data, rng)
    return changes


def change(data: bytes, rng: Random) -> bytes:
    """Return bytes with one change, which suits their format four times out of five."""
    operators = _suited(data)
    return rng.choice(operators if operators and rng.random() < 0.8 else ANY)(data, rng)


def _choose_file(files: Files, rng: Random) -> str:
    """Return a file: kinds of files have equal chances, so that scans do not hide the few
    documents.
    """
    kinds: dict[str, list[str]] = {}
    for path in files:
        folder, name = PurePosixPath(path).parent, PurePosixPath(path).name
        kinds.setdefault(
            f"{folder.name if '/c/' not in path else folder}/{re.sub('[0-9]+', '0', name)}", []
        ).append(path)
    return rng.choice(kinds[rng.choice(sorted(kinds))])


def _rearrange(files: Files, path: str, rng: Random) -> Changes:
    """Remove a file, make a folder in its place, rename it, give it another one's name, or add one
    with an odd name.
    """
    other, kind = rng.choice(sorted(files)), rng.randrange(5)
    beside = str(PurePosixPath(path).with_name(rng.choice(_NAMES)))
    if kind == 0:
        return {path: None}
    if kind == 1:
        return {f"{path}/": None}
    if kind == 2:
        return {path: None, beside: files[path]}
    return {path: files[other], other: files[path]} if kind == 3 else {beside: files[path]}


def _from_others(data: bytes, files: Files, path: str, rng: Random) -> bytes:
    """Return bytes made of two files: the head of one and the tail of the other, or all of the
    other.
    """
    alike = [name for name in files if PurePosixPath(name).suffix == PurePosixPath(path).suffix]
    other = files[rng.choice(alike if rng.random() < 0.7 else sorted(files))]
    if rng.random() < 0.3:
        return other
    return data[: rng.randint(0, len(data))] + other[rng.randint(0, len(other)) :]


# Formats


def _suited(data: bytes) -> Sequence[Operator]:
    """Return the operators for the format of some bytes; those for any bytes are among them where
    offsets matter.
    """
    head = data[:8]
    if head.startswith(b"PK"):
        return (_zip, _zip, number)
    if head.startswith(b"\x93NUMPY"):
        return (_npy, _npy, number)
    if head[:1] in (b"{", b"["):
        return (_json, _json, _json, _json, _words)
    if head.startswith(b"\x89HDF"):
        return (number, number, put, flip, copy, digits, zero)
    if b"\0" not in data[:4096] and _is_text(data[:4096]):
        return (_words, _words, _lines)
    return (_checked, _checked, number) if _is_checked(data) else ()


def _is_text(data: bytes) -> bool:
    return (
        sum((byte < 32 and byte not in (9, 10, 13)) or byte > 126 for byte in data)
        <= len(data) // 50
    )


def _json(data: bytes, rng: Random) -> bytes:
    """Replace, remove, rename, double or exchange a value of a JSON document."""
    try:
        value = json.loads(data)
    except ValueError:
        return _words(data, rng)
    places = _places(value)
    if not places:
        return json.dumps(rng.choice(_VALUES)).encode()
    container, key = rng.choice(places)
    kind = rng.random()
    if kind < 0.55:
        container[key] = _near(container[key], rng) if rng.random() < 0.4 else rng.choice(_VALUES)
    elif kind < 0.75:
        del container[key]
    elif kind < 0.85:
        other, name = rng.choice(places)
        container[key] = deepcopy(other[name])
    elif isinstance(container, dict):
        container[rng.choice(("", "x", "../x", str(key) + " ", "format", "carlasc", "classes"))] = (
            container.pop(key)
        )
    else:
        container.insert(key, deepcopy(container[key]))
    text = json.dumps(value)
    return text.encode() if rng.random() < 0.98 else text.encode("utf-16")


def _near(value: Any, rng: Random) -> Any:
    """Return a value of the same type that is a little different."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int | float):
        return rng.choice(
            (value + 1, value - 1, -value, value * 2, value * 1000, value // 3, str(value))
        )
    if isinstance(value, str):
        return rng.choice(
            (
                value[:-1],
                value + "x",
                value.upper(),
                value + "\n",
                value.replace("/", "/../"),
                [value],
            )
        )
    if isinstance(value, list):
        return rng.choice(
            (
                value[:-1],
                value * 2,
                value[::-1],
                value[:1] * 100,
                {str(i): v for i, v in enumerate(value)},
            )
        )
    return list(value.values()) if isinstance(value, dict) else value


def _places(value: Any) -> list[tuple[Any, Any]]:
    """Return (container, key) of every value inside a JSON value."""
    found: list[tuple[Any, Any]] = []
    waiting = [value]
    while waiting:
        container = waiting.pop()
        if isinstance(container, dict | list):
            keys = list(container) if isinstance(container, dict) else range(len(container))
            found += [(container, key) for key in keys]
            waiting += [container[key] for key in keys]
    return found


def _words(data: bytes, rng: Random) -> bytes:
    """Replace, remove or double a word of a text."""
    text = data.decode("utf-8", "surrogateescape")
    words = list(re.finditer(r"[\w.+-]+", text)) or [re.match("", text)]
    match = rng.choice(words)
    assert match is not None
    word = rng.choice(
        (
            rng.choice(_WORDS),
            rng.choice(_WORDS),
            "",
            match[0] * 2,
            words[-1][0] if words[-1] else "",
        )
    )  # type: ignore[index]
    return (text[: match.start()] + word + text[match.end() :]).encode("utf-8", "surrogateescape")


def _lines(data: bytes, rng: Random) -> bytes:
    """Remove, double, exchange, join or cut a line of a text."""
    lines = data.split(b"\n")
    row, other, kind = rng.randrange(len(lines)), rng.randrange(len(lines)), rng.randrange(6)
    if kind == 0:
        del lines[row]
    elif kind == 1:
        lines[row:row] = [lines[row]] * rng.choice((1, 1, 2, 100))
    elif kind == 2:
        lines[row], lines[other] = lines[other], lines[row]
    elif kind == 3:
        lines[row] = lines[row][: rng.randint(0, len(lines[row]))]
    elif kind == 4:
        lines[row] += rng.choice((b" 1", b"\r", b"\x0b", b"\x85", b" x", b"\0")) + lines[other]
    else:
        lines = lines[: row + 1]
    return b"\n".join(lines)


def _zip(data: bytes, rng: Random) -> bytes:
    """Change one member of a zip, whose checksum is right again, or its name or compression."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [(info, archive.read(info)) for info in archive.infolist()]
    except Exception:  # noqa: BLE001 (it was damaged before)
        return number(data, rng)
    if not members:
        return extend(data, rng)
    chosen, kind = rng.randrange(len(members)), rng.random()
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for place, (info, content) in enumerate(members):
            name, method = info.filename, info.compress_type
            if place == chosen:
                if kind < 0.7:
                    content = change(content, rng)  # noqa: PLW2901
                elif kind < 0.8:
                    continue
                elif kind < 0.9:
                    name = rng.choice(
                        ("x", "../x", "/x", name + "/", name.upper(), members[0][0].filename)
                    )
                else:
                    method = rng.choice(
                        (
                            zipfile.ZIP_STORED,
                            zipfile.ZIP_DEFLATED,
                            zipfile.ZIP_BZIP2,
                            zipfile.ZIP_LZMA,
                        )
                    )
            _add(archive, name, content, method)
    return out.getvalue()


def _add(archive: zipfile.ZipFile, name: str, content: bytes, method: int) -> None:
    info = zipfile.ZipInfo(name)
    info.compress_type = method
    archive.NameToInfo.pop(name, None)  # no warning of a name that occurs twice
    archive.writestr(info, content)


_TYPES = (
    "<f4",
    "<f8",
    ">f4",
    "<i8",
    "|u1",
    "|b1",
    "|O",
    "<U3",
    "|S0",
    "<c16",
    "<M8[s]",
    "|V8",
    "<f2",
    "<f16",
)


def _npy(data: bytes, rng: Random) -> bytes:
    """Change the header of a .npy file, whose length is right again, or the values."""
    length = int.from_bytes(data[8:10], "little")
    header, values = data[10 : 10 + length], data[10 + length :]
    kind = rng.random()
    if kind < 0.25:
        header = re.sub(rb"'descr': [^,]*", f"'descr': '{rng.choice(_TYPES)}'".encode(), header)
    elif kind < 0.5:
        shape = rng.choice(
            (
                "()",
                "(0,)",
                "(-1,)",
                "(3,)",
                "(2, 2)",
                "(1, 1, 1)",
                f"({2**62},)",
                f"({2**31}, {2**31})",
                "(1e3,)",
                "(None,)",
            )
        )
        header = re.sub(rb"'shape': \([^)]*\)", f"'shape': {shape}".encode(), header)
    elif kind < 0.75:
        header = _words(header, rng)
    else:
        values = rng.choice(ANY)(values, rng)
    return data[:8] + len(header).to_bytes(4, "little")[:2] + header + values


# Chunks with a crc32c, as in zarr stores

_PER_SHARD = (16, 256)  # numbers of chunks that the shards of grids and of columns have room for


def _seal(body: bytes) -> bytes:
    """Return bytes with their crc32c."""
    import google_crc32c

    return body + google_crc32c.value(body).to_bytes(4, "little")


def _is_sealed(data: bytes) -> bool:
    return len(data) > 4 and _seal(data[:-4]) == data


def _find_index(data: bytes) -> tuple[int, int] | None:
    """Return the start and the end of the index of a shard; None if the bytes are no shard."""
    for size in (16 * count + 4 for count in _PER_SHARD):
        if len(data) > size and _is_sealed(data[:size]):
            return 0, size
    return None


def _is_checked(data: bytes) -> bool:
    try:
        return _is_sealed(data) or _find_index(data) is not None
    except ModuleNotFoundError:
        return False


def _checked(data: bytes, rng: Random) -> bytes:
    """Change a chunk, or the index of a shard, and make the checksums right again: what a decoder
    meets that trusts them.
    """
    if _is_sealed(data):
        return _seal(change(data[:-4], rng))
    place = _find_index(data)
    if place is None:
        return number(data, rng)
    first, last = place
    index = bytearray(data[first : last - 4])
    entries = [
        entry
        for entry in range(0, len(index), 16)
        if struct.unpack_from("<Q", index, entry)[0] < len(data)
    ]
    if not entries or rng.random() < 0.25:
        return data[:first] + _seal(number(bytes(index), rng)) + data[last:]
    entry = rng.choice(entries)
    start, length = struct.unpack_from("<QQ", index, entry)
    body = rng.choice((flip, put, number, zero, truncate, copy))(
        data[start : start + length - 4], rng
    )
    body = _seal(body[: length - 4])
    struct.pack_into("<Q", index, entry + 8, len(body))
    changed = bytearray(data)
    changed[start : start + len(body)] = body
    changed[first:last] = _seal(bytes(index))
    return bytes(changed)
