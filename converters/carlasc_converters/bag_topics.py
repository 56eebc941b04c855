"""The topics of a bag: those in all of its files, the choice of those to use, and its sensors.

Messages of LiDARs are read by their times. Cameras have projections from CameraInfo, and the images
of the same namespace.
"""

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
from typing import Any

import numpy as np

from carlasc.converting.protocol import Cloud, FrameHandle, Trajectory
from carlasc.core import CameraModel
from carlasc.core.arrays import FloatArray, IntArray, RecordArray
from carlasc.core.cameras import Lens
from carlasc.core.geometry import Transform, transform_points
from carlasc.errors import ArgumentError, FormatError, MissingDataError, reading
from carlasc.motion.odometry import move_each, ticks_of
from carlasc.storage.camera_files import encode_image
from carlasc_converters import db3_file, mcap_file, ros1_bag
from carlasc_converters.bag_messages import (
    CAMERA_INFO,
    CLOUDS,
    COMPRESSED_IMAGE,
    IMAGES,
    POSES,
    TRANSFORMS,
    Channel,
    CloudMessage,
    FileIndex,
    decode,
    decompressed,
    is_readable,
    read_cloud,
    read_stamp,
)
from carlasc_converters.files import opening, raw_advice
from carlasc_converters.image_files import nearest_within
from carlasc_converters.point_fields import (
    TIMES,
    PointClock,
    TimeUnit,
    find_clock,
    named_fields,
    returns,
    unread,
)

_KINDS = (ros1_bag, mcap_file, db3_file)
ENDINGS = (".bag", ".bag.active", ".mcap", ".db3")
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
        "*/" * level + f"*{ending}" for level in range(_LEVELS) for ending in (*ENDINGS, *_PACKED)
    )
    files = sorted(path for pattern in patterns for path in source.glob(pattern) if path.is_file())
    bags = [path for path in files if path.name.endswith(ENDINGS)]
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
        size = sum(entry.file_size for entry in archive.infolist())
        free = disk_usage(folder.name)
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


_PACKETS_HZ = 150  # messages that are more frequent are packets, because no LiDAR turns so fast
_PROBES = 5  # first messages that say, with the last one, what the times of points are


class LidarTopic:
    """A topic of points: its messages by their time.

    Attributes:
        name: of the topic.
    """

    def __init__(self, topic: Topic, time_unit: TimeUnit, *, deskewed: bool) -> None:
        self.name = topic.channel.topic
        self._topic = topic
        self._time_unit = time_unit
        self._deskewed = deskewed
        self.notes: list[str] = []
        gaps = np.diff(np.sort(topic.times)) / 1e9
        if len(gaps) >= _PROBES and (period := float(np.median(gaps))) * _PACKETS_HZ < 1:
            raise FormatError(
                f"{topic.parts[0][0]}: {self.name}",
                expected="a message for each turn of the LiDAR",
                found=f"{len(topic)} messages, {1 / max(period, 1e-9):.0f} per second, of a packet "
                f"each",
                advice="set the driver to publish full turns, and replay its packets",
            )

    @cached_property
    def _read(self) -> tuple[IntArray, list[MessagePlace]]:
        """The time and position of each message, by time.

        An unreadable message follows the one before it; reading its frame reports the error.
        """
        times_read = list[int | None]()
        places = list(self._topic.places())
        for place in places:
            try:
                times_read.append(read_stamp(place.read(), place.channel, str(place)))
            except FormatError:
                times_read.append(None)
        lead = next((row for row, stamp in enumerate(times_read) if stamp is not None), 0)
        stamps = [(times_read[lead] or 0) - lead - 1]
        for stamp in times_read:
            stamps.append(stamps[-1] + 1 if stamp is None else stamp)
        del stamps[0]
        # the fields were not filled in
        known = np.array(stamps, np.int64) if any(times_read) else self._topic.times
        times, first = np.unique(known, return_index=True)
        if len(times) < len(stamps):
            self.notes.append(
                f"{self.name}: {len(stamps) - len(times)} messages have the time of another one, "
                f"and are left out"
            )
        return times, [places[row] for row in first]

    @property
    def stamps(self) -> IntArray:
        """(F,) increasing times in nanoseconds."""
        return self._read[0]

    @property
    def places(self) -> list[MessagePlace]:
        """The position of each message."""
        return self._read[1]

    @cached_property
    def frame(self) -> str:
        """The frame of the sensor."""
        return self._probes[0].frame

    @cached_property
    def _probes(self) -> list[CloudMessage]:
        """The first messages that can be read, and the last one.

        Raises:
            FormatError: no message can be read.
        """
        problem = None
        messages = list[CloudMessage]()
        for places in (self.places, self.places[: -_PROBES - 1 : -1]):
            for place in places:
                try:
                    messages.append(read_cloud(place.read(), place.channel, str(place)))
                except FormatError as error:
                    problem = problem or error
                if len(messages) >= _PROBES:
                    break
        if problem is not None and not messages:
            raise problem
        return messages

    @cached_property
    def clock(self) -> PointClock | None:
        """How the times of points are found, from some messages; None without times.

        Raises:
            FormatError: they are not the times of a scan.
        """
        given = self._time_unit
        scans = [(one.columns, one.stamp_ns) for one in self._probes]
        unit = (self._probes[0].time_unit or "auto") if given == "auto" else given
        clock = find_clock(scans, unit, self.name, needed=not self._deskewed)
        if clock is None:
            if set(TIMES) & {name.lower() for name in self._probes[0].columns}:
                self.notes.append(
                    f"{self.name}: the times of the points of a message do not differ: points are "
                    f"not corrected for the motion of the vehicle"
                )
        elif given == "auto":
            self.notes.append(f"{self.name}: the times of points are in {clock.unit}")
        if clock is not None and clock.own:
            self.notes.append(
                f"{self.name}: the times of points are of another clock than those of the "
                f"messages, which are taken as the times of the first points"
            )
        return clock

    @property
    def unread(self) -> list[str]:
        """The fields that are not read, each with the topic."""
        return [f"{name} of {self.name}" for name in unread(self._probes[0].columns, self.clock)]

    def nearest(self, stamps: IntArray) -> list[MessagePlace | None]:
        """Return the message nearest to each time; None if it is farther away than the interval of
        messages.
        """
        own = self.stamps
        reach = float(np.median(np.diff(own))) if len(own) > 1 else float("inf")
        rows = nearest_within(own, stamps, reach)
        if far := rows.count(None):
            self.notes.append(f"{self.name}: has no message near {far} of {len(stamps)} frames")
        return [None if row is None else self.places[row] for row in rows]


