"""Reading the files in a local or remote zip in place.

The published zips have a million members. `zipfile` creates an object for each, which takes ten
seconds and a gigabyte. This module parses the central directory once (PKWARE's APPNOTE, sections
4.3 and 4.4) into a few NumPy columns.
"""

from __future__ import annotations

import stat
import struct
import zlib
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from carlasc.core.arrays import IntArray
from carlasc.errors import FormatError, MissingDataError
from carlasc.storage.arrays import check_ratio
from carlasc.storage.files import leads_outside
from carlasc.storage.transport.trees import Tree, check_length, from_start

_END = struct.Struct("<4s4H2LH")  # end of central directory record
_END64_LOCATOR = struct.Struct("<4sLQL")
_END64 = struct.Struct("<4sQ2H2L4Q")
_LOCAL = struct.Struct("<4s5H3L2H")
# the fixed fields of a record of the central directory that are used
_RECORD = np.dtype(
    {
        "names": ("flags", "method", "crc", "packed", "size", "name", "extra", "mode", "offset"),
        "formats": ("<u2", "<u2", "<u4", "<u4", "<u4", "<u2", "<u2", "<u2", "<u4"),
        "offsets": (8, 10, 16, 20, 24, 28, 30, 40, 42),
        "itemsize": 46,
    }
)
_LENGTHS = struct.Struct("<3H")  # of the name, the extra field and the comment, at byte 28
_WIDE = 0xFFFFFFFF  # the value is in the 64-bit extra field
# the end record, its longest comment, and the locator before it
_TAIL = _END.size + 65535 + _END64_LOCATOR.size
# methods
_STORED = 0
_DEFLATED = 8
# flags
_ENCRYPTED = 1
_UTF8 = 0x800
# additional bytes to fetch: the extra field of the local header may be longer than in the central
# directory
_SLACK = 64

_Columns = dict[str, IntArray]
_Folders = dict[str, dict[str, int]]


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
    def _index(self) -> tuple[_Columns, _Folders]:
        return read_index(self.tree, self.path)

    def _number(self, path: str) -> int:
        """Return the number of a member; -1 if there is none."""
        folder, _, name = path.rpartition("/")
        return self._index[1].get(folder, {}).get(name, -1)

    def entries(self, folder: str = "") -> Mapping[str, bool]:
        """Return the names in a folder, from the central directory."""
        return {name: number < 0 for name, number in self._index[1].get(folder, {}).items()}

    def is_file(self, path: str) -> bool:
        """Whether a member of that name exists."""
        return self._number(path) >= 0

    def states(self, paths: Sequence[str]) -> dict[str, str]:
        """Return the state of the zip for each member."""
        return dict.fromkeys(paths, self.tree.states([self.path])[self.path])

    def sizes(self) -> dict[str, int]:
        """Return the unpacked sizes of all files, by path."""
        columns, folders = self._index
        return {
            f"{folder}/{name}" if folder else name: int(columns["size"][number])
            for folder, names in folders.items()
            for name, number in names.items()
            if number >= 0
        }

    def read_many(self, paths: Sequence[str], size: int | None = None) -> list[bytes | memoryview]:
        """Read several members and check their checksums; all at once from a remote zip.

        The size and the compression ratio are checked before decompressing.
        """
        members = []
        for path in paths:
            if (number := self._number(path)) < 0:
                raise MissingDataError(self.where(path), expected="a file", found="nothing")
            member = {name: int(column[number]) for name, column in self._index[0].items()}
            if member["size"] != size:
                check_ratio(member["size"], member["packed"], self.where(path))
            members.append(member)
        ranges = [(self.path, member["offset"], member["end"]) for member in members]
        contents = zip(paths, members, self.tree.read_ranges(ranges), strict=True)
        return [self._extract(path, member, memoryview(data)) for path, member, data in contents]

    def read_range(self, path: str, start: int, end: int) -> bytes | memoryview:
        """Return a part of a member. The whole member is read, because it may be compressed."""
        data = self.read(path)
        start, end = from_start(start, end, len(data))
        return check_length(data[start:end], end - start, self.where(path))

    def _extract(self, path: str, member: dict[str, int], data: memoryview) -> bytes | memoryview:
        """Return the bytes of a member from a range that starts with its local header and may end
        after the member.
        """
        where = self.where(path)
        is_encrypted = member["flags"] & _ENCRYPTED
        if is_encrypted or member["method"] not in (_STORED, _DEFLATED):
            raise FormatError(
                where,
                expected="a stored or deflated member",
                found="an encrypted one" if is_encrypted else f"compression {member['method']}",
                advice="unpack the zip and give the folder",
            )
        header = _LOCAL.unpack_from(data) if len(data) >= _LOCAL.size else (b"",)
        if header[0] != b"PK\x03\x04":
            raise _damaged(where, "something else", f"a member's header at byte {member['offset']}")
        first = _LOCAL.size + header[9] + header[10]
        last = first + member["packed"]
        if last > len(data):  # the extra field of the local header is longer than expected
            offset = member["offset"]
            data = memoryview(self.tree.read_range(self.path, offset, offset + last))
        content: bytes | memoryview = data[first:last]
        expected = f"{member['size']} bytes with the checksum in the zip"
        if member["method"] == _DEFLATED:
            try:
                # At most one byte more than the size in the directory, to detect longer members.
                content = zlib.decompressobj(-15).decompress(content, member["size"] + 1)
            except zlib.error as error:
                raise _damaged(where, str(error), expected) from error
        if len(content) != member["size"] or zlib.crc32(content) != member["crc"]:
            raise _damaged(where, "different bytes", expected)
        return content

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "_index"}


