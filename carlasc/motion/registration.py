"""Registration of the sightings of a rigid actor to each other.

A passing car shows only its side for a long time, and registration of points to points slides along it. So the actor is followed from scan to
scan: its position is predicted from its motion so far, and then corrected by registering its points to the planes of everything that was
seen of it before. The planes correct the prediction only in the directions that they determine: across a side, and along the path if the
front or the back is visible.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from carlasc.core.compiling import cached
from carlasc.core.geometry import Transform, invert, rotation_z, thin, transform_points
from carlasc.motion.planes import Planes
from carlasc.motion.smoothing import smooth_at

_INITIAL_S = 0.5  # half width of the window for the initial estimate of the motion
_POINTS = 300  # number of points of a sighting that are registered to the model
_SIDE_M = 0.14  # standard deviation, across a side, of points of this side alone
_ITERATIONS = 8
_FIRST_REACH_M, _LAST_REACH_M = 1.0, 0.3  # maximum distance of paired points; it decreases with each iteration
_DEVIATIONS = 2.0  # the first reach is at least so many standard deviations of the prediction
_POINT_M, _INDEPENDENT = 0.05, 200  # error of a point, and the number of points with independent errors
_VARIANCE_M2 = _POINT_M**2
_PREDICTED = np.array(
    [0.2, 0.2, 0.01, 0.02]
)  # error of a prediction from one scan to the next: x, y, z in metres (streets are flat), yaw in radians
_UNKNOWN = 5.0  # factor of this error while the motion is not known yet
_ROBUST = 0.3  # fraction of the reach; pairs farther from their plane get less weight
_SLOW_M_S, _END_POINTS = 1.0, 20  # the ends of slower actors, and of sightings with fewer points, are not compared
_SAME_WIDTH_M, _ENDS_M = 0.12, 0.12  # greatest difference of the widths of the same ends, and the error of their shift
_GAIN = 0.3  # weight of the last correction in the motion


def follow(sightings: Sequence[NDArray[np.float64]], seconds: NDArray[np.float64], best: int) -> NDArray[np.float64]:
    """Register the sightings of a rigid, upright actor, starting with the best sighting and going outwards.

    Args:
        sightings: (M, 3) points of the actor at each time, metres, world.
        seconds: (F,) times, increasing.
        best: index of the sighting to start with: see `best_sighting`.

    Returns:
        (F, 3) centre of the actor, metres, world.
    """
    counts = np.array([len(points) for points in sightings])
    middles = middles_of(sightings)
    states = np.zeros((len(counts), 4))  # x, y, z, yaw of the actor at each time
    states[best, :3] = middles[best]
    initial = smooth_at(best, middles, seconds, np.minimum(counts, 200.0), _INITIAL_S)[1]
    motion = np.append(initial, 0.0)  # of x, y, z and yaw per second
    model = Planes(sightings[best] - middles[best])
    seen = 0
    for step, stop in ((1, len(counts)), (-1, -1)):
        velocity, previous = motion, best
        for index in range(best + step, stop, step):
            elapsed = seconds[index] - seconds[previous]
            predicted = states[previous] + velocity * elapsed
            error = _PREDICTED * max(1.0, abs(elapsed) / 0.1) * (_UNKNOWN / (1 + seen) if seen < _UNKNOWN - 1 else 1.0)
            points = thin(sightings[index], _POINTS)
            shifts = _shift_of_ends(sightings[previous], sightings[index], velocity[:3])
            states[index] = _register(points, model, predicted, error, states[previous, :3], shifts)
            velocity = velocity + max(_GAIN, 1 / (2 + seen)) * (states[index] - predicted) / elapsed
            if seen < _UNKNOWN and step == 1:
                motion = velocity  # the backward pass starts with this estimate
            model.add(transform_points(invert(_pose(states[index])), points))
            previous, seen = index, seen + 1
    middle = (np.quantile(model.points, 0.01, axis=0) + np.quantile(model.points, 0.99, axis=0)) / 2
    return np.stack([transform_points(_pose(state), middle) for state in states])


def _register(
    points: NDArray[np.float64],
    model: Planes,
    predicted: NDArray[np.float64],
    error: NDArray[np.float64],
    previous: NDArray[np.float64],
    shifts: Sequence[tuple[NDArray[np.float64], float]],
) -> NDArray[np.float64]:
    """Return the state (x, y, z, yaw), near the predicted one, that registers points to the planes of the model.

    Args:
        points: (N, 3) points of the sighting, metres, world.
        model: what was seen of the actor so far.
        predicted: (4,) predicted state.
        error: (4,) standard deviation of the prediction.
        previous: (3,) position at the sighting before, metres, world.
        shifts: directions in which the ends of what is seen moved since then, and how far: see `_shift_of_ends`.
    """
    state = predicted.copy()
    prior = expected = np.diag(1 / error**2)
    ways = [(np.append(direction, 0.0), direction, shift) for direction, shift in shifts]
    for row, _, _ in ways:
        expected = expected + np.outer(row, row) / _ENDS_M**2
    first_reach = max(_FIRST_REACH_M, _DEVIATIONS * float(error[:2].max()))
    for iteration in range(_ITERATIONS):
        reach = first_reach * (_LAST_REACH_M / first_reach) ** (iteration / (_ITERATIONS - 1))
        pose = _pose(state)
        pairs, nearest = model.near(points, pose, reach**2)
        information, pull = expected, prior @ (predicted - state)
        for row, direction, shift in ways:
            pull = pull + row * (direction @ (previous - state[:3]) + shift) / _ENDS_M**2
        if len(pairs) >= 3:
            arm, normal = model.points[nearest] @ pose[:3, :3].T, model.normals[nearest] @ pose[:3, :3].T
            scale, share = max(2 * _POINT_M, _ROBUST * reach), min(1.0, _INDEPENDENT / len(pairs))
            slope, weighted, off = lay(points[pairs], pose[:3, 3], arm, normal, scale, share)
            information = information + weighted.T @ slope
            pull = pull + weighted.T @ off
        state = state + np.linalg.solve(information, pull)
    return state


@cached(error_model="python")
def lay(
    points: NDArray[np.float64],
    place: NDArray[np.float64],
    arm: NDArray[np.float64],
    normal: NDArray[np.float64],
    scale: float,
    share: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the equations that lay points on planes, for a step of the state of the actor.

    Args:
        points: (P, 3) metres, world.
        place: (3,) position of the actor, metres, world.
        arm: (P, 3) point of the plane of each point, metres, from the actor in the axes of the world.
        normal: (P, 3) normals of the planes, in the axes of the world.
        scale: distance from its plane, in metres, at which a point has half the weight.
        share: of its weight that each point has, because the errors of so many points are not independent.

    Returns:
        (P, 4) slope of the distance to the plane over x, y, z and yaw; the same with the weight of each point; (P,) the distance, metres.
    """
    count = len(points)
    slope, weighted, off = np.empty((count, 4)), np.empty((count, 4)), np.empty(count)
    for i in range(count):
        slope[i, 0], slope[i, 1], slope[i, 2] = normal[i, 0], normal[i, 1], normal[i, 2]
        slope[i, 3] = arm[i, 0] * normal[i, 1] - arm[i, 1] * normal[i, 0]
        x = (points[i, 0] - place[0] - arm[i, 0]) * normal[i, 0]
        y = (points[i, 1] - place[1] - arm[i, 1]) * normal[i, 1]
        z = (points[i, 2] - place[2] - arm[i, 2]) * normal[i, 2]
        off[i] = x + y + z
        relative = off[i] / scale
        weight = 1 / (1 + relative * relative) * share / _VARIANCE_M2
        for a in range(4):
            weighted[i, a] = slope[i, a] * weight
    return slope, weighted, off


