"""Merging the scans of one sensor over time, without ghost trails of moving actors.

Plain voting would remove moving actors, because free space of other scans has more votes in their
voxels. So the static scene and each actor have separate votes. In the box of an actor, the motion
of the actor moves the points and rays of all scans to the time of the frame, and then they vote.
Free space of the static scene from other scans does not count there.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from collections.abc import Sequence as Series
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple, Self

import numpy as np

from carlasc.core.arrays import (
    AnyFloatArray,
    BoolArray,
    Float32Array,
    FloatArray,
    IntArray,
    LabelArray,
    Uint16Array,
)
from carlasc.core.cells import as_pose, pose_of, transform
from carlasc.core.classes import ClassTable
from carlasc.core.compiling import cached
from carlasc.core.geometry import (
    Transform,
    invert,
    moved_back,
    rotate_vectors,
    transform_points,
)
from carlasc.core.grids import GridSpec
from carlasc.core.scans import Rays, lengths
from carlasc.groundtruth.options import Dynamic
from carlasc.groundtruth.voting.ballot import ClassPoints, Observation, SeenClass
from carlasc.motion import BODY_MARGIN_M
from carlasc.motion.tracks import MovingActors, Track, is_doubtful
from carlasc.storage import layout

STATIC = 0  # region of the voxels that belong to no actor
# fact: deformable
_DEFORMABLE_S = 0.85  # the shape of a person is used for this time before and after
RECENT_S = 0.25  # scans within this time before and after a frame show the scene at the frame
# Points so near to the body of an actor may belong to it, as paths have errors: metres along,
# across and up.
_AROUND_M = np.array([0.3, 0.3, 0.1])
_UNDER_M = np.array([0.1, 0.1, 0.3])  # ground so near to it, and below, may be of wheels or feet
# Ground in a body is of wheels or feet if it is so much higher than so many points of ground around
# it, so near.
_FOOT_M, _BESIDE_M, _BESIDE = 0.15, 0.6, 8
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
_ByClass = dict[int, tuple[Float32Array, Float32Array | None]]  # points and their probabilities


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

    @cached_property
    def grid_T_world(self) -> Transform:
        """(4, 4), the inverse of the grid's pose."""
        return invert(self.world_T_grid)


class Cast(NamedTuple):
    """The rays of one scan.

    Attributes:
        points: (N, 3) float32, metres, from the origin of each ray, in the order of origins.
        ends: (K,) index after the last point of each origin.
        map_T_places: (K, 4, 4) poses of the origins.
        lower: (3,) lower corner of the region in which the rays count, metres, frame of the map.
        upper: (3,) upper corner.
    """

    points: Float32Array
    ends: IntArray
    map_T_places: FloatArray
    lower: FloatArray
    upper: FloatArray


@cached
def passed_by(
    points: Float32Array, ends: IntArray, poses: FloatArray, places: FloatArray, size_m: float
) -> BoolArray:
    """Return (M,) bool: which places rays pass through.

    Args:
        points: (N, 3) as in `Cast`.
        ends: (K,) as in `Cast`.
        poses: (K, 4, 4) of the origins, as in `Cast`.
        places: (M, 3) metres, frame of the map.
        size_m: size of a place. A ray passes nearer than a quarter of it to the middle, and ends
            farther than it behind the middle.
    """
    passed, first = np.zeros(len(places), np.bool_), 0
    rows = np.ascontiguousarray(poses[:, :3]).reshape(-1, 12)
    for k in range(len(ends)):
        pose = pose_of(rows, k)
        ox, oy, oz = pose[3], pose[7], pose[11]
        for row in range(first, ends[k]):
            x, y, z = transform(pose, points[row, 0], points[row, 1], points[row, 2])
            reach = np.sqrt((x - ox) ** 2 + (y - oy) ** 2 + (z - oz) ** 2)
            ux, uy, uz = (x - ox) / reach, (y - oy) / reach, (z - oz) / reach
            for i in range(len(places)):
                dx = places[i, 0] - ox
                dy = places[i, 1] - oy
                dz = places[i, 2] - oz
                along = dx * ux + dy * uy + dz * uz
                beside = dx * dx + dy * dy + dz * dz - along * along
                passed[i] |= 0 < along < reach - size_m and beside < size_m * size_m / 16
        first = ends[k]
    return passed


