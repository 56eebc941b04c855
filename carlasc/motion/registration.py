"""Where a rigid actor was, from its points alone: each sighting is laid over a model that grows from all of them."""

from __future__ import annotations

from collections.abc import Sequence

import numba
import numpy as np
from numpy.typing import NDArray

from carlasc.geometry import invert, rotation_z, transform_points

_MODEL_CELL_M = 0.1  # the model keeps one point a cell
_MODEL_POINTS = 3000
_SIGHTING_POINTS = 500
_ITERATIONS = 20
_FIRST_REACH_M, _LAST_REACH_M = 1.0, 0.25  # pairs farther apart are no pairs; the reach shrinks as the fit improves
_SMOOTH_S = 0.5  # half width of the window in which motion is taken as uniformly accelerated
_HEADING_SPEED_M_S = 1.0


def register(
    sightings: Sequence[NDArray[np.float64]], seconds: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Estimate the path of a rigid actor that stands upright.

    The sighting with most points comes first; from there the path grows forward and backward, each sighting starting where
    the motion so far predicts it. Motion is then smoothed: an actor's acceleration is bounded, a registration's error is not.

    Args:
        sightings: of each time, (M, 3) points of the actor, world.
        seconds: (F,) times, rising.

    Returns:
        (F, 3) positions of the point that starts in the middle of the largest sighting, world, and (F,) headings in radians,
        unwrapped: the direction of motion where the actor is fast enough to have one.
    """
    best = int(np.argmax([len(points) for points in sightings]))
    center = (sightings[best].min(axis=0) + sightings[best].max(axis=0)) / 2
    positions = np.tile(center, (len(sightings), 1))
    yaws = np.zeros(len(sightings))
    model = _thin(sightings[best] - center, _MODEL_POINTS)
    for step, stop in ((1, len(sightings)), (-1, -1)):
        model = _follow(sightings, seconds, positions, yaws, model, range(best + step, stop, step), best)
    positions = smooth(positions, seconds)
    return positions, _headings(positions, yaws, seconds)


def _follow(
    sightings: Sequence[NDArray[np.float64]],
    seconds: NDArray[np.float64],
    positions: NDArray[np.float64],
    yaws: NDArray[np.float64],
    model: NDArray[np.float64],
    order: range,
    previous: int,
) -> NDArray[np.float64]:
    """Register sightings one after the other, writing positions and yaws; returns the model, grown."""
    velocity, turning = None, 0.0
    for index in order:
        elapsed = seconds[index] - seconds[previous]
        points = sightings[index]
        if (
            velocity is None
        ):  # nothing is known of the motion yet: the shift that brings most points near is tried first
            start = positions[previous] + np.median(points, axis=0) - np.median(sightings[previous], axis=0)
        else:
            start = positions[previous] + velocity * elapsed
        position, yaw = _fit(points, model, start, yaws[previous] + turning * elapsed)
        step = (position - positions[previous]) / elapsed
        velocity = step if velocity is None else 0.5 * velocity + 0.5 * step
        turning = 0.5 * turning + 0.5 * (yaw - yaws[previous]) / elapsed
        positions[index], yaws[index] = position, yaw
        pose = rotation_z(yaw)
        pose[:3, 3] = position
        model = _thin(np.concatenate([model, transform_points(invert(pose), points)]), _MODEL_POINTS)
        previous = index
    return model


def _fit(
    points: NDArray[np.float64], model: NDArray[np.float64], position: NDArray[np.float64], yaw: float
) -> tuple[NDArray[np.float64], float]:
    """Iterated closest points: the position and yaw of the actor that lay `points` on the model."""
    points = points[:: max(1, len(points) // _SIGHTING_POINTS)]
    for iteration in range(_ITERATIONS):
        reach = _FIRST_REACH_M * (_LAST_REACH_M / _FIRST_REACH_M) ** (iteration / (_ITERATIONS - 1))
        pose = rotation_z(yaw)
        pose[:3, 3] = position
        body = transform_points(invert(pose), points)
        nearest, squared = _nearest(body, model)
        pairs = squared < reach**2
        if np.count_nonzero(pairs) < 3:
            break
        source, target = points[pairs], model[nearest[pairs]]
        middle, goal = source.mean(axis=0), target.mean(axis=0)
        a, b = (target - goal)[:, :2], (source - middle)[:, :2]
        turn = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
        # A few points in a heap say where an actor is, not how it is turned.
        spread = np.square(a).sum() / len(a)
        yaw = float(turn) if spread > 0.25 and len(a) > 20 else yaw
        position = middle - rotation_z(yaw)[:3, :3] @ goal
    return position, yaw


def smooth(values: NDArray[np.float64], seconds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fit a parabola around each time, robustly, and return its value there: (F, D) like `values`."""
    smoothed = values.copy()
    for index, now in enumerate(seconds):
        near = np.abs(seconds - now) <= _SMOOTH_S + 1e-9
        if np.count_nonzero(near) < 4:
            continue
        offsets = seconds[near] - now
        design = np.stack([np.ones_like(offsets), offsets, offsets**2], axis=1)
        weights = 1 - 0.9 * (np.abs(offsets) / (_SMOOTH_S + 1e-9)) ** 3
        for _ in range(3):  # reweighted: a single bad fit must not bend the path
            root = np.sqrt(weights)[:, None]
            solution = np.linalg.lstsq(design * root, values[near] * root, rcond=None)[0]
            error = np.linalg.norm(values[near] - design @ solution, axis=1)
            weights = weights / (1 + (error / max(float(np.median(error)) * 3, 1e-3)) ** 2)
        smoothed[index] = solution[0]
    return smoothed


def _headings(
    positions: NDArray[np.float64], yaws: NDArray[np.float64], seconds: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return headings whose changes are the yaws' and whose mean is the direction of motion."""
    if len(seconds) < 2:
        return yaws
    velocity = np.gradient(positions, seconds, axis=0)
    fast = np.hypot(velocity[:, 0], velocity[:, 1]) > _HEADING_SPEED_M_S
    if not fast.any():
        return yaws
    direction = np.arctan2(velocity[fast, 1], velocity[fast, 0]) - yaws[fast]
    offset = np.arctan2(np.sin(direction).mean(), np.cos(direction).mean())
    headings: NDArray[np.float64] = np.unwrap(yaws + offset)
    return headings


def _thin(points: NDArray[np.float64], most: int) -> NDArray[np.float64]:
    """Keep one point a cell, and at most so many."""
    _, first = np.unique(np.floor(points / _MODEL_CELL_M).astype(np.int64), axis=0, return_index=True)
    kept = points[np.sort(first)]
    return kept[:: -(-len(kept) // most)]


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
