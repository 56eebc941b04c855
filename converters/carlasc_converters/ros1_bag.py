"""Files of ROS 1, `.bag` version 2.0: records of chunks, as https://wiki.ros.org/Bags/Format/2.0
describes them.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from struct import unpack, unpack_from
from typing import BinaryIO

import numpy as np

from carlasc.core.arrays import RecordArray
from carlasc.errors import FormatError
from carlasc_converters.bag_messages import Channel, FileIndex, decompressed, ros_type
from carlasc_converters.files import Version, version_of

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE = 2
_HEADER = 3
_INDEX = 4
_CHUNK = 5
_CONNECTION = 7
_LONGEST_HEADER = 1 << 20
_EXPECTED = "a message in the chunk at byte {}"
_ENTRY = np.dtype([("s", "<u4"), ("ns", "<u4"), ("offset", "<u4")])

_Fields = dict[bytes, bytes]


def index_file(path: Path) -> FileIndex:
    """Return the index of the messages of a file."""
    index = FileIndex(str(path))
    size = path.stat().st_size
    at = len(MAGIC)
    chunk = -1
    entries = list[tuple[int, RecordArray]]()
    closed = False
    with path.open("rb") as file:
        while at < size:
            try:
                fields, begin, end = _record_at(file, at)
                kind = fields[b"op"][0]
                if end > size:
                    raise EOFError
                if kind == _HEADER:
                    closed = 0 < _number(fields, b"index_pos") <= size
                elif kind == _CHUNK:
                    _add_chunk(index, chunk, entries)
                    chunk = at
                    entries = []
                elif kind == _INDEX:
                    file.seek(begin)
                    entries.append(
                        (_number(fields, b"conn"), np.frombuffer(file.read(end - begin), _ENTRY))
                    )
                elif kind == _CONNECTION:
                    file.seek(begin)
                    _learn(index, fields, file.read(end - begin))
            except (EOFError, KeyError, ValueError, struct.error):
                index.lost = (
                    f"it is cut short or damaged at byte {at} of {size}, and what follows is lost"
                )
                entries = []  # the index of the last chunk may not be whole
                break
            at = end
    if index.lost is None and not closed:
        index.lost = "its recorder did not close it, and data that were not written yet are lost"
    try:
        _add_chunk(index, chunk, entries)
    except FormatError:
        if index.lost is None:
            raise  # otherwise the last chunk is lost too
    return index


def read_message(path: str, chunk: int, offset: int) -> bytes:
    """Return the content of a message.

    Raises:
        FormatError: the file has no message there.
    """
    data = _read_chunk(path, chunk, version_of(path))
    try:
        kind, _, begin, end = next(
            record for record in _records(data, offset) if record[0] != _CONNECTION
        )
    except (KeyError, StopIteration, struct.error) as error:
        raise FormatError(
            path, expected=_EXPECTED.format(chunk), found=f"damage ({error!r})"
        ) from error
    if kind != _MESSAGE or end > len(data):
        raise FormatError(path, expected=_EXPECTED.format(chunk), found=f"a record of kind {kind}")
    return data[begin:end]


def _add_chunk(index: FileIndex, chunk: int, entries: list[tuple[int, RecordArray]]) -> None:
    """Add the messages of a chunk, from its index if there is one, or from its content."""
    if chunk < 0:
        return
    if not entries or any(connection not in index.channels for connection, _ in entries):
        try:
            _scan_chunk(index, chunk)
            return
        except FormatError:
            if not entries:
                raise
            # The connections may be known later; reading its frames reports the damage.
    for number, rows in entries:
        index.add(number, chunk, rows["s"].astype(np.int64) * 10**9 + rows["ns"], rows["offset"])


def _scan_chunk(index: FileIndex, chunk: int) -> None:
    """Add the messages of a chunk from its content."""
    times = dict[int, list[int]]()
    offsets = dict[int, list[int]]()
    data = _read_chunk(index.path, chunk, version_of(index.path))
    at = 0
    for kind, fields, begin, end in _records(data, 0):
        number = _number(fields, b"conn")
        if kind == _CONNECTION:
            _learn(index, fields, data[begin:end])
        elif kind == _MESSAGE:
            seconds, rest = unpack("<II", fields[b"time"])
            times.setdefault(number, []).append(seconds * 10**9 + rest)
            offsets.setdefault(number, []).append(at)
        at = end
    for number in times:
        index.add(number, chunk, times[number], offsets[number])


def _learn(index: FileIndex, fields: _Fields, data: bytes) -> None:
    kind = ros_type(_fields(data)[b"type"].decode())
    index.channels[_number(fields, b"conn")] = Channel(fields[b"topic"].decode(), kind, "ros1")


@lru_cache(maxsize=2)
def _read_chunk(path: str, at: int, version: Version) -> bytes:
    """Return the content of a chunk; the last two are cached, because frames are read in order."""
    with Path(path).open("rb") as file:
        fields, begin, end = _record_at(file, at)
        file.seek(begin)
        codec = fields[b"compression"].decode()
        size = _number(fields, b"size")
        return decompressed(file.read(end - begin), codec, path, size)


def _record_at(file: BinaryIO, at: int) -> tuple[_Fields, int, int]:
    """Return the header of a record of the file, and where its data begin and end."""
    file.seek(at)
    (length,) = unpack("<I", file.read(4))
    if length > _LONGEST_HEADER:
        raise ValueError("a header that is too long")
    fields = _fields(file.read(length))
    (size,) = unpack("<I", file.read(4))
    return fields, at + 8 + length, at + 8 + length + size


def _records(data: bytes, at: int) -> Iterator[tuple[int, _Fields, int, int]]:
    """Yield the records of a chunk: kind, header, and where its data begin and end."""
    while at < len(data):
        (length,) = unpack_from("<I", data, at)
        fields = _fields(data[at + 4 : at + 4 + length])
        (size,) = unpack_from("<I", data, at + 4 + length)
        begin = at + 8 + length
        at = begin + size
        yield fields[b"op"][0], fields, begin, at


def _fields(header: bytes) -> _Fields:
    fields = _Fields()
    at = 0
    while at < len(header):
        (size,) = unpack_from("<I", header, at)
        name, _, value = header[at + 4 : at + 4 + size].partition(b"=")
        fields[name] = value
        at = at + 4 + size
    return fields


def _number(fields: _Fields, name: bytes) -> int:
    return int.from_bytes(fields[name], "little")
