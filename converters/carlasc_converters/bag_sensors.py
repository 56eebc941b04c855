"""The sensors of a bag: the messages of its LiDARs by time, and how their points are read; its
cameras, with projections from CameraInfo and images of the same namespace.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from carlasc.converting.protocol import Cloud, FrameHandle
from carlasc.core import CameraModel
from carlasc.core.arrays import FloatArray, IntArray
from carlasc.core.cameras import Lens
from carlasc.core.geometry import Transform, transform_points
from carlasc.errors import FormatError, reading
from carlasc.storage.camera_files import encode_image
from carlasc_converters.bag_messages import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGES,
    CloudMessage,
    decode,
    read_cloud,
    read_stamp,
)
from carlasc_converters.bag_topics import BagFiles, MessagePlace, Topic
from carlasc_converters.image_files import nearest_rows
from carlasc_converters.point_fields import (
    TIMES,
    PointClock,
    TimeUnit,
    check_near,
    find_clock,
    named_fields,
    returns,
    unread,
)

_PACKETS_HZ = 150  # messages that are more frequent are packets, because no LiDAR turns so fast
_PROBES = 5  # first messages that say, with the last one, what the times of points are


class LidarTopic:
    """A topic of points: its messages by their time.

    Attributes:
        name: of the topic.
    """

    def __init__(self, topic: Topic, time_unit: TimeUnit, *, deskewed: bool) -> None:
        self.name, self._topic, self._time_unit = topic.channel.topic, topic, time_unit
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
        times_read, places = list[int | None](), list(self._topic.places())
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
        problem, messages = None, list[CloudMessage]()
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
        given, scans = self._time_unit, [(one.columns, one.stamp_ns) for one in self._probes]
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
        rows = np.searchsorted((own[:-1] + own[1:]) // 2, stamps)
        near = np.abs(own[rows] - stamps) <= reach
        if not near.all():
            self.notes.append(
                f"{self.name}: has no message near {np.count_nonzero(~near)} of {len(stamps)} "
                f"frames"
            )
        return [
            self.places[row] if there else None
            for row, there in zip(rows.tolist(), near.tolist(), strict=True)
        ]


@dataclass(frozen=True)
class CloudPlace:
    """The points of a LiDAR for a frame.

    Attributes:
        sensor: index of the LiDAR.
        place: its message.
        clock: how the times of points are found; None if they have none.
    """

    sensor: int
    place: MessagePlace
    clock: PointClock | None


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
        points, seconds = points[seen], None
        if message.pose is not None:
            points[:, :3] = transform_points(message.pose, points[:, :3])
        check_near(points, where)
        points[:, 3] = np.nan_to_num(points[:, 3])
        if cloud.clock is not None:
            seconds = cloud.clock.seconds(message.columns, seen, message.stamp_ns, where)
        # the message of another sensor has another time than the frame
        late = (message.stamp_ns - self.stamp_ns) * 1e-9
        if seconds is not None:
            seconds = seconds[seen] + late
        elif late:
            seconds = np.full(len(points), late)
        return Cloud(points, seconds=seconds, sensor=cloud.sensor)


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
_ENDINGS = {b"\xff\xd8": "jpg", b"\x89PNG"[:2]: "png"}


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
        times, _ = self.images
        if not len(times):
            return [None] * len(frames)
        period = float(np.median(np.diff(frames))) if len(frames) > 1 else np.inf
        rows = nearest_rows(times, frames)
        near = np.abs(times[rows] - frames) <= period / 2
        return [row if ok else None for row, ok in zip(rows.tolist(), near.tolist(), strict=True)]

    def model(self, vehicle_T_camera: Transform, times: FloatArray | None) -> CameraModel:
        """Return the camera; images that the topic calls rectified have no distortion.

        Raises:
            FormatError: the model of its distortion is unknown, or numbers do not fit it.
        """
        info, where = self.message, str(self.info)
        with reading(where, "a message of type CameraInfo"):
            given = {
                key: np.array(getattr(info, key.lower(), getattr(info, key, ())), np.float64)
                for key in "DKP"
            }
            kind, distortion = str(info.distortion_model), given["D"]
            width, height = int(info.width), int(info.height)
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
        message, where = decode(place.read(), place.channel, str(place)), str(place)
        with reading(where, "an image"):
            data = np.asarray(message.data, np.uint8)
            if place.channel.type == COMPRESSED_IMAGE:
                if (ending := _ENDINGS.get(data[:2].tobytes())) is None:
                    raise FormatError(where, expected="a JPEG or PNG", found=str(message.format))
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
    images, cameras = files.of_types(IMAGES), []
    for topic in files.of_types((CAMERA_INFO,)):
        space = topic.channel.topic.rpartition("/")[0] + "/"
        own = [one for one in images if one.channel.topic.startswith(space)]
        own.sort(key=lambda one: (one.channel.type != COMPRESSED_IMAGE, one.channel.topic))
        cameras.append(BagCamera(next(topic.places()), own[0] if own else None))
    return cameras
