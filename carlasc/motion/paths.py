"""Paths: the positions and velocities of an actor, estimated from its points alone, for scans that number actors and have no flow.

A sighting is the set of an actor's points in one scan.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import rotation_z, thin
from carlasc.motion.registration import best_sighting, follow, middles_of, nearest_points
from carlasc.motion.smoothing import resample, smooth

MIN_POINTS = 10  # sightings with fewer points are interpolated from the others
_MAX_ACCELERATION_M_S2 = 6.0  # hard braking, a sharp bend
_WALK_S = 0.6  # half width of the window in which a person walks with constant acceleration
_DRIVE_S = 0.5  # the same for a vehicle
_HEADING_SPEED_M_S = 1.0  # above it, the heading is the direction of motion
_POINTS = 200  # number of points of a sighting that are compared
_PAIRS, _APART_S = 12, 1.0  # pairs of sightings that are compared, and their distance in time
_MAX_DISTANCE_M, _DOUBT_M = 0.5, 0.02
_STANDING_M = 0.38  # sightings of a standing actor are closer to each other, although they show different sides of it


def estimate_path(
    sightings: Sequence[NDArray[np.float64]], seconds: NDArray[np.float64], *, rigid: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Estimate the position and the velocity of an actor at each of its sightings.

    Rigid actors are registered, so that it does not matter which side of them is seen. For people, who change their shape as they walk, the
    centre of the points is followed. Sightings with too few points are interpolated. An actor that was seen once has velocity zero.

    Args:
        sightings: (M, 3) points of the actor at each time, metres, world.
        seconds: (F,) times, increasing.
        rigid: whether the actor keeps its shape.

    Returns:
        (F, 3) centre of the actor, metres, world, and its (F, 3) velocity, m/s, world.
    """
    counts = np.array([len(points) for points in sightings])
    enough = np.flatnonzero(counts >= max(1, min(MIN_POINTS, counts.max(initial=0))))
    chosen, at, weights = [sightings[i] for i in enough.tolist()], seconds[enough], np.minimum(counts[enough], 200.0)
    if len(enough) < 2:
        middle = np.mean(chosen[0], axis=0) if chosen else np.zeros(3)
        return np.tile(middle, (len(seconds), 1)), np.zeros((len(seconds), 3))
    best = best_sighting(chosen)
    path = follow(chosen, at, best) if rigid else middles_of(chosen)
    positions, velocities = smooth(path, at, weights, _DRIVE_S if rigid else _WALK_S)
    velocities = _limit_acceleration(velocities, at, best)
    return resample(seconds, at, positions, velocities)


def headings_of(velocities: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (F,) headings in radians, unwrapped: the direction of (F, 3) velocities, interpolated while the actor is slow."""
    fast = np.flatnonzero(np.hypot(velocities[:, 0], velocities[:, 1]) > _HEADING_SPEED_M_S)
    if not len(fast):
        mean = velocities.mean(axis=0)
        return np.full(len(velocities), np.arctan2(mean[1], mean[0]))
    angles = np.unwrap(np.arctan2(velocities[fast, 1], velocities[fast, 0]))
    return np.interp(np.arange(len(velocities)), fast, angles)


def is_standing(
    sightings: Sequence[NDArray[np.float64]],
    positions: NDArray[np.float64],
    headings: NDArray[np.float64],
    seconds: NDArray[np.float64],
) -> bool:
    """Return whether sightings overlap as well without any motion as with the estimated motion.

    Args:
        sightings: (M, 3) points of the actor at each time, metres, world.
        positions: (F, 3) estimated positions of the actor, metres, world.
        headings: (F,) estimated headings, radians.
        seconds: (F,) times, increasing.
    """
    thinned = [thin(points, _POINTS) for points in sightings]
    body = [(points - positions[i]) @ rotation_z(headings[i])[:3, :3] for i, points in enumerate(thinned)]
    still, moved = [], []
    for i in np.unique(np.linspace(0, len(seconds) - 1, _PAIRS).astype(int)):
        j = int(np.argmin(np.abs(np.abs(seconds - seconds[i]) - _APART_S)))
        if j != i:
            still.append(_mean_distance(thinned[i], thinned[j]))
            moved.append(_mean_distance(body[i], body[j]))
    if not still:
        return True
    # With a wrong path the sightings overlap badly too, so those of a standing actor must also be close to each other.
    return float(np.mean(still)) < min(float(np.mean(moved)) + _DOUBT_M, _STANDING_M)


def _mean_distance(points: NDArray[np.float64], others: NDArray[np.float64]) -> float:
    """Return the mean distance of points to the nearest of others, in metres; distances above `_MAX_DISTANCE_M` count as this value."""
    return float(np.minimum(np.sqrt(nearest_points(points, others)[1]), _MAX_DISTANCE_M).mean())


def _limit_acceleration(
    velocities: NDArray[np.float64], seconds: NDArray[np.float64], best: int
) -> NDArray[np.float64]:
    """Limit the change of (F, 3) velocities to what an actor can do, starting at the index `best` and going outwards."""
    bounded = velocities.copy()
    for step, stop in ((1, len(seconds)), (-1, -1)):
        for index in range(best + step, stop, step):
            before = bounded[index - step]
            change = velocities[index] - before
            most = _MAX_ACCELERATION_M_S2 * abs(seconds[index] - seconds[index - step])
            length = float(np.linalg.norm(change))
            bounded[index] = before + change * min(1.0, most / length) if length > 0 else before
    return bounded
