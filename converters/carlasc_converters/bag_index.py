"""The index of the messages in a file of a bag, from one pass over the records, so that any message
can be read alone.

The pass does not need the index at the end of a file: of a file that was cut short, all messages
before the cut are read.
"""

from __future__ import annotations

import sys
from bz2 import decompress
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import FormatError, import_extra

EXTRA = "bags"
PLACE = np.dtype([("time", "<i8"), ("chunk", "<i8"), ("offset", "<i8")])
"""The position of a message: time of its recording, nanoseconds; start of its chunk, -1 without
one; its place in the chunk or file.
"""


@dataclass(frozen=True)
class Channel:
    """The topic and the type of messages.

    Attributes:
        topic: its name.
        type: of its messages, such as "sensor_msgs/msg/PointCloud2" or "foxglove.PointCloud".
        encoding: "ros1", "cdr", "protobuf", "json", or another one, which is not read.
    """

    topic: str
    type: str
    encoding: str


@dataclass
class FileIndex:
    """The messages of a file.

    Attributes:
        path: the file.
        channels: by their numbers.
        lost: what is incomplete, in a few words; None if the file is complete.
    """

    path: str
    channels: dict[int, Channel] = field(default_factory=dict)
    lost: str | None = None
    _parts: dict[int, list[NDArray[Any]]] = field(default_factory=dict)

    def add(self, channel: int, chunk: int, times: Any, offsets: Any) -> None:
        """Add messages of a channel that are in one chunk, or in none (-1)."""
        part = np.empty(np.size(times), PLACE)
        part["time"], part["chunk"], part["offset"] = times, chunk, offsets
        self._parts.setdefault(channel, []).append(part)

    def places(self, channel: int) -> NDArray[Any]:
        """Return (N,) `PLACE`, the messages of a channel, in the order of the file."""
        return np.concatenate([np.empty(0, PLACE), *self._parts.get(channel, [])])


def ros_type(name: str) -> str:
    """Return the name of a type of ROS 1 or 2 as in ROS 2: "sensor_msgs/msg/PointCloud2"."""
    package, slash, kind = name.partition("/")
    return name if "/" in kind or not slash else f"{package}/msg/{kind}"


def decompressed(data: bytes, codec: str, where: str) -> bytes:
    """Return the content of a chunk.

    Raises:
        FormatError: the codec is not known, or the chunk is damaged.
        DependencyError: the codec is not installed.
    """
    if codec in ("", "none"):
        return data
    if codec not in ("bz2", "lz4", "zstd"):
        raise FormatError(
            where,
            expected="chunks that are not compressed, or with bz2, lz4 or zstd",
            found=repr(codec),
            advice="write the bag again with one of these",
        )
    zstd = "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"
    unpack: Callable[[bytes], bytes] = (
        decompress
        if codec == "bz2"
        else import_extra("lz4.frame" if codec == "lz4" else zstd, EXTRA).decompress
    )
    try:
        return unpack(data)
    except Exception as error:  # each codec has its own errors
        raise FormatError(
            where, expected=f"a chunk compressed with {codec}", found=f"damage ({error})"
        ) from error
