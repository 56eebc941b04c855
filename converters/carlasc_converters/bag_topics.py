"""The topics of a bag: the topics in all of its files, and the choice of those to use."""

from __future__ import annotations

import atexit
import re
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from shutil import disk_usage
from types import ModuleType

import numpy as np

from carlasc.core.arrays import IntArray, RecordArray
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc_converters import db3_file, mcap_file, ros1_bag
from carlasc_converters.bag_messages import (
    CLOUDS,
    POSES,
    TRANSFORMS,
    Channel,
    FileIndex,
    decompressed,
    is_readable,
)
from carlasc_converters.files import opening, raw_advice

_KINDS = (ros1_bag, mcap_file, db3_file)
_ENDINGS = (".bag", ".bag.active", ".mcap", ".db3")
_PACKED = (".db3.zstd", ".mcap.zstd")
_LEVELS = 3  # how deep below the given folder a bag may be
_ZSTD = (
    b"\x28\xb5\x2f\xfd"  # start of a single compressed message of ROS 2; CDR never begins like this
)
_PART = re.compile(r"_(\d+)$")
_EXPECTED = "a bag: .bag, .db3, .mcap"


@dataclass(frozen=True)
class MessagePlace:
    """The position of a message, so that a worker can read it.

    Attributes:
        path: the file.
        channel: its topic and type.
        chunk: the position of its chunk, -1 if it is in none.
        offset: its place in the chunk or file.
    """

    path: str
    channel: Channel
    chunk: int
    offset: int

    def read(self) -> bytes:
        """Return the content of the message.

        Raises:
            FormatError: the file does not contain it.
        """
        kind = _kind_of(Path(self.path))
        with opening(self.path, f"a message of {self.channel.topic}"):
            data: bytes = kind.read_message(self.path, self.chunk, self.offset)
        return decompressed(data, "zstd", str(self)) if data.startswith(_ZSTD) else data

    def __str__(self) -> str:
        return f"{self.path}: {self.channel.topic}"


@dataclass
class Topic:
    """The messages of a topic, in the order of the files.

    Attributes:
        channel: topic and type.
        parts: the path of each file, the channel there, and (N,) `PLACE` of its messages.
    """

    channel: Channel
    parts: list[tuple[str, Channel, RecordArray]] = field(default_factory=list)

    @cached_property
    def times(self) -> IntArray:
        """(N,) times at which the messages were recorded, nanoseconds."""
        return np.concatenate([np.empty(0, np.int64), *(rows["time"] for _, _, rows in self.parts)])

    def __len__(self) -> int:
        return len(self.times)

    def places(self) -> Iterator[MessagePlace]:
        """Yield the position of each message."""
        for path, channel, rows in self.parts:
            for _, chunk, offset in rows.tolist():
                yield MessagePlace(path, channel, chunk, offset)

    def __str__(self) -> str:
        """Return name, type, count and rate."""
        span = float(np.ptp(self.times)) / 1e9 if len(self) > 1 else 0.0
        rate = f", {(len(self) - 1) / span:.3g} Hz" if span else ""
        kind = self.channel.type.rpartition("/")[2] + (
            "" if is_readable(self.channel) else f" as {self.channel.encoding}"
        )
        return f"{self.channel.topic} ({kind}, {len(self)} messages{rate})"


