"""The actor of each voxel of a frame from merged scans: moving actors by their bodies, static ones
by the numbers of the data.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from collections.abc import Sequence as Series
from dataclasses import dataclass, replace
from typing import Self
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import Transform, invert, multiply, rotate_vectors, transform_points
from carlasc.core.grids import GridSpec
from carlasc.core.scans import finite
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.merging import STATIC, Instant, Merger
from carlasc.groundtruth.voxel_actors import VoxelActors, centers_of, number_actors
from carlasc.motion import BODY_MARGIN_M
from carlasc.motion.tracks import FIRST_FOUND, MovingActors, Track
from carlasc.storage.protocol import Sequence

_CLASS_PARTS = 1 << 10  # in the upper 16 bits, smaller values may be a class
_TURN_FRAMES = 3  # frames before and after, between which the turn rate of an actor is measured
Numbered = tuple[NDArray[np.float32], NDArray[np.int64]]
# the numbered points of scans
_NUMBERED: WeakKeyDictionary[ScanFeed, dict[int, Numbered]] = WeakKeyDictionary()


def with_numbers(actors: MovingActors, feed: ScanFeed) -> MovingActors:
    """Return the actors with their numbers in the whole sequence."""
    highest = max((int(actor["instance"]) for actor in actors.summary), default=0)
    numbered = [track for track in actors.tracks.values() if 0 < track.instance < FIRST_FOUND]
    if len(numbered) < len(actors.tracks):
        upper = lower = 0
        for given in _numbers_of(feed.sequence):
            highest, upper = (
                max(highest, int(given.max(initial=0))),
                max(upper, int(given.max(initial=0)) >> 16),
            )
            lower = max(lower, int((given & 0xFFFF).max(initial=0)))
        # new numbers are unique in the lower half too: SemanticKITTI's files keep it alone
        if upper < _CLASS_PARTS:
            highest = max(highest, upper << 16 | lower)
    return replace(actors, numbers=number_actors(actors.tracks, highest))


def _numbers_of(sequence: Sequence) -> Iterator[NDArray[np.int64]]:
    """Yield the numbers of actors in the data: of the points of each scan, and of the tracks of its
    boxes.
    """
    fields = sequence.fields()
    for frame in sequence.frames("instances").tolist() if "instances" in fields else ():
        yield sequence.read("instances", frame).astype(np.int64)
    for frame in sequence.frames("boxes").tolist() if "boxes" in fields else ():
        yield sequence.read("boxes", frame)["track"].astype(np.int64)


def find_voxels(
    spec: GridSpec,
    feed: ScanFeed,
    actors: MovingActors,
    now: Instant,
    regions: BodyRegions,
    window: list[int],
    labels: NDArray[np.integer],
) -> VoxelActors:
    """Return the actors of the voxels of a frame.

    Args:
        spec: the grid.
        feed: the scans.
        actors: the moving actors, with numbers.
        now: the frame.
        regions: the voxels of their bodies.
        window: frames whose scans were merged.
        labels: (V,) classes of the grid, with ground classes.
    """
    classes, instance = feed.classes, np.zeros(spec.num_voxels, np.uint32)
    solid = (labels > 0) & ~np.isin(labels, sorted(classes.ground))
    movable = solid & np.isin(labels, sorted(classes.movable)) if feed.has_labels else solid
    voxels, velocities = [np.empty(0, np.int64)], [np.empty((0, 3))]
    bodies = np.flatnonzero((regions.of_voxel != STATIC) & solid)
    centers = transform_points(now.world_T_grid, centers_of(spec, bodies))
    for region, number in regions.actors.items():
        track = actors.tracks[number]
        own = (regions.of_voxel[bodies] == region) & (
            movable[bodies] | (labels[bodies] == track.label)
        )
        instance[bodies[own]] = actors.numbers[number]
        voxels.append(bodies[own])
        velocities.append(
            rotate_vectors(now.grid_T_world, velocity_at(track, now.frame, centers[own], feed))
        )
    free = movable & (instance == 0)
    _number_points(spec, feed, actors, now, window, free, instance)
    _number_boxes(spec, feed, actors, now, free & (instance == 0), instance)
    return VoxelActors.of(spec, instance, np.concatenate(voxels), np.concatenate(velocities))


def velocity_at(
    track: Track, frame: int, places: NDArray[np.float64], feed: ScanFeed
) -> NDArray[np.float64]:
    """Return the (N, 3) velocities, m/s, world, of (N, 3) positions on an actor, metres, world,
    which moves and turns about the vertical.
    """
    row, known = frame - track.first, feed.frames
    near = np.clip([frame - _TURN_FRAMES, frame + _TURN_FRAMES], known[0], known[-1]) - track.first
    before, after = np.clip(near, 0, len(track.world_T_actor) - 1).tolist()
    turn = multiply(track.world_T_actor[after], invert(track.world_T_actor[before]))
    begin, end = np.interp(
        [track.first + before, track.first + after], known, list(feed.times.values())
    )
    rate = (
        float(np.arctan2(turn[1, 0], turn[0, 0])) / (end - begin)
        if end > begin and track.rigid
        else 0.0
    )
    arm = places - track.world_T_actor[row, :3, 3]
    return track.velocity[row] + rate * np.column_stack([-arm[:, 1], arm[:, 0], np.zeros(len(arm))])


def _number_points(
    spec: GridSpec,
    feed: ScanFeed,
    actors: MovingActors,
    now: Instant,
    window: list[int],
    free: NDArray[np.bool_],
    instance: NDArray[np.uint32],
) -> None:
    """Give voxels without an actor the most frequent number of the static points in them."""
    if "instances" not in feed.sequence.fields():
        return
    moving = {track.instance for track in actors.tracks.values()}
    kept = _NUMBERED.setdefault(feed, {})
    for old in [frame for frame in kept if frame < now.frame + feed.options.window[0]]:
        del kept[old]
    pairs = [np.empty(0, np.int64)]
    for frame in window:
        if frame not in kept:
            kept[frame] = _numbered(feed, frame)
        points, numbers = kept[frame]
        static = ~np.isin(numbers, list(moving))
        points, numbers = points[static], numbers[static]
        found = spec.flat_index(transform_points(now.grid_T_world, points))
        used = found >= 0
        used[used] = free[found[used]]
        pairs.append(found[used].astype(np.int64) << 32 | numbers[used])
    keys, counts = np.unique(np.concatenate(pairs), return_counts=True)
    order = np.argsort(counts, kind="stable")  # the most frequent number is written last
    instance[keys[order] >> 32] = (keys[order] & 0xFFFFFFFF).astype(np.uint32)


def _numbered(feed: ScanFeed, frame: int) -> Numbered:
    """Return the (M, 3) numbered points of a scan, metres, world, and their (M,) numbers."""
    scan = feed.sequence.scan(frame, ("instances",))
    if scan.instances is None:
        return np.empty((0, 3), np.float32), np.empty(0, np.int64)
    own = (scan.instances > 0) & finite(scan.points)
    return transform_points(feed.pose(frame), scan.points[own]).astype(np.float32), scan.instances[
        own
    ].astype(np.int64)


def _number_boxes(
    spec: GridSpec,
    feed: ScanFeed,
    actors: MovingActors,
    now: Instant,
    free: NDArray[np.bool_],
    instance: NDArray[np.uint32],
) -> None:
    """Give voxels without an actor the number of the smallest box of the frame that contains them."""
    boxes = feed.sequence.boxes(now.frame) if "boxes" in feed.sequence.fields() else None
    if boxes is None or not len(boxes):
        return
    moving = {track.instance for track in actors.tracks.values()}
    voxels = np.flatnonzero(free)
    centers, half = (
        centers_of(spec, voxels),
        np.asarray(spec.voxel_size if spec.coordinates == "cartesian" else (0, 0, 0)) / 2,
    )
    for row in np.argsort(-boxes.sizes.prod(axis=1), kind="stable").tolist():
        if int(boxes.tracks[row]) not in moving:
            box_T_grid = invert(boxes.sensor_T_box[row])
            slack = np.abs(box_T_grid[:3, :3]) @ half
            inside = (
                np.abs(transform_points(box_T_grid, centers)) < boxes.sizes[row] / 2 + slack
            ).all(axis=1)
            instance[voxels[inside]] = boxes.tracks[row]


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

    of_voxel: NDArray[np.uint16]
    actors: Mapping[int, int]
    hidden: NDArray[np.int64]
    hidden_ends: NDArray[np.int64]

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
            scan = merger.scan_of(now.frame)
            moving = scan.points[~merger.static(now.frame)]
            return regions.with_points(
                spec, transform_points(now.grid_T_world @ scan.world_T_sensor, moving)
            )
        return regions

    def with_points(self, spec: GridSpec, points: NDArray[np.floating]) -> BodyRegions:
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
        hidden, hidden_ends = (
            np.zeros(spec.num_voxels, np.bool_),
            np.zeros(spec.num_voxels, np.bool_),
        )
        size = spec.voxel_size
        # x and y of the centres of the columns of cells, (C, 2), z of the centres in each, and half
        # the extent of the cells.
        columns = spec.from_axes(replace(spec, size=(*spec.size[:2], 1)).centers())[
            :, :, 0, :2
        ].reshape(-1, 2)
        columns, heights = (
            columns.astype(np.float64),
            spec.lower[2] + (np.arange(spec.size[2]) + 0.5) * size[2],
        )
        width = (
            np.hypot(columns[:, 0], columns[:, 1]) * size[1]
            if spec.coordinates == "cylindrical"
            else size[1]
        )
        across, up = (
            np.broadcast_to(np.maximum(size[0], width) / 2, len(columns)),
            float(size[2] / 2),
        )
        largest_first = sorted(bodies, key=lambda body: -float(np.prod(body[1].size)))
        for region, (_, track, pose) in enumerate(largest_first, 1):
            actor_T_grid = invert(pose) @ world_T_grid
            turned = np.abs(actor_T_grid[:3, :3])
            middle = invert(actor_T_grid)[:2, 3]
            reach = float(np.linalg.norm(np.maximum(-track.lower, track.upper))) + across + up
            near = np.flatnonzero((np.abs(columns - middle) < reach[:, None]).all(axis=1))
            cells = np.column_stack(
                [np.repeat(columns[near], len(heights), axis=0), np.tile(heights, len(near))]
            )
            slack = (
                np.repeat(across[near], len(heights))[:, None] * turned[:, :2].sum(axis=1)
                + up * turned[:, 2]
            )
            body = transform_points(actor_T_grid, cells)
            inside = ((body > track.lower - slack) & (body < track.upper + slack)).all(axis=1)
            own = (near[:, None] * len(heights) + np.arange(len(heights))).reshape(-1)[inside]
            of_voxel[own] = region
            rear, front, low, high = track.extent.faces
            mirrored = (rear, front, low or high, low or high)
            hidden[own] = _on_hidden_face(track, body[inside], slack[inside], track.extent.faces)
            hidden_ends[own] = _on_hidden_face(track, body[inside], slack[inside], mirrored)
        present = np.unique(of_voxel[of_voxel != STATIC]).tolist()
        actors = {region: largest_first[region - 1][0] for region in present}
        return cls(of_voxel, actors, np.flatnonzero(hidden), np.flatnonzero(hidden_ends))


def _on_hidden_face(
    track: Track,
    cells: NDArray[np.float64],
    slack: NDArray[np.float64],
    faces: tuple[bool, bool, bool, bool],
) -> NDArray[np.bool_]:
    """Return (C,) bool: which cells touch an unseen face and no seen face of an actor.

    Args:
        track: the actor.
        cells: (C, 3) centres of cells that its body touches, metres, actor frame.
        slack: (C, 3) half the extent of each cell along the axes of the actor.
        faces: whether scans saw the rear, the front, the side of low y and the side of high y.
    """
    lower, upper = track.lower + BODY_MARGIN_M, track.upper - BODY_MARGIN_M
    away = np.stack(
        [
            cells[:, 0] - lower[0],
            upper[0] - cells[:, 0],
            cells[:, 1] - lower[1],
            upper[1] - cells[:, 1],
        ]
    )
    touches = np.abs(away) <= np.stack([slack[:, 0], slack[:, 0], slack[:, 1], slack[:, 1]])
    seen = np.array(faces)[:, None]
    return (touches & ~seen).any(axis=0) & ~(touches & seen).any(axis=0)
