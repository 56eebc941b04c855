"""Merging the scans of one sensor over time, without traces of moving actors.

Plain voting would remove moving actors: the free space that other scans saw in their voxels has more votes. So the static scene and each
actor are voted on separately. In the box of an actor, the points and rays of every scan vote after the actor's motion has moved them to the
time of the frame. Free space that other scans saw of the static scene does not count there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform, invert, transform_points, translation
from carlasc.core.scans import runs_of_origins
from carlasc.groundtruth.options import Dynamic
from carlasc.groundtruth.voting.ballot import NOWHERE, Observation
from carlasc.motion.tracks import MovingActors, Track
from carlasc.storage import layout

STATIC = 0  # region of the voxels that belong to no actor
_DEFORMABLE_S = 0.85  # a person's shape is used for this time before and after
_RECENT_S = 0.25  # what scans saw within this time before and after a frame is so at the frame
# What is so near to an actor's body may be a part of it that its path puts elsewhere: metres along, across and up.
_AROUND_M = np.array([0.3, 0.3, 0.1])
_MIRROR, _MIRRORED = np.diag([1.0, -1.0, 1.0, 1.0]), np.array([1, -1, 1], np.float32)
_TURN = 65_000  # steps of azimuth, of 0.1 mrad: they fit 16 bits


@dataclass(frozen=True)
class Instant:
    """The frame that a grid is made for.

    Attributes:
        frame: its number.
        seconds: its time.
        world_T_grid: (4, 4) pose of the grid.
    """

    frame: int
    seconds: float
    world_T_grid: Transform

    @property
    def grid_T_world(self) -> Transform:
        """(4, 4), the inverse of the grid's pose."""
        return invert(self.world_T_grid)


@dataclass(frozen=True)
class RaysFromPlace:
    """Those rays of a scan that began at one place.

    Attributes:
        part: the points of the scan to which they go.
        sensor_T_place: (4, 4), from the place where they began, in the axes of the sensor, to the sensor's frame.
        points: (M, 3) float32, the same points seen from there, metres.
        order: (M,) int32, indices of `points` by increasing azimuth.
        azimuth: (M,) uint16, their azimuths in this order, in steps of which `_TURN` are a full circle, from -pi.
    """

    part: slice
    sensor_T_place: Transform
    points: NDArray[np.float32]
    order: NDArray[np.int32]
    azimuth: NDArray[np.uint16]

    @classmethod
    def of(cls, points: NDArray[np.float32], part: slice, origin: NDArray[np.floating]) -> RaysFromPlace:
        """Return the rays from `origin`, (3,) metres, to a part of the (N, 3) points of a scan, which are given as seen from there."""
        own = points[part]
        azimuth = _steps(np.arctan2(own[:, 1], own[:, 0])).astype(np.uint16)
        order = np.argsort(azimuth, kind="stable").astype(np.int32)  # of 16 bits: by their digits
        return cls(part, translation(origin), own, order, azimuth[order])

    def through(
        self, box_T_sensor: Transform, lower: NDArray[np.float64], upper: NDArray[np.float64]
    ) -> NDArray[np.int32]:
        """Return the indices of the points whose rays, from where they began to the point, intersect a box.

        Args:
            box_T_sensor: (4, 4), from the frame of `points` to the frame in which the box is axis-aligned.
            lower: (3,) lower corner.
            upper: (3,) upper corner.
        """
        candidates = self._in_view_of(box_T_sensor, lower, upper)
        origin = box_T_sensor[:3, 3]
        rays = transform_points(box_T_sensor, self.points[candidates]) - origin
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = (lower - origin) / rays, (upper - origin) / rays
        # A ray that lies in a face gives 0/0 there: fmin and fmax ignore the NaN.
        enter = np.fmin(one, other).max(axis=1)
        leave = np.fmax(one, other).min(axis=1)
        return candidates[(enter <= leave) & (leave >= 0) & (enter <= 1)]

    def _in_view_of(
        self, box_T_sensor: Transform, lower: NDArray[np.float64], upper: NDArray[np.float64]
    ) -> NDArray[np.int32]:
        """Return the indices of the points in the range of azimuths that a box covers."""
        origin = box_T_sensor[:3, 3]
        if ((origin > lower) & (origin < upper))[:2].all():  # the sensor is above, below or inside the box
            return self.order
        corners = np.stack(np.meshgrid(*zip(lower, upper, strict=True), indexing="ij"), axis=-1).reshape(-1, 3)
        seen = transform_points(invert(box_T_sensor), corners)
        angles = np.arctan2(seen[:, 1], seen[:, 0])
        middle = np.arctan2(np.sin(angles).sum(), np.cos(angles).sum())
        half = np.abs((angles - middle + np.pi) % (2 * np.pi) - np.pi).max() + 1e-6
        if half > np.pi / 2:  # the corners surround the sensor
            return self.order
        low, high = np.floor(_steps(middle - half)) - 1, np.ceil(_steps(middle + half)) + 1
        parts = [
            self.order[slice(*np.searchsorted(self.azimuth, np.clip([low + turn, high + turn + 1], 0, _TURN + 1)))]
            for turn in (0, _TURN, -_TURN)
        ]
        return np.concatenate(parts)