def _shift_of_ends(
    before: NDArray[np.float64], now: NDArray[np.float64], velocity: NDArray[np.float64]
) -> list[tuple[NDArray[np.float64], float]]:
    """Return the directions in which two sightings show the same ends of an actor, (3,) world, and the shift of these ends, in metres.

    A flat face determines no motion along it, but its ends do: the rear of a car that drives ahead shows where the car is across the
    street. If what is seen has the same width in both sightings, its ends are taken for the same.
    """
    speed = float(np.hypot(velocity[0], velocity[1]))
    if speed < _SLOW_M_S or min(len(before), len(now)) < _END_POINTS:
        return []
    ahead = np.array([velocity[0], velocity[1], 0.0]) / speed
    shifts = []
    for direction in (ahead, np.array([-ahead[1], ahead[0], 0.0]), np.array([0.0, 0.0, 1.0])):
        (low, high), (low_now, high_now) = ends(before @ direction), ends(now @ direction)
        if abs((high_now - low_now) - (high - low)) < _SAME_WIDTH_M:
            shifts.append((direction, (low_now + high_now) / 2 - (low + high) / 2))
    return shifts


def ends(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return the 2 % and 98 % quantiles of (N,) values, as `np.quantile` does in ten times the time."""
    places = [(len(values) - 1) * quantile for quantile in (0.02, 0.98)]
    after = [min(int(place) + 1, len(values) - 1) for place in places]
    ranked = np.partition(values, [int(places[0]), after[0], int(places[1]), after[1]])
    low, high = (
        _between(float(ranked[int(place)]), float(ranked[upper]), place - int(place))
        for place, upper in zip(places, after, strict=True)
    )
    return low, high


def _between(low: float, high: float, share: float) -> float:
    return low + (high - low) * share if share < 0.5 else high - (high - low) * (1 - share)


def _pose(state: NDArray[np.float64]) -> Transform:
    pose = rotation_z(float(state[3]))
    pose[:3, 3] = state[:3]
    return pose


def middles_of(sightings: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return (F, 3) the middle of the bounds of the (M, 3) points of each sighting."""
    return np.stack([(points.min(axis=0) + points.max(axis=0)) / 2 for points in sightings])


def best_sighting(sightings: Sequence[NDArray[np.float64]]) -> int:
    """Return the index of the sighting to start with: one with many points, more than one side, and not at an end of the track."""
    counts = np.array([len(points) for points in sightings])
    across = [np.linalg.eigvalsh(np.cov(p[:, :2], rowvar=False))[0] if len(p) > 2 else 0.0 for p in sightings]
    inner = np.arange(len(sightings))
    amid = np.minimum(np.minimum(inner, inner[::-1]) + 1, 5)
    return int(np.argmax(counts * np.clip(np.array(across) / _SIDE_M**2, 1e-6, 1.0) * amid))


@cached(error_model="python")
def nearest_points(
    points: NDArray[np.float64], model: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the index of the model point nearest to each point, and the squared distance, by comparing all pairs."""
    index, squared = np.zeros(len(points), np.int64), np.full(len(points), np.inf)
    for i in range(len(points)):
        for j in range(len(model)):
            dx, dy, dz = points[i, 0] - model[j, 0], points[i, 1] - model[j, 1], points[i, 2] - model[j, 2]
            distance = dx * dx + dy * dy + dz * dz
            if distance < squared[i]:
                squared[i], index[i] = distance, j
    return index, squared
