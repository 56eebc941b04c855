"""The actor and the velocity of each voxel of a grid, and how the points of recordings give them.

Each actor has one number in the whole sequence, also if it has several tracks.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from carlasc.captures.raw import SensorRecording
from carlasc.core.arrays import (
    AnyFloatArray,
    BoolArray,
    FloatArray,
    IntArray,
    LabelArray,
    RecordArray,
    Uint32Array,
)
from carlasc.core.cells import run_starts
from carlasc.core.geometry import Transform, invert, multiply, rotate_vectors, transform_points
from carlasc.core.grids import GridSpec
from carlasc.motion.segments import MIN_SPEED_M_S
from carlasc.motion.tracks import FIRST_FOUND, Track
from carlasc.storage.field_files import VELOCITY_DTYPE

_POINTS_DTYPE = np.dtype(
    [("voxel", np.int32), ("label", np.uint16), ("actor", np.uint32), ("points", np.int64)]
)


@dataclass(frozen=True)
class VoxelActors:
    """The actors in the voxels of a grid, and their velocities.

    Attributes:
        instance: (X, Y, Z) uint32, number of the actor of each voxel in the whole sequence; 0 for
            none.
        velocity: (M,) `field_files.VELOCITY_DTYPE`, sorted by voxel: the moving voxels, m/s, axes
            of the frame's sensor, ego motion removed.
    """

    instance: Uint32Array
    velocity: RecordArray

    @classmethod
    def of(
        cls,
        spec: GridSpec,
        instance: Uint32Array,
        voxels: IntArray,
        velocity: AnyFloatArray,
    ) -> Self:
        """Return the actors of a grid.

        Args:
            spec: the grid.
            instance: (V,) number of the actor of each voxel.
            voxels: (M,) flat indices of voxels that may move.
            velocity: (M, 3) their velocities, m/s; slow ones are left out.
        """
        fast = np.flatnonzero(np.square(velocity).sum(axis=1) > MIN_SPEED_M_S**2)
        fast = fast[np.argsort(voxels[fast], kind="stable")]
        table = np.empty(len(fast), VELOCITY_DTYPE)
        table["voxel"] = voxels[fast]
        table["velocity"] = velocity[fast]
        return cls(instance.reshape(spec.size), table)

    def within(self, occupied: BoolArray) -> Self:
        """Return the actors in the voxels that are occupied, (X, Y, Z)."""
        kept = occupied.reshape(-1)[self.velocity["voxel"]]
        return replace(self, instance=self.instance * occupied, velocity=self.velocity[kept])


class ActorPoints:
    """Counts the points of each actor in each voxel; memory does not grow with the number of
    sensors.

    Attributes:
        spec: the grid.
        turns: turn rates of actors about the vertical, rad/s, by their numbers.
        deformable: classes of actors that do not turn as a whole.
    """

    def __init__(
        self, spec: GridSpec, turns: Mapping[int, float], deformable: Collection[int]
    ) -> None:
        self.spec = spec
        self.turns = turns
        self.deformable = deformable
        self._counts = np.empty(0, _POINTS_DTYPE)
        self._velocity: dict[int, FloatArray] = {}
        # (2, 2) lower and upper bounds in x, y of turning actors
        self._extent: dict[int, FloatArray] = {}

    def add(self, recording: SensorRecording, grid_T_sensor: Transform) -> None:
        """Add the points of a recording; numbers of actors are those of the whole recording."""
        scan = recording.scan
        if scan.labels is None or scan.instances is None:
            return
        points = transform_points(grid_T_sensor, scan.points)
        voxels = self.spec.flat_index(points)
        used = (voxels >= 0) & (scan.labels > 0)
        rows = np.empty(np.count_nonzero(used), _POINTS_DTYPE)
        rows["voxel"] = voxels[used]
        rows["label"] = scan.labels[used]
        rows["actor"] = scan.instances[used]
        rows["points"] = 1
        self._counts = _sum(np.concatenate([self._counts, _sum(rows)]))
        velocity = rotate_vectors(grid_T_sensor, recording.velocities[:, 1:])
        for actor, own in zip(
            recording.velocities[:, 0].astype(np.int64).tolist(), velocity, strict=True
        ):
            self._velocity.setdefault(actor, own)
            places = points[scan.instances == actor, :2]
            if self.turns.get(actor) and len(places):
                places = np.concatenate([places, self._extent.get(actor, places[:0])])
                self._extent[actor] = np.stack([places.min(axis=0), places.max(axis=0)])

    def of(self, labels: LabelArray) -> VoxelActors:
        """Return the actors of a grid with (X, Y, Z) labels: the most frequent number of the points
        of a voxel's class; ties go to the lowest.
        """
        counts = self._counts
        counts = counts[counts["label"] == labels.reshape(-1)[counts["voxel"]]]
        best = counts[np.lexsort((counts["actor"], -counts["points"], counts["voxel"]))]
        best = best[run_starts(best["voxel"])]
        instance = np.zeros(self.spec.num_voxels, np.uint32)
        instance[best["voxel"]] = best["actor"]
        known = best[np.isin(best["actor"], list(self._velocity)) & (best["actor"] > 0)]
        velocity = np.array([self._velocity[actor] for actor in known["actor"].tolist()]).reshape(
            -1, 3
        )
        self._turn(known, velocity)
        return VoxelActors.of(self.spec, instance, known["voxel"].astype(np.int64), velocity)

    def _turn(self, rows: RecordArray, velocity: FloatArray) -> None:
        """Add to the velocity of each voxel the turn of its actor about the middle of the points of
        the actor.
        """
        for actor, extent in self._extent.items():
            own = np.flatnonzero(
                (rows["actor"] == actor) & ~np.isin(rows["label"], list(self.deformable))
            )
            arm = self.spec.centers_of(rows["voxel"][own])[:, :2] - extent.mean(axis=0)
            velocity[own, :2] += self.turns[actor] * np.column_stack([-arm[:, 1], arm[:, 0]])


def _sum(rows: RecordArray) -> RecordArray:
    """Return one row for each voxel, class and actor, with the sum of its points."""
    order = np.lexsort((rows["actor"], rows["label"], rows["voxel"]))
    rows = rows[order]
    keys = rows[["voxel", "label", "actor"]]
    first = np.flatnonzero(np.append(True, keys[1:] != keys[:-1])[: len(rows)])
    sums = rows[first]
    sums["points"] = np.add.reduceat(rows["points"], first) if len(first) else 0
    return sums


_FEWEST_COMMON = 3  # least number of frames in which two compared tracks have poses
_AROUND_M = 0.3  # margin around a body
_INSIDE = 0.7  # least share of these frames with one actor in the body of the other


def number_actors(tracks: Mapping[int, Track], highest: int = 0) -> dict[int, int]:
    """Return the number of the actor of each track, by the number of the track.

    Numbers of the data are kept. Other tracks get higher numbers, in the order of their first
    frames. Two tracks belong to one actor if they have the same class, at most one of them has a
    number, and the middle of the visible part of the smaller one is mostly in the body of the
    larger one; tracks of people only if no scan shows both.

    Args:
        tracks: the moving actors.
        highest: the highest number in the data.
    """
    order = sorted(tracks, key=lambda number: (tracks[number].first, number))
    group = {number: number for number in order}
    numbers = {n: t.instance for n, t in tracks.items() if 0 < t.instance < FIRST_FOUND}

    def root(number: int) -> int:
        while group[number] != number:
            number = group[number]
        return number

    for row, one in enumerate(order):
        end = tracks[one].first + len(tracks[one].world_T_actor)
        for other in order[row + 1 :]:
            if tracks[other].first > end - _FEWEST_COMMON:
                break
            first = root(one)
            second = root(other)
            may_join = first != second and not (first in numbers and second in numbers)
            if may_join and _are_one(tracks[one], tracks[other]):
                kept, joined = (second, first) if second in numbers else (first, second)
                group[joined] = kept
    following = max([highest, *numbers.values()], default=0)
    seen: dict[int, set[int]] = {}  # scans that show each number of the data
    given: dict[int, int] = {}
    for number in sorted(order, key=lambda number: (-len(tracks[number].members), number)):
        own = root(number)
        if own in given or own not in numbers:
            continue
        members = {f for n in order if root(n) == own for f in tracks[n].members}
        # at two places at once, the longer track has the number
        if not members & seen.get(numbers[own], set()):
            seen.setdefault(numbers[own], set()).update(members)
            given[own] = numbers[own]
    for number in order:
        if root(number) not in given:
            following += 1
            given[root(number)] = following
    return {number: given[root(number)] for number in order}


def _are_one(one: Track, other: Track) -> bool:
    """Return whether two tracks belong to one actor."""
    if one.label != other.label or (
        (not one.rigid or not other.rigid) and set(one.members) & set(other.members)
    ):
        return False
    small, large = sorted((one, other), key=lambda track: float(np.prod(track.size)))
    begin = max(one.first, other.first)
    end = min(one.first + len(one.world_T_actor), other.first + len(other.world_T_actor))
    if end - begin < _FEWEST_COMMON:
        return False
    poses = (
        track.world_T_actor[begin - track.first : end - track.first] for track in (large, small)
    )
    large_T_world = invert(next(poses))
    world_T_small = next(poses)
    # not of the completed body, whose position is uncertain
    seen = (small.extent.lower + small.extent.upper) / 2
    middle = multiply(large_T_world, world_T_small, np.append(seen, 1.0)[:, None])[:, :3, 0]
    inside = ((middle > large.lower - _AROUND_M) & (middle < large.upper + _AROUND_M)).all(axis=1)
    return bool(inside.mean() >= _INSIDE)