@dataclass(frozen=True)
class PreparedScan:
    """A scan that is ready for merging: decoded once, and used for every frame whose window contains it.

    Attributes:
        frame: frame number.
        points: (N, 3) float32, metres, sensor frame.
        labels: (N,) uint16; 0 casts no vote.
        world_T_sensor: (4, 4).
        reach_m: distance of the farthest point, metres.
        seconds: time of the scan.
        moving: (M,) indices of the points that move by their flow or their class, on a track or not.
        sure: (N,) float32, probability of each label, as a network gave it; None: 1.
        ends: (N, 3) float32, the points seen from where their rays began, metres: `points` themselves if that is the sensor.
        rays: the rays to the points, by where they began: at one place, unless there are several sensors, or the vehicle moved.
    """

    frame: int
    points: NDArray[np.float32]
    labels: NDArray[np.uint16]
    world_T_sensor: Transform
    reach_m: float
    seconds: float
    moving: NDArray[np.int64]
    ends: NDArray[np.float32]
    rays: tuple[RaysFromPlace, ...]
    sure: NDArray[np.float32] | None = None

    @classmethod
    def of(
        cls,
        frame: int,
        points: NDArray[np.float32],
        labels: NDArray[np.unsignedinteger],
        world_T_sensor: Transform,
        *,
        seconds: float = 0.0,
        moving: NDArray[np.int64] | None = None,
        origins: NDArray[np.float32] | None = None,
        probabilities: NDArray[np.uint16] | None = None,
    ) -> PreparedScan:
        """Prepare the voting points of a scan.

        Args:
            frame: frame number.
            points: (N, 3) metres, sensor frame.
            labels: (N,) class ids.
            world_T_sensor: (4, 4) pose of the scan.
            seconds: time of the scan.
            moving: (M,) indices of the points that move; None: none does.
            origins: (N, 3) where the ray to each point began, metres; None: all at the sensor. Points with one origin are next to each other.
            probabilities: (N, 6) the field of the scan; None: labels are sure.
        """
        reach = float(np.sqrt(np.square(points).sum(axis=1).max(initial=0.0)))
        moving = np.empty(0, np.int64) if moving is None else moving
        sure = None
        if probabilities is not None:  # labels that it does not name first were found by carlasc
            likely = probabilities[:, 1] / np.float32(layout.CERTAIN)
            sure = np.where(probabilities[:, 0] == labels, likely, np.float32(1)).astype(np.float32)
        ends = points if origins is None or not origins.any() else points - origins
        rays = tuple(RaysFromPlace.of(ends, part, origin) for part, origin in runs_of_origins(origins, len(points)))
        return cls(frame, points, labels.astype(np.uint16), world_T_sensor, reach, seconds, moving, ends, rays, sure)

    @cached_property
    def world_T_places(self) -> NDArray[np.float64]:
        """(4, 4) pose of the sensor, or (K, 4, 4) those of the places where rays began."""
        places = np.stack([rays.sensor_T_place for rays in self.rays])
        return self.world_T_sensor @ places if len(places) > 1 or places[0, :3, 3].any() else self.world_T_sensor

    def observation(
        self,
        grid_T_world: Transform,
        hits: NDArray[np.bool_] | None = None,
        *,
        labels: NDArray[np.uint16] | None = None,
        free_region: int | None = None,
    ) -> Observation:
        """Return the votes of the scan: those of a voter for each place where rays began.

        Args:
            grid_T_world: (4, 4).
            hits: (N,) bool, points that vote for their class; None: all.
            labels: (N,) the classes that they vote for; None: their own.
            free_region: region of the grid in which rays vote; None for the whole grid.
        """
        return Observation(
            self.ends,
            self.labels if labels is None else labels,
            grid_T_world @ self.world_T_places,
            hits,
            free_region=free_region,
            sure=self.sure,
            ends=None if self.world_T_places.ndim == 2 else np.array([rays.part.stop for rays in self.rays]),
        )

    def through(
        self, world_T_box: Transform, lower: NDArray[np.float64], upper: NDArray[np.float64]
    ) -> Iterator[tuple[RaysFromPlace, Transform, NDArray[np.int32]]]:
        """Yield the rays from each place, (4, 4) box_T_place, and the indices of those of its points whose rays intersect a box.

        Args:
            world_T_box: (4, 4) to the world from the frame in which the box is axis-aligned.
            lower: (3,) lower corner, metres.
            upper: (3,) upper corner.
        """
        for rays in self.rays:
            box_T_place = invert(world_T_box) @ self.world_T_sensor @ rays.sensor_T_place
            yield rays, box_T_place, rays.through(box_T_place, lower, upper)


