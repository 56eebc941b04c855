"""Tracks: the motion, the poses and the body of one actor over time; the tracks of a sequence, and
the file that keeps them.
"""

from __future__ import annotations

import io
import json
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np

from carlasc.core.arrays import (
    AnyArray,
    AnyFloatArray,
    AnyIntArray,
    BoolArray,
    Float32Array,
    FloatArray,
    IntArray,
)
from carlasc.core.geometry import (
    Transform,
    invert,
    multiply,
    rotation_z,
    transform_each,
)
from carlasc.errors import reading
from carlasc.motion.bodies import BODY_MARGIN_M, Extent, Sizes, measure, surface_of
from carlasc.motion.paths import (
    Path,
    Segment,
    ends,
    headings_of_vehicle,
    in_body,
    is_static,
    length_of,
    path_of,
)
from carlasc.motion.segments import MIN_SPEED_M_S
from carlasc.motion.solving import headings_of, least_squares, resample, smooth
from carlasc.storage.arrays import ArrayFormat, open_npz
from carlasc.storage.files import parse_json

_EXTRAPOLATE_S = 0.5  # a track extends beyond its first and its last segment by this time
_STATIC_M = 0.5  # the visible part of a static actor may seem to move this far
# No actor, with its margins, is longer, wider or higher: a larger one has points of other things.
LONGEST_M, _WIDEST_M, _HIGHEST_M = 30.0, 4.2, 5.0
_SURE = 0.8  # actors with less confidence are doubtful
_ASIDE = 0.1  # weight of an end that is not turned to the sensor
_AGREE_M = 0.5  # an end that is farther from its usual place is that of a part of the actor
_ROUNDS, _TURNS_RAD = 3, 0.1
_SURELY = 0.8  # a vehicle does what is less usual if its ends agree better by this factor
_ENDS_M = 0.25  # and in reverse only if they agree so well
_SETTLED_S, _SETTLED_POINTS = 1.5, 200  # positions change over so long; no scan weighs more
FIRST_FOUND = 1 << 33  # found actors are numbered from here, above all instances
_FORMATS = {
    "members": ArrayFormat(("<i4",), (None,)),
    "frames": ArrayFormat(("<i8",), (None, 3)),
    "poses": ArrayFormat(("<f8",), (None, 4, 4)),
    "velocities": ArrayFormat(("<f8",), (None, 3)),
    "bounds": ArrayFormat(("<f8",), (None, 20)),
    "table": ArrayFormat(("<i8",), (None, 8)),
    "surfaces": ArrayFormat(("<f4",), (None, 3)),
    "moving": ArrayFormat(("<i4",), (None,)),
    "moving_frames": ArrayFormat(("<i8",), (None, 2)),
    "own": ArrayFormat(("<f8",), (None, 6)),
}


@dataclass(frozen=True)
class Track:
    """One actor over time.

    Attributes:
        label: most frequent class of its points.
        instance: number of the actor; 0 if actors are not numbered.
        members: (M,) indices of the points of the actor in each scan that sees it, by frame.
        first: frame of `world_T_actor[0]`.
        world_T_actor: (F, 4, 4) pose at each frame from `first` on; x is forward, and the origin is
            the centre of its body.
        velocity: (F, 3) m/s, world, at the same frames.
        lower: (3,) metres, lower corner of the actor's whole body, actor frame.
        upper: (3,) metres, upper corner.
        extent: the visible part of the body.
        rigid: whether it keeps its shape, as vehicles do.
        surface: (P, 3) float32, points of its surface, metres, actor frame. Before bodies are
            completed, exemplary actors alone have them.
        confidence: probability that it is real, from 0 to 1; 1 for an actor of the data.
    """

    label: int
    instance: int
    members: Mapping[int, AnyIntArray]
    first: int
    world_T_actor: FloatArray
    velocity: FloatArray
    lower: FloatArray
    upper: FloatArray
    extent: Extent
    rigid: bool = True
    surface: Float32Array = field(default_factory=lambda: np.empty((0, 3), np.float32))
    confidence: float = 1.0

    def pose(self, frame: int) -> Transform | None:
        """Return (4, 4) world_T_actor at a frame; None if the track does not extend to it."""
        return self._at(self.world_T_actor, frame)

    def velocity_at(self, frame: int) -> FloatArray | None:
        """Return (3,) m/s, world, at a frame; None if the track does not extend to it."""
        return self._at(self.velocity, frame)

    def _at(self, values: FloatArray, frame: int) -> FloatArray | None:
        row = frame - self.first
        return values[row] if 0 <= row < len(values) else None

    def between(self, first: int, last: int) -> Track:
        """Return the track at the frames from `first` to `last` only, which is small enough to send
        to a worker.
        """
        start = max(self.first, first)
        rows = slice(start - self.first, max(last + 1 - self.first, start - self.first))
        members = {frame: own for frame, own in self.members.items() if first <= frame <= last}
        poses, velocity = self.world_T_actor[rows], self.velocity[rows]
        return replace(self, members=members, first=start, world_T_actor=poses, velocity=velocity)

    @property
    def size(self) -> FloatArray:
        """(3,) metres: length, width, height of the body."""
        return self.upper - self.lower

    def interval(self) -> FloatArray:
        """Return (2, 3) metres: see `Extent.interval`."""
        return self.extent.interval(self.size - 2 * BODY_MARGIN_M, found=self.confidence < 1)

    @property
    def is_possible(self) -> bool:
        """Whether its body, and what was seen of it, are not too large for one actor."""
        return is_possible(self.size) and bool(self.extent.size.max() < LONGEST_M)

    @property
    def moves(self) -> bool:
        """Whether the actor moves faster and farther than a static actor may seem to, and is not
        too large for one actor.
        """
        fast = (np.square(self.velocity).sum(axis=1) > MIN_SPEED_M_S**2).any()
        return bool(
            self.is_possible
            and fast
            and np.ptp(self.world_T_actor[:, :3, 3], axis=0).max() > _STATIC_M
        )


