"""Paths: the positions and velocities of an actor, estimated from its points alone, for scans that
number actors and have no flow.

An observation is the set of an actor's points in one scan. A rigid actor is followed from scan to
scan: its position is predicted from its motion so far, and corrected by registering its points to
the planes of its earlier observations. The planes correct the prediction only in the directions
that they determine: across a side, and along the path if the front or the back is visible.
Registration of points to points would drift along the side of a passing car.

Paths are smoothed: the acceleration of an actor is limited, and the error of a measured position is
not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from carlasc.core.arrays import AnyFloatArray, BoolArray, FloatArray, IntArray
from carlasc.core.geometry import (
    invert,
    moved_back,
    multiply,
    rotation_z,
    spread_rows,
    thin,
    transform_points,
)
from carlasc.motion.planes import Planes, nearest_points, pose_of, register
from carlasc.motion.solving import fast_rows, headings_of, resample, smooth, smooth_at

MIN_POINTS = 10  # observations with fewer points are interpolated from the others
_MAX_ACCELERATION_M_S2 = 6.0  # hard braking, a sharp bend
_WALK_S = 0.6  # half width of the window in which a person walks with constant acceleration
_DRIVE_S = 0.5  # the same for a vehicle
_POINTS = 200  # number of points of an observation that are compared
_PAIRS, _APART_S = 12, 1.0  # pairs of observations that are compared, and their distance in time
_MAX_DISTANCE_M, _DOUBT_M = 0.5, 0.02
# observations of a static actor are closer to each other, although they show different sides
_STATIC_M = 0.38
_TURN_S = 1.0  # half width of the window in which directions correct registered turns
_MIN_TURNS = 4  # least number of such directions
# The rear axle is so far behind the centre, in lengths of the vehicle. No vehicle moves farther
# aside: the sine.
_REAR_AXLE, _MOST_ASIDE = 0.3, 0.5
# Changes by less are noise; least share in reverse, of a vehicle that turns by so much.
_STEADY_RAD, _REVERSE, _BEND_RAD = 0.06, 0.4, 0.5
_CLEAR = 0.5  # sides of a vehicle are at right angles: their normals agree by so much

_INITIAL_S = 0.5  # half width of the window for the initial estimate of the motion
_REGISTERED = 300  # number of points of an observation that are registered to the model
_SIDE_M = 0.14  # standard deviation of the points of one side, across it
# Error of a prediction from one scan to the next: x, y, z in metres (streets are flat), yaw in
# radians.
_PREDICTED = np.array([0.2, 0.2, 0.01, 0.02])
_UNKNOWN = 5.0  # factor of this error while the motion is not known yet
# slower actors and observations with fewer points are not compared by their ends
_SLOW_M_S, _END_POINTS = (
    1.0,
    20,
)
_SAME_WIDTH_M = 0.12  # greatest difference of the widths of the same ends
_GAIN = 0.3  # weight of the last correction in the estimate of the motion


@dataclass(frozen=True)
class Segment:
    """The points of one actor in one scan.

    Attributes:
        frame: frame number.
        label: most frequent class of its points.
        members: (M,) int64 indices of the points in the scan.
        points: (M, 3) float64 metres, world.
        velocity: (3,) m/s, world; None if the scan has no flow.
        instance: number of the actor; 0 if actors are not numbered.
        origin: (3,) position of the sensor, metres, world.
        times: (M,) seconds of `points` after the time of the frame; None if they are unknown, or
            the points are where they are at that time.
    """

    frame: int
    label: int
    members: IntArray
    points: FloatArray
    velocity: FloatArray | None
    instance: int = 0
    origin: FloatArray = field(default_factory=lambda: np.zeros(3))
    times: AnyFloatArray | None = None

    @property
    def center(self) -> FloatArray:
        """(3,) centre of the points' bounding box, metres, world."""
        return middles_of([self.points])[0]

    def thinned(self, most: int) -> Segment:
        """Return the same with at most `most` of the points; `members` stay complete."""
        if self.times is None:
            return replace(self, points=thin(self.points, most))
        rows = spread_rows(len(self.points), most)
        return replace(self, points=self.points[rows], times=self.times[rows])

    def part(self, chosen: BoolArray) -> Segment:
        """Return the segment of some of the (M,) points; members that were thinned out are where
        the points beside them in the scan are.
        """
        rows = spread_rows(len(self.members), len(self.points))
        after = np.searchsorted(rows, np.arange(len(self.members)), side="right") - 1
        members = self.members[chosen[np.maximum(after, 0)]]
        times = None if self.times is None else self.times[chosen]
        return replace(self, members=members, points=self.points[chosen], times=times)

    def joined(self, other: Segment) -> Segment:
        """Return this segment with the points of another one of the scan too."""
        members = np.concatenate([self.members, other.members])
        points = np.concatenate([self.points, other.points])
        known = self.times is not None and other.times is not None
        times = np.concatenate([self.times, other.times]) if known else None
        return replace(self, members=members, points=points, times=times)

    def at_frame(self, velocity: FloatArray) -> Segment:
        """Return the same with its points moved to the time of the frame, by (3,) m/s, world."""
        points = moved_back(self.points, self.times, velocity)
        return self if self.times is None else replace(self, points=points, times=None)


