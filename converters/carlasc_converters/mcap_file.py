"""Files `.mcap`, of ROS 1, ROS 2 or Foxglove: the records that https://mcap.dev/spec describes."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from struct import unpack, unpack_from
from zlib import crc32

import numpy as np

from carlasc.core.arrays import RecordArray
from carlasc.errors import FormatError
from carlasc_converters.bag_messages import Channel, FileIndex, decompressed, ros_type
from carlasc_converters.files import Version, version_of

MAGIC = b"\x89MCAP0\r\n"
_SCHEMA = 3
_CHANNEL = 4
_MESSAGE = 5
_CHUNK = 6
_INDEX = 7
_END = 15
# bytes before a record's content, and before the data of a message
_HEAD = 9
_MESSAGE_HEAD = 22
_ENTRY = np.dtype([("time", "<u8"), ("offset", "<u8")])


def index_file(path: Path) -> FileIndex:
    """Return the index of the messages of a file."""
    walk = _McapRecords(path)
    size = path.stat().st_size
    at = len(MAGIC)
    ended = False
    with path.open("rb") as file:
        while at < size - len(MAGIC) or not ended:
            file.seek(at)
            head = file.read(_HEAD)
            kind, length = unpack("<BQ", head) if len(head) == _HEAD else (0, size)
            if at + _HEAD + length > size or not kind:
                if not ended:
                    walk.index.lost = (
                        f"it is cut short at byte {at} of {size}, and what follows is lost"
                    )
                break
            ended = ended or kind == _END
            if kind == _CHUNK:
                walk.end_chunk()
                walk.chunk = at
            elif kind in (_SCHEMA, _CHANNEL, _MESSAGE, _INDEX):
                walk.take(kind, file.read(length if kind != _MESSAGE else _MESSAGE_HEAD), at)
            at += _HEAD + length
        file.seek(max(size - len(MAGIC), 0))
        if ended and file.read() != MAGIC:
            walk.index.lost = "it lacks its end, but no message is lost"
    try:
        walk.end_chunk(whole=ended)
    except FormatError:
        if walk.index.lost is None:
            raise  # otherwise the last chunk is lost too
    walk.index.channels = {
        number: Channel(topic, walk.schemas.get(schema, "no schema"), encoding)
        for number, (topic, schema, encoding) in walk.channels.items()
    }
    for number, rows in walk.loose.items():
        index_rows = np.array(rows, np.int64)
        walk.index.add(number, -1, index_rows[:, 0], index_rows[:, 1])
    return walk.index


def read_message(path: str, chunk: int, offset: int) -> bytes:
    """Return the content of a message.

    Raises:
        FormatError: the file has no message there.
    """
    if chunk < 0:
        with Path(path).open("rb") as file:
            file.seek(offset)
            kind, length = unpack("<BQ", file.read(_HEAD))
            data = file.read(length)
    else:
        content = _read_chunk(path, chunk, version_of(path))
        kind, length = (
            unpack_from("<BQ", content, offset) if offset + _HEAD <= len(content) else (0, 0)
        )
        data = content[offset + _HEAD : offset + _HEAD + length]
    if kind != _MESSAGE or len(data) != length:
        raise FormatError(
            path,
            expected=f"a message at {offset} in the chunk at byte {chunk}",
            found="something else",
        )
    return data[_MESSAGE_HEAD:]


class _McapRecords:
    """The records of a file so far.

    Attributes:
        index: the messages.
        schemas: names of types by number.
        channels: topic, number of the schema and encoding, by number.
        loose: time and position of each message outside of chunks, by channel.
        chunk: position of the last chunk; -1 before the first.
    """

    def __init__(self, path: Path) -> None:
        self.index = FileIndex(str(path))
        self.schemas: dict[int, str] = {}
        self.channels: dict[int, tuple[str, int, str]] = {}
        self.loose: dict[int, list[tuple[int, int]]] = {}
        self.chunk = -1
        self._entries: list[tuple[int, RecordArray]] = []

    def take(self, kind: int, content: bytes, at: int) -> None:
        """Take a record outside of chunks."""
        if kind == _MESSAGE:
            number, _, time = unpack_from("<HIQ", content)
            self.loose.setdefault(number, []).append((time, at))
        elif kind == _INDEX:
            self._entries.append(
                (unpack_from("<H", content)[0], np.frombuffer(content, _ENTRY, offset=6))
            )
        else:
            self._learn(kind, content)

    def end_chunk(self, *, whole: bool = True) -> None:
        """Add the messages of the last chunk, from its index if it is whole, or its content."""
        chunk = self.chunk
        entries = self._entries
        self.chunk = -1
        self._entries = []
        if chunk < 0:
            return
        if whole and entries and all(number in self.channels for number, _ in entries):
            self._add(chunk, entries)
            return
        messages: dict[int, list[tuple[int, int]]] = {}
        try:
            data = _read_chunk(self.index.path, chunk, version_of(self.index.path))
        except FormatError:
            if not (whole and entries):
                raise
            # the channels may be known later; reading its frames reports the damage
            self._add(chunk, entries)
            return
        for kind, begin, end in _records(data):
            if kind == _MESSAGE:
                number, _, time = unpack_from("<HIQ", data, begin)
                messages.setdefault(number, []).append((time, begin - _HEAD))
            else:
                self._learn(kind, data[begin:end])
        for number, places in messages.items():
            times, offsets = np.array(places, np.int64).T
            self.index.add(number, chunk, times, offsets)

    def _add(self, chunk: int, entries: list[tuple[int, RecordArray]]) -> None:
        for number, rows in entries:
            self.index.add(
                number, chunk, rows["time"].astype(np.int64), rows["offset"].astype(np.int64)
            )

    def _learn(self, kind: int, content: bytes) -> None:
        if kind == _SCHEMA:
            self.schemas[unpack_from("<H", content)[0]] = ros_type(_text(content, 2)[0])
        elif kind == _CHANNEL:
            number, schema = unpack_from("<HH", content)
            topic, at = _text(content, 4)
            self.channels[number] = (topic, schema, _text(content, at)[0])


@lru_cache(maxsize=2)
def _read_chunk(path: str, at: int, version: Version) -> bytes:
    """Return the content of a chunk; the last two are cached, because frames are read in order."""
    try:
        with Path(path).open("rb") as file:
            file.seek(at)
            content = file.read(unpack("<BQ", file.read(_HEAD))[1])
        codec, begin = _text(content, 28)
        (length,) = unpack_from("<Q", content, begin)
    except (struct.error, UnicodeDecodeError) as error:
        raise FormatError(
            path, expected=f"a chunk at byte {at}", found=f"damage ({error})"
        ) from error
    data, (checksum,) = (
        decompressed(
            content[begin + 8 : begin + 8 + length], codec, path, unpack_from("<Q", content, 16)[0]
        ),
        unpack_from("<I", content, 24),
    )
    if checksum and crc32(data) != checksum:
        raise FormatError(
            path, expected=f"a chunk at byte {at} that fits its checksum", found="damage"
        )
    return data


def _records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield the records of a chunk: kind, and where its content begins and ends."""
    at = 0
    while at + _HEAD <= len(data):
        kind, length = unpack_from("<BQ", data, at)
        yield kind, at + _HEAD, at + _HEAD + length
        at += _HEAD + length


def _text(content: bytes, at: int) -> tuple[str, int]:
    """Return a text of a record, and where the next value begins."""
    (length,) = unpack_from("<I", content, at)
    return content[at + 4 : at + 4 + length].decode(), at + 4 + length