def make_track(
    chain: Sequence[Segment],
    times: Mapping[int, float],
    *,
    deformable: Collection[int] = (),
    rigid: bool | None = None,
    confidence: float = 1.0,
    path: Path | None = None,
) -> Track:
    """Return the track of linked segments: their path, the poses along it, and the box around all
    points.

    Args:
        chain: the segments of one actor, in order of time.
        times: seconds by frame.
        deformable: classes whose actors change their shape.
        rigid: whether this actor keeps its shape; None: its class decides.
        confidence: probability that the actor is real.
        path: at the times of the segments, if it is known, and the actor moves.
    """
    seconds = np.array([times[segment.frame] for segment in chain])
    label = int(np.bincount([s.label for s in chain], [len(s.members) for s in chain]).argmax())
    # Flow gives the path directly. Without it, the path is found by aligning the observations.
    keeps_shape = label not in deformable if rigid is None else rigid
    if path is not None or any(segment.velocity is None for segment in chain):
        estimated = path_of(chain, seconds, rigid=keeps_shape) if path is None else path
        positions, velocities, headings = estimated
        chain = [segment.at_frame(v) for segment, v in zip(chain, velocities, strict=True)]
        observations = [segment.points for segment in chain]
        if path is None and is_static(observations, estimated, seconds):
            positions, velocities, headings = (
                np.zeros_like(values) for values in (positions, velocities, headings)
            )
        elif keeps_shape:
            positions = _settle(chain, positions, headings, seconds)
    else:
        velocities = np.stack(
            [segment.velocity for segment in chain if segment.velocity is not None]
        )
        positions = _integrate(velocities, seconds, chain)
        headings = headings_of(velocities)
        if keeps_shape:
            headings = headings_of_vehicle(velocities, seconds, 0.0)
            if np.ptp(headings) > _TURNS_RAD:
                positions, headings = _turned(chain, positions, velocities, seconds)
    positions, extent, body = _fit_box(chain, positions, headings)
    frames, at = _frames_around(chain[0].frame, chain[-1].frame, times)
    places, speed = resample(at, seconds, positions, velocities)
    poses = np.stack([rotation_z(angle) for angle in np.interp(at, seconds, headings)])
    poses[:, :3, 3] = places
    members = {segment.frame: segment.members.astype(np.int32) for segment in chain}
    lower, upper = extent.lower - BODY_MARGIN_M, extent.upper + BODY_MARGIN_M
    surface = surface_of(body if keeps_shape and extent.exemplary else body[:0])
    whole = (lower, upper, extent, keeps_shape, surface, confidence)
    return Track(label, chain[0].instance, members, int(frames[0]), poses, speed, *whole)


