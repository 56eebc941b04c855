"""The actor of each voxel of a frame from merged scans: moving actors by their bodies, static ones
by the numbers of the data.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from carlasc.core.arrays import (
    AnyIntArray,
    BoolArray,
    FloatArray,
    Uint32Array,
)
from carlasc.core.cells import warped_voxels
from carlasc.core.geometry import invert, multiply, rotate_vectors, transform_points
from carlasc.core.grids import GridSpec
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.merging import STATIC, BodyRegions, Instant
from carlasc.groundtruth.voxel_actors import VoxelActors, number_actors
from carlasc.motion.tracks import FIRST_FOUND, MovingActors, Track

_CLASS_PARTS = 1 << 10  # in the upper 16 bits, smaller values may be a class
_TURN_FRAMES = 3  # frames before and after, between which the turn rate of an actor is measured


def with_numbers(actors: MovingActors, feed: ScanFeed) -> MovingActors:
    """Return the actors with their numbers in the whole sequence."""
    highest = max((int(actor["instance"]) for actor in actors.summary), default=0)
    numbered = [track for track in actors.tracks.values() if 0 < track.instance < FIRST_FOUND]
    if len(numbered) < len(actors.tracks):
        upper, lower, sequence = 0, 0, feed.sequence
        # the numbers of the points of each scan, and of the tracks of its boxes
        for field in sorted({"boxes", "instances"} & sequence.fields()):
            for frame in sequence.frames(field).tolist():
                rows = sequence.read(field, frame)
                given = (rows["track"] if field == "boxes" else rows).astype(np.int64)
                most = int(given.max(initial=0))
                highest, upper = max(highest, most), max(upper, most >> 16)
                lower = max(lower, int((given & 0xFFFF).max(initial=0)))
        # new numbers are unique in the lower half too: SemanticKITTI's files keep it alone
        if upper < _CLASS_PARTS:
            highest = max(highest, upper << 16 | lower)
    return replace(actors, numbers=number_actors(actors.tracks, highest))


def find_voxels(
    spec: GridSpec,
    feed: ScanFeed,
    actors: MovingActors,
    now: Instant,
    regions: BodyRegions,
    window: list[int],
    labels: AnyIntArray,
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
    solid = (labels > 0) & ~classes.have_role(labels, "ground")
    movable = solid & classes.have_role(labels, "movable") if feed.has_labels else solid
    voxels, velocities = [np.empty(0, np.int64)], [np.empty((0, 3))]
    bodies = np.flatnonzero((regions.of_voxel != STATIC) & solid)
    centers = transform_points(now.world_T_grid, spec.centers_of(bodies))
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
    # Bodies are of moving actors, points and boxes of static ones. Each step fills voxels that the
    # steps before it left without an actor.
    free = movable & (instance == 0)
    moving = {track.instance for track in actors.tracks.values()}
    _number_points(spec, feed, moving, now, window, free, instance)
    _number_boxes(spec, feed, moving, now, free & (instance == 0), instance)
    return VoxelActors.of(spec, instance, np.concatenate(voxels), np.concatenate(velocities))


def velocity_at(track: Track, frame: int, places: FloatArray, feed: ScanFeed) -> FloatArray:
    """Return the (N, 3) velocities, m/s, world, of (N, 3) positions on an actor, metres, world,
    which moves and turns about the vertical.
    """
    row, known = frame - track.first, feed.frames
    near = np.clip([frame - _TURN_FRAMES, frame + _TURN_FRAMES], known[0], known[-1]) - track.first
    before, after = np.clip(near, 0, len(track.world_T_actor) - 1).tolist()
    # The velocity of a track is that of the origin of its body; the turn adds the rest.
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
    moving: set[int],
    now: Instant,
    window: list[int],
    free: BoolArray,
    instance: Uint32Array,
) -> None:
    """Give voxels without an actor the most frequent number of the static points in them."""
    if "instances" not in feed.sequence.fields() or not window:
        return
    of_scans = zip(*map(feed.numbered, window), strict=True)
    points, numbers = (np.concatenate(parts) for parts in of_scans)
    static = ~np.isin(numbers, list(moving))
    grid_T_world = np.column_stack([now.grid_T_world[:3], np.zeros(3)])[None]
    (voxels,) = warped_voxels(points[static], spec, grid_T_world)
    used = np.append(free, False)[voxels]
    # voxel and number in one integer: `unique` of integers is faster than of rows
    pairs = voxels[used] << 32 | numbers[static][used]
    keys, counts = np.unique(pairs, return_counts=True)
    order = np.argsort(counts, kind="stable")  # the most frequent number is written last
    instance[keys[order] >> 32] = (keys[order] & 0xFFFFFFFF).astype(np.uint32)


def _number_boxes(
    spec: GridSpec,
    feed: ScanFeed,
    moving: set[int],
    now: Instant,
    free: BoolArray,
    instance: Uint32Array,
) -> None:
    """Give voxels without an actor the number of the smallest box that contains them."""
    boxes = feed.sequence.boxes(now.frame) if "boxes" in feed.sequence.fields() else None
    if boxes is None or not len(boxes):
        return
    voxels = np.flatnonzero(free)
    centers = spec.centers_of(voxels)
    half = np.asarray(spec.voxel_size if spec.coordinates == "cartesian" else (0, 0, 0)) / 2
    # The largest box first: a smaller box inside of it overwrites its voxels.
    for row in np.argsort(-boxes.sizes.prod(axis=1), kind="stable").tolist():
        if int(boxes.tracks[row]) not in moving:
            box_T_grid = invert(boxes.sensor_T_box[row])
            slack = np.abs(box_T_grid[:3, :3]) @ half
            inside = (
                np.abs(transform_points(box_T_grid, centers)) < boxes.sizes[row] / 2 + slack
            ).all(axis=1)
            instance[voxels[inside]] = boxes.tracks[row]
