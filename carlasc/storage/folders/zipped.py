"""The inside of a zip, read in place: a local one or one behind a URL, member by member, by ranges of bytes.

The published zips hold a million members. `zipfile` makes an object of each, which takes ten seconds and a gigabyte; here
the central directory is walked once (PKWARE's APPNOTE, sections 4.3 and 4.4) and kept as a few NumPy columns.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import FormatError, MissingDataError
from carlasc.storage.folders.trees import Tree

_END = struct.Struct("<4s4H2LH")  # end of central directory record
_END64_LOCATOR = struct.Struct("<4sLQL")
_END64 = struct.Struct("<4sQ2H2L4Q")
_CENTRAL_SIZE, _LOCAL = 46, struct.Struct("<4s5H3L2H")
_TAIL = _END.size + 65535 + _END64_LOCATOR.size  # the end record, its comment, and the locator before it
_STORED, _DEFLATED = 0, 8  # methods
_ENCRYPTED, _UTF8 = 1, 0x800  # flags
_SLACK = 64  # the local header's extra field may be longer than the central one's: fetch a little more than is said


class ZipTree(Tree):
    """The members of a zip that stands in another tree."""

    def __init__(self, tree: Tree, path: str) -> None:
        """Remember where the zip is; its directory is read when it is first needed, once per process."""
        self.tree = tree
        self.path = path
        self.location = tree.where(path)

    @cached_property
    def _index(self) -> _Index:
        return read_index(self.tree, self.path)

    def entries(self, folder: str = "") -> Mapping[str, bool]:
        """Return what the central directory has of a folder."""
        found = self._index.folders.get(folder, {})
        return {name: number < 0 for name, number in found.items()}

    def is_file(self, path: str) -> bool:
        """Whether there is a member of that name."""
        folder, _, name = path.rpartition("/")
        return self._index.folders.get(folder, {}).get(name, -1) >= 0

    def read(self, path: str) -> bytes | memoryview:
        """Read a member and check its checksum."""
        return self.read_many([path])[0]

    def read_many(self, paths: Sequence[str]) -> list[bytes | memoryview]:
        """Read several members; from a remote zip all at once."""
        members = [self._member(path) for path in paths]
        ranges = [(self.path, int(self._index.columns["offset"][m]), self._index.end_of(m)) for m in members]
        found = zip(paths, members, self.tree.read_ranges(ranges), strict=True)
        return [self._extract(path, member, memoryview(data)) for path, member, data in found]

    def read_range(self, path: str, start: int, end: int) -> bytes | memoryview:
        """Return a part of a member, which is read whole: it may be compressed."""
        data = self.read(path)
        start, end = (max(0, len(data) + start), len(data) + end) if start < 0 else (start, end)
        if end > len(data):
            raise FormatError(
                self.where(path), expected=f"at least {end} bytes", found=f"{len(data)}", advice="cut short?"
            )
        return data[start:end]

    def _member(self, path: str) -> int:
        folder, _, name = path.rpartition("/")
        member = self._index.folders.get(folder, {}).get(name, -1)
        if member < 0:
            raise MissingDataError(self.where(path), expected="a file", found="nothing")
        return member

    def _extract(self, path: str, member: int, data: memoryview) -> bytes | memoryview:
        """Take a member's bytes out of the range that holds its local header and, it may be, a little more."""
        where = self.where(path)
        columns = {name: int(column[member]) for name, column in self._index.columns.items()}
        if columns["flags"] & _ENCRYPTED or columns["method"] not in (_STORED, _DEFLATED):
            raise FormatError(
                where,
                expected="a stored or deflated member",
                found=f"{'an encrypted one' if columns['flags'] & _ENCRYPTED else 'compression ' + str(columns['method'])}",
                advice="unpack the zip and give the folder",
            )
        header = _LOCAL.unpack_from(data) if len(data) >= _LOCAL.size else (b"",)
        if header[0] != b"PK\x03\x04":
            raise FormatError(
                where,
                expected=f"a member's header at byte {columns['offset']}",
                found="something else",
                advice="damaged zip",
            )
        first = _LOCAL.size + header[9] + header[10]
        last = first + columns["packed"]
        if last > len(data):  # a long extra field in the local header only
            data = memoryview(self.tree.read_range(self.path, columns["offset"], columns["offset"] + last))
        packed = data[first:last]
        content: bytes | memoryview = packed
        if columns["method"] == _DEFLATED:
            content = _inflate(packed, columns["size"], where)
        if len(content) != columns["size"] or zlib.crc32(content) != columns["crc"]:
            raise FormatError(
                where,
                expected=f"{columns['size']} bytes with the zip's checksum",
                found="others",
                advice="damaged zip, fetch it again",
            )
        return content

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "_index"}