def complete_bodies(tracks: Sequence[Track], others: Iterable[Track] = ()) -> list[Track]:
    """Return tracks in order of their first segment, with bodies that similar actors, among them or
    among others, complete where they were not seen.
    """
    known = [track for track in (*tracks, *others) if track.rigid]
    sizes = Sizes([(track.label, track.extent, track.surface) for track in known])
    whole = [_with_body(track, sizes) if track.rigid else track for track in tracks]
    return sorted(
        whole,
        key=lambda track: (
            track.first,
            track.instance,
            track.label,
            *track.world_T_actor[0, :3, 3],
        ),
    )


def with_surfaces(tracks: Sequence[Track]) -> list[Track]:
    """Return tracks of known bodies, such as boxes, with surfaces that the exemplary actors among
    them complete.
    """
    sizes = Sizes([(track.label, track.extent, track.surface) for track in tracks if track.rigid])
    shapes = (
        sizes.surface(t.label, t.lower + BODY_MARGIN_M, t.upper - BODY_MARGIN_M, t.extent)
        for t in tracks
    )
    return [replace(track, surface=surface) for track, surface in zip(tracks, shapes, strict=True)]


def _with_body(track: Track, sizes: Sizes) -> Track:
    lower, upper = sizes.complete(track.label, track.extent)
    # The origin of an actor is the centre of its body: where the body grows, poses, corners and
    # surface move by the same vector, and nothing moves in the world.
    middle = (lower + upper) / 2
    poses = track.world_T_actor.copy()
    poses[:, :3, 3] += multiply(poses[:, :3, :3], middle[:, None])[..., 0]
    seen = replace(
        track.extent, lower=track.extent.lower - middle, upper=track.extent.upper - middle
    )
    return replace(
        track,
        world_T_actor=poses,
        lower=lower - middle - BODY_MARGIN_M,
        upper=upper - middle + BODY_MARGIN_M,
        extent=seen,
        surface=sizes.surface(track.label, lower, upper, track.extent) - middle.astype(np.float32),
    )


def _integrate(velocities: FloatArray, seconds: FloatArray, chain: Sequence[Segment]) -> FloatArray:
    """Integrate velocities by the trapezoidal rule, through the centre of the segment with most
    points.
    """
    steps = (velocities[1:] + velocities[:-1]) / 2 * np.diff(seconds)[:, None]
    path = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    # The integral is known up to a constant; the largest segment shows most of the actor, so its
    # centre is nearest to the centre of the body.
    best = int(np.argmax([len(segment.members) for segment in chain]))
    return path - path[best] + chain[best].center