class BagFiles:
    """The files of one recording.

    Attributes:
        paths: the files.
        indexes: the index of each file.
        topics: topics with messages, by name.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self.paths = tuple(paths)
        self.indexes: list[FileIndex] = []
        self.topics: dict[str, Topic] = {}
        for path in paths:
            with opening(path, _EXPECTED):
                index: FileIndex = _kind_of(path).index_file(path)
            self.indexes.append(index)
            for number, channel in index.channels.items():
                rows = index.places(number)
                if len(rows):
                    self.topics.setdefault(channel.topic, Topic(channel)).parts.append(
                        (str(path), channel, rows)
                    )

    @property
    def location(self) -> str:
        """The name of the recording in errors."""
        first = self.paths[0]
        return str(first if len(self.paths) == 1 else first.parent)

    def of_types(self, types: Sequence[str]) -> list[Topic]:
        """Return the topics of some types, by name, in an encoding that is read."""
        by_name = sorted(self.topics.items())
        return [
            topic
            for _, topic in by_name
            if topic.channel.type in types and is_readable(topic.channel)
        ]

    def clouds(self, names: str | None) -> list[Topic]:
        """Return the named topics of points, or the only one.

        Args:
            names: separated by commas; None for the only one.

        Raises:
            MissingDataError: the bag has no topic of points.
            ArgumentError: the bag has several and none is named, or a named one does not exist or
                does not hold points.
        """
        topics = self.of_types(CLOUDS)
        if names:
            return [self._named("topics", name.strip(), topics) for name in names.split(",")]
        if not topics:
            lost = [f"{index.path}: {index.lost}" for index in self.indexes if index.lost]
            raise MissingDataError(
                self.location,
                expected="a topic of points: PointCloud2, CustomMsg of Livox, or PointCloud of "
                "Foxglove",
                found="; ".join([_listed(list(self.topics.values())), *lost]),
                advice=""
                if lost
                else "if the bag holds packets of a LiDAR, replay them with its driver",
            )
        if len(topics) > 1:
            raise ArgumentError(
                "topics",
                expected=f"one or several of {_listed(topics)} in {self.location}",
                found="none",
                advice="name the LiDARs, separated by commas; the messages of the first become the "
                "frames",
            )
        return topics

    def poses(self, name: str | None) -> Topic | None:
        """Return the named topic of poses, or the only one; None without one.

        Raises:
            ArgumentError: the bag has several and none is named, or the named one does not exist or
                does not hold poses.
        """
        topics = self.of_types(POSES)
        if name:
            return self._named("pose_topic", name, topics + self.of_types(TRANSFORMS))
        if len(topics) > 1:
            expected = f"one of {_listed(topics)} in {self.location}"
            raise ArgumentError("pose_topic", expected=expected, found="none")
        return topics[0] if topics else None

    def notes(self) -> list[str]:
        """Return notes on files that are incomplete."""
        lost = [f"{index.path}: {index.lost}" for index in self.indexes if index.lost]
        if len(self.paths) > 1:
            lost.append(
                f"{len(self.paths)} files are parts of one recording: {self.paths[0].name} and the "
                f"next"
            )
        return lost

    def _named(self, option: str, name: str, topics: Sequence[Topic]) -> Topic:
        if (
            topic := next((topic for topic in topics if topic.channel.topic == name), None)
        ) is not None:
            return topic
        other = self.topics.get(name)
        said = f"{name!r}" if other is None else f"{other}, which is not read"
        raise ArgumentError(
            option, expected=f"one of {_listed(topics)} in {self.location}", found=said
        )


def find_bags(source: Path) -> list[list[Path]]:
    """Return the files of each recording in a file or a folder: parts _0, _1, ... of one bag belong
    together.

    Raises:
        MissingDataError: no file exists.
    """
    if source.suffix.lower() == ".zip" and source.is_file():
        source = _unzipped(source)
    if source.is_file():
        return [[source]]
    patterns = (
        "*/" * level + f"*{ending}" for level in range(_LEVELS) for ending in (*_ENDINGS, *_PACKED)
    )
    files = sorted(path for pattern in patterns for path in source.glob(pattern) if path.is_file())
    bags = [path for path in files if path.name.endswith(_ENDINGS)]
    if not bags:
        packed = next((path.name for path in files if path.name.endswith(_PACKED)), None)
        raise MissingDataError(
            source,
            expected=_EXPECTED,
            found=packed or ("none" if source.is_dir() else "no such folder"),
            advice=f"unpack it with `zstd -d {packed}`"
            if packed
            else raw_advice(path.name for path in source.glob("*")) or "check the path",
        )
    groups: dict[tuple[Path, str], list[tuple[int, Path]]] = {}
    for path in bags:
        part = _PART.search(path.stem)
        name = (path.parent, path.stem if part is None else path.stem[: part.start()])
        groups.setdefault(name, []).append((-1 if part is None else int(part[1]), path))
    recordings: list[list[Path]] = []
    for parts in groups.values():
        paths = [path for _, path in sorted(parts)]
        recordings.extend([paths] if min(parts)[0] == 0 else [[path] for path in paths])
    return recordings


@cache
def _unzipped(path: Path) -> Path:
    """Return a temporary folder with the bags of a zip archive, until this process ends.

    Raises:
        FormatError: it is damaged, or there is not enough space for it.
    """
    folder = tempfile.TemporaryDirectory(prefix="carlasc-")
    atexit.register(folder.cleanup)
    with opening(path, "a zip archive of bags"), zipfile.ZipFile(path) as archive:
        size, free = sum(entry.file_size for entry in archive.infolist()), disk_usage(folder.name)
        if size > free.free:
            raise FormatError(
                path,
                expected=f"at most {free.free >> 20:,} MiB, the free space in {folder.name}",
                found=f"{size >> 20:,} MiB",
                advice="unpack it, and give the folder",
            )
        archive.extractall(folder.name)
    return Path(folder.name)


def _kind_of(path: Path) -> ModuleType:
    """Return the module that reads a file, by its first bytes.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: it is not a bag.
    """
    with opening(path, _EXPECTED), path.open("rb") as file:
        head = file.read(16)
    kind = next((kind for kind in _KINDS if head.startswith(kind.MAGIC)), None)
    if kind is None:
        advice = (
            f"unpack it with `zstd -d {path.name}`"
            if path.name.endswith(_PACKED)
            else raw_advice([path.name])
        )
        raise FormatError(path, expected=_EXPECTED, found="another kind of file", advice=advice)
    return kind


def _listed(topics: Sequence[Topic]) -> str:
    return ", ".join(map(str, topics)) or "no topics with messages"
