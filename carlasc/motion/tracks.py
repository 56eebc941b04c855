"""Tracks: the motion of one actor, its pose at each frame, and its body."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import Transform, invert, rotation_z, transform_points
from carlasc.motion.bodies import Extent, Sizes, measure
from carlasc.motion.linking import Chain, Linker
from carlasc.motion.paths import estimate_path, headings_of, is_standing
from carlasc.motion.segments import MIN_SPEED_M_S, Segment, Standing
from carlasc.motion.smoothing import resample

_EXTRAPOLATE_S = 0.5  # time by which a track extends beyond its first and its last segment
_STANDING_M = 0.5  # the visible part of a standing actor may seem to move this far
LONGEST_M = 30.0  # no actor is longer or wider: other points have its number
BODY_MARGIN_M = 0.1  # by which the box of an actor is larger than its body


@dataclass(frozen=True)
class Track:
    """One actor over time.

    Attributes:
        label: class of the actor, which is that of most of its points.
        instance: number of the actor; 0 if actors are not numbered.
        members: (M,) indices of the actor's points in each scan that saw it, by frame.
        first: frame of `world_T_actor[0]`.
        world_T_actor: (F, 4, 4) pose at each frame from `first` on; x is forward, and the origin is the centre of its body.
        velocity: (F, 3) m/s, world, at the same frames.
        lower: (3,) metres, lower corner of the actor's whole body, actor frame.
        upper: (3,) metres, upper corner.
        extent: what was seen of the body.
        rigid: whether it keeps its shape, as vehicles do.
    """

    label: int
    instance: int
    members: Mapping[int, NDArray[np.integer]]
    first: int
    world_T_actor: NDArray[np.float64]
    velocity: NDArray[np.float64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    extent: Extent
    rigid: bool = True

    def pose(self, frame: int) -> Transform | None:
        """Return (4, 4) world_T_actor at a frame; None if the track does not extend to it."""
        row = frame - self.first
        return self.world_T_actor[row] if 0 <= row < len(self.world_T_actor) else None

    def velocity_at(self, frame: int) -> NDArray[np.float64] | None:
        """Return (3,) m/s, world, at a frame; None if the track does not extend to it."""
        row = frame - self.first
        return self.velocity[row] if 0 <= row < len(self.velocity) else None

    def between(self, first: int, last: int) -> Track:
        """Return the track at the frames from `first` to `last` only: small enough to be sent to a worker."""
        start = max(self.first, first)
        rows = slice(start - self.first, max(last + 1 - self.first, start - self.first))
        members = {frame: own for frame, own in self.members.items() if first <= frame <= last}
        poses, velocity = self.world_T_actor[rows], self.velocity[rows]
        return replace(self, members=members, first=start, world_T_actor=poses, velocity=velocity)

    @property
    def size(self) -> NDArray[np.float64]:
        """(3,) metres: length, width, height of the body."""
        return self.upper - self.lower

    @property
    def moves(self) -> bool:
        """Whether the actor moves faster and farther at some time than a standing actor seems to, and is one thing."""
        fast = (np.square(self.velocity).sum(axis=1) > MIN_SPEED_M_S**2).any()
        return bool(
            self.size.max() < LONGEST_M and fast and np.ptp(self.world_T_actor[:, :3, 3], axis=0).max() > _STANDING_M
        )


def link_segments(
    segments: Iterable[Segment],
    times: Mapping[int, float],
    standing: Mapping[int, Standing] | None = None,
    *,
    deformable: Collection[int] = (),
) -> list[Track]:
    """Link the segments of several scans into tracks.

    Args:
        segments: the segments of all scans, in any order.
        times: seconds by frame, for every frame with a segment.
        standing: the standing points of each scan, in which an actor that stops, for example at a crossing, is found until it continues.
        deformable: classes whose actors change their shape; without flow, the centre of their points is followed.

    Returns:
        Tracks in order of their first segment, with whole bodies.
    """
    by_frame: dict[int, list[Segment]] = {}
    for segment in segments:
        by_frame.setdefault(segment.frame, []).append(segment)
    linker = Linker()
    chains: list[Chain] = []
    for frame in sorted(by_frame.keys() | (standing or {}).keys()):
        chains += linker.add(frame, times[frame], by_frame.get(frame, []), (standing or {}).get(frame))
    chains += linker.finish()
    return complete_bodies([make_track(chain, times, deformable=deformable) for chain in chains])


def make_track(
    chain: Sequence[Segment],
    times: Mapping[int, float],
    *,
    deformable: Collection[int] = (),
    rigid: bool | None = None,
) -> Track:
    """Return the track of linked segments: their path, the poses along it, and the box around all points.

    Args:
        chain: the segments of one actor, in order of time.
        times: seconds by frame.
        deformable: classes whose actors change their shape.
        rigid: whether this one keeps its shape; None: unless it is of one of these classes.
    """
    seconds = np.array([times[segment.frame] for segment in chain])
    label = int(np.bincount([s.label for s in chain], [len(s.members) for s in chain]).argmax())
    keeps_shape = label not in deformable if rigid is None else rigid
    if any(segment.velocity is None for segment in chain):
        sightings = [segment.points for segment in chain]
        positions, velocities = estimate_path(sightings, seconds, rigid=keeps_shape)
        if is_standing(sightings, positions, headings_of(velocities), seconds):
            positions, velocities = np.zeros_like(positions), np.zeros_like(velocities)
    else:
        velocities = np.stack([segment.velocity for segment in chain if segment.velocity is not None])
        positions = _integrate(velocities, seconds, chain)
    headings = headings_of(velocities)
    positions, extent = _fit_box(chain, positions, headings)
    frames, at = _frames_around(chain[0].frame, chain[-1].frame, times)
    path, speed = resample(at, seconds, positions, velocities)
    poses = np.stack([rotation_z(angle) for angle in np.interp(at, seconds, headings)])
    poses[:, :3, 3] = path
    members = {segment.frame: segment.members.astype(np.int32) for segment in chain}
    lower, upper = extent.lower - BODY_MARGIN_M, extent.upper + BODY_MARGIN_M
    return Track(label, chain[0].instance, members, int(frames[0]), poses, speed, lower, upper, extent, keeps_shape)


def complete_bodies(tracks: Sequence[Track]) -> list[Track]:
    """Return tracks in order of their first segment, each with a body as large as similar actors', and not only as what was seen of it."""
    sizes = Sizes([(track.label, track.extent) for track in tracks if track.rigid])
    whole = [_with_body(track, sizes) if track.rigid else track for track in tracks]
    return sorted(whole, key=lambda track: (track.first, track.instance, track.label, *track.world_T_actor[0, :3, 3]))


