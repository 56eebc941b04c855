"""Bags of ROS 1, ROS 2 and Foxglove: see the page `docs/sets/bag.md`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np

from carlasc.converting.protocol import Converter, FrameHandle, Recording, Sensor, Trajectory
from carlasc.core import CameraModel
from carlasc.core.arrays import FloatArray, IntArray
from carlasc.core.tables import CARLA
from carlasc.errors import CarlascError, FormatError, MissingDataError, first_names
from carlasc_converters.bag_messages import CAMERA_INFO, PATH, TRANSFORMS, read_placed
from carlasc_converters.bag_topics import (
    ENDINGS,
    BagCamera,
    BagFiles,
    BagFrame,
    CloudPlace,
    LidarTopic,
    Topic,
    find_bags,
    find_cameras,
)
from carlasc_converters.files import sequence_name
from carlasc_converters.point_fields import TimeUnit
from carlasc_converters.transforms import BAD_SHARE, FrameTrack, FrameTree, PlacedFrame, are_poses

_BASES = ("base_link", "base_footprint")  # names of the frame of a vehicle, by ROS' REP 105
_MOVED = 0.02  # metres, or sine of an angle: a LiDAR that moves less on the vehicle is fixed
_AROUND_NS = 10**9  # a frame needs the motion of a LiDAR on the vehicle around it
_WORLDS = ("odom", "map", "world")  # names of frames that do not move, the smoothest first


@dataclass(eq=False)
class Bag(Converter):
    """Reads bags of ROS 1 (.bag), ROS 2 (.db3, .mcap) and Foxglove (.mcap), without ROS."""

    title: ClassVar[str] = "a bag of ROS 1, ROS 2 or Foxglove"
    endings = ENDINGS
    classes = CARLA
    to_carla = None

    source: Path
    _: KW_ONLY
    topics: Annotated[
        str | None,
        "Topics of points, one per LiDAR, with commas. The messages of the first are the frames.",
    ] = None
    pose_topic: Annotated[
        str | None, "Topic of the poses, or /tf. Needed only if there are several."
    ] = None
    pose_frame: Annotated[
        str | None, "Coordinate frame of the poses, if the messages do not name it."
    ] = None
    world_frame: Annotated[
        str | None, "Reference frame of poses from /tf, such as odom, map or world."
    ] = None
    time_unit: Annotated[
        TimeUnit, "Unit of the times of points. auto: from the duration of a scan."
    ] = "auto"
    deskewed: Annotated[bool, "The points are already corrected for the motion of the vehicle."] = (
        False
    )

    def sequences(self) -> list[Recording]:
        """Return the recordings, by name.

        Raises:
            MissingDataError: no bag exists, or one has no points.
            ArgumentError: one has several topics of points, and none is named.
            FormatError: a file is not a bag.
        """
        return [BagRecording(BagFiles(paths), self) for paths in find_bags(self.source)]


class BagRecording(Recording):
    """A bag.

    The messages of the first LiDAR are its frames. Messages of other LiDARs belong to the nearest
    frame in time.

    Its times begin at the first frame. The frame of the vehicle is the one with poses, or
    `base_link`, or the first LiDAR.
    """

    split = "Train"

    def __init__(self, files: BagFiles, options: Bag) -> None:
        self._files = files
        self._options = options
        self.location = files.location
        self.name = sequence_name(files.paths[0].name.split(".")[0].removesuffix("_0"))
        self._pose_note = ""
        self._notes = list[str]()
        self._lidars = [
            LidarTopic(topic, options.time_unit, deskewed=options.deskewed)
            for topic in files.clouds(options.topics)
        ]

    @cached_property
    def frames(self) -> Sequence[FrameHandle]:  # type: ignore[override]
        """The messages of the first LiDAR, each with the nearest of the others."""
        first, *others = self._lidars
        near = [lidar.nearest(first.stamps) for lidar in others]
        frames = list[FrameHandle]()
        for number, (place, stamp) in enumerate(
            zip(first.places, first.stamps.tolist(), strict=True)
        ):
            parts = [
                (0, place, first.clock),
                *((k, rows[number], others[k - 1].clock) for k, rows in enumerate(near, 1)),
            ]
            given = tuple(
                CloudPlace(k, message, clock, self._mount(k, stamp))
                for k, message, clock in parts
                if message is not None
            )
            frames.append(BagFrame(number, f"{place}: message {number}", stamp, given))
        return frames

    @cached_property
    def sensors(self) -> Sequence[Sensor]:  # type: ignore[override]
        """The LiDARs, with their poses on the vehicle from the transforms of the bag.

        Raises:
            MissingDataError: there are several, and no transforms between them.
            FormatError: the points of one are in the frame of the world.
        """
        tree = self._tree
        sensors = list[Sensor]()
        for lidar, motion in zip(self._lidars, self._motions, strict=True):
            if not tree.connected(lidar.frame, self._vehicle):
                raise self._no_path(lidar.frame, self._vehicle, "convert one LiDAR with `topics`")
            (place,) = tree.lookup(self._vehicle, lidar.frame, lidar.stamps[:1])
            points_in: Literal["sensor", "vehicle"] = "sensor" if motion is None else "vehicle"
            sensors.append(Sensor(lidar.name, place, points_in, deskewed=self._options.deskewed))
        return sensors

    @cached_property
    def _motions(self) -> list[tuple[IntArray, FloatArray] | None]:
        """The times and poses of each LiDAR on the vehicle; None if it does not move there.

        Raises:
            FormatError: its frame does not belong to the vehicle.
        """
        tree = self._tree
        motions = list[tuple[IntArray, FloatArray] | None]()
        for frame in (lidar.frame for lidar in self._lidars):
            known = tree.connected(frame, self._vehicle)
            stamps = tree.motion(self._vehicle, frame) if known else None
            poses = None if stamps is None else tree.lookup(self._vehicle, frame, stamps)
            if stamps is None or poses is None or np.ptp(poses, axis=0).max() <= _MOVED:
                motions.append(None)
                continue
            if frame in tree.ancestors(self._vehicle):
                raise self._in_world(frame)
            self._notes.append(
                f"{self.location}: {frame} moves on {self._vehicle}, as transforms say"
            )
            motions.append((stamps, poses))
        return motions

    def _mount(self, lidar: int, stamp: int) -> Trajectory | None:
        """Return the poses of a LiDAR on the vehicle around a frame; None if it does not move."""
        motion = self._motions[lidar]
        if motion is None:
            return None
        first, last = np.searchsorted(motion[0], [stamp - _AROUND_NS, stamp + _AROUND_NS])
        near = slice(max(int(first) - 1, 0), int(last) + 1)
        seconds = np.asarray((motion[0][near] - stamp) * 1e-9, np.float64)
        return Trajectory(motion[1][near], seconds, self.location)

    def times(self) -> FloatArray:
        """Return seconds after the first frame."""
        return self._seconds(self._lidars[0].stamps)

    def poses(self, *, force: bool = False) -> Trajectory | None:
        """Return the poses of the topic of poses, or of the tree of transforms; None if the bag has
        neither.

        Raises:
            ArgumentError: there are several topics of poses, and none is named.
            MissingDataError: no transforms lead from the LiDAR to the frame of the poses, or from
                there to the world.
            FormatError: a pose is not valid, or poses and scans were not recorded at the same time.
        """
        topic = self._files.poses(self._options.pose_topic)
        if topic is None or topic.channel.type in TRANSFORMS:
            moving = self._poses_of_tree(required=topic is not None)
            if moving is None:
                return None
            stamps, poses = moving
            where = f"{self.location}: transforms"
        else:
            where = f"{self.location}: {topic.channel.topic}"
            track = FrameTrack(where)
            for placed in self._placed(topic):
                if placed.parent == self._lidars[0].frame and not force:
                    raise self._in_world(placed.parent)
                track.add(placed)
            if not len(track):
                raise FormatError(where, expected="poses", found="none that can be read")
            stamps, poses = track.values
        if self._unplaced and not force:
            advice = (
                "name a connected frame with `pose_frame`, or take both as the same frame with "
                "`force=True`"
            )
            raise self._no_path(self._lidars[0].frame, self._unplaced, advice)
        own = self._lidars[0].stamps
        if stamps[-1] < own[0] or stamps[0] > own[-1]:
            expected = (
                f"poses between {own[0] / 1e9:.3f} and {own[-1] / 1e9:.3f} s, the times of the "
                f"scans"
            )
            raise FormatError(
                where, expected=expected, found=f"{stamps[0] / 1e9:.3f} to {stamps[-1] / 1e9:.3f} s"
            )
        self._pose_note = f"{where}: the poses are those of {self._unplaced or self._vehicle}"
        return Trajectory(poses, self._seconds(stamps), where)

    def cameras(self) -> Sequence[CameraModel]:
        """Return the cameras that transforms place on the vehicle, with the image nearest to each
        frame.
        """
        cameras = list[CameraModel]()
        stamps = self._lidars[0].stamps
        for camera in self._cameras.values():
            if not self._tree.connected(camera.frame, self._vehicle):
                note = (
                    f"{self.location}: no transforms lead from {camera.frame} to {self._vehicle}: "
                    f"{camera.name} is left out"
                )
                self._notes.append(note)
                continue
            rows = self._images[camera.name]
            taken = [
                np.nan if row is None else float(camera.images[0][row] - stamps[0]) * 1e-9
                for row in rows
            ]
            place = self._tree.lookup(self._vehicle, camera.frame, stamps[:1])[0]
            cameras.append(camera.model(place, np.array(taken) if len(camera.images[0]) else None))
        return cameras

    def image(self, camera: CameraModel, frame: int) -> tuple[str, bytes] | None:
        """Return the image of a frame, which lies in the bag."""
        row = self._images[camera.name][frame]
        return None if row is None else self._cameras[camera.name].read(row)

    @cached_property
    def _cameras(self) -> dict[str, BagCamera]:
        return {camera.name: camera for camera in find_cameras(self._files)}

    @cached_property
    def _images(self) -> dict[str, list[int | None]]:
        """The row of the image of each frame, by camera."""
        return {
            name: camera.nearest(self._lidars[0].stamps) for name, camera in self._cameras.items()
        }

    def notes(self) -> list[str]:
        """Return notes on incomplete files, on what was assumed, and on what is not read."""
        read = {lidar.name for lidar in self._lidars} | {
            camera.topic.channel.topic for camera in self._cameras.values() if camera.topic
        }
        if self._pose_note:
            poses = self._files.poses(self._options.pose_topic)
            read |= {poses.channel.topic} if poses else set()
        left = [
            *(name for lidar in self._lidars for name in lidar.unread),
            *(
                str(topic)
                for name, topic in sorted(self._files.topics.items())
                if name not in read and topic.channel.type not in (*TRANSFORMS, CAMERA_INFO)
            ),
        ]
        notes = [
            *self._files.notes(),
            *self._notes,
            *(note for lidar in self._lidars for note in lidar.notes),
        ]
        if self._pose_note:
            assumed = self._pose_child == "" and not self._options.pose_frame
            notes.append(
                self._pose_note
                + (", which is assumed: the messages do not name it" if assumed else "")
            )
        if self._pose_note and self._unplaced:
            notes.append(
                f"{self.location}: no transforms lead from {self._lidars[0].frame} to "
                f"{self._unplaced}: both are taken as the same frame"
            )
        if left:
            notes.append(f"{self.location}: not read: {', '.join(left)}")
        for camera in self._cameras.values():  # their transforms are used, too
            if self._tree.connected(camera.frame, self._vehicle):
                self._tree.motion(self._vehicle, camera.frame)
        if self._tree.unused:
            notes.append(
                f"{self.location}: transforms that were not used: {first_names(self._tree.unused)}"
            )
        return list(dict.fromkeys(notes))

    @cached_property
    def _tree(self) -> FrameTree:
        tree = FrameTree(self.location)
        for topic in self._files.of_types(TRANSFORMS):
            for placed in self._placed(topic):
                tree.add(placed)
        return tree

    @cached_property
    def _pose_child(self) -> str | None:
        """The frame of the poses by their messages, empty if they do not name it; None without
        exactly one topic of poses.
        """
        try:
            topic = self._files.poses(self._options.pose_topic)
            if topic is None or topic.channel.type in TRANSFORMS:
                return None
            return next((placed.child for placed in self._placed(topic)), "")
        except CarlascError:
            return None  # `poses` raises the error, if poses are needed

    @cached_property
    def _unplaced(self) -> str | None:
        """The frame of the poses, if no transforms lead there from the first LiDAR."""
        wanted = self._options.pose_frame or self._pose_child
        return (
            wanted if wanted and not self._tree.connected(self._lidars[0].frame, wanted) else None
        )

    @cached_property
    def _vehicle(self) -> str:
        """The frame of the vehicle: that of the poses, if transforms lead there."""
        lidar = self._lidars[0].frame
        bases = (base for base in _BASES if base != lidar and self._tree.connected(lidar, base))
        wanted = self._options.pose_frame or self._pose_child
        return wanted if wanted and not self._unplaced else next(bases, lidar)

    def _placed(self, topic: Topic) -> Iterator[PlacedFrame]:
        """Yield the poses or transforms of a topic.

        Of a topic of paths, the last message is read, which holds the whole path.
        """
        places = list(topic.places())
        errors = list[FormatError]()
        bad = list[str]()
        good = 0
        for place in places[-1:] if topic.channel.type == PATH else places:
            try:
                placed = read_placed(place.read(), place.channel, str(place))
            except FormatError as error:
                errors.append(error)
                continue
            bad += (f"{place}: {one.pose}" for one in placed if not are_poses(one.pose))
            good += len(placed)
            yield from (one for one in placed if are_poses(one.pose))
        if errors:
            self._notes.append(
                f"{errors[0]}: so {len(errors)} of {len(places)} messages are left out"
            )
        if len(bad) > BAD_SHARE * good:
            raise FormatError(
                f"{self.location}: {topic.channel.topic}",
                expected="a position, and a rotation: a quaternion w, x, y, z of length 1",
                found=f"{len(bad)} of {good} others, such as {bad[0]}",
            )
        if bad:
            self._notes.append(f"{bad[0]} is no pose: {len(bad)} of {good} are left out")

    def _poses_of_tree(self, *, required: bool) -> tuple[IntArray, FloatArray] | None:
        """Return times and poses of the vehicle in the world; None if the vehicle does not move in
        the tree.
        """
        line = self._tree.ancestors(self._vehicle)
        wanted = self._options.world_frame
        world = next(
            (name for name in ((wanted,) if wanted else (*_WORLDS, line[-1])) if name in line), None
        )
        edges = [] if world is None else self._tree.edges(self._vehicle, world)
        moving = [edge for edge in edges if edge.moves]
        if world is not None and moving:
            stamps = max(moving, key=len).values[0]
            return stamps, self._tree.lookup(world, self._vehicle, stamps)
        if required or wanted:
            raise self._no_path(
                self._lidars[0].frame,
                wanted or _WORLDS[0],
                'estimate poses with `poses="kiss-icp"`',
            )
        if self._tree.moves:
            self._notes.append(
                f"{self.location}: transforms do not say how {self._vehicle} moves, only "
                f"{self._tree}"
            )
        return None

    def _no_path(self, frame: str, target: str, advice: str) -> MissingDataError:
        expected = f"transforms from {frame} to {target}"
        return MissingDataError(
            self.location, expected=expected, found=f"only {self._tree}", advice=advice
        )

    def _in_world(self, frame: str) -> FormatError:
        return FormatError(
            self.location,
            expected="points in a frame that does not move on the vehicle",
            found=f"the frame {frame}, which does: such as that of the world",
            advice="convert the topic of points in the frame of the sensor",
        )

    def _seconds(self, stamps: IntArray) -> FloatArray:
        """Return seconds after the first frame.

        Nanoseconds are subtracted as integers, because float64 would round them to 256 ns.
        """
        return (stamps - self._lidars[0].stamps[0]) * 1e-9