@dataclass(frozen=True)
class CloudPlace:
    """The points of a LiDAR for a frame.

    Attributes:
        sensor: index of the LiDAR.
        place: its message.
        clock: how the times of points are found; None if they have none.
        mount: poses of the LiDAR on the vehicle, by seconds after the frame; None if it is fixed.
    """

    sensor: int
    place: MessagePlace
    clock: PointClock | None
    mount: Trajectory | None = None


@dataclass(frozen=True)
class BagFrame(FrameHandle):
    """A message of the first LiDAR.

    Attributes:
        stamp_ns: its time.
        clouds: the messages with the points of each LiDAR.
    """

    number: int
    location: str
    stamp_ns: int
    clouds: tuple[CloudPlace, ...]

    def read(self) -> Sequence[Cloud]:
        """Read the points of each LiDAR.

        Points that are NaN or at the origin are no returns, and left out.
        """
        clouds = []
        for cloud in self.clouds:  # in Python 3.11, a comprehension is a level of calls
            clouds.append(self._read(cloud))  # noqa: PERF401
        return clouds

    def _read(self, cloud: CloudPlace) -> Cloud:
        where = str(cloud.place)
        message = read_cloud(cloud.place.read(), cloud.place.channel, where)
        points = named_fields(message.columns, where)["points"]
        seen = returns(message.columns)
        if not seen.any():
            raise FormatError(self.location, expected="points", found="none")
        points = points[seen]
        seconds = None
        if message.pose is not None:
            points[:, :3] = transform_points(message.pose, points[:, :3])
        points[:, 3] = np.nan_to_num(points[:, 3])
        if cloud.clock is not None:
            seconds = cloud.clock.seconds(message.columns, seen, message.stamp_ns, where)
        # the message of another sensor has another time than the frame
        late = (message.stamp_ns - self.stamp_ns) * 1e-9
        if seconds is not None:
            seconds = seconds[seen] + late
        elif late:
            seconds = np.full(len(points), late)
        if cloud.mount is None:
            return Cloud(points, seconds=seconds, sensor=cloud.sensor)
        ticks, tick_of = ticks_of(np.full(len(points), late) if seconds is None else seconds)
        known = cloud.mount.seconds
        assert known is not None
        vehicle_T_then = cloud.mount.at(ticks.clip(known[0], known[-1]))
        points[:, :3] = move_each(points, vehicle_T_then, tick_of)
        origins = vehicle_T_then[tick_of, :3, 3].astype(np.float32)
        return Cloud(points, seconds=seconds, origins=origins, sensor=cloud.sensor)