@dataclass(frozen=True)
class PreparedScan:
    """A scan for merging. It is decoded once, and used for all frames whose windows contain it.

    Attributes:
        frame: frame number.
        points: (N, 3) float32, metres, sensor frame.
        labels: (N,) uint16; 0 casts no vote.
        world_T_sensor: (4, 4).
        reach_m: distance of the farthest point, metres.
        seconds: time of the scan.
        moving: (M,) indices of the points that move by their flow or their class, on a track or
            not.
        sure: (N,) float32, probability of each label from a network; None: 1.
        ends: (N, 3) float32, the points relative to the origins of their rays, metres: `points`
            themselves if that is the sensor.
        rays: the rays to the points, by origin and time.
    """

    frame: int
    points: Float32Array
    labels: Uint16Array
    world_T_sensor: Transform
    reach_m: float
    seconds: float
    moving: IntArray
    ends: Float32Array
    rays: Rays
    sure: Float32Array | None = None

    @classmethod
    def of(
        cls,
        frame: int,
        points: Float32Array,
        labels: LabelArray,
        world_T_sensor: Transform,
        *,
        seconds: float = 0.0,
        moving: IntArray | None = None,
        origins: Float32Array | None = None,
        probabilities: Uint16Array | None = None,
    ) -> PreparedScan:
        """Prepare the voting points of a scan.

        Args:
            frame: frame number.
            points: (N, 3) metres, sensor frame.
            labels: (N,) class ids.
            world_T_sensor: (4, 4) pose of the scan.
            seconds: time of the scan.
            moving: (M,) indices of the points that move; None: none.
            origins: (N, 3) origins of the rays, metres, sensor frame, or (N, 4) with their times,
                seconds after the scan; None: all at the sensor. Points with one row follow each
                other.
            probabilities: (N, 6) the field of the scan; None: labels are certain.
        """
        reach = float(lengths(points).max(initial=0.0))
        moving = np.empty(0, np.int64) if moving is None else moving
        sure = None
        if probabilities is not None:  # other labels than the likeliest one were found by carlasc
            likely = probabilities[:, 1] / np.float32(layout.CERTAIN)
            sure = np.where(probabilities[:, 0] == labels, likely, np.float32(1)).astype(np.float32)
        # Rays are kept relative to their origins; the origin is in the pose of the place, so that
        # the rule of votes is the same for a sensor that moves during the scan.
        ends = points if origins is None or not origins[:, :3].any() else points - origins[:, :3]
        return cls(
            frame,
            points,
            labels.astype(np.uint16),
            world_T_sensor,
            reach,
            seconds,
            moving,
            ends,
            Rays.of(ends, origins),
            sure,
        )

    @cached_property
    def world_T_places(self) -> FloatArray:
        """(K, 4, 4) poses of the origins of rays."""
        return self.world_T_sensor @ self.rays.sensor_T_places

    def cast(self, map_T_world: Transform, lower: FloatArray, upper: FloatArray) -> Cast:
        """Return the rays for a map of free space: those that pass through a region.

        Args:
            map_T_world: (4, 4).
            lower: (3,) lower corner of the region, metres, frame of the map.
            upper: (3,) upper corner.
        """
        places = map_T_world @ self.world_T_places
        origins, reach_m = places[:, :3, 3], self.reach_m  # where no point is, no ray is
        lower = np.maximum(lower, origins.min(axis=0) - reach_m)
        upper = np.minimum(upper, origins.max(axis=0) + reach_m)
        return Cast(self.ends, self.rays.ends, places, lower, upper)

    def through(
        self, track: Track, lower: FloatArray, upper: FloatArray
    ) -> tuple[IntArray, FloatArray, Cast] | None:
        """Return the (M,) rays that intersect a box, where they end, (M, 3) metres, frame of the
        actor, and their cast; None if the track does not extend to the scan.

        Args:
            track: the actor, which is where it was at the time of the rays.
            lower: (3,) lower corner of the box, metres, frame of the actor.
            upper: (3,) upper corner.
        """
        pose, velocity = track.pose(self.frame), track.velocity_at(self.frame)
        if pose is None or velocity is None:
            return None
        poses = np.repeat(pose[None], len(self.rays.ends), axis=0)
        poses[:, :3, 3] += velocity * self.rays.seconds[:, None]
        actor_T_places = invert(poses) @ self.world_T_sensor @ self.rays.sensor_T_places
        rays, ends, body = self.rays.through(actor_T_places, lower, upper)
        return rays, body, Cast(self.rays.points[rays], ends, actor_T_places, lower, upper)

    def at_frame(self, tracks: Iterable[Track]) -> PreparedScan:
        """Return the scan with the points of tracks where they are at the time of the frame."""
        seconds = self.rays.seconds
        if not seconds.any():
            return self
        times = np.repeat(seconds, np.diff(self.rays.ends, prepend=0))
        points, ends = self.points.copy(), self.ends.copy()
        for track in tracks:
            own = track.members.get(self.frame)
            velocity = track.velocity_at(self.frame)
            if own is not None and velocity is not None:
                moves = rotate_vectors(invert(self.world_T_sensor), velocity)
                points[own] = moved_back(points[own], times[own], moves)
                ends[own] = self.ends[own] + (points[own] - self.points[own])
        return replace(self, points=points, ends=ends)


