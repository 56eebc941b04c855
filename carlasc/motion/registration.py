"""Where an actor was, from its points alone.

Of a car one sees the sides that face the sensor, and others a second later, so the middle of what is seen wanders over the car, and
points laid on points slide along its flanks. But the end nearest to the sensor is always in sight. So each sighting is hung up by its
near end and its near side, the car's length and width coming from the sightings that show the most of it, and then laid on what
all of them together show. Because an actor's acceleration is bounded, and the error of a sighting is not, the path is smoothed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numba
import numpy as np
from numpy.typing import NDArray

from carlasc.geometry import rotation_z

_OUTLIERS = 0.01  # share of points at either end that may be somebody else's
_FULL = 0.9  # the quantile of sightings, by what they show, that counts as showing all
_ROUNDS, _SETTLINGS = 4, 2
_POINTS = 200  # of a sighting are looked at
_CELL_M, _MODEL_POINTS = 0.15, 1500
_COMPARED, _APART_S = 12, 1.0  # pairs of sightings, and how far apart in time, that tell standing from moving
_FAR_M, _DOUBT_M = 0.5, 0.02
_OVERLAID_M = 0.38  # sightings of what stands are nearer to each other, though each shows another side of it
_SMOOTH_S = 0.5  # half width of the window in which motion is taken as uniformly accelerated
_HEADING_S = 0.8  # half width of the window that the direction of motion comes from
_HEADING_SPEED_M_S = 0.7  # slower actors are not going anywhere


def register(
    sightings: Sequence[NDArray[np.float64]], origins: NDArray[np.float64], seconds: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Estimate the path of an upright actor that stands or moves forward.

    Args:
        sightings: of each time, (M, 3) points of the actor, world.
        origins: (F, 3) where the sensor was, world.
        seconds: (F,) times, rising.

    Returns:
        positions: (F, 3) middle of the actor's box, world.
        velocities: (F, 3) m/s; all zero for an actor that stands.
        headings: (F,) radians, unwrapped: the direction of motion.
    """
    thinned = [points[:: -(-len(points) // _POINTS)] for points in sightings]
    weights = np.minimum([len(points) for points in sightings], _POINTS).astype(np.float64)
    middles = np.stack([(points.min(axis=0) + points.max(axis=0)) / 2 for points in sightings])
    positions, velocities = smooth(middles, seconds, weights)
    headings = _headings(positions, seconds, weights)
    for _ in range(_ROUNDS):
        middles, trust = _hang_up(sightings, origins, headings)
        positions, velocities = smooth(middles, seconds, weights * trust)
        headings = _headings(positions, seconds, weights)
    for _ in range(_SETTLINGS):
        settled = _settle(thinned, positions, headings)
        positions, velocities = smooth(settled, seconds, weights)
        headings = _headings(positions, seconds, weights)
    if _stands(thinned, positions, headings, seconds):
        middle = (np.concatenate(thinned).min(axis=0) + np.concatenate(thinned).max(axis=0)) / 2
        return np.tile(middle, (len(seconds), 1)), np.zeros_like(positions), np.zeros(len(seconds))
    return positions, velocities, headings


def _stands(
    sightings: Sequence[NDArray[np.float64]],
    positions: NDArray[np.float64],
    headings: NDArray[np.float64],
    seconds: NDArray[np.float64],
) -> bool:
    """Whether sightings lie on each other as well without any motion as with the one found."""
    body = [_to_body(points, positions[i], headings[i]) for i, points in enumerate(sightings)]
    still, moved = [], []
    for i in np.unique(np.linspace(0, len(seconds) - 1, _COMPARED).astype(int)):
        j = int(np.argmin(np.abs(np.abs(seconds - seconds[i]) - _APART_S)))
        if j != i:
            still.append(_apart(sightings[i], sightings[j]))
            moved.append(_apart(body[i], body[j]))
    if not still:
        return True
    # A path that was lost overlays badly too: standing must also look like standing.
    return float(np.mean(still)) < min(float(np.mean(moved)) + _DOUBT_M, _OVERLAID_M)


def _apart(points: NDArray[np.float64], others: NDArray[np.float64]) -> float:
    """Return how far, in the mean, points are from the nearest of others; farther than `_FAR_M` counts as that."""
    return float(np.minimum(np.sqrt(_nearest(points, others)[1]), _FAR_M).mean())


def _settle(
    sightings: Sequence[NDArray[np.float64]], positions: NDArray[np.float64], headings: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (F, 3) positions after each sighting was laid, by its nearest points, on what all of them together show."""
    body = [_to_body(points, positions[i], headings[i]) for i, points in enumerate(sightings)]
    together = np.concatenate(body)
    _, first = np.unique(np.floor(together / _CELL_M).astype(np.int64), axis=0, return_index=True)
    model = together[np.sort(first)]
    model = model[:: -(-len(model) // _MODEL_POINTS)]
    settled = positions.copy()
    for i, points in enumerate(body):
        shift = np.zeros(3)
        for reach in (0.6, 0.4, 0.3):
            nearest, squared = _nearest(points + shift, model)
            pairs = squared < reach**2
            if np.count_nonzero(pairs) >= 3:
                shift = shift + (model[nearest[pairs]] - points[pairs] - shift).mean(axis=0)
        settled[i] = positions[i] - rotation_z(headings[i])[:3, :3] @ shift
    return settled


def _to_body(points: NDArray[np.float64], position: NDArray[np.float64], heading: float) -> NDArray[np.float64]:
    return (points - position) @ rotation_z(heading)[:3, :3]


def _hang_up(
    sightings: Sequence[NDArray[np.float64]],
    origins: NDArray[np.float64],
    headings: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (F, 3) middles of the actor's box, each found from the ends that face the sensor, and how far to trust each: (F,)."""
    cos, sin = np.cos(headings), np.sin(headings)
    turn = np.zeros((len(headings), 3, 3))  # world to heading
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = cos, sin, -sin, cos, 1.0
    ends = np.stack(
        [np.quantile(points @ turn[i].T, [_OUTLIERS, 1 - _OUTLIERS], axis=0) for i, points in enumerate(sightings)]
    )
    lower, upper = ends[:, 0], ends[:, 1]
    counts = np.array([len(points) for points in sightings])
    size = np.quantile((upper - lower)[counts >= np.median(counts)], _FULL, axis=0)
    eye = np.einsum("fij,fj->fi", turn, origins)
    middles = (lower + upper) / 2
    middles = np.where(eye <= lower, lower + size / 2, middles)
    middles = np.where(eye >= upper, upper - size / 2, middles)
    beside = ((eye > lower) & (eye < upper))[:, 0]
    half_hidden = beside & ((upper - lower)[:, 0] < 0.8 * size[0])  # of such a flank, nothing tells which part it is
    return np.einsum("fji,fj->fi", turn, middles), np.where(half_hidden, 0.1, 1.0)


def smooth(
    values: NDArray[np.float64], seconds: NDArray[np.float64], weights: NDArray[np.float64], half_s: float = _SMOOTH_S
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit a parabola around each time, robustly; a straight line where there are few values.

    Args:
        values: (F, D).
        seconds: (F,) times, rising.
        weights: (F,) of the values.
        half_s: half width of the window of each fit, seconds.

    Returns:
        (F, D) values of the fits, and their (F, D) derivatives.
    """
    smoothed, slopes = values.copy(), np.zeros_like(values)
    for index, now in enumerate(seconds):
        near = np.flatnonzero(np.abs(seconds - now) <= half_s + 1e-9)
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


def _headings(
    positions: NDArray[np.float64], seconds: NDArray[np.float64], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (F,) directions of motion, unwrapped; where the actor is slow, those before and after."""
    velocities = smooth(positions[:, :2], seconds, weights, _HEADING_S)[1]
    fast = np.flatnonzero(np.linalg.norm(velocities, axis=1) > _HEADING_SPEED_M_S)
    if not len(fast):
        way = positions[-1, :2] - positions[0, :2]
        return np.full(len(positions), np.arctan2(way[1], way[0]))
    angles = np.unwrap(np.arctan2(velocities[fast, 1], velocities[fast, 0]))
    return np.interp(np.arange(len(positions)), fast, angles)


@numba.njit(cache=True, nogil=True)
def _nearest(points: NDArray[np.float64], model: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the index of the model point nearest to each point, and the squared distance: all pairs, they are few."""
    index = np.zeros(len(points), np.int64)
    squared = np.full(len(points), np.inf)
    for i in range(len(points)):
        for j in range(len(model)):
            dx, dy, dz = points[i, 0] - model[j, 0], points[i, 1] - model[j, 1], points[i, 2] - model[j, 2]
            distance = dx * dx + dy * dy + dz * dz
            if distance < squared[i]:
                squared[i], index[i] = distance, j
    return index, squared