class Merger:
    """Merges the scans of a window into the observations of one frame.

    Args:
        scan_of: returns the prepared scan of a frame.
        actors: what moves.
        classes: class table of the labels.
        dynamic: what happens to moving points.
    """

    def __init__(
        self, scan_of: Callable[[int], PreparedScan], actors: MovingActors, classes: ClassTable, dynamic: Dynamic
    ) -> None:
        self.scan_of, self.actors, self.classes, self.dynamic = scan_of, actors, classes, dynamic
        self._static: dict[int, NDArray[np.bool_]] = {}
        self._labels: dict[int, NDArray[np.uint16]] = {}
        self._carried: dict[tuple[int, int], tuple[Observation, ...]] = {}
        self._moving: dict[int, tuple[NDArray[np.float32], NDArray[np.uint16]]] = {}

    def forget_before(self, frame: int) -> None:
        """Remove what is kept of scans before a frame."""
        for kept in (self._static, self._labels, self._moving):
            for other in [key for key in kept if key < frame]:
                del kept[other]
        self._carried = {key: value for key, value in self._carried.items() if key[1] >= frame}

    def observations(self, now: Instant, window: Iterable[int], bodies: Mapping[int, int]) -> Iterator[Observation]:
        """Yield the observations of a frame's grid: each scan of the static scene, then each actor's scans in its body.

        Static surfaces vote everywhere, so the road below an actor is kept. Free space that was seen at other times does not count
        inside an actor's body. The frame's own rays always count.

        Args:
            now: the frame.
            window: frames of the scans.
            bodies: number of the actor by region, for the actors that vote in their bodies.
        """
        window, grid_T_world = list(window), now.grid_T_world
        for other in window:
            scan, own = self.scan_of(other), other == now.frame
            everything = self.dynamic == "tube" or (own and self.dynamic != "drop")
            hits = None if everything else self.static(other)
            if everything and self.actors.own:  # the recording vehicle is no part of the scene
                hits = ~self.actors.is_own(scan.points)
            yield scan.observation(grid_T_world, hits, labels=self.labels(other), free_region=None if own else STATIC)
        yield from self.in_bodies(now, window, bodies)

    def in_bodies(self, now: Instant, window: Iterable[int], bodies: Mapping[int, int]) -> Iterator[Observation]:
        """Yield the second part of `observations`."""
        window = list(window)
        for region, number in bodies.items():
            pose = self.actors.tracks[number].pose(now.frame)
            if pose is not None:
                yield from self._in_body(number, region, [other for other in window if other != now.frame], now, pose)

    def mirrored(self, now: Instant, window: Iterable[int], bodies: Mapping[int, int]) -> Iterator[Observation]:
        """Yield what the scans of actors would have seen if they had looked at the actors' other side.

        Vehicles are symmetric: their points and rays are reflected in the vertical plane through the middle of the body, if that is known.
        """
        for region, number in bodies.items():
            track = self.actors.tracks[number]
            pose = track.pose(now.frame)
            if track.rigid and pose is not None and any(track.extent.known):
                yield from self._in_body(number, region, window, now, pose, mirror=True)

    def _in_body(
        self, number: int, region: int, window: Iterable[int], now: Instant, pose: Transform, mirror: bool = False
    ) -> Iterator[Observation]:
        """Yield what the scans of a window saw in an actor's body, if they did: one observation, with a voter for each place where rays began."""
        seen = [carried for other in window for carried in self._carry(number, other, now)]
        if seen:
            points = np.concatenate([carried.points for carried in seen])
            places = np.stack([carried.grid_T_sensor for carried in seen])
            grid_T_actor = now.grid_T_world @ pose
            yield Observation(
                points * _MIRRORED if mirror else points,
                np.concatenate([carried.labels for carried in seen]),
                grid_T_actor @ _MIRROR @ places @ _MIRROR if mirror else grid_T_actor @ places,
                np.concatenate([carried.hits for carried in seen if carried.hits is not None]),
                hit_region=region,
                free_region=region,
                ends=np.cumsum([len(carried) for carried in seen]),
            )

    def passing(self, now: Instant, window: Iterable[int]) -> Iterator[Observation]:
        """Yield the moving points of each scan where that scan saw them. No ray votes for free space."""
        yield from self.moving(now, (other for other in window if other != now.frame))

    def moving(self, now: Instant, window: Iterable[int]) -> Iterator[Observation]:
        """Yield the same of all scans, that of the frame too."""
        for other in window:
            scan = self.scan_of(other)
            if other not in self._moving:
                moving = np.flatnonzero(~self.static(other))
                self._moving[other] = scan.points[moving], self.labels(other)[moving]
            points, labels = self._moving[other]
            if len(points):
                yield Observation(points, labels, now.grid_T_world @ scan.world_T_sensor, free_region=NOWHERE)

    def recent(self, now: Instant, window: Iterable[int]) -> list[int]:
        """Return the scans of the instant: those just before and after the frame."""
        return [other for other in window if abs(self.scan_of(other).seconds - now.seconds) <= _RECENT_S]

    def shells(self, now: Instant, bodies: Mapping[int, int]) -> Iterator[Observation]:
        """Yield the surface of each vehicle as it usually is, for what no scan saw of it. No ray votes for free space."""
        for region, number in bodies.items():
            track = self.actors.tracks[number]
            pose = track.pose(now.frame)
            points = track.surface
            if len(points) and pose is not None:
                labels = np.full(len(points), track.label, np.uint16)
                yield Observation(points, labels, now.grid_T_world @ pose, hit_region=region, free_region=NOWHERE)

    def static(self, frame: int) -> NDArray[np.bool_]:
        """Return (N,) bool: the points of a scan that do not belong to anything that moves.

        Ground aside, what is in or at the body of an actor is not static either: a field or free space need not show all points of an actor.
        """
        if frame not in self._static:
            scan = self.scan_of(frame)
            static = np.ones(len(scan.points), np.bool_)
            static[scan.moving] = False
            static[self.actors.is_own(scan.points)] = False
            static[self.actors.moving.get(frame, [])] = False
            ground = np.isin(scan.labels, sorted(self.classes.ground))
            for track in self.actors.tracks.values():
                static[track.members.get(frame, [])] = False
                near = _points_near(track, scan)
                static[near[~ground[near]]] = False
            self._static[frame] = static
        return self._static[frame]

    def labels(self, frame: int) -> NDArray[np.uint16]:
        """Return (N,) the classes that the points of a scan vote for: all points of an actor for the class that most of them have in all scans."""
        if frame not in self._labels:
            labels = self.scan_of(frame).labels.copy()
            for track in self.actors.tracks.values() if self.dynamic == "align" else ():
                labels[track.members.get(frame, [])] = track.label
            self._labels[frame] = labels
        return self._labels[frame]

    def _carry(self, number: int, other: int, now: Instant) -> tuple[Observation, ...]:
        """Return a scan's rays through an actor's body, in the actor's frame; none if it had another shape then."""
        track = self.actors.tracks[number]
        if not track.rigid and abs(self.scan_of(other).seconds - now.seconds) > _DEFORMABLE_S:
            return ()
        pose, found = track.pose(other), list[Observation]()
        if (number, other) not in self._carried and pose is not None:
            scan = self.scan_of(other)
            own = np.zeros(len(scan.points), np.bool_)
            own[track.members.get(other, [])] = True
            for rays, actor_T_place, crossing in scan.through(pose, track.lower, track.upper):
                if len(crossing):
                    labels, hits = self.labels(other)[rays.part][crossing], own[rays.part][crossing]
                    found.append(Observation(rays.points[crossing], labels, actor_T_place, hits))
        return self._carried.setdefault((number, other), tuple(found))


def _steps(azimuth_rad: Any) -> Any:
    """Return azimuths in steps, counted from -pi, not rounded."""
    return (azimuth_rad + np.pi) * (_TURN / (2 * np.pi))


def _points_near(track: Track, scan: PreparedScan) -> NDArray[np.int64]:
    """Return the indices of the points of a scan that are in the body of an actor, or within `_AROUND_M` of it."""
    pose, found = track.pose(scan.frame), [np.empty(0, np.int64)]
    if pose is None:
        return found[0]
    lower, upper = track.lower - _AROUND_M, track.upper + _AROUND_M
    for rays, actor_T_place, crossing in scan.through(pose, lower, upper):
        body = transform_points(actor_T_place, rays.points[crossing])
        found.append(rays.part.start + crossing[((body >= lower) & (body <= upper)).all(axis=1)])
    return np.concatenate(found)