# what a scan saw of the body of an actor: the rays through it, and (3, M) points of the actor,
# metres, both in the frame of the actor
_Carried = tuple[Cast, Float32Array]


class SeenBody(NamedTuple):
    """What scans saw of the body of an actor.

    Attributes:
        number: number of the actor.
        world_T_actor: (4, 4) pose of the actor at the frame of the grid.
        casts: the rays of each scan through the body, frame of the actor, by frame.
        points: the points of the actor, in the voxels of its body.
    """

    number: int
    world_T_actor: Transform
    casts: dict[int, Cast]
    points: SeenClass


class Merger:
    """Merges the scans of a window into the votes of one frame.

    Args:
        scan_of: returns the prepared scan of a frame.
        actors: the moving actors.
        classes: class table of the labels.
        dynamic: what happens to moving points.
    """

    def __init__(
        self,
        scan_of: Callable[[int], PreparedScan],
        actors: MovingActors,
        classes: ClassTable,
        dynamic: Dynamic,
    ) -> None:
        self.scan_of = scan_of
        self.actors = actors
        self.classes = classes
        self.dynamic = dynamic
        # of each scan, by its frame; then of its points by class, in its own grid or in others, and
        # of what it saw of each actor
        self._static = dict[int, tuple[BoolArray, BoolArray]]()
        self._moving = dict[int, Float32Array]()
        self._points = defaultdict[int, dict[bool, _ByClass]](dict)
        self._carried = defaultdict[int, dict[int, _Carried | None]](dict)

    def forget_before(self, frame: int) -> None:
        """Clear the caches of scans before a frame."""
        for kept in (self._static, self._moving, self._points, self._carried):
            for other in [key for key in kept if key < frame]:
                del kept[other]

    def own(self, now: Instant) -> Observation:
        """Return the observation by the frame's own scan, whose rays count everywhere."""
        scan = self.settled(now.frame)
        places = now.grid_T_world @ scan.world_T_places
        return Observation(scan.ends, self.labels(now.frame), places, scan.rays.ends)

    def points(self, now: Instant, window: Iterable[int]) -> list[SeenClass]:
        """Return the static points of each scan, and all points of the frame's own scan, by class.

        Static surfaces vote everywhere, so the road below an actor is kept.

        Args:
            now: the frame.
            window: frames of the scans.
        """
        found = defaultdict[int, list[ClassPoints]](list)
        for other in window:
            kept, own = self._points[other], other == now.frame
            scan = self.settled(other) if own else self.scan_of(other)
            if own not in kept:
                all_vote = self.dynamic == "tube" or (own and self.dynamic != "drop")
                votes = ~self.actors.is_own(scan.points) if all_vote else self.static(other)
                kept[own] = self._by_class(scan, votes)
            pose = as_pose(now.grid_T_world @ scan.world_T_sensor)
            for label, (points, sure) in kept[own].items():
                found[label].append(ClassPoints(points, pose, sure))
        return [SeenClass(label, points) for label, points in found.items()]

    def _by_class(self, scan: PreparedScan, votes: BoolArray) -> _ByClass:
        """Return the points of a scan that vote, (N,) bool, and how sure they are, by class."""
        found, voting = _ByClass(), np.flatnonzero(votes)
        labels = self.labels(scan.frame)[voting]
        # a radix sort, because they have 16 bits
        order = voting[np.argsort(labels, kind="stable")]
        ends = np.cumsum(np.bincount(labels))
        for label in np.flatnonzero(np.diff(ends)).tolist():
            rows = order[ends[label] : ends[label + 1]]
            points = np.ascontiguousarray(scan.points.take(rows, axis=0).T)
            found[label + 1] = points, None if scan.sure is None else scan.sure[rows]
        return found

    def bodies(
        self, now: Instant, window: Iterable[int], regions: BodyRegions, *, mirror: bool = False
    ) -> Iterator[SeenBody]:
        """Yield what other scans saw of each actor in its body, without actors that none saw.

        Args:
            now: the frame.
            window: frames of the scans.
            regions: the voxels of the bodies.
            mirror: yield mirror images instead. Vehicles are symmetric: their points and rays are
                reflected in the vertical plane through the middle of the body, if that is known.
                Only mirror images use the frame's own scan.
        """
        for region, number in regions.actors.items():
            track = self.actors.tracks[number]
            pose = track.pose(now.frame)
            if pose is None or (mirror and not (track.rigid and any(track.extent.known))):
                continue
            pose = pose @ _MIRROR if mirror else pose
            casts = {}
            points = []
            grid_T_actor = as_pose(now.grid_T_world @ pose)
            for other in window:
                if mirror or other != now.frame:
                    carried = self._carry(number, other, now)
                    if carried is not None:
                        casts[other], seen = carried
                        points.append(ClassPoints(seen, grid_T_actor))
            if casts:
                votes = SeenClass(track.label, points, regions.of_voxel, region)
                yield SeenBody(number, pose, casts, votes)

    def settled(self, frame: int) -> PreparedScan:
        """Return a scan with the points of actors where they are at the time of the frame."""
        return self.scan_of(frame).at_frame(self.actors.tracks.values())

    def moving(self, frame: int) -> Float32Array:
        """Return the (M, 3) moving points of a scan, metres, sensor frame."""
        if frame not in self._moving:
            self._moving[frame] = self.settled(frame).points[~self.static(frame)]
        return self._moving[frame]

    def recent(self, now: Instant, window: Iterable[int]) -> list[int]:
        """Return the frames of the scans within `RECENT_S` of the frame."""
        return [
            other for other in window if abs(self.scan_of(other).seconds - now.seconds) <= RECENT_S
        ]

    def shells(self, now: Instant, regions: BodyRegions) -> Iterator[SeenClass]:
        """Yield the surface of each vehicle in its body, for the parts that no scan saw."""
        for region, number in regions.actors.items():
            track = self.actors.tracks[number]
            pose = track.pose(now.frame)
            if len(track.surface) and pose is not None:
                surface = np.ascontiguousarray(track.surface.T)
                points = [ClassPoints(surface, as_pose(now.grid_T_world @ pose))]
                yield SeenClass(track.label, points, regions.of_voxel, region)

    def static(self, frame: int) -> BoolArray:
        """Return (N,) bool: the points of a scan that belong to no moving actor.

        Points in or near the body of an actor are not static, except ground: fields and free space
        may miss some points of an actor.
        """
        if frame not in self._static:
            scan = self.scan_of(frame)
            under = np.zeros(len(scan.points), np.bool_)
            static = ~under
            static[scan.moving] = False
            static[self.actors.is_own(scan.points)] = False
            static[self.actors.moving.get(frame, [])] = False
            # Wheels touch the ground: ground near a body stays static, or each actor would leave a
            # hole in the road. A map knows the road of other scans: see `under`.
            ground = self.classes.have_role(scan.labels, "ground")
            for track in self.actors.tracks.values():
                static[track.members.get(frame, [])] = False
                if is_doubtful(track.confidence):  # its body may be a part of the static scene
                    continue
                found = scan.through(track, track.lower - _BESIDE_M, track.upper + _BESIDE_M)
                if found is None:
                    continue
                near, body, _ = found
                inside = _is_near(track, body, _AROUND_M) & ~ground[near]
                below = _is_near(track, body, _UNDER_M) & ground[near]
                static[near[inside]], under[near[below]] = False, True
                beside = body[ground[near] & ~below, 2]
                if len(beside) >= _BESIDE:
                    foot = body[:, 2] > np.median(beside) + _FOOT_M
                    static[near[below & foot]] = False
            self._static[frame] = static, under
        return self._static[frame][0]

    def under(self, frame: int) -> BoolArray:
        """Return (N,) bool: the points of a scan on ground in, near or below the body of a moving
        actor. Some of them are of its wheels or feet.
        """
        self.static(frame)
        return self._static[frame][1]

    def labels(self, frame: int) -> Uint16Array:
        """Return the (N,) classes of the points of a scan.

        All points of an actor have the most frequent class of its points in all scans.
        """
        labels = self.scan_of(frame).labels.copy()
        for track in self.actors.tracks.values() if self.dynamic == "align" else ():
            labels[track.members.get(frame, [])] = track.label
        return labels

    def _carry(self, number: int, other: int, now: Instant) -> _Carried | None:
        """Return what a scan saw of the body of an actor; None if no ray passed through it, or the
        shape of the actor was different then.
        """
        track = self.actors.tracks[number]
        if not track.rigid and abs(self.scan_of(other).seconds - now.seconds) > _DEFORMABLE_S:
            return None
        kept = self._carried[other]
        if number not in kept:
            found = self.scan_of(other).through(track, track.lower, track.upper)
            if found is not None and len(found[0]):
                rays, places, cast = found
                seen = np.isin(rays, track.members.get(other, []))
                kept[number] = cast, np.ascontiguousarray(places[seen].astype(np.float32).T)
        return kept.setdefault(number, None)


