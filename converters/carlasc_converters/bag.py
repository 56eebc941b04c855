"""Bags of ROS 1, ROS 2 and Foxglove: see the page `docs/sets/bag.md`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, ClassVar, cast

import numpy as np
from numpy.typing import NDArray

from carlasc.converting.protocol import Cloud, Converter, FrameHandle, Recording, Sensor, Trajectory
from carlasc.core.classes import Remap
from carlasc.core.geometry import transform_points
from carlasc.core.tables import CARLA
from carlasc.errors import CarlascError, FormatError, MissingDataError
from carlasc_converters.bag_messages import PATH, TRANSFORMS, CloudMessage, read_cloud, read_placed, read_stamp
from carlasc_converters.bag_topics import BagFiles, MessagePlace, Topic, find_bags
from carlasc_converters.point_fields import TimeUnit, named_fields, point_seconds
from carlasc_converters.transforms import FrameTrack, FrameTree

_BASES = ("base_link", "base_footprint")  # names of the frame of a vehicle, by ROS' REP 105
_WORLDS = ("odom", "map", "world")  # names of frames that do not move, the smoothest first
_PACKETS_HZ = 150  # no LiDAR turns so often: these are packets
_OWN_CLOCK_S = 1.0  # times of points that are farther from that of the message are those of another clock
_PROBES = 5  # messages from which the unit of the times of points is found


class Bag(Converter):
    """Reads bags of ROS 1 (.bag), ROS 2 (.db3, .mcap) and Foxglove (.mcap), without ROS."""

    title: ClassVar[str] = "a bag of ROS 1, ROS 2 or Foxglove"
    classes = CARLA
    to_carla = Remap("carla", CARLA, CARLA, {label: label for label in CARLA.names})

    def __init__(
        self,
        source: Path,
        *,
        topics: Annotated[
            str, "Topics of points, one a LiDAR, by commas; the messages of the first are the frames."
        ] = "",
        pose_topic: Annotated[str, "Topic of the poses, or /tf; otherwise the only one of its kind."] = "",
        pose_frame: Annotated[str, "Frame whose poses these are, where the messages do not say it."] = "",
        world_frame: Annotated[str, "Frame in which poses from /tf are: odom, map, world, or the root."] = "",
        time_unit: Annotated[TimeUnit, "Unit of the times of points; auto: from how long a scan takes."] = "auto",
        deskewed: Annotated[bool, "The points are already corrected for the motion of the vehicle."] = False,
    ) -> None:
        super().__init__(source)
        self.options = BagOptions(topics, pose_topic, pose_frame, world_frame, time_unit, deskewed)

    def sequences(self) -> list[Recording]:
        """Return the recordings, by name.

        Raises:
            MissingDataError: no bag exists, or one has no points.
            ArgumentError: one has several topics of points, and none is named.
            FormatError: a file is no bag.
        """
        return [BagRecording(BagFiles(paths), self.options) for paths in find_bags(self.source)]


@dataclass(frozen=True)
class BagOptions:
    """The options of `Bag`, which says what they mean."""

    topics: str = ""
    pose_topic: str = ""
    pose_frame: str = ""
    world_frame: str = ""
    time_unit: TimeUnit = "auto"
    deskewed: bool = False


class BagRecording(Recording):
    """A bag. The messages of the first LiDAR are its frames; of other LiDARs, the message that is nearest in time belongs to a frame.

    Its times begin at the first frame. The vehicle is the frame whose poses are given, or `base_link`, or the first LiDAR.
    """

    split = "Train"

    def __init__(self, files: BagFiles, options: BagOptions) -> None:
        self._files, self._options, self.location = files, options, files.location
        self.name = re.sub(r"[^\w-]+", "_", files.paths[0].name.split(".")[0].removesuffix("_0"))
        self._pose_note = ""
        self._lidars = [LidarTopic(topic, options) for topic in files.clouds(options.topics)]

    @cached_property
    def frames(self) -> Sequence[FrameHandle]:  # type: ignore[override]
        """The messages of the first LiDAR, each with the nearest of the others."""
        first, *others = self._lidars
        near = [lidar.nearest(first.stamps) for lidar in others]
        frames = list[FrameHandle]()
        for number, (place, stamp) in enumerate(zip(first.places, first.stamps.tolist(), strict=True)):
            parts = [(0, place, first.unit), *((k, rows[number], others[k - 1].unit) for k, rows in enumerate(near, 1))]
            given = tuple(CloudPlace(k, found, unit) for k, found, unit in parts if found is not None)
            frames.append(BagFrame(number, f"{place}: message {number}", stamp, given))
        return frames

    @cached_property
    def sensors(self) -> Sequence[Sensor]:  # type: ignore[override]
        """The LiDARs, where the bag's transforms say that they are on the vehicle.

        Raises:
            MissingDataError: there are several, and no transforms between them.
        """
        tree, at, sensors = self._tree, self._lidars[0].stamps[:1], list[Sensor]()
        for lidar in self._lidars:
            known = tree.connected(lidar.frame, self._vehicle)
            if not known and len(self._lidars) > 1:
                raise self._no_path(lidar.frame, self._vehicle, "convert one LiDAR with `topics`")
            place = tree.lookup(self._vehicle, lidar.frame, at)[0] if known else np.eye(4)
            sensors.append(Sensor(lidar.name, place, deskewed=self._options.deskewed, calibrated=known))
        return sensors

    def times(self) -> NDArray[np.float64]:
        """Return seconds after the first frame."""
        return self._seconds(self._lidars[0].stamps)

    def poses(self, *, force: bool = False) -> Trajectory | None:
        """Return the poses of the topic of poses, or of the tree of transforms; None if the bag has neither.

        Raises:
            ArgumentError: there are several topics of poses, and none is named.
            MissingDataError: no transforms lead from the LiDAR to the frame whose poses these are, or from there to the world.
            FormatError: a pose is none, or poses and scans were not recorded at the same time.
        """
        topic = self._files.poses(self._options.pose_topic)
        if topic is None or topic.channel.type in TRANSFORMS:
            found = self._poses_of_tree(required=topic is not None)
            if found is None:
                return None
            stamps, poses = found
            where = f"{self.location}: transforms"
        else:
            where = f"{self.location}: {topic.channel.topic}"
            stamps, poses = _read_track(topic, where).values
        if not force and not all(sensor.calibrated for sensor in self.sensors):
            advice = "name the frame of the LiDAR, or of the poses, with `pose_frame`, or accept both as one with `force=True`"
            raise self._no_path(self._lidars[0].frame, self._vehicle, advice)
        own = self._lidars[0].stamps
        if stamps[-1] < own[0] or stamps[0] > own[-1]:
            expected = f"poses between {own[0] / 1e9:.3f} and {own[-1] / 1e9:.3f} s, the times of the scans"
            raise FormatError(where, expected=expected, found=f"{stamps[0] / 1e9:.3f} to {stamps[-1] / 1e9:.3f} s")
        self._pose_note = f"{where}: the poses are those of {self._vehicle}"
        return Trajectory(poses, self._seconds(stamps), where)

    def notes(self) -> list[str]:
        """Say what is not whole, and what was assumed."""
        notes = [*self._files.notes(), *(note for lidar in self._lidars for note in lidar.notes)]
        if self._pose_note:
            assumed = self._pose_child == "" and not self._options.pose_frame
            notes.append(self._pose_note + (", as assumed: the messages do not say it" if assumed else ""))
        if not all(sensor.calibrated for sensor in self.sensors):
            notes.append(
                f"{self.location}: no transforms lead from {self._lidars[0].frame} to {self._vehicle}: both are taken as one"
            )
        return notes

    @cached_property
    def _tree(self) -> FrameTree:
        tree = FrameTree(self.location)
        for topic in self._files.of_types(TRANSFORMS):
            for place in topic.places():
                for placed in read_placed(place.read(), place.channel, str(place)):
                    tree.add(placed)
        return tree

    @cached_property
    def _pose_child(self) -> str | None:
        """The frame of the poses as their messages say it, empty if they do not; None if there is no topic of poses, or no single one."""
        try:
            topic = self._files.poses(self._options.pose_topic)
        except CarlascError:
            return None  # `poses` says it, if poses are asked for
        if topic is None or topic.channel.type in TRANSFORMS:
            return None
        place = next(topic.places())
        placed = read_placed(place.read(), place.channel, str(place))
        return placed[0].child if placed else ""

    @cached_property
    def _vehicle(self) -> str:
        """The frame of the vehicle."""
        lidar = self._lidars[0].frame
        bases = (base for base in _BASES if base != lidar and self._tree.connected(lidar, base))
        return self._options.pose_frame or self._pose_child or next(bases, lidar)

    def _poses_of_tree(self, *, required: bool) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
        """Return times and poses of the vehicle in the world; None if the tree does not say how it moves."""
        line, wanted = self._tree.ancestors(self._vehicle), self._options.world_frame
        names = (
            (name for name in (wanted,) if name in line)
            if wanted
            else (name for name in (*_WORLDS, line[-1]) if name in line)
        )
        world = next(names, None)
        edges = [] if world is None else self._tree.edges(self._vehicle, world)
        if world is None or not any(edge.moves for edge in edges):
            if required or wanted:
                raise self._no_path(
                    self._lidars[0].frame, wanted or _WORLDS[0], 'estimate poses with `poses="kiss-icp"`'
                )
            return None
        stamps = max((edge for edge in edges if edge.moves), key=len).values[0]
        return stamps, self._tree.lookup(world, self._vehicle, stamps)

    def _no_path(self, frame: str, target: str, advice: str) -> MissingDataError:
        expected = f"transforms from {frame} to {target}"
        return MissingDataError(self.location, expected=expected, found=f"only {self._tree}", advice=advice)

    def _seconds(self, stamps: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return seconds after the first frame. Nanoseconds are subtracted as integers, because float64 would round them to 256 ns."""
        return (stamps - self._lidars[0].stamps[0]) * 1e-9


