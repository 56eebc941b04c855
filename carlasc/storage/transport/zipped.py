"""Reading the files in a local or remote zip in place.

The published zips have a million members. `zipfile` creates an object for each, which takes ten
seconds and a gigabyte. This module parses the central directory once (PKWARE's APPNOTE, sections
4.3 and 4.4) into a few NumPy columns.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from carlasc.core.arrays import IntArray
from carlasc.errors import FormatError, MissingDataError
from carlasc.storage.arrays import check_ratio
from carlasc.storage.files import leads_outside
from carlasc.storage.transport.trees import Tree

_END = struct.Struct("<4s4H2LH")  # end of central directory record
_END64_LOCATOR = struct.Struct("<4sLQL")
_END64 = struct.Struct("<4sQ2H2L4Q")
_CENTRAL_SIZE, _LOCAL = 46, struct.Struct("<4s5H3L2H")
# the end record, its longest comment, and the locator before it
_TAIL = _END.size + 65535 + _END64_LOCATOR.size
_STORED, _DEFLATED = 0, 8  # methods
_ENCRYPTED, _UTF8 = 1, 0x800  # flags
# additional bytes to fetch: the extra field of the local header may be longer than in the central
# directory
_SLACK = 64


class ZipTree(Tree):
    """The members of a zip in another tree."""

    def __init__(self, tree: Tree, path: str) -> None:
        """Keep the path of the zip.

        Its central directory is read on first use, once per process.
        """
        self.tree = tree
        self.path = path
        self.location = tree.where(path)

    @cached_property
    def _index(self) -> _Index:
        return read_index(self.tree, self.path)

    def entries(self, folder: str = "") -> Mapping[str, bool]:
        """Return the names in a folder, from the central directory."""
        names = self._index.folders.get(folder, {})
        return {name: number < 0 for name, number in names.items()}

    def is_file(self, path: str) -> bool:
        """Whether a member of that name exists."""
        folder, _, name = path.rpartition("/")
        return self._index.folders.get(folder, {}).get(name, -1) >= 0

    def read(self, path: str, size: int | None = None) -> bytes | memoryview:
        """Read a member and check its checksum."""
        return self.read_many([path], size)[0]

    def read_many(self, paths: Sequence[str], size: int | None = None) -> list[bytes | memoryview]:
        """Read several members; all at once from a remote zip.

        The size and the compression ratio are checked before decompressing.
        """
        members = [self._member(path) for path in paths]
        for path, member in zip(paths, members, strict=True):
            unpacked, packed = (
                int(self._index.columns[name][member]) for name in ("size", "packed")
            )
            if unpacked != size:
                check_ratio(unpacked, packed, self.where(path))
        ranges = [
            (self.path, int(self._index.columns["offset"][m]), self._index.end_of(m))
            for m in members
        ]
        contents = zip(paths, members, self.tree.read_ranges(ranges), strict=True)
        return [self._extract(path, member, memoryview(data)) for path, member, data in contents]

    def read_range(self, path: str, start: int, end: int) -> bytes | memoryview:
        """Return a part of a member. The whole member is read, because it may be compressed."""
        data = self.read(path)
        start, end = (max(0, len(data) + start), len(data) + end) if start < 0 else (start, end)
        if end > len(data):
            raise FormatError(
                self.where(path),
                expected=f"at least {end} bytes",
                found=str(len(data)),
                advice="it may be truncated",
            )
        return data[start:end]

    def _member(self, path: str) -> int:
        folder, _, name = path.rpartition("/")
        member = self._index.folders.get(folder, {}).get(name, -1)
        if member < 0:
            raise MissingDataError(self.where(path), expected="a file", found="nothing")
        return member

    def _extract(self, path: str, member: int, data: memoryview) -> bytes | memoryview:
        """Return the bytes of a member from a range that starts with its local header and may end
        after the member.
        """
        where = self.where(path)
        columns = {name: int(column[member]) for name, column in self._index.columns.items()}
        if columns["flags"] & _ENCRYPTED or columns["method"] not in (_STORED, _DEFLATED):
            raise FormatError(
                where,
                expected="a stored or deflated member",
                found="an encrypted one"
                if columns["flags"] & _ENCRYPTED
                else f"compression {columns['method']}",
                advice="unpack the zip and give the folder",
            )
        header = _LOCAL.unpack_from(data) if len(data) >= _LOCAL.size else (b"",)
        if header[0] != b"PK\x03\x04":
            raise FormatError(
                where,
                expected=f"a member's header at byte {columns['offset']}",
                found="something else",
                advice="the zip is damaged: fetch it again",
            )
        first = _LOCAL.size + header[9] + header[10]
        last = first + columns["packed"]
        if last > len(data):  # the extra field of the local header is longer than expected
            data = memoryview(
                self.tree.read_range(self.path, columns["offset"], columns["offset"] + last)
            )
        packed = data[first:last]
        content: bytes | memoryview = packed
        if columns["method"] == _DEFLATED:
            content = _inflate(packed, columns["size"], where)
        if len(content) != columns["size"] or zlib.crc32(content) != columns["crc"]:
            raise FormatError(
                where,
                expected=f"{columns['size']} bytes with the checksum in the zip",
                found="different bytes",
                advice="the zip is damaged: fetch it again",
            )
        return content

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "_index"}


@dataclass(frozen=True)
class _Index:
    """The central directory of a zip.

    Attributes:
        columns: offset, packed, size, crc, method, flags and further fields, each (M,) for M
            members.
        folders: by folder, the names in it and the member of each; -1 for a folder.
        limit: offset of the central directory; all members end before it.
    """

    columns: dict[str, IntArray]
    folders: dict[str, dict[str, int]]
    limit: int

    def end_of(self, member: int) -> int:
        """Return an upper bound for the end of a member, valid in nearly all zips."""
        columns = self.columns
        reach = (
            columns["offset"][member]
            + _LOCAL.size
            + columns["header"][member]
            + columns["packed"][member]
            + _SLACK
        )
        return min(int(reach), self.limit)


def read_index(tree: Tree, path: str) -> _Index:
    """Read a zip's central directory.

    Raises:
        FormatError: the zip is truncated, its directory is damaged, or a member's name leads out of
            the folder.
    """
    where = tree.where(path)
    count, start, size = _find_directory(tree, path)
    try:
        data = bytes(tree.read_range(path, start, start + size))
    except FormatError as error:
        raise _damaged(where, "one that reaches beyond the end of the file") from error
    positions = _walk(data, count, where)
    columns = _columns(data, positions, where)
    if len(positions) and int((columns["offset"] + _LOCAL.size + columns["packed"]).max()) > start:
        raise _damaged(where, "a member beyond the directory")
    names = _names(data, positions + _CENTRAL_SIZE, columns)
    _check_names(names, where)
    folders: dict[str, dict[str, int]] = {"": {}}
    for member, name in enumerate(names):
        folder, _, base = name.rpartition("/")
        if folder not in folders:
            _add_folder(folders, folder)
        if base:
            folders[folder][base] = member
    return _Index(columns, folders, start)


def _find_directory(tree: Tree, path: str) -> tuple[int, int, int]:
    """Return the number of members, and the offset and length of the central directory."""
    where = tree.where(path)
    try:
        tail = bytes(tree.read_range(path, -_TAIL, 0))
    except FormatError as error:
        raise _damaged(where, "none") from error
    place = tail.rfind(b"PK\x05\x06")
    if place < 0 or len(tail) < place + _END.size:
        raise FormatError(
            where,
            expected="a zip's end record",
            found="none",
            advice="the zip may be truncated: fetch it again",
        )
    _, disk, _, _, count, size, start, _ = _END.unpack_from(tail, place)
    locator = place - _END64_LOCATOR.size
    if locator >= 0 and tail[locator : locator + 4] == b"PK\x06\x07":
        _, _, offset, _ = _END64_LOCATOR.unpack_from(tail, locator)
        try:
            record = _END64.unpack(bytes(tree.read_range(path, offset, offset + _END64.size)))
        except FormatError as error:
            raise _damaged(where, "a 64-bit end record beyond the end of the file") from error
        if record[0] != b"PK\x06\x06":
            raise _damaged(where, "no 64-bit end record where its locator points")
        _, _, _, _, disk, _, _, count, size, start = record
    if disk:
        raise FormatError(
            where, expected="one zip", found="a part of a split zip", advice="join the parts first"
        )
    return count, start, size


def _walk(data: bytes, count: int, where: str) -> IntArray:
    """Return the start of each record of the central directory.

    Records have different lengths, so each start follows from the previous one.
    """
    positions = (
        np.empty(count, np.int64) if count <= len(data) // _CENTRAL_SIZE else np.empty(0, np.int64)
    )
    lengths = struct.Struct("<3H").unpack_from
    position = 0
    for member in range(len(positions)):
        if data[position : position + 4] != b"PK\x01\x02" or position + _CENTRAL_SIZE > len(data):
            raise _damaged(where, f"something else than the record of member {member}")
        positions[member] = position
        name, extra, comment = lengths(data, position + 28)
        position += _CENTRAL_SIZE + name + extra + comment
    if position != len(data) or len(positions) != count:
        raise _damaged(
            where, f"{len(positions)} members in {position} bytes instead of {count} in {len(data)}"
        )
    return positions


def _columns(data: bytes, positions: IntArray, where: str) -> dict[str, IntArray]:
    """Return the fixed fields of all records, with the values of 64-bit extra fields."""
    raw = np.frombuffer(data, np.uint8)

    def column(offset: int, width: int) -> IntArray:
        return sum(
            (raw[positions + offset + i].astype(np.int64) << (8 * i) for i in range(width)),
            np.zeros(len(positions), np.int64),
        )

    columns = {
        "flags": column(8, 2),
        "method": column(10, 2),
        "crc": column(16, 4),
        "packed": column(20, 4),
        "size": column(24, 4),
    }
    columns |= {"name": column(28, 2), "extra": column(30, 2), "offset": column(42, 4)}
    wide = (
        (columns["packed"] == 0xFFFFFFFF)
        | (columns["size"] == 0xFFFFFFFF)
        | (columns["offset"] == 0xFFFFFFFF)
    )
    for member in np.flatnonzero(wide).tolist():
        begin = int(positions[member]) + _CENTRAL_SIZE + int(columns["name"][member])
        _widen(columns, member, data[begin : begin + int(columns["extra"][member])], where)
    columns["header"] = columns["name"] + columns["extra"]
    return columns


def _widen(columns: dict[str, IntArray], member: int, extra: bytes, where: str) -> None:
    position = 0
    while position + 4 <= len(extra):
        kind, length = struct.unpack_from("<2H", extra, position)
        if kind == 1:  # the values that do not fit into 32 bits, in this order
            names = [
                name for name in ("size", "packed", "offset") if columns[name][member] == 0xFFFFFFFF
            ]
            if length < 8 * len(names) or position + 4 + 8 * len(names) > len(extra):
                break
            values = struct.unpack_from(f"<{len(names)}Q", extra, position + 4)
            if max(values, default=0) >= 2**63:
                break
            for name, value in zip(names, values, strict=True):
                columns[name][member] = value
            return
        position += 4 + length
    raise _damaged(where, f"no 64-bit sizes of member {member}")


def _add_folder(folders: dict[str, dict[str, int]], folder: str) -> None:
    """Add a folder and its parents."""
    folders[folder] = {}
    while folder:
        folder, _, name = folder.rpartition("/")
        missing = folder not in folders
        folders.setdefault(folder, {}).setdefault(name, -1)
        if not missing:
            return


def _names(data: bytes, begins: IntArray, columns: dict[str, IntArray]) -> list[str]:
    """Return the names of the members.

    The whole directory is decoded at once; if it is not ASCII, each name separately.
    """
    text = data.decode("latin-1")
    names = [
        text[a:b] for a, b in zip(begins.tolist(), (begins + columns["name"]).tolist(), strict=True)
    ]
    if not "".join(names).isascii():
        for member, name in enumerate(names):
            if not name.isascii():
                encoding = "utf-8" if columns["flags"][member] & _UTF8 else "cp437"
                names[member] = name.encode("latin-1").decode(encoding, "replace")
    return names


def _check_names(names: list[str], where: str) -> None:
    """Check that no name leads out of the folder.

    For nearly every zip, one search in the joined names is enough.
    """
    together = "\n" + "\n".join(names)
    if not any(sign in together for sign in ("..", "\\", "\0", ":", "\n/")):
        return
    for name in names:
        if leads_outside(name):
            raise FormatError(
                where,
                expected="names inside the zip",
                found=repr(name),
                advice="the name leads out of the folder: do not unpack this zip",
            )


def _inflate(content: memoryview, size: int, where: str) -> bytes:
    try:
        # At most one byte more than the size in the directory, to detect longer members.
        return zlib.decompressobj(-15).decompress(content, size + 1)
    except zlib.error as error:
        raise FormatError(
            where,
            problem=f"cannot be decompressed: {error}",
            advice="the zip is damaged: fetch it again",
        ) from error


def _damaged(where: str, found: str) -> FormatError:
    return FormatError(
        where,
        expected="a zip's central directory",
        found=found,
        advice="it is truncated or damaged: fetch it again",
    )