def _is_near(track: Track, places: FloatArray, margin_m: FloatArray) -> BoolArray:
    """Return (M,) bool: which of (M, 3) places, metres, frame of the actor, are in its body or
    within (3,) a margin of it.
    """
    inside = (places >= track.lower - margin_m) & (places <= track.upper + margin_m)
    return np.asarray(inside.all(axis=1))


@dataclass(frozen=True)
class BodyRegions:
    """Which voxels belong to which actor.

    Attributes:
        of_voxel: (V,) uint16, region of each voxel; STATIC outside of all bodies.
        actors: number of the actor by region, for the regions that have voxels.
        hidden: (H,) flat indices of voxels of faces that no scan saw. Rays beside the body pass
            through them, and do not count there.
        hidden_ends: (E,) the same for faces that are hidden also in the mirror image of the body.
    """

    of_voxel: Uint16Array
    actors: Mapping[int, int]
    hidden: IntArray
    hidden_ends: IntArray

    @classmethod
    def at(
        cls, merger: Merger, now: Instant, window: Collection[int], spec: GridSpec
    ) -> BodyRegions:
        """Return the regions of a frame: of the bodies of moving actors, and of moving points
        without a body.

        Args:
            merger: the moving actors, and the scans.
            now: the frame.
            window: frames whose scans are merged.
            spec: the grid.
        """
        tracks = merger.actors.tracks.items() if merger.dynamic == "align" else ()
        present = [
            (number, track, pose)
            for number, track in tracks
            if (pose := track.pose(now.frame)) is not None
        ]
        regions = cls.of_bodies(spec, now.world_T_grid, present)
        if merger.dynamic in ("align", "current") and now.frame in window:
            grid_T_sensor = now.grid_T_world @ merger.scan_of(now.frame).world_T_sensor
            return regions.with_points(
                spec, transform_points(grid_T_sensor, merger.moving(now.frame))
            )
        return regions

    def with_points(self, spec: GridSpec, points: AnyFloatArray) -> BodyRegions:
        """Return the regions with another one for the voxels of moving points without a body.

        Only the frame's own rays vote there.

        Args:
            spec: the grid.
            points: (M, 3) metres, grid frame.
        """
        of_voxel = self.of_voxel.copy()
        voxels = spec.flat_index(points)
        voxels = voxels[voxels >= 0]
        of_voxel[voxels[of_voxel[voxels] == STATIC]] = max(self.actors, default=0) + 1
        return replace(self, of_voxel=of_voxel)

    @classmethod
    def of_bodies(
        cls, spec: GridSpec, world_T_grid: Transform, bodies: Series[tuple[int, Track, Transform]]
    ) -> Self:
        """Return the regions of bodies: (number, track, world_T_actor) of each actor.

        A body has all voxels that it touches. Where bodies overlap, the smaller body has the voxel.
        """
        of_voxel = np.zeros(spec.num_voxels, np.uint16)
        hidden, hidden_ends = np.zeros((2, spec.num_voxels), np.bool_)
        columns, heights, across, up = _columns_of(spec)
        largest_first = sorted(bodies, key=lambda body: -float(np.prod(body[1].size)))
        for region, (_, track, pose) in enumerate(largest_first, 1):
            actor_T_grid = invert(pose) @ world_T_grid
            turned = np.abs(actor_T_grid[:3, :3])
            x, y = invert(actor_T_grid)[:2, 3]
            reach = float(np.linalg.norm(np.maximum(-track.lower, track.upper))) + across + up
            is_near = (np.abs(columns[0] - x) < reach) & (np.abs(columns[1] - y) < reach)
            near = np.flatnonzero(is_near)
            if not len(near):
                continue
            cells = np.column_stack(
                [*np.repeat(columns[:, near], len(heights), axis=1), np.tile(heights, len(near))]
            )
            slack = (
                np.repeat(across[near], len(heights))[:, None] * turned[:, :2].sum(axis=1)
                + up * turned[:, 2]
            )
            body = transform_points(actor_T_grid, cells)
            inside = ((body > track.lower - slack) & (body < track.upper + slack)).all(axis=1)
            # C order: the cells of a column follow each other in the flat index
            own = (near[:, None] * len(heights) + np.arange(len(heights))).reshape(-1)[inside]
            of_voxel[own] = region
            # Vehicles are symmetric about their length only: a side that one scan saw is known on
            # the other side too, but not the rear from the front.
            rear, front, low, high = track.extent.faces
            mirrored = (rear, front, low or high, low or high)
            hidden[own] = _on_hidden_face(track, body[inside], slack[inside], track.extent.faces)
            hidden_ends[own] = _on_hidden_face(track, body[inside], slack[inside], mirrored)
        present = np.unique(of_voxel[of_voxel != STATIC]).tolist()
        actors = {region: largest_first[region - 1][0] for region in present}
        return cls(of_voxel, actors, np.flatnonzero(hidden), np.flatnonzero(hidden_ends))


