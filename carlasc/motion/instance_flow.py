"""Scene flow from instances: how fast an actor is, from its points alone, in scans that number actors and have no flow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from carlasc.motion.registration import register, smooth

MIN_POINTS = 10  # fewer say too little; such a sighting inherits from its track
_FASTEST_CHANGE_M_S2 = 6.0  # of velocity: hard braking, a sharp bend
_WALK_S = 0.6  # half width of the window in which a person walks evenly


def estimate_velocities(
    sightings: Sequence[NDArray[np.float64]],
    origins: NDArray[np.float64],
    seconds: NDArray[np.float64],
    *,
    rigid: bool,
) -> NDArray[np.float64]:
    """Estimate the velocity of an actor at each of its sightings.

    Rigid actors are registered, so that it does not matter which of their sides is seen; of people, who bend as they walk, the middle is
    followed. Sightings of too few points inherit from those around them. An actor that was seen once has velocity zero: nothing is known of it.

    Args:
        sightings: of each time, (M, 3) points of the actor, world.
        origins: (F, 3) where the sensor was, world.
        seconds: (F,) times, rising.
        rigid: whether the actor keeps its shape.

    Returns:
        (F, 3) m/s over ground, world.
    """
    counts = np.array([len(points) for points in sightings])
    enough = np.flatnonzero(counts >= min(MIN_POINTS, counts.max(initial=0)))
    if len(enough) < 2:
        return np.zeros((len(sightings), 3))
    chosen = [sightings[index] for index in enough.tolist()]
    if rigid:
        velocities = register(chosen, origins[enough], seconds[enough])[1]
    else:
        middles = np.stack([(points.min(axis=0) + points.max(axis=0)) / 2 for points in chosen])
        velocities = smooth(middles, seconds[enough], np.minimum(counts[enough], 200).astype(np.float64), _WALK_S)[1]
    velocities = _bounded(velocities, seconds[enough], counts[enough])
    return np.stack([np.interp(seconds, seconds[enough], velocities[:, axis]) for axis in range(3)], axis=1)


def _bounded(
    velocities: NDArray[np.float64], seconds: NDArray[np.float64], counts: NDArray[np.integer]
) -> NDArray[np.float64]:
    """Let velocity change no faster than an actor can, going out from where it is known best: not at the ends of a track."""
    inner = np.arange(len(counts))
    best = int(np.argmax(counts * np.minimum(np.minimum(inner, inner[::-1]) + 1, 5)))
    bounded = velocities.copy()
    for step, stop in ((1, len(counts)), (-1, -1)):
        for index in range(best + step, stop, step):
            before = bounded[index - step]
            change = velocities[index] - before
            most = _FASTEST_CHANGE_M_S2 * abs(seconds[index] - seconds[index - step])
            length = float(np.linalg.norm(change))
            bounded[index] = before + change * min(1.0, most / length) if length > 0 else before
    return bounded
