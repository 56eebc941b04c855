"""The messages of bags: where they lie in a file, and how messages of points, poses or transforms
are read.

The index of a file is made in one pass over its records, so that any message can be read alone.
The pass does not need the index at the end of a file: of a file that was cut short, all messages
before the cut are read.

Definitions: sensor_msgs, nav_msgs and geometry_msgs of ROS as rosbags has them; tf2_msgs/TFMessage
of https://docs.ros.org/en/noetic/api/tf2_msgs/html/msg/TFMessage.html; CustomMsg and CustomPoint of
Livox of the read-me pages of https://github.com/Livox-SDK/livox_ros_driver and
https://github.com/Livox-SDK/livox_ros_driver2.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from functools import cache
from struct import unpack_from
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyArray
from carlasc.core.geometry import Transform
from carlasc.errors import FormatError, import_extra, reading
from carlasc_converters import foxglove_messages
from carlasc_converters.files import MAX_UNPACKED, check_size
from carlasc_converters.point_fields import TimeUnit, read_columns, unpack_fields
from carlasc_converters.transforms import PlacedFrame, poses_of

EXTRA = "bags"
_CODECS = {
    "bz2": ("bz2", "BZ2Decompressor"),
    "lz4": ("lz4.frame", "LZ4FrameDecompressor"),
    "zstd": (
        "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd",
        "ZstdDecompressor",
    ),
}
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
    _parts: dict[int, list[AnyArray]] = field(default_factory=dict)

    def add(self, channel: int, chunk: int, times: Any, offsets: Any) -> None:
        """Add messages of a channel that are in one chunk, or in none (-1)."""
        part = np.empty(np.size(times), PLACE)
        part["time"] = times
        part["chunk"] = chunk
        part["offset"] = offsets
        self._parts.setdefault(channel, []).append(part)

    def places(self, channel: int) -> AnyArray:
        """Return (N,) `PLACE`, the messages of a channel, in the order of the file."""
        return np.concatenate([np.empty(0, PLACE), *self._parts.get(channel, [])])


def ros_type(name: str) -> str:
    """Return the name of a type of ROS 1 or 2 as in ROS 2: "sensor_msgs/msg/PointCloud2"."""
    package, slash, kind = name.partition("/")
    return name if "/" in kind or not slash else f"{package}/msg/{kind}"


def decompressed(data: bytes, codec: str, where: str, size: int = MAX_UNPACKED) -> bytes:
    """Return the content of a chunk.

    Args:
        data: the chunk.
        codec: its compression; empty or "none" without one.
        where: the file, for errors.
        size: the greatest number of bytes of the content.

    Raises:
        FormatError: the codec is not known, the chunk is damaged, or has more bytes.
        DependencyError: the codec is not installed.
    """
    if codec in ("", "none"):
        return data
    if codec not in _CODECS:
        raise FormatError(
            where,
            expected="chunks that are not compressed, or with bz2, lz4 or zstd",
            found=repr(codec),
            advice="write the bag again with one of these",
        )
    module, name = _CODECS[codec]
    decoder = getattr(import_extra(module, EXTRA), name)
    check_size(size, where)
    parts = list[bytes]()
    left = size
    try:
        while data and left >= 0:  # a chunk may be several streams
            stream = decoder()
            parts.append(stream.decompress(data, max_length=left + 1))
            left -= len(parts[-1])
            if left >= 0 and not stream.eof:
                raise EOFError("cut short")
            data = stream.unused_data
    except Exception as error:  # each codec has its own errors
        raise FormatError(
            where, expected=f"a chunk compressed with {codec}", found=f"damage ({error})"
        ) from error
    if left < 0:
        raise FormatError(
            where, expected=f"a chunk of {size} bytes, compressed with {codec}", found="more"
        )
    return b"".join(parts)


_PACKAGES = ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
_LIVOX = tuple(f"{package}/msg/CustomMsg" for package in _PACKAGES)
PATH = "nav_msgs/msg/Path"
CLOUDS = ("sensor_msgs/msg/PointCloud2", *_LIVOX, "foxglove.PointCloud")
POSES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    PATH,
    "foxglove.PoseInFrame",
)
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
IMAGES = ("sensor_msgs/msg/Image", COMPRESSED_IMAGE)
TRANSFORMS = (
    "tf2_msgs/msg/TFMessage",
    "tf/msg/tfMessage",
    "foxglove.FrameTransform",
    "foxglove.FrameTransforms",
)

_TRANSFORM_TEXT = "geometry_msgs/TransformStamped[] transforms\n"
_POINT_TEXT = (
    "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\n"
    "uint8 reflectivity\nuint8 tag\nuint8 line\n"
)
_CUSTOM_TEXT = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\n"
    "uint8[3] rsvd\nCustomPoint[] points\n"
)
_TEXTS = dict.fromkeys(TRANSFORMS[:2], _TRANSFORM_TEXT) | {
    f"{package}/msg/{name}": text
    for package in _PACKAGES
    for name, text in (("CustomPoint", _POINT_TEXT), ("CustomMsg", _CUSTOM_TEXT))
}
_POINT = np.dtype(
    {
        "names": "offset_time x y z reflectivity tag line".split(),
        "formats": "u4 f4 f4 f4 u1 u1 u1".split(),
    }
)
_ENCODINGS = {"ros1": "ros", "cdr": "ros", "protobuf": "foxglove", "json": "foxglove"}


@dataclass(frozen=True)
class CloudMessage:
    """A message of points.

    Attributes:
        stamp_ns: its time.
        frame: of the sensor.
        columns: (N,) values by the names of its fields.
        pose: (4, 4) from the points to the frame; None if they are in it.
        time_unit: unit of the times of points; None if its type does not define it.
    """

    stamp_ns: int
    frame: str
    columns: dict[str, AnyArray]
    pose: Transform | None = None
    time_unit: TimeUnit | None = None


def is_readable(channel: Channel) -> bool:
    """Return whether a type in CLOUDS, POSES, TRANSFORMS or IMAGES exists in an encoding."""
    return _ENCODINGS.get(channel.encoding) == (
        "foxglove" if channel.type.startswith("foxglove.") else "ros"
    )


def read_cloud(data: bytes, channel: Channel, where: str) -> CloudMessage:
    """Return a message of one of the types `CLOUDS`.

    Raises:
        FormatError: the data are not such a message.
    """
    message = decode(data, channel, where)
    with reading(where, f"a message of type {channel.type}"):
        if channel.type.startswith("foxglove."):
            return _foxglove_cloud(message, where)
        stamp = _stamp(message.header.stamp)
        frame = _frame(message.header.frame_id)
        if channel.type in _LIVOX:
            rows = [
                (p.offset_time, p.x, p.y, p.z, p.reflectivity, p.tag, p.line)
                for p in message.points
            ]
            points = np.array(rows, _POINT)
            return CloudMessage(
                stamp, frame, {name: points[name] for name in _POINT.names or ()}, time_unit="ns"
            )
        return CloudMessage(stamp, frame, read_columns(message, where))


def read_stamp(data: bytes, channel: Channel, where: str) -> int:
    """Return the time of a message that begins with a header, in nanoseconds, without its content.

    Raises:
        FormatError: the message is cut short.
    """
    with reading(where, f"a message of type {channel.type}"):
        if channel.encoding == "ros1":
            seconds, rest = unpack_from("<II", data, 4)
        elif channel.encoding == "cdr":
            seconds, rest = unpack_from("<iI" if data[1] else ">iI", data, 4)
        else:
            return _stamp(decode(data, channel, where).timestamp)
        return seconds * 10**9 + rest


def read_placed(data: bytes, channel: Channel, where: str) -> list[PlacedFrame]:
    """Return the poses or transforms of a message of one of the types `POSES` and `TRANSFORMS`.

    Raises:
        FormatError: the data are not such a message.
    """
    message = decode(data, channel, where)
    with reading(where, f"a message of type {channel.type}"):
        if channel.type == "foxglove.PoseInFrame":
            numbers = _numbers(message.pose.position, message.pose.orientation)
            return [PlacedFrame(_stamp(message.timestamp), _frame(message.frame_id), "", numbers)]
        if channel.type.startswith("foxglove."):
            return [
                PlacedFrame(
                    _stamp(one.timestamp),
                    _frame(one.parent_frame_id),
                    _frame(one.child_frame_id),
                    _numbers(one.translation, one.rotation),
                )
                for one in (message.transforms if channel.type.endswith("s") else [message])
            ]
        if channel.type in TRANSFORMS:
            return [
                _placed(
                    one.header,
                    one.child_frame_id,
                    one.transform.translation,
                    one.transform.rotation,
                )
                for one in message.transforms
            ]
        placed = []
        for one in message.poses if channel.type == PATH else [message]:
            # the other one has a covariance
            pose = one.pose if hasattr(one.pose, "position") else one.pose.pose
            header = one.header if one.header.frame_id else message.header
            placed.append(
                _placed(
                    one.header,
                    getattr(one, "child_frame_id", ""),
                    pose.position,
                    pose.orientation,
                    header.frame_id,
                )
            )
        return placed


def decode(data: bytes, channel: Channel, where: str) -> Any:
    """Return a message with its fields as attributes.

    Raises:
        FormatError: the data are not such a message.
    """
    with reading(where, f"a message of type {channel.type}"):
        if _ENCODINGS.get(channel.encoding) == "foxglove":
            return foxglove_messages.read_message(data, channel.type, channel.encoding)
        store = _store(channel.encoding)
        read = store.deserialize_ros1 if channel.encoding == "ros1" else store.deserialize_cdr
        return read(data, channel.type)


@cache
def _store(encoding: str) -> Any:
    """Return the message types of rosbags, with added types that it does not have."""
    types = import_extra("rosbags.typesys", EXTRA)
    store = types.get_typestore(
        types.Stores.ROS1_NOETIC if encoding == "ros1" else types.Stores.ROS2_HUMBLE
    )
    for name, text in _TEXTS.items():
        store.register(
            {
                key: value
                for key, value in types.get_types_from_msg(text, name).items()
                if key not in store.fielddefs
            }
        )
    return store


def _foxglove_cloud(message: Any, where: str) -> CloudMessage:
    fields = [
        (field.name, field.offset, foxglove_messages.FIELD_TYPES.get(field.type, "V"), 1)
        for field in message.fields
    ]
    data = np.frombuffer(message.data, np.uint8)
    columns = unpack_fields(data, fields, message.point_stride, where)
    x, y, z, *quaternion = _numbers(message.pose.position, message.pose.orientation)
    placed = (x, y, z) != (0, 0, 0) or quaternion not in ([1, 0, 0, 0], [0, 0, 0, 0])
    pose = poses_of(np.array([quaternion]), np.array([[x, y, z]]), where)[0] if placed else None
    return CloudMessage(_stamp(message.timestamp), _frame(message.frame_id), columns, pose)


def _placed(
    header: Any, child: str, position: Any, rotation: Any, parent: str | None = None
) -> PlacedFrame:
    parent = header.frame_id if parent is None else parent
    return PlacedFrame(
        _stamp(header.stamp), _frame(parent), _frame(child), _numbers(position, rotation)
    )


def _numbers(
    position: Any, rotation: Any
) -> tuple[float, float, float, float, float, float, float]:
    return position.x, position.y, position.z, rotation.w, rotation.x, rotation.y, rotation.z


def _stamp(stamp: Any) -> int:
    """Return the nanoseconds of a time of ROS or of Foxglove."""
    return int(stamp.sec) * 10**9 + int(stamp.nanosec if hasattr(stamp, "nanosec") else stamp.nsec)


def _frame(name: str) -> str:
    """Return the name of a frame: early versions of ROS put a slash before it."""
    return name.removeprefix("/")