@lru_cache(maxsize=4)
def _columns_of(spec: GridSpec) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return the columns of the cells of a grid: x and y of their centres, (2, C), z of the centres
    in each, and half the extent of the cells, (C,) across and up, all in metres.
    """
    # Cells of a column share x and y: a body is compared with columns first, then with the cells of
    # the few columns near it.
    size = spec.voxel_size
    centers = spec.from_axes(replace(spec, size=(*spec.size[:2], 1)).centers())
    columns = centers[:, :, 0, :2].reshape(-1, 2).T.astype(np.float64, order="C")
    heights = spec.lower[2] + (np.arange(spec.size[2]) + 0.5) * size[2]
    is_curved = spec.coordinates == "cylindrical"
    width = np.hypot(*columns) * size[1] if is_curved else np.full(columns.shape[1], size[1])
    return columns, heights, np.maximum(size[0], width) / 2, float(size[2] / 2)


def _on_hidden_face(
    track: Track,
    cells: FloatArray,
    slack: FloatArray,
    faces: tuple[bool, bool, bool, bool],
) -> BoolArray:
    """Return (C,) bool: which cells touch an unseen face and no seen face of an actor.

    Args:
        track: the actor.
        cells: (C, 3) centres of cells that its body touches, metres, actor frame.
        slack: (C, 3) half the extent of each cell along the axes of the actor.
        faces: whether scans saw the rear, the front, the side of low y and the side of high y.
    """
    lower, upper = track.lower + BODY_MARGIN_M, track.upper - BODY_MARGIN_M
    # of each cell, along x and y, from the lower face and from the upper one
    away = np.stack([cells - lower, upper - cells], axis=2)[:, :2]
    touches = np.abs(away) <= slack[:, :2, None]
    seen = np.reshape(faces, (2, 2))
    return (touches & ~seen).any(axis=(1, 2)) & ~(touches & seen).any(axis=(1, 2))