Path = tuple[FloatArray, FloatArray, FloatArray]
"""(F, 3) positions, metres, world, (F, 3) velocities, m/s, world, and (F,) headings, radians, of an
actor at each of its observations.
"""


def path_of(segments: Sequence[Segment], seconds: FloatArray, *, rigid: bool) -> Path:
    """Estimate the path of an actor from its segments: see `estimate_path`."""
    delays = [s.times for s in segments] if any(s.times is not None for s in segments) else None
    return estimate_path([s.points for s in segments], seconds, rigid=rigid, delays=delays)


def estimate_path(
    observations: Sequence[FloatArray],
    seconds: FloatArray,
    *,
    rigid: bool,
    delays: Sequence[AnyFloatArray | None] | None = None,
) -> Path:
    """Estimate the position, the velocity and the heading of an actor at each of its observations.

    Rigid actors are registered, so the result does not depend on the side that is visible. People
    change their shape as they walk, so the centre of their points is followed. Observations with
    too few points are interpolated. An actor with one observation has velocity zero.

    Args:
        observations: (M, 3) points of the actor at each time, metres, world.
        seconds: (F,) times, increasing.
        rigid: whether the actor keeps its shape.
        delays: (M,) seconds of the points after each of these times; None: all are 0.

    Returns:
        (F, 3) centre of the actor, metres, world, its (F, 3) velocity, m/s, world, and its (F,)
        heading, radians, unwrapped.
    """
    counts = np.array([len(points) for points in observations])
    enough = np.flatnonzero(counts >= max(1, min(MIN_POINTS, counts.max(initial=0))))
    chosen, at, weights = (
        [observations[i] for i in enough.tolist()],
        seconds[enough],
        np.minimum(counts[enough], 200.0),
    )
    if len(enough) < 2:
        middle = np.mean(chosen[0], axis=0) if chosen else np.zeros(3)
        return (
            np.tile(middle, (len(seconds), 1)),
            np.zeros((len(seconds), 3)),
            np.zeros(len(seconds)),
        )
    best = best_observation(chosen)
    after = None if delays is None else [delays[i] for i in enough.tolist()]
    if after is not None and not rigid:
        walked = smooth(middles_of(chosen), at, weights, _WALK_S)[1]
        chosen = [moved_back(*seen) for seen in zip(chosen, after, walked, strict=True)]
    path, turns, sides = (
        follow(chosen, at, best, after) if rigid else (middles_of(chosen), None, math.nan)
    )
    positions, velocities = smooth(path, at, weights, _DRIVE_S if rigid else _WALK_S)
    positions, velocities = resample(
        seconds, at, positions, _limit_acceleration(velocities, at, best)
    )
    if turns is None:
        return positions, velocities, headings_of(velocities)
    turns, length_m = np.interp(seconds, at, turns), length_of(chosen)
    return (
        positions,
        velocities,
        headings_of_vehicle(velocities, seconds, length_m, turns, sides),
    )


def in_body(
    observations: Sequence[FloatArray], positions: FloatArray, headings: FloatArray
) -> list[FloatArray]:
    """Return the (M, 3) points of each observation of an actor, metres, actor frame."""
    return [
        multiply(points - place, rotation_z(heading)[:3, :3])
        for points, place, heading in zip(observations, positions, headings, strict=True)
    ]


