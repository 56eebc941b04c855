"""Smoothing: values over time that change as the motion of an actor does, and the same at other times."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import multiply
from carlasc.motion.solving import least_squares


def smooth(
    values: NDArray[np.float64], seconds: NDArray[np.float64], weights: NDArray[np.float64], half_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit a parabola around each time, robustly; a straight line if there are few values.

    Args:
        values: (F, D).
        seconds: (F,) times, rising.
        weights: (F,) of the values.
        half_s: half width of the window of each fit, seconds. It grows until it holds four values.

    Returns:
        The (F, D) values of the fits, and their (F, D) derivatives per second.
    """
    smoothed, slopes = values.copy(), np.zeros_like(values)
    for index in range(len(seconds)):
        smoothed[index], slopes[index] = smooth_at(index, values, seconds, weights, half_s)
    return smoothed, slopes


def smooth_at(
    index: int,
    values: NDArray[np.float64],
    seconds: NDArray[np.float64],
    weights: NDArray[np.float64],
    half_s: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what `smooth` returns for the time of one index alone: (D,) and (D,)."""
    distance = np.abs(seconds - seconds[index])
    near = np.flatnonzero(distance <= half_s + 1e-9)
    if len(near) < 4:
        near = np.sort(np.argsort(distance, kind="stable")[:4])
    offsets = seconds[near] - seconds[index]
    degree = 2 if len(near) > 5 else 1 if len(near) > 1 else 0
    design, own = offsets[:, None] ** np.arange(degree + 1), values[near]
    weight = weights[near] * (1 - 0.9 * (np.abs(offsets) / max(np.abs(offsets).max(), 1e-9)) ** 3)
    for _ in range(3):  # reweighted, so that partly hidden actors do not bend the path
        root = np.sqrt(weight)[:, None]
        fit = least_squares(design * root, own * root)
        error = np.linalg.norm(own - multiply(design, fit), axis=1)
        weight = weight / (1 + (error / max(3 * _median(error), 0.02)) ** 2)
    return fit[0], fit[1] if degree else np.zeros_like(fit[0])


def _median(values: NDArray[np.float64]) -> float:
    """Return the median of (N,) values, N > 0; `np.median` takes five times as long for few values."""
    ranked, half = np.sort(values), len(values) // 2
    return float(ranked[half]) if len(values) % 2 else float((ranked[half - 1] + ranked[half]) / 2)


def resample(
    at: NDArray[np.float64],
    seconds: NDArray[np.float64],
    positions: NDArray[np.float64],
    velocities: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return positions and velocities at other times: linear between the known times, at constant velocity beyond.

    Args:
        at: (A,) the other times, seconds.
        seconds: (F,) the known times, increasing.
        positions: (F, 3) metres.
        velocities: (F, 3) m/s.

    Returns:
        (A, 3) positions and (A, 3) velocities.
    """
    path = np.stack([np.interp(at, seconds, positions[:, axis]) for axis in range(3)], axis=1)
    speed = np.stack([np.interp(at, seconds, velocities[:, axis]) for axis in range(3)], axis=1)
    beyond = np.minimum(at - seconds[0], 0) + np.maximum(at - seconds[-1], 0)
    return path + speed * beyond[:, None], speed
