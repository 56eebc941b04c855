"""Tracks: the segments of one actor over time, and the pose of the actor at each frame."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import Transform, invert, rotation_z, transform_points
from carlasc.motion.paths import estimate_path, headings_of, is_standing
from carlasc.motion.segments import MIN_SPEED_M_S, Segment, Standing
from carlasc.motion.smoothing import resample

_REACH_M, _MAX_SPEED_M_S = 15.0, 40.0  # fast first test: no actor is longer or faster
_GATE_M = 1.5  # maximum distance of a segment from the prediction of its track
_SAME_VELOCITY_M_S = 2.0  # maximum change of an actor's velocity between two segments
_STOPPING_M_S = 1.5  # slower actors may be standing in the next scan, or in the previous one
_MAX_GAP = 15  # maximum number of frames for which an actor may be hidden
_EXTRAPOLATE = 5  # number of frames by which a track extends beyond its first and its last segment
_STANDING_M = 0.5  # the visible part of a standing actor may seem to move this far
_TRIM = 0.01  # fraction of points that may be outside an actor's box: outliers, points of a neighbour
_MARGIN_M = 0.1


@dataclass(frozen=True)
class Track:
    """One actor over time.

    Attributes:
        label: class of the actor, which is that of most of its points.
        instance: number of the actor; 0 if actors are not numbered.
        segments: the actor's segments by frame.
        first: frame of `world_T_actor[0]`.
        world_T_actor: (F, 4, 4) pose at each frame from `first` on; x is forward, and the origin is the centre of its box.
        velocity: (F, 3) m/s, world, at the same frames.
        lower: (3,) metres, lower corner of the actor's box, actor frame.
        upper: (3,) metres, upper corner.
    """

    label: int
    instance: int
    segments: Mapping[int, Segment]
    first: int
    world_T_actor: NDArray[np.float64]
    velocity: NDArray[np.float64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]

    def pose(self, frame: int) -> Transform | None:
        """Return (4, 4) world_T_actor at a frame; None if the track does not extend to it."""
        row = frame - self.first
        return self.world_T_actor[row] if 0 <= row < len(self.world_T_actor) else None

    def velocity_at(self, frame: int) -> NDArray[np.float64] | None:
        """Return (3,) m/s, world, at a frame; None if the track does not extend to it."""
        row = frame - self.first
        return self.velocity[row] if 0 <= row < len(self.velocity) else None

    @property
    def size(self) -> NDArray[np.float64]:
        """(3,) metres: length, width, height of the box."""
        return self.upper - self.lower

    @property
    def moves(self) -> bool:
        """Whether the actor moves faster and farther at some time than a standing actor seems to."""
        fast = (np.square(self.velocity).sum(axis=1) > MIN_SPEED_M_S**2).any()
        return bool(fast and np.ptp(self.world_T_actor[:, :3, 3], axis=0).max() > _STANDING_M)


def link_segments(
    segments: Iterable[Segment],
    times: Mapping[int, float],
    standing: Mapping[int, Standing] | None = None,
    *,
    deformable: Collection[int] = (),
) -> list[Track]:
    """Link the segments of several scans into tracks.

    Numbered actors are linked by their numbers, others by prediction: a segment continues the track of its class whose
    predicted position is nearest to it, also after the actor was hidden for some frames.

    Args:
        segments: the segments of all scans, in any order.
        times: seconds by frame, for every frame with a segment.
        standing: the standing points of each scan, in which an actor that stops, for example at a crossing, is found until it continues.
        deformable: classes whose actors change their shape; without flow, the centre of their points is followed.

    Returns:
        Tracks in order of their first segment.
    """
    ordered = sorted(segments, key=lambda segment: segment.frame)
    chains = _chains(ordered, times, standing or {})
    for chain in chains:
        _extend_backwards(chain, standing or {})
    return [_make_track(chain, times, deformable) for chain in chains]


def _chains(
    segments: list[Segment], times: Mapping[int, float], standing: Mapping[int, Standing]
) -> list[list[Segment]]:
    by_instance: dict[int, list[Segment]] = {}
    by_frame: dict[int, list[Segment]] = {}
    for segment in segments:
        if segment.instance:
            by_instance.setdefault(segment.instance, []).append(segment)
        else:
            by_frame.setdefault(segment.frame, []).append(segment)
    chains: list[list[Segment]] = []
    for frame in sorted(by_frame.keys() | (standing.keys() if by_frame else set())):
        alive = [chain for chain in chains if frame - _MAX_GAP <= chain[-1].frame < frame]
        for segment, chain in _match(by_frame.get(frame, []), alive, times):
            if chain is None:
                chains.append([segment])
            else:
                chain.append(segment)
        for chain in alive:  # a slow actor that was not found may have stopped
            if chain[-1].frame < frame and frame in standing and _is_slow(chain[-1]):
                rest = standing[frame].segment_at(chain[-1])
                if rest is not None:
                    chain.append(rest)
    return [*by_instance.values(), *chains]


def _extend_backwards(chain: list[Segment], standing: Mapping[int, Standing]) -> None:
    """Insert segments before a chain from the scans in which its actor was standing where the chain starts."""
    if chain[0].instance:
        return
    for frame in sorted((frame for frame in standing if frame < chain[0].frame), reverse=True):
        rest = standing[frame].segment_at(chain[0]) if _is_slow(chain[0]) else None
        if rest is None:
            return
        chain.insert(0, rest)


def _is_slow(segment: Segment) -> bool:
    return segment.velocity is not None and float(np.square(segment.velocity).sum()) < _STOPPING_M_S**2


def _match(
    found: list[Segment], alive: list[list[Segment]], times: Mapping[int, float]
) -> list[tuple[Segment, list[Segment] | None]]:
    """Pair the segments of one scan with the chains that they continue: nearest prediction first, each chain once."""
    if not found or not alive:
        return [(segment, None) for segment in found]
    candidates = []
    ends = np.stack([chain[-1].center for chain in alive])
    for i, segment in enumerate(found):
        reach = _REACH_M + _MAX_SPEED_M_S * np.array([times[segment.frame] - times[chain[-1].frame] for chain in alive])
        for j in np.flatnonzero(np.linalg.norm(ends - segment.center, axis=1) < reach).tolist():
            last = alive[j][-1]
            cost = _cost(last, segment, times[segment.frame] - times[last.frame])
            if cost is not None:
                candidates.append((cost, i, j))
    taken: dict[int, int] = {}
    for _, i, j in sorted(candidates):
        if i not in taken and j not in taken.values():
            taken[i] = j
    return [(segment, alive[taken[i]] if i in taken else None) for i, segment in enumerate(found)]


def _cost(last: Segment, segment: Segment, elapsed_s: float) -> float | None:
    """Return how much a segment differs from the prediction of its predecessor; None if it cannot be the same actor."""
    if last.label != segment.label or last.velocity is None or segment.velocity is None:
        return None
    change = float(np.linalg.norm(segment.velocity - last.velocity))
    predicted = last.points + (last.velocity + segment.velocity) / 2 * elapsed_s
    # The visible part of an actor changes, so the gap between boxes is compared first, and their centres have little weight.
    gap = np.maximum(
        predicted.min(axis=0) - segment.points.max(axis=0), segment.points.min(axis=0) - predicted.max(axis=0)
    )
    distance = float(np.linalg.norm(np.maximum(gap, 0.0)))
    if distance > _GATE_M or change > _SAME_VELOCITY_M_S:
        return None
    offset = float(np.linalg.norm(predicted.mean(axis=0) - segment.center))
    return distance + change + 0.1 * offset


def _make_track(chain: list[Segment], times: Mapping[int, float], deformable: Collection[int]) -> Track:
    """Return the track of linked segments: their path, the poses along it, and the box around all points."""
    seconds = np.array([times[segment.frame] for segment in chain])
    label = int(np.bincount([s.label for s in chain], [len(s.members) for s in chain]).argmax())
    if any(segment.velocity is None for segment in chain):
        sightings = [segment.points for segment in chain]
        positions, velocities = estimate_path(sightings, seconds, rigid=label not in deformable)
        if is_standing(sightings, positions, headings_of(velocities), seconds):
            positions, velocities = np.zeros_like(positions), np.zeros_like(velocities)
    else:
        velocities = np.stack([segment.velocity for segment in chain if segment.velocity is not None])
        positions = _integrate(velocities, seconds, chain)
    headings = headings_of(velocities)
    positions, lower, upper = _fit_box(chain, positions, headings)
    first, last = chain[0].frame - _EXTRAPOLATE, chain[-1].frame + _EXTRAPOLATE
    frames = np.arange(first, last + 1)
    at = _frame_times(frames, times)
    path, speed = resample(at, seconds, positions, velocities)
    poses = np.stack([rotation_z(angle) for angle in np.interp(at, seconds, headings)])
    poses[:, :3, 3] = path
    return Track(label, chain[0].instance, {s.frame: s for s in chain}, first, poses, speed, lower, upper)


def _integrate(
    velocities: NDArray[np.float64], seconds: NDArray[np.float64], chain: list[Segment]
) -> NDArray[np.float64]:
    """Integrate velocities by the trapezoidal rule, through the centre of the segment with most points."""
    steps = (velocities[1:] + velocities[:-1]) / 2 * np.diff(seconds)[:, None]
    path = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    best = int(np.argmax([len(segment.members) for segment in chain]))
    return path - path[best] + chain[best].center


def _fit_box(
    chain: list[Segment], positions: NDArray[np.float64], headings: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Move the path to the centre of the actor, and return it with the corners of the actor's box.

    The path is known except for a constant offset in the world. If the actor turns, the segments overlap only with the correct
    offset, which is the one that moves the origin to their centre.
    """
    best = int(np.argmax([len(segment.members) for segment in chain]))
    for _ in range(3):
        body = []
        for segment, position, heading in zip(chain, positions, headings, strict=True):
            pose = rotation_z(heading)
            pose[:3, 3] = position
            body.append(transform_points(invert(pose), segment.points))
        points = np.concatenate(body)
        lower, upper = np.quantile(points, _TRIM, axis=0), np.quantile(points, 1 - _TRIM, axis=0)
        middle = (lower + upper) / 2
        positions = positions + rotation_z(headings[best])[:3, :3] @ middle
        lower, upper = lower - middle, upper - middle
    return positions, lower - _MARGIN_M, upper + _MARGIN_M


def _frame_times(frames: NDArray[np.int64], times: Mapping[int, float]) -> NDArray[np.float64]:
    """Return the seconds of frames. Frames without a scan are interpolated, and extrapolated by the mean period."""
    known = np.array(sorted(times))
    seconds = np.array([times[int(frame)] for frame in known])
    period = (seconds[-1] - seconds[0]) / (known[-1] - known[0]) if len(known) > 1 else 0.1
    inside = np.interp(frames, known, seconds)
    before, after = np.minimum(frames - known[0], 0), np.maximum(frames - known[-1], 0)
    return inside + (before + after) * period