def is_static(observations: Sequence[FloatArray], path: Path, seconds: FloatArray) -> bool:
    """Return whether observations align as well without motion as with the estimated motion; the
    arguments are those of `misalignment`.
    """
    # a wrong path aligns them badly too
    still, moved = misalignment(observations, path, seconds)
    return bool(np.isnan(still) or still < min(moved + _DOUBT_M, _STATIC_M))


def misalignment(
    observations: Sequence[FloatArray],
    path: Path,
    seconds: FloatArray,
    shifts_m: Sequence[float] = (0.0,),
) -> tuple[float, ...]:
    """Return how well observations of an actor, about a second apart, align: the mean distance to
    the nearest point of the other, metres.

    Args:
        observations: (M, 3) points of the actor at each time, metres, world.
        path: the estimated motion.
        seconds: (F,) times, increasing.
        shifts_m: shifts along the heading that are added to the estimated motion, metres.

    Returns:
        The distance without motion, and the distance with the estimated motion and each shift. All
        are NaN for a single observation.
    """
    thinned = [thin(points, _POINTS) for points in observations]
    body, means = in_body(thinned, path[0], path[2]), []
    for i in np.unique(np.linspace(0, len(seconds) - 1, _PAIRS).astype(int)):
        j = int(np.argmin(np.abs(np.abs(seconds - seconds[i]) - _APART_S)))
        if j != i:
            shifted = [
                _mean_distance(body[i] + np.array([shift, 0.0, 0.0]), body[j]) for shift in shifts_m
            ]
            means.append([_mean_distance(thinned[i], thinned[j]), *shifted])
    return tuple(np.mean(means, axis=0).tolist()) if means else (np.nan,) * (1 + len(shifts_m))


def _mean_distance(points: FloatArray, others: FloatArray) -> float:
    """Return the mean distance of points to the nearest of other points, metres.

    Each distance is at most `_MAX_DISTANCE_M`.
    """
    return float(np.minimum(np.sqrt(nearest_points(points, others)[1]), _MAX_DISTANCE_M).mean())


def _limit_acceleration(velocities: FloatArray, seconds: FloatArray, best: int) -> FloatArray:
    """Limit the change of (F, 3) velocities to the acceleration of an actor, from the index `best`
    outwards.
    """
    bounded = velocities.copy()
    for step, stop in ((1, len(seconds)), (-1, -1)):
        for index in range(best + step, stop, step):
            before = bounded[index - step]
            change = velocities[index] - before
            most = _MAX_ACCELERATION_M_S2 * abs(seconds[index] - seconds[index - step])
            length = float(np.linalg.norm(change, axis=0))
            bounded[index] = before + change * min(1.0, most / length) if length > 0 else before
    return bounded


def headings_of_vehicle(
    velocities: FloatArray,
    seconds: FloatArray,
    length_m: float,
    turns: FloatArray | None = None,
    sides: float = math.nan,
) -> FloatArray:
    """Return the headings of a vehicle, which moves ahead or in reverse.

    On a straight road, its centre moves to where the vehicle points. In a bend, it moves aside, as
    the rear axle does not. Registered turns drift; directions over a second or two correct them.

    Args:
        velocities: (F, 3) m/s.
        seconds: (F,) times, rising.
        length_m: visible length of the vehicle; 0: its centre does not move aside; negative: it
            moves aside as in reverse.
        turns: (F,) registered headings, except for a constant, radians; None: they are unknown.
        sides: this constant, except for quarters of a turn, radians; NaN: it is unknown.

    Returns:
        (F,) radians, unwrapped; those of `headings_of` if few velocities are fast enough.
    """
    fast = fast_rows(velocities)
    if len(fast) < _MIN_TURNS:
        return headings_of(velocities)
    known = np.zeros(len(velocities)) if turns is None else turns
    x, y, _ = velocities[fast].T
    directions = np.arctan2(y, x)
    at = seconds[fast]
    weights = np.ones(len(fast))
    # In reverse, a direction differs from the heading by half a turn. It is ahead more often.
    left = np.unwrap(directions - known[fast], period=np.pi)
    speeds = np.hypot(x, y) * np.where(np.cos(directions - known[fast] - left) > 0, 1, -1)
    if speeds.sum() < 0:
        left, speeds = left + np.pi, -speeds
    turning = smooth((known[fast] + left)[:, None], at, weights, _DRIVE_S)[1][:, 0]
    aside = np.arcsin(np.clip(_REAR_AXLE * length_m * turning / speeds, -_MOST_ASIDE, _MOST_ASIDE))
    if turns is None:
        return np.interp(np.arange(len(velocities)), fast, left - aside)
    # Registration shows how far aside it moves, and whether it is in reverse: then the other way.
    change, moved = aside - aside.mean(), left - left.mean()
    if not math.isnan(sides):
        quarters = np.round((left.mean() - sides) / (np.pi / 2))
        change, moved = aside, left - sides - quarters * np.pi / 2
    share = float((change * moved).sum() / (np.square(change) + _STEADY_RAD**2).sum())
    if share < -_REVERSE and np.ptp(turns) > _BEND_RAD:
        left = left + np.pi
    left = smooth((left - np.clip(share, -1.0, 1.0) * aside)[:, None], at, weights, _TURN_S)[0]
    return known + np.interp(np.arange(len(velocities)), fast, left[:, 0])