_MODELS: dict[str, tuple[Lens, tuple[int, ...]]] = {
    "plumb_bob": ("radial-tangential", (4, 5)),
    "rational_polynomial": ("radial-tangential", (8,)),
    "equidistant": ("fisheye", (4,)),
}
_CHANNELS = {
    "mono8": (0,),
    "rgb8": (0, 1, 2),
    "bgr8": (2, 1, 0),
    "rgba8": (0, 1, 2),
    "bgra8": (2, 1, 0),
}
_WIDTHS = {"mono8": 1, "rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}
_IMAGE_ENDINGS = {b"\xff\xd8": "jpg", b"\x89PNG"[:2]: "png"}


@dataclass(frozen=True)
class BagCamera:
    """A camera of a bag.

    Attributes:
        info: position of its first CameraInfo.
        topic: topic of its images; None without one.
    """

    info: MessagePlace
    topic: Topic | None

    @property
    def name(self) -> str:
        """The namespace of its topics, with "-" between the parts."""
        return "-".join(filter(None, self.info.channel.topic.split("/")[:-1])) or "camera"

    @cached_property
    def message(self) -> Any:
        """The first CameraInfo."""
        return decode(self.info.read(), self.info.channel, str(self.info))

    @property
    def frame(self) -> str:
        """Its frame: x to the right, y down, z ahead (REP 103)."""
        return str(self.message.header.frame_id).removeprefix("/")

    @cached_property
    def images(self) -> tuple[IntArray, list[MessagePlace]]:
        """(N,) increasing times of the images, nanoseconds, and their positions."""
        places = [] if self.topic is None else list(self.topic.places())
        stamps = np.array(
            [read_stamp(place.read(), place.channel, str(place)) for place in places], np.int64
        )
        times, first = np.unique(stamps, return_index=True)
        return times, [places[row] for row in first.tolist()]

    def nearest(self, frames: IntArray) -> list[int | None]:
        """Return the row of the image nearest to each of (F,) times, nanoseconds; None if it is
        nearer to another frame.
        """
        period = float(np.median(np.diff(frames))) if len(frames) > 1 else np.inf
        return nearest_within(self.images[0], frames, period / 2)

    def model(self, vehicle_T_camera: Transform, times: FloatArray | None) -> CameraModel:
        """Return the camera; images that the topic calls rectified have no distortion.

        Raises:
            FormatError: the model of its distortion is unknown, or numbers do not fit it.
        """
        info = self.message
        where = str(self.info)
        with reading(where, "a message of type CameraInfo"):
            given = {
                key: np.array(getattr(info, key.lower(), getattr(info, key, ())), np.float64)
                for key in "DKP"
            }
            kind = str(info.distortion_model)
            distortion = given["D"]
            width = int(info.width)
            height = int(info.height)
            rectified = (
                self.topic is not None
                and "rect"
                in self.topic.channel.topic.removesuffix("/compressed").rpartition("/")[2]
            )
            matrix = given["P"].reshape(3, 4)[:, :3] if rectified else given["K"].reshape(3, 3)
        model: Lens = "pinhole"
        if not rectified and distortion.any():
            model, counts = _MODELS.get(kind, ("pinhole", ()))
            if len(distortion) not in counts:
                expected = "one of the models " + ", ".join(
                    f"{name} ({n[-1]})" for name, (_, n) in _MODELS.items()
                )
                raise FormatError(
                    where, expected=expected, found=f"{kind!r} with {len(distortion)} coefficients"
                )
        coefficients = tuple(distortion.tolist()) if model != "pinhole" else ()
        return CameraModel(
            name=self.name,
            width=width,
            height=height,
            model=model,
            matrix=matrix,
            distortion=coefficients,
            sensor_T_camera=vehicle_T_camera,
            times=times,
        )

    def read(self, row: int) -> tuple[str, bytes]:
        """Return the ending and the bytes of a file of an image.

        Raises:
            FormatError: the image is cut short, or its encoding is not supported.
        """
        place = self.images[1][row]
        message = decode(place.read(), place.channel, str(place))
        where = str(place)
        with reading(where, "an image"):
            data = np.asarray(message.data, np.uint8)
            if place.channel.type == COMPRESSED_IMAGE:
                if (ending := _IMAGE_ENDINGS.get(data[:2].tobytes())) is None:
                    raise FormatError(where, expected="a JPEG or PNG", found=message.format)
                return ending, data.tobytes()
            if message.encoding not in _CHANNELS:
                raise FormatError(
                    where, expected=f"one of {', '.join(_CHANNELS)}", found=repr(message.encoding)
                )
            rows = data[: message.height * message.step].reshape(message.height, message.step)
            wide = _WIDTHS[message.encoding]
            pixels = rows[:, : message.width * wide].reshape(message.height, message.width, wide)
            chosen = np.ascontiguousarray(pixels[..., list(_CHANNELS[message.encoding])])
            return "png", encode_image(chosen[..., 0] if wide == 1 else chosen, "PNG").tobytes()


def find_cameras(files: BagFiles) -> list[BagCamera]:
    """Return the cameras of a bag, by the name of their topics; of several topics of images, the
    compressed one is read, because its messages are files.
    """
    images = files.of_types(IMAGES)
    cameras = []
    for topic in files.of_types((CAMERA_INFO,)):
        space = topic.channel.topic.rpartition("/")[0] + "/"
        own = [one for one in images if one.channel.topic.startswith(space)]
        own.sort(key=lambda one: (one.channel.type != COMPRESSED_IMAGE, one.channel.topic))
        cameras.append(BagCamera(next(topic.places()), own[0] if own else None))
    return cameras
