"""Paths: where an actor was and how fast it went, from its points alone, in scans that number actors and have no flow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import rotation_z
from carlasc.motion.registration import best_sighting, follow, nearest_points
from carlasc.motion.smoothing import resample, smooth

MIN_POINTS = 10  # fewer say too little; such a sighting inherits from its track
_FASTEST_CHANGE_M_S2 = 6.0  # of velocity: hard braking, a sharp bend
_WALK_S = 0.6  # half width of the window in which a person walks evenly
_DRIVE_S = 0.5  # and a vehicle
_HEADING_SPEED_M_S = 1.0  # faster actors look where they go
_POINTS = 200  # of a sighting are compared
_COMPARED, _APART_S = 12, 1.0  # pairs of sightings, and how far apart in time, that tell standing from moving
_FAR_M, _DOUBT_M = 0.5, 0.02
_OVERLAID_M = 0.38  # sightings of what stands are nearer to each other, though each shows another side of it


def estimate_path(
    sightings: Sequence[NDArray[np.float64]], seconds: NDArray[np.float64], *, rigid: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Estimate where an actor was, and its velocity, at each of its sightings.

    Rigid actors are registered, so that it does not matter which of their sides is seen; of people, who bend as they walk, the middle is
    followed. Sightings of too few points inherit from those around them. An actor that was seen once has velocity zero: nothing is known of it.

    Args:
        sightings: of each time, (M, 3) points of the actor, world.
        seconds: (F,) times, rising.
        rigid: whether the actor keeps its shape.

    Returns:
        (F, 3) middle of the actor, world, and its (F, 3) velocity over ground, m/s.
    """
    counts = np.array([len(points) for points in sightings])
    enough = np.flatnonzero(counts >= max(1, min(MIN_POINTS, counts.max(initial=0))))
    chosen, at, weights = [sightings[i] for i in enough.tolist()], seconds[enough], np.minimum(counts[enough], 200.0)
    if len(enough) < 2:
        middle = np.mean(chosen[0], axis=0) if chosen else np.zeros(3)
        return np.tile(middle, (len(seconds), 1)), np.zeros((len(seconds), 3))
    path = (
        follow(chosen, at) if rigid else np.stack([(points.min(axis=0) + points.max(axis=0)) / 2 for points in chosen])
    )
    positions, velocities = smooth(path, at, weights, _DRIVE_S if rigid else _WALK_S)
    velocities = _bounded(velocities, at, best_sighting(chosen))
    return resample(seconds, at, positions, velocities)


def headings_of(velocities: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (F,) headings in radians, unwrapped: the direction of (F, 3) velocities, held while the actor is slow."""
    fast = np.flatnonzero(np.hypot(velocities[:, 0], velocities[:, 1]) > _HEADING_SPEED_M_S)
    if not len(fast):
        mean = velocities.mean(axis=0)
        return np.full(len(velocities), np.arctan2(mean[1], mean[0]))
    angles = np.unwrap(np.arctan2(velocities[fast, 1], velocities[fast, 0]))
    return np.interp(np.arange(len(velocities)), fast, angles)


def stands(
    sightings: Sequence[NDArray[np.float64]],
    positions: NDArray[np.float64],
    headings: NDArray[np.float64],
    seconds: NDArray[np.float64],
) -> bool:
    """Whether sightings lie on each other as well without any motion as with the one found.

    Args:
        sightings: of each time, (M, 3) points of the actor, world.
        positions: (F, 3) where the actor was found to be.
        headings: (F,) radians.
        seconds: (F,) times, rising.
    """
    thinned = [points[:: -(-len(points) // _POINTS)] for points in sightings]
    body = [(points - positions[i]) @ rotation_z(headings[i])[:3, :3] for i, points in enumerate(thinned)]
    still, moved = [], []
    for i in np.unique(np.linspace(0, len(seconds) - 1, _COMPARED).astype(int)):
        j = int(np.argmin(np.abs(np.abs(seconds - seconds[i]) - _APART_S)))
        if j != i:
            still.append(_apart(thinned[i], thinned[j]))
            moved.append(_apart(body[i], body[j]))
    if not still:
        return True
    # A path that was lost overlays badly too: standing must also look like standing.
    return float(np.mean(still)) < min(float(np.mean(moved)) + _DOUBT_M, _OVERLAID_M)


def _apart(points: NDArray[np.float64], others: NDArray[np.float64]) -> float:
    """Return how far, in the mean, points are from the nearest of others; farther than `_FAR_M` counts as that."""
    return float(np.minimum(np.sqrt(nearest_points(points, others)[1]), _FAR_M).mean())


def _bounded(velocities: NDArray[np.float64], seconds: NDArray[np.float64], best: int) -> NDArray[np.float64]:
    """Let velocity change no faster than an actor can, going out from where it is known best: not at the ends of a track."""
    bounded = velocities.copy()
    for step, stop in ((1, len(seconds)), (-1, -1)):
        for index in range(best + step, stop, step):
            before = bounded[index - step]
            change = velocities[index] - before
            most = _FASTEST_CHANGE_M_S2 * abs(seconds[index] - seconds[index - step])
            length = float(np.linalg.norm(change))
            bounded[index] = before + change * min(1.0, most / length) if length > 0 else before
    return bounded