class LidarTopic:
    """A topic of points: its messages by their time.

    Attributes:
        name: of the topic.
    """

    def __init__(self, topic: Topic, options: BagOptions) -> None:
        self.name, self._topic, self._options = topic.channel.topic, topic, options
        self.notes: list[str] = []
        gaps = np.diff(np.sort(topic.times)) / 1e9
        if len(gaps) >= _PROBES and (period := float(np.median(gaps))) * _PACKETS_HZ < 1:
            raise FormatError(
                f"{topic.parts[0][0]}: {self.name}",
                expected="a message for each turn of the LiDAR",
                found=f"{len(topic)} messages, {1 / max(period, 1e-9):.0f} per second, of a packet each",
                advice="set the driver to publish whole turns, and play its packets again",
            )

    @cached_property
    def _read(self) -> tuple[NDArray[np.int64], list[MessagePlace]]:
        """The time and place of each message, by time. One that cannot be read comes after the one before it: its frame says why."""
        stamps, places = list[int](), list[MessagePlace]()
        for recorded, place in zip(self._topic.times.tolist(), self._topic.places(), strict=True):
            try:
                stamps.append(read_stamp(place.read(), place.channel, str(place)) or recorded)
            except FormatError:
                stamps.append(stamps[-1] + 1 if stamps else recorded)
            places.append(place)
        times, first = np.unique(np.array(stamps, np.int64), return_index=True)
        if len(times) < len(stamps):
            self.notes.append(
                f"{self.name}: {len(stamps) - len(times)} messages have the time of another one, and are left out"
            )
        return times, [places[row] for row in first]

    @property
    def stamps(self) -> NDArray[np.int64]:
        """(F,) increasing times in nanoseconds."""
        return self._read[0]

    @property
    def places(self) -> list[MessagePlace]:
        """Where each message is."""
        return self._read[1]

    @cached_property
    def frame(self) -> str:
        """The frame of the sensor."""
        place = self.places[0]
        return read_cloud(place.read(), place.channel, str(place)).frame

    @cached_property
    def unit(self) -> TimeUnit:
        """The unit of the times of points, from the first messages; "auto" if points have no times."""
        if self._options.time_unit != "auto":
            return self._options.time_unit
        problem: FormatError | None = None
        for place in self.places[:_PROBES]:
            message = read_cloud(place.read(), place.channel, str(place))
            fields = named_fields(message.columns, str(place))
            if "time" not in fields or not np.any(fields["time"]):
                continue
            try:
                unit = message.time_unit or point_seconds(fields["time"], "auto", str(place))[2]
            except FormatError as error:
                problem = error
            else:
                self.notes.append(f"{self.name}: the times of points are in {unit}")
                return cast(TimeUnit, unit)
        if problem is not None:
            raise problem
        return "auto"

    def nearest(self, stamps: NDArray[np.int64]) -> list[MessagePlace | None]:
        """Return the message nearest to each time; None where it is farther away than the time between two messages."""
        own = self.stamps
        reach = float(np.median(np.diff(own))) if len(own) > 1 else float("inf")
        rows = np.searchsorted((own[:-1] + own[1:]) // 2, stamps)
        near = np.abs(own[rows] - stamps) <= reach
        if not near.all():
            self.notes.append(f"{self.name}: has no message near {np.count_nonzero(~near)} of {len(stamps)} frames")
        return [self.places[row] if there else None for row, there in zip(rows.tolist(), near.tolist(), strict=True)]


@dataclass(frozen=True)
class CloudPlace:
    """What a LiDAR saw for a frame.

    Attributes:
        sensor: index of the LiDAR.
        place: its message.
        unit: of the times of points.
    """

    sensor: int
    place: MessagePlace
    unit: TimeUnit


@dataclass(frozen=True)
class BagFrame(FrameHandle):
    """A message of the first LiDAR.

    Attributes:
        stamp_ns: its time.
        clouds: where the points of each LiDAR are.
    """

    number: int
    location: str
    stamp_ns: int
    clouds: tuple[CloudPlace, ...]

    def read(self) -> Sequence[Cloud]:
        """Read the points of each LiDAR. Those that are no numbers or at the origin are no returns, and left out."""
        return [self._read(cloud) for cloud in self.clouds]

    def _read(self, cloud: CloudPlace) -> Cloud:
        where = str(cloud.place)
        message = read_cloud(cloud.place.read(), cloud.place.channel, where)
        fields = named_fields(message.columns, where)
        points = fields["points"]
        seen = np.isfinite(points[:, :3]).all(axis=1) & points[:, :3].any(axis=1)
        if not seen.any():
            raise FormatError(self.location, expected="points", found="none")
        points = points[seen]
        if message.pose is not None:
            points[:, :3] = transform_points(message.pose, points[:, :3])
        points[:, 3] = np.nan_to_num(points[:, 3])
        seconds = self._seconds_of(message, fields.get("time"), cloud.unit, where)
        return Cloud(points, seconds=None if seconds is None else seconds[seen], sensor=cloud.sensor)

    def _seconds_of(
        self, message: CloudMessage, times: NDArray[np.generic] | None, unit: TimeUnit, where: str
    ) -> NDArray[np.float64] | None:
        """Return the time of each point after the time of the frame; None if it is not known."""
        late = (message.stamp_ns - self.stamp_ns) * 1e-9
        if times is None:
            return np.full(len(next(iter(message.columns.values()))), late) if late else None
        seconds, start_ns, _ = point_seconds(times, unit, where)
        if start_ns is not None:
            after = (start_ns - message.stamp_ns) * 1e-9
            seconds = seconds + (after if abs(after) < _OWN_CLOCK_S else 0.0)
        return seconds + late


def _read_track(topic: Topic, where: str) -> FrameTrack:
    """Return the poses of a topic. Of a topic of paths, the last message is read, which holds the whole path."""
    track, places = FrameTrack(where), list(topic.places())
    for place in places[-1:] if topic.channel.type == PATH else places:
        for placed in read_placed(place.read(), place.channel, str(place)):
            track.add(placed)
    if not len(track):
        raise FormatError(where, expected="poses", found="none")
    return track