@dataclass(frozen=True)
class _Index:
    """The central directory of a zip.

    Attributes:
        columns: offset, packed, size, crc, method, flags: (M,) each, a member a row.
        folders: names by folder, and of each its row; -1 for a folder.
        limit: where the central directory starts: no member goes beyond.
    """

    columns: dict[str, NDArray[np.int64]]
    folders: dict[str, dict[str, int]]
    limit: int

    def end_of(self, member: int) -> int:
        """Return an offset up to which a member surely, or almost surely, reaches."""
        columns = self.columns
        reach = columns["offset"][member] + _LOCAL.size + columns["header"][member] + columns["packed"][member] + _SLACK
        return min(int(reach), self.limit)


def read_index(tree: Tree, path: str) -> _Index:
    """Read a zip's central directory.

    Raises:
        FormatError: the zip is cut short, its directory is wrong, or a name would lead out of the folder it is unpacked to.
    """
    where = tree.where(path)
    count, start, size = _find_directory(tree, path)
    try:
        data = bytes(tree.read_range(path, start, start + size))
    except FormatError as error:
        raise _damaged(where, "one that reaches beyond the end") from error
    positions = _walk(data, count, where)
    columns = _columns(data, positions, where)
    if len(positions) and int((columns["offset"] + _LOCAL.size + columns["packed"]).max()) > start:
        raise _damaged(where, "a member that lies beyond the directory")
    names = _names(data, positions + _CENTRAL_SIZE, columns)
    _refuse_traversal(names, where)
    folders: dict[str, dict[str, int]] = {"": {}}
    for member, name in enumerate(names):
        folder, _, base = name.rpartition("/")
        if folder not in folders:
            _add_folder(folders, folder)
        if base:
            folders[folder][base] = member
    return _Index(columns, folders, start)


def _find_directory(tree: Tree, path: str) -> tuple[int, int, int]:
    """Return how many members the zip says it has, and where its central directory starts and how long it is."""
    where = tree.where(path)
    try:
        tail = bytes(tree.read_range(path, -_TAIL, 0))
    except FormatError as error:
        raise _damaged(where, "nothing") from error
    found = tail.rfind(b"PK\x05\x06")
    if found < 0 or len(tail) < found + _END.size:
        raise FormatError(
            where, expected="a zip's end record", found="none", advice="cut short? Fetch the rest, or all of it again"
        )
    _, disk, _, _, count, size, start, _ = _END.unpack_from(tail, found)
    locator = found - _END64_LOCATOR.size
    if locator >= 0 and tail[locator : locator + 4] == b"PK\x06\x07":
        _, _, offset, _ = _END64_LOCATOR.unpack_from(tail, locator)
        try:
            record = _END64.unpack(bytes(tree.read_range(path, offset, offset + _END64.size)))
        except FormatError as error:
            raise _damaged(where, "a directory beyond its end") from error
        if record[0] != b"PK\x06\x06":
            raise _damaged(where, "no 64-bit end record where one is announced")
        _, _, _, _, disk, _, _, count, size, start = record
    if disk:
        raise FormatError(where, expected="one zip", found="a part of several", advice="join them first")
    return count, start, size