def _visible_ends(
    chain: Sequence[Segment], positions: FloatArray, headings: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what each scan shows of the ends of an actor.

    Ends towards the sensor are seen in most scans, and do not depend on the path.

    Returns:
        (F, 2, 2) rotations from the actor to the world, (F, 2, 2) the ends: lower and upper, x and
        y, metres, actor frame, and (F, 2, 2) how much each is turned to the sensor.
    """
    turns = np.stack([rotation_z(heading) for heading in headings])
    body = in_body([segment.points for segment in chain], positions, headings)
    faces = np.array([ends(points[:, :2]) for points in body])
    origins = np.stack([segment.origin for segment in chain]) - positions
    places = multiply(invert(turns)[:, :3, :3], origins[..., None])[:, None, :2, 0]
    beyond = (np.median(faces, axis=0) - places) * np.array([[1], [-1]])
    distance = np.maximum(np.linalg.norm(places, axis=2, keepdims=True), 1e-6)
    return turns[:, :2, :2], faces, _ASIDE + np.clip(beyond / distance, 0, 1)


def _settle(
    chain: Sequence[Segment], positions: FloatArray, headings: FloatArray, seconds: FloatArray
) -> FloatArray:
    """Return (F, 3) positions at which the visible ends of the actor agree.

    A path that is a little wrong for seconds smears the body. Where a scan shows a part of the
    actor only, its ends are elsewhere, and do not count.
    """
    turns, faces, weights = _visible_ends(chain, positions, headings)
    counts = np.minimum([len(segment.points) for segment in chain], _SETTLED_POINTS)
    order = np.argsort(faces, axis=0, kind="stable")
    total = np.cumsum(np.take_along_axis(weights * counts[:, None, None], order, 0), axis=0)
    middle = (total < total[-1] / 2).sum(axis=0)[None]
    usual = np.take_along_axis(np.take_along_axis(faces, order, 0), middle, 0)
    agree = np.abs(faces - usual) < _AGREE_M
    weights = weights * agree + 1e-9  # no scan is without weight
    shifts = (weights * agree * (faces - usual)).sum(axis=1) / weights.sum(axis=1)
    moved, _ = smooth(shifts, seconds, counts.astype(np.float64), _SETTLED_S)
    settled = positions.copy()
    settled[:, :2] += multiply(turns, moved[..., None])[..., 0]
    return settled


def _anchor(
    chain: Sequence[Segment], positions: FloatArray, headings: FloatArray
) -> tuple[FloatArray, float]:
    """Return (F, 3) positions with the constant offset at which the visible ends of an actor that
    turns agree, and their mean squared distance, metres. Its path is known except for this offset.
    """
    moved = positions
    for _ in range(_ROUNDS):
        turns, faces, weights = _visible_ends(chain, moved, headings)
        # Each end is where it is on the body, and shifted by the offset as the body sees it.
        shifts = np.repeat(np.swapaxes(turns, 1, 2)[:, None], 2, axis=1).reshape(-1, 2)
        design = np.hstack([np.tile(np.eye(4), (len(chain), 1)), shifts])
        values, root = faces.reshape(-1, 1), np.sqrt(weights.reshape(-1, 1))
        # An offset matters, and is known, where the actor turns by more than this.
        few = np.zeros((2, 6))
        few[:, 4:] = np.eye(2) * _TURNS_RAD * np.sqrt(weights.sum())
        for _ in range(_ROUNDS):  # parts of the actor have their ends elsewhere
            fit = least_squares(
                np.concatenate([design * root, few]), np.concatenate([values * root, few[:, :1]])
            )
            error = values - multiply(design, fit)
            root = np.sqrt(weights.reshape(-1, 1) / (1 + (error / _AGREE_M) ** 2))
        moved = moved + np.append(fit[4:, 0], 0.0)
    return moved, float(np.square(error * root).sum() / np.square(root).sum())


def _turned(
    chain: Sequence[Segment], positions: FloatArray, velocities: FloatArray, seconds: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the positions and the headings of an actor that turns, from its flow: around its rear
    axle, ahead or in reverse, or as it moves. Its ends decide.
    """
    length_m = length_of([segment.points for segment in chain])
    ways = [headings_of_vehicle(velocities, seconds, long) for long in (0.0, length_m, -length_m)]
    ways[2] += np.pi
    places, errors = zip(*(_anchor(chain, positions, way) for way in ways), strict=True)
    way = 2 if errors[2] < min(_SURELY * errors[1], _ENDS_M**2) else 1
    if errors[way] > _SURELY * errors[0]:
        # its ends agree as well if it points to where it moves: registration shows how it turns
        turns = path_of(chain, seconds, rigid=True)[2]
        aside = [np.abs(np.sin(ways[k] - turns)).mean() for k in (0, way)]
        if errors[0] < _SURELY * errors[way] or aside[0] < aside[1]:
            way = 0
    return places[way], ways[way]


def _fit_box(
    chain: Sequence[Segment], positions: FloatArray, headings: FloatArray
) -> tuple[FloatArray, Extent, FloatArray]:
    """Move the path to the centre of the visible part of the actor; return it, the extent, and the
    points in the actor frame.
    """
    counts = np.array([len(segment.points) for segment in chain])
    points = np.concatenate([segment.points for segment in chain])
    poses = np.stack([rotation_z(heading) for heading in headings])
    poses[:, :3, 3] = positions
    actor_T_world = invert(poses)
    sensors = transform_each(actor_T_world, np.stack([segment.origin for segment in chain]))
    body = transform_each(np.repeat(actor_T_world, counts, axis=0), points)
    extent = measure(body, counts, sensors)
    middle = (extent.lower + extent.upper) / 2
    extent = replace(extent, lower=extent.lower - middle, upper=extent.upper - middle)
    return positions + multiply(poses[:, :3, :3], middle[:, None])[..., 0], extent, body - middle


def _frames_around(
    first: int, last: int, times: Mapping[int, float]
) -> tuple[IntArray, FloatArray]:
    """Return the frames from `_EXTRAPOLATE_S` before `first` to as long after `last`, and their
    times.

    Frames without a scan are interpolated, and extrapolated by the mean period.
    """
    known, seconds = (np.array(values) for values in zip(*sorted(times.items()), strict=True))
    period = (
        float(seconds[-1] - seconds[0]) / float(known[-1] - known[0]) if len(known) > 1 else 0.1
    )
    more = max(1, round(_EXTRAPOLATE_S / period))
    frames = np.arange(first - more, last + more + 1)
    inside = np.interp(frames, known, seconds)
    # `np.interp` holds its ends, so the frames beyond them are continued by the mean period.
    before = np.minimum(frames - known[0], 0)
    after = np.maximum(frames - known[-1], 0)
    return frames, inside + (before + after) * period


@dataclass(frozen=True)
class MovingActors:
    """The moving actors of a sequence, and the moving points of no track.

    Attributes:
        tracks: the actors that move, by number.
        moving: (M,) indices of the points that move and belong to no track, by frame.
        summary: the facts of every actor, static ones too, as plain values.
        own: (6,) lower and upper corners, metres, sensor frame, of boxes around points that move
            with the sensor: the recording vehicle.
        numbers: number of each actor over the whole sequence, by the number of its track; empty if
            not needed.
        seen: number of points of all scans in which free space was looked for.
    """

    tracks: Mapping[int, Track] = field(default_factory=dict)
    moving: Mapping[int, AnyIntArray] = field(default_factory=dict)
    summary: tuple[Mapping[str, Any], ...] = ()
    own: tuple[FloatArray, ...] = ()
    numbers: Mapping[int, int] = field(default_factory=dict)
    seen: int = 0

    @classmethod
    def of(
        cls,
        tracks: list[Track],
        moving: Mapping[int, AnyIntArray] | None = None,
        own: Sequence[FloatArray] = (),
        seen: int = 0,
    ) -> Self:
        """Return the actors of tracks: moving ones with their tracks, static ones in the summary
        only.
        """
        return cls(
            {number: track for number, track in enumerate(tracks) if track.moves},
            moving or {},
            tuple(_summarize(track) for track in tracks),
            tuple(own),
            seen=seen,
        )

    def between(self, first: int, last: int) -> MovingActors:
        """Return the part for the frames from `first` to `last`, which is small enough to send to a
        worker with each frame.
        """
        # A track may reach the frames by extrapolation only, with poses and without members.
        tracks = {
            number: track.between(first, last)
            for number, track in self.tracks.items()
            if track.first <= last and track.first + len(track.world_T_actor) > first
        }
        frames = range(first, last + 1)
        moving = {frame: self.moving[frame] for frame in frames if frame in self.moving}
        numbers = {number: self.numbers[number] for number in tracks} if self.numbers else {}
        return MovingActors(tracks, moving, own=self.own, numbers=numbers)

    def is_own(self, points: AnyFloatArray) -> BoolArray:
        """Return which of (N, 3) points, metres, sensor frame, are on the recording vehicle."""
        own = np.zeros(len(points), np.bool_)
        if not self.own:
            return own
        corners = np.stack(self.own)
        reach = np.abs(corners).max()
        near = np.flatnonzero((np.abs(points) <= reach).all(axis=1))
        for lower, upper in corners.reshape(-1, 2, 3):
            own[near] |= ((points[near] >= lower) & (points[near] <= upper)).all(axis=1)
        return own

    def to_bytes(self, key: str, *, is_compressed: bool = True) -> bytes:
        """Return the content of a file with these actors. `key` is a digest of their source."""
        table, bounds, frames, members = [], [], [], list[AnyIntArray]()
        tracks = self.tracks.values()
        for number, track in self.tracks.items():
            extent, sizes = track.extent, (len(track.world_T_actor), track.extent.points)
            about = number, track.label, track.instance, track.first
            table.append((*about, *sizes, track.rigid, len(track.surface)))
            corners = [track.lower, track.upper, extent.lower, extent.upper]
            bounds.append(
                np.concatenate([*corners, extent.faces, extent.seen_from, [track.confidence]])
            )
            members += track.members.values()
            frames += [(number, frame, len(own)) for frame, own in track.members.items()]
        # Tables of numbers, one row per track or per scan of a track, and the values of all tracks
        # one after the other: a file of ten arrays is read at once, whatever the number of tracks.
        facts = json.dumps({"key": key, "summary": self.summary, "seen": self.seen})
        arrays = {
            "about": np.frombuffer(facts.encode(), np.uint8),
            "table": np.array(table, np.int64).reshape(-1, 8),
            "poses": np.concatenate([np.empty((0, 4, 4)), *(t.world_T_actor for t in tracks)]),
            "velocities": np.concatenate([np.empty((0, 3)), *(t.velocity for t in tracks)]),
            "surfaces": np.concatenate(
                [np.empty((0, 3), np.float32), *(t.surface for t in tracks)]
            ),
            "bounds": np.array(bounds, np.float64).reshape(-1, 20),
            "members": np.concatenate([np.empty(0, np.int32), *members]).astype(np.int32),
            "frames": np.array(frames, np.int64).reshape(-1, 3),
            "moving": np.concatenate([np.empty(0, np.int32), *self.moving.values()]).astype(
                np.int32
            ),
            "moving_frames": np.array(
                [(f, len(own)) for f, own in self.moving.items()], np.int64
            ).reshape(-1, 2),
            "own": np.array(self.own, np.float64).reshape(-1, 6),
        }
        buffer = io.BytesIO()
        save = np.savez_compressed if is_compressed else np.savez
        save(buffer, **arrays)  # type: ignore[arg-type]
        return buffer.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes, where: str) -> tuple[Self, str]:
        """Return the actors of a file, and the key of their source.

        Raises:
            FormatError: the file is not valid; the message starts with `where`.
        """
        with open_npz(data, where) as file:
            arrays = {name: file.read(name, expected) for name, expected in _FORMATS.items()}
            about = parse_json(file.read("about", ArrayFormat(("u1",), (None,))).tobytes(), where)
        with reading(where, "tracks written by regrid", "remove it"):
            tracks = _tracks(arrays)
            moved = _divided(arrays["moving"], arrays["moving_frames"], 1)
            moving = {frame: own for (frame, _), own in moved}
            summary = tuple(about["summary"])
            own = tuple(arrays["own"])
            seen = int(about["seen"])
            return cls(tracks, moving, summary, own, seen=seen), str(about["key"])


