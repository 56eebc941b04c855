"""Where an actor was, from its points alone.

Of a car one sees the sides that face the sensor, and others a second later, so the middle of what is seen wanders over the car, and
points laid on points slide along its flanks. But the end nearest to the sensor is always in sight. So each sighting is hung up by its
near end and its near side, the car's length and width coming from the sightings that show the most of it; and because its
acceleration is bounded, and an error of one sighting is not, the path is smoothed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

_OUTLIERS = 0.01  # share of points at either end that may be somebody else's
_FULL = 0.9  # the quantile of sightings, by what they show, that counts as showing all
_ROUNDS = 4
_SMOOTH_S = 0.5  # half width of the window in which motion is taken as uniformly accelerated
_HEADING_S = 0.8  # half width of the window that the direction of motion comes from
_HEADING_M = 0.8  # shorter ways have no direction


def register(
    sightings: Sequence[NDArray[np.float64]], origins: NDArray[np.float64], seconds: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Estimate the path of an upright actor that moves forward.

    Args:
        sightings: of each time, (M, 3) points of the actor, world.
        origins: (F, 3) where the sensor was, world.
        seconds: (F,) times, rising.

    Returns:
        positions: (F, 3) middle of the actor's box, world.
        velocities: (F, 3) m/s.
        headings: (F,) radians, unwrapped: the direction of motion.
    """
    weights = np.minimum([len(points) for points in sightings], 200).astype(np.float64)
    middles = np.stack([(points.min(axis=0) + points.max(axis=0)) / 2 for points in sightings])
    positions, velocities = smooth(middles, seconds, weights)
    headings = _headings(positions, seconds)
    for _ in range(_ROUNDS):
        middles = _hang_up(sightings, origins, headings, weights)
        positions, velocities = smooth(middles, seconds, weights)
        headings = _headings(positions, seconds)
    return positions, velocities, headings


def _hang_up(
    sightings: Sequence[NDArray[np.float64]],
    origins: NDArray[np.float64],
    headings: NDArray[np.float64],
    weights: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return (F, 3) middles of the actor's box, each found from the ends that face the sensor."""
    cos, sin = np.cos(headings), np.sin(headings)
    turn = np.zeros((len(headings), 3, 3))  # world to heading
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = cos, sin, -sin, cos, 1.0
    ends = np.stack(
        [np.quantile(points @ turn[i].T, [_OUTLIERS, 1 - _OUTLIERS], axis=0) for i, points in enumerate(sightings)]
    )
    lower, upper = ends[:, 0], ends[:, 1]
    seen = weights >= np.median(weights)
    size = np.quantile((upper - lower)[seen], _FULL, axis=0)
    eye = np.einsum("fij,fj->fi", turn, origins)
    middles = (lower + upper) / 2
    middles = np.where(eye <= lower, lower + size / 2, middles)
    middles = np.where(eye >= upper, upper - size / 2, middles)
    return np.einsum("fji,fj->fi", turn, middles)


def smooth(
    values: NDArray[np.float64], seconds: NDArray[np.float64], weights: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit a parabola around each time, robustly; a straight line where there are few values.

    Args:
        values: (F, D).
        seconds: (F,) times, rising.
        weights: (F,) of the values.

    Returns:
        (F, D) values of the fits, and their (F, D) derivatives.
    """
    smoothed, slopes = values.copy(), np.zeros_like(values)
    for index, now in enumerate(seconds):
        near = np.flatnonzero(np.abs(seconds - now) <= _SMOOTH_S + 1e-9)
        if len(near) < 4:  # a window that reaches as far as it must
            near = np.sort(np.argsort(np.abs(seconds - now), kind="stable")[:4])
        offsets = seconds[near] - now
        degree = 2 if len(near) > 5 else 1 if len(near) > 1 else 0
        design = offsets[:, None] ** np.arange(degree + 1)
        weight = weights[near] * (1 - 0.9 * (np.abs(offsets) / max(np.abs(offsets).max(), 1e-9)) ** 3)
        for _ in range(3):  # reweighted: a sighting half hidden must not bend the path
            root = np.sqrt(weight)[:, None]
            fit = np.linalg.lstsq(design * root, values[near] * root, rcond=None)[0]
            error = np.linalg.norm(values[near] - design @ fit, axis=1)
            weight = weight / (1 + (error / max(3 * float(np.median(error)), 0.02)) ** 2)
        smoothed[index] = fit[0]
        slopes[index] = fit[1] if degree else 0.0
    return smoothed, slopes


def _headings(positions: NDArray[np.float64], seconds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (F,) directions of motion, unwrapped; where the actor hardly moves, those before and after."""
    known, angles = [], []
    for index, now in enumerate(seconds):
        near = positions[np.abs(seconds - now) <= _HEADING_S + 1e-9, :2]
        way = near[-1] - near[0]
        if np.linalg.norm(way) > _HEADING_M:
            known.append(index)
            angles.append(np.arctan2(way[1], way[0]))
    if not known:
        way = positions[-1, :2] - positions[0, :2]
        return np.full(len(positions), np.arctan2(way[1], way[0]))
    return np.interp(np.arange(len(positions)), known, np.unwrap(angles))