def _walk(data: bytes, count: int, where: str) -> NDArray[np.int64]:
    """Return where each record of the central directory starts: they differ in length, so one follows from the other."""
    positions = np.empty(count, np.int64) if count <= len(data) // _CENTRAL_SIZE else np.empty(0, np.int64)
    lengths = struct.Struct("<3H").unpack_from
    position = 0
    for member in range(len(positions)):
        if data[position : position + 4] != b"PK\x01\x02" or position + _CENTRAL_SIZE > len(data):
            raise _damaged(where, f"something else than member {member}'s record")
        positions[member] = position
        name, extra, comment = lengths(data, position + 28)
        position += _CENTRAL_SIZE + name + extra + comment
    if position != len(data) or len(positions) != count:
        raise _damaged(where, f"{position} bytes of records where {len(data)} and {count} members are announced")
    return positions


def _columns(data: bytes, positions: NDArray[np.int64], where: str) -> dict[str, NDArray[np.int64]]:
    """Read the fixed fields of all records, and the 64-bit extra field of those that have one."""
    raw = np.frombuffer(data, np.uint8)

    def column(offset: int, width: int) -> NDArray[np.int64]:
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
    wide = (columns["packed"] == 0xFFFFFFFF) | (columns["size"] == 0xFFFFFFFF) | (columns["offset"] == 0xFFFFFFFF)
    for member in np.flatnonzero(wide).tolist():
        begin = int(positions[member]) + _CENTRAL_SIZE + int(columns["name"][member])
        _widen(columns, member, data[begin : begin + int(columns["extra"][member])], where)
    columns["header"] = columns["name"] + columns["extra"]
    return columns


def _widen(columns: dict[str, NDArray[np.int64]], member: int, extra: bytes, where: str) -> None:
    position = 0
    while position + 4 <= len(extra):
        kind, length = struct.unpack_from("<2H", extra, position)
        if kind == 1:  # the values that did not fit, in this order
            names = [name for name in ("size", "packed", "offset") if columns[name][member] == 0xFFFFFFFF]
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
    """Add a folder and those above it."""
    folders[folder] = {}
    while folder:
        folder, _, name = folder.rpartition("/")
        missing = folder not in folders
        folders.setdefault(folder, {}).setdefault(name, -1)
        if not missing:
            return


def _names(data: bytes, begins: NDArray[np.int64], columns: dict[str, NDArray[np.int64]]) -> list[str]:
    """Return the members' names; all of the directory is decoded at once, and again only where that was not ASCII."""
    text = data.decode("latin-1")
    names = [text[a:b] for a, b in zip(begins.tolist(), (begins + columns["name"]).tolist(), strict=True)]
    if not "".join(names).isascii():
        for member, name in enumerate(names):
            if not name.isascii():
                encoding = "utf-8" if columns["flags"][member] & _UTF8 else "cp437"
                names[member] = name.encode("latin-1").decode(encoding, "replace")
    return names


def _refuse_traversal(names: list[str], where: str) -> None:
    """Refuse names that lead out of the folder that a zip is unpacked to; one look at all of them clears nearly every zip."""
    together = "\n" + "\n".join(names)
    if not any(sign in together for sign in ("..", "\\", "\0", ":", "\n/")):
        return
    for name in names:
        if ".." in name.split("/") or name.startswith("/") or "\\" in name or "\0" in name or name[1:2] == ":":
            raise FormatError(
                where,
                expected="names inside the zip",
                found=f"{name!r}",
                advice="it leads elsewhere, do not unpack this zip",
            )


def _inflate(content: memoryview, size: int, where: str) -> bytes:
    try:
        return zlib.decompressobj(-15).decompress(
            content, size + 1
        )  # never more than the directory says, plus one to notice
    except zlib.error as error:
        raise FormatError(f"{where}: cannot be decompressed: {error}: damaged zip, fetch it again") from error


def _damaged(where: str, found: str) -> FormatError:
    return FormatError(
        where, expected="a zip's central directory", found=f"{found}", advice="cut short or damaged, fetch it again"
    )