def length_of(observations: Sequence[FloatArray]) -> float:
    """Return the visible length of an actor, metres, from its (M, 3) points in each scan."""
    sizes = [np.hypot(*np.ptp(points[:, :2], axis=0)) for points in observations]
    return float(np.quantile(sizes, 0.8))


def follow(
    observations: Sequence[FloatArray],
    seconds: FloatArray,
    best: int,
    delays: Sequence[AnyFloatArray | None] | None = None,
) -> tuple[FloatArray, FloatArray, float]:
    """Register the observations of a rigid, upright actor, from the best observation outwards.

    Args:
        observations: (M, 3) points of the actor at each time, metres, world.
        seconds: (F,) times, increasing.
        best: index of the observation to start with: see `best_observation`.
        delays: (M,) seconds of the points after each of these times; None: all are 0. Points are
            moved to the time of their observation by the motion so far.

    Returns:
        (F, 3) centre of the actor, metres, world, its (F,) heading, radians, 0 in the best
        observation, and the direction of its sides then, except for quarters of a turn; NaN if it
        shows none.
    """
    counts = np.array([len(points) for points in observations])
    middles, seen_at = middles_of(observations), list(observations)
    delays = [None] * len(counts) if delays is None else delays
    states = np.zeros((len(counts), 4))  # x, y, z, yaw of the actor at each time
    initial = smooth_at(best, middles, seconds, np.minimum(counts, 200.0), _INITIAL_S)[1]
    motion = np.append(initial, 0.0)  # of x, y, z and yaw per second
    seen_at[best] = moved_back(observations[best], delays[best], initial)
    states[best, :3] = middle = middles_of(seen_at[best : best + 1])[0]
    model = Planes()
    model.add(seen_at[best] - middle)
    seen = 0
    for step, stop in ((1, len(counts)), (-1, -1)):
        velocity, previous = motion, best
        for index in range(best + step, stop, step):
            elapsed = seconds[index] - seconds[previous]
            predicted = states[previous] + velocity * elapsed
            error = (
                _PREDICTED
                * max(1.0, abs(elapsed) / 0.1)
                * (_UNKNOWN / (1 + seen) if seen < _UNKNOWN - 1 else 1.0)
            )
            seen_at[index] = moved_back(observations[index], delays[index], velocity[:3])
            points = thin(seen_at[index], _REGISTERED)
            shifts = _shift_of_ends(seen_at[previous], seen_at[index], velocity[:3])
            states[index] = register(points, model, predicted, error, states[previous, :3], shifts)
            velocity = velocity + max(_GAIN, 1 / (2 + seen)) * (states[index] - predicted) / elapsed
            if seen < _UNKNOWN and step == 1:
                motion = velocity  # the backward pass starts with this estimate
            model.add(transform_points(invert(pose_of(states[index])), points))
            previous, seen = index, seen + 1
    middle = (np.quantile(model.points, 0.01, axis=0) + np.quantile(model.points, 0.99, axis=0)) / 2
    path = np.stack([transform_points(pose_of(state), middle) for state in states])
    return path, states[:, 3], _sides_of(model)


def _sides_of(model: Planes) -> float:
    """Return the direction to which most sides of an actor are at right angles, except for quarters
    of a turn, radians; NaN without any.
    """
    x, y, _ = model.normals.T
    # four times the angle: normals of all four sides are alike
    weight, angle = np.hypot(x, y), 4 * np.arctan2(y, x)
    across, along = (float((weight * part(angle)).sum()) for part in (np.sin, np.cos))
    clear = math.hypot(across, along) > _CLEAR * weight.sum()
    return math.atan2(across, along) / 4 if clear else math.nan