def is_possible(size: Sequence[float] | FloatArray) -> bool:
    """Return whether one actor may have (3,) this length, width and height, metres; length and
    width may be exchanged, as where its heading is wrong.
    """
    short, long = sorted(size[:2])
    return bool(long < LONGEST_M and short < _WIDEST_M and size[2] < _HIGHEST_M)


def is_doubtful(confidence: float) -> bool:
    """Return whether an actor with this confidence may be a false one."""
    return confidence < _SURE


def _tracks(arrays: Mapping[str, AnyArray]) -> dict[int, Track]:
    table, frames = arrays["table"], arrays["frames"]
    members: dict[int, dict[int, AnyIntArray]] = {}
    for (number, frame, _), own in _divided(arrays["members"], frames, 2):
        members.setdefault(number, {})[frame] = own
    tracks = {}
    for (row, poses), (_, velocity), (_, surface), bounds in zip(
        _divided(arrays["poses"], table, 4),
        _divided(arrays["velocities"], table, 4),
        _divided(arrays["surfaces"], table, 7),
        arrays["bounds"],
        strict=True,
    ):
        number, label, instance, first, _, points, rigid, _ = row
        rear, front, low, high = (bounds[12:16] > 0).tolist()
        tracks[number] = Track(
            label,
            instance,
            members.get(number, {}),
            first,
            poses,
            velocity,
            bounds[0:3],
            bounds[3:6],
            Extent(
                bounds[6:9],
                bounds[9:12],
                (rear, front, low, high),
                points,
                tuple(bounds[16:19].tolist()),
            ),
            bool(rigid),
            surface,
            float(bounds[19]),
        )
    return tracks


def _divided(values: AnyArray, rows: AnyArray, count: int) -> Iterator[tuple[list[int], AnyArray]]:
    """Yield the rows of a table, each with its values, of which a column has the number."""
    parts = np.split(values, np.cumsum(rows[:, count])[:-1])
    return zip(rows.tolist(), parts, strict=False)  # without rows, there is one empty part


def _summarize(track: Track) -> dict[str, Any]:
    speed = np.linalg.norm(track.velocity, axis=1)
    return {
        "label": track.label,
        "instance": track.instance
        if track.instance < FIRST_FOUND
        else 0,  # found actors have no number in the data
        "first": int(min(track.members, default=track.first)),
        "last": int(max(track.members, default=track.first)),
        "scans": len(track.members),
        "points": sum(len(own) for own in track.members.values()),
        "moves": track.moves,
        "confidence": int(1000 * track.confidence) / 1000,  # never 1 for a found actor
        "speed_m_s": round(float(np.median(speed)), 3),
        "size_m": [round(float(value), 3) for value in track.size],
        "seen_m": [round(float(value), 3) for value in track.extent.size],
        "faces": sum(track.extent.faces),
    }