def read_index(tree: Tree, path: str) -> tuple[_Columns, _Folders]:
    """Read a zip's central directory.

    Returns:
        The fields of `_RECORD`, and "end", an upper bound for the end of the member that is valid
        in nearly all zips, each (M,) for M members; by folder, the names in it and the number of
        the member, -1 for a folder.

    Raises:
        FormatError: the zip is truncated, its directory is damaged, or a member is a link or its
            name leads out of the folder.
    """
    where = tree.where(path)
    count, start, size = _find_directory(tree, path)
    try:
        data = bytes(tree.read_range(path, start, start + size))
    except FormatError as error:
        raise _damaged(where, "one that reaches beyond the end of the file") from error
    positions = _walk(data, count, where)
    columns = _columns(data, positions, where)
    ends = columns["offset"] + _LOCAL.size + columns["packed"]
    if ends.max(initial=0) > start:
        raise _damaged(where, "a member beyond the directory")
    columns["end"] = np.minimum(ends + columns["name"] + columns["extra"] + _SLACK, start)
    names = _names(data, positions + _RECORD.itemsize, columns)
    _check_names(names, where)
    for number in np.flatnonzero(columns["mode"] >> 12 == stat.S_IFLNK >> 12).tolist()[:1]:
        raise FormatError(
            where,
            expected="files",
            found=f"the link {names[number]!r}",
            advice="do not unpack this zip",
        )
    folders: _Folders = {"": {}}
    for number, name in enumerate(names):
        folder, _, base = name.rpartition("/")
        if folder not in folders:
            _add_folder(folders, folder)
        if base:
            folders[folder][base] = number
    return columns, folders


def _find_directory(tree: Tree, path: str) -> tuple[int, int, int]:
    """Return the number of members, and the offset and length of the central directory."""
    where = tree.where(path)
    tail = bytes(tree.read_range(path, -_TAIL, 0))
    place = tail.rfind(b"PK\x05\x06")
    if place < 0 or len(tail) < place + _END.size:
        raise _damaged(where, "none", "a zip's end record")
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
    positions = np.empty(min(count, len(data) // _RECORD.itemsize), np.int64)
    position = 0
    for member in range(len(positions)):
        if data[position : position + 4] != b"PK\x01\x02" or position + _RECORD.itemsize > len(
            data
        ):
            raise _damaged(where, f"something else than the record of member {member}")
        positions[member] = position
        position += _RECORD.itemsize + sum(_LENGTHS.unpack_from(data, position + 28))
    if position != len(data) or len(positions) != count:
        raise _damaged(
            where, f"{len(positions)} members in {position} bytes instead of {count} in {len(data)}"
        )
    return positions


def _columns(data: bytes, positions: IntArray, where: str) -> _Columns:
    """Return the fixed fields of all records, with the values of 64-bit extra fields."""
    raw = np.frombuffer(data + bytes(_RECORD.itemsize), np.uint8)
    windows = np.lib.stride_tricks.sliding_window_view(raw, _RECORD.itemsize)
    records = windows[positions].view(_RECORD)[:, 0]
    columns = {name: records[name].astype(np.int64) for name in _RECORD.names or ()}
    values = [columns[name] for name in ("size", "packed", "offset")]
    for member in np.flatnonzero(np.any(np.equal(values, _WIDE), axis=0)).tolist():
        begin = int(positions[member]) + _RECORD.itemsize + int(columns["name"][member])
        extra = data[begin : begin + int(columns["extra"][member])]
        wide = [column for column in values if column[member] == _WIDE]
        found = _wide_values(extra, len(wide))
        if len(found) != len(wide):
            raise _damaged(where, f"no 64-bit sizes of member {member}")
        for column, value in zip(wide, found, strict=True):
            column[member] = value
    return columns


def _wide_values(extra: bytes, count: int) -> tuple[int, ...]:
    """Return the first values of the 64-bit extra field; nothing if it lacks them."""
    while len(extra) >= 4:
        kind, length = struct.unpack_from("<2H", extra)
        if kind == 1:  # the values that do not fit into 32 bits
            if min(length, len(extra) - 4) < 8 * count:
                return ()
            values = struct.unpack_from(f"<{count}Q", extra, 4)
            return values if max(values) < 2**63 else ()
        extra = extra[4 + length :]
    return ()


def _add_folder(folders: _Folders, folder: str) -> None:
    """Add a folder and its parents."""
    folders[folder] = {}
    while folder:
        folder, _, name = folder.rpartition("/")
        missing = folder not in folders
        folders.setdefault(folder, {}).setdefault(name, -1)
        if not missing:
            return


def _names(data: bytes, begins: IntArray, columns: _Columns) -> list[str]:
    """Return the names of the members, in UTF-8 or in code page 437."""
    ends = begins + columns["name"]
    are_utf8 = columns["flags"] & _UTF8
    names = []
    for begin, end, is_utf8 in zip(begins.tolist(), ends.tolist(), are_utf8.tolist(), strict=True):
        name = data[begin:end]
        encoding = "utf-8" if is_utf8 or name.isascii() else "cp437"
        names.append(name.decode(encoding, "replace"))
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
                expected="names inside the folder",
                found=repr(name),
                advice="the name leads out of the folder: do not unpack this zip",
            )


def _damaged(where: str, found: str, expected: str = "a zip's central directory") -> FormatError:
    advice = "the zip is damaged or truncated: fetch it again"
    return FormatError(where, expected=expected, found=found, advice=advice)