def _with_body(track: Track, sizes: Sizes) -> Track:
    lower, upper = sizes.complete(track.label, track.extent)
    middle = (lower + upper) / 2
    poses = track.world_T_actor.copy()
    poses[:, :3, 3] += poses[:, :3, :3] @ middle
    seen = replace(track.extent, lower=track.extent.lower - middle, upper=track.extent.upper - middle)
    return replace(
        track,
        world_T_actor=poses,
        lower=lower - middle - BODY_MARGIN_M,
        upper=upper - middle + BODY_MARGIN_M,
        extent=seen,
    )


def _integrate(
    velocities: NDArray[np.float64], seconds: NDArray[np.float64], chain: Sequence[Segment]
) -> NDArray[np.float64]:
    """Integrate velocities by the trapezoidal rule, through the centre of the segment with most points."""
    steps = (velocities[1:] + velocities[:-1]) / 2 * np.diff(seconds)[:, None]
    path = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    best = int(np.argmax([len(segment.members) for segment in chain]))
    return path - path[best] + chain[best].center


def _fit_box(
    chain: Sequence[Segment], positions: NDArray[np.float64], headings: NDArray[np.float64]
) -> tuple[NDArray[np.float64], Extent]:
    """Move the path to the centre of what was seen of the actor, and return it with the extent of its points around it.

    The path is known except for a constant offset in the world. If the actor turns, the segments overlap only with the correct
    offset, which is the one that moves the origin to their centre.
    """
    best = int(np.argmax([len(segment.members) for segment in chain]))
    for _ in range(3):
        body, sensors = [], []
        for segment, position, heading in zip(chain, positions, headings, strict=True):
            pose = rotation_z(heading)
            pose[:3, 3] = position
            body.append(transform_points(invert(pose), segment.points))
            sensors.append(transform_points(invert(pose), segment.origin))
        extent = measure(body, np.stack(sensors))
        middle = (extent.lower + extent.upper) / 2
        positions = positions + rotation_z(headings[best])[:3, :3] @ middle
        extent = replace(extent, lower=extent.lower - middle, upper=extent.upper - middle)
    return positions, extent


def _frames_around(first: int, last: int, times: Mapping[int, float]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the frames from `_EXTRAPOLATE_S` before `first` to as long after `last`, and their times.

    Frames without a scan are interpolated, and extrapolated by the mean period.
    """
    known = np.array(sorted(times))
    seconds = np.array([times[int(frame)] for frame in known])
    period = float(seconds[-1] - seconds[0]) / float(known[-1] - known[0]) if len(known) > 1 else 0.1
    more = max(1, round(_EXTRAPOLATE_S / period))
    frames = np.arange(first - more, last + more + 1)
    inside = np.interp(frames, known, seconds)
    before, after = np.minimum(frames - known[0], 0), np.maximum(frames - known[-1], 0)
    return frames, inside + (before + after) * period