def corrections(
    observations: Sequence[FloatArray],
    seconds: FloatArray,
    states: FloatArray,
    error: FloatArray,
    best: int,
) -> tuple[FloatArray, FloatArray]:
    """Return the smooth change of the path of a rigid, upright actor with which its observations
    align.

    Args:
        observations: (M, 3) points of the actor at each time, metres, world.
        seconds: (F,) times, increasing.
        states: (F, 4) x, y, z in metres, and yaw in radians, world, before the change.
        error: (4,) their standard deviation.
        best: index of the observation to start with: see `best_observation`.

    Returns:
        (F, 4) the change, to be added to the states, and (F, 4) its derivative per second.
    """
    laid, model = states.copy(), Planes()
    for index in [best, *range(best + 1, len(states)), *range(best - 1, -1, -1)]:
        points = thin(observations[index], _REGISTERED)
        if index != best:
            laid[index] = register(
                points, model, states[index], error, states[index, :3], np.empty((0, 4))
            )
        model.add(transform_points(invert(pose_of(laid[index])), points))
    counts = np.array([min(len(points), _REGISTERED) for points in observations], np.float64)
    return smooth(laid - states, seconds, counts, _DRIVE_S)


def _shift_of_ends(before: FloatArray, now: FloatArray, velocity: FloatArray) -> FloatArray:
    """Return (K, 4) directions, world, in which two observations show the same ends of an actor,
    and the displacement of these ends, metres.

    A flat face determines no motion along it, but its ends do: the ends of the rear of a car ahead
    show its position across the street. The ends are taken as the same if the visible part has the
    same width in both observations.
    """
    speed = float(np.hypot(velocity[0], velocity[1]))
    if speed < _SLOW_M_S or min(len(before), len(now)) < _END_POINTS:
        return np.empty((0, 4))
    ahead = np.array([velocity[0], velocity[1], 0.0]) / speed
    directions = np.stack([ahead, [-ahead[1], ahead[0], 0.0], [0.0, 0.0, 1.0]])
    (low, high), (low_now, high_now) = (
        ends((points[:, None] * directions).sum(axis=2)) for points in (before, now)
    )
    same = np.abs((high_now - low_now) - (high - low)) < _SAME_WIDTH_M
    moved = (low_now + high_now) / 2 - (low + high) / 2
    return np.column_stack([directions, moved])[same]


def ends(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the 2% and 98% quantiles of each column of (N, K) values.

    `np.quantile` returns the same and takes much longer.
    """
    places = (len(values) - 1) * np.array([[0.02], [0.98]])
    before = places.astype(np.int64)
    after, share = np.minimum(before + 1, len(values) - 1), places - before
    ranked = np.sort(values, axis=0)
    low, high = ranked[before[:, 0]], ranked[after[:, 0]]
    low, high = np.where(share < 0.5, low + (high - low) * share, high - (high - low) * (1 - share))
    return low, high


def middles_of(observations: Sequence[FloatArray]) -> FloatArray:
    """Return (F, 3) the middle of the bounds of the (M, 3) points of each observation."""
    return np.stack([(points.min(axis=0) + points.max(axis=0)) / 2 for points in observations])


def best_observation(observations: Sequence[FloatArray]) -> int:
    """Return the index of the observation to start with: it has many points, shows more than one
    side, and is not at an end of the track.
    """
    counts = np.array([len(points) for points in observations])
    across = [_least_variance(points[:, :2]) if len(points) > 2 else 0.0 for points in observations]
    inner = np.arange(len(observations))
    amid = np.minimum(np.minimum(inner, inner[::-1]) + 1, 5)
    return int(np.argmax(counts * np.clip(np.array(across) / _SIDE_M**2, 1e-6, 1.0) * amid))


def _least_variance(points: FloatArray) -> float:
    """Return the variance of (N, 2) points, N > 2, in the direction in which it is smallest."""
    x, y = (points - points.mean(axis=0)).T
    a, b, c = (
        float((one * other).sum()) / (len(points) - 1) for one, other in ((x, x), (x, y), (y, y))
    )
    return (a + c) / 2 - float(np.sqrt(((a - c) / 2) ** 2 + b * b))
