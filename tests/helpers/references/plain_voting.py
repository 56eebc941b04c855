"""Ground truth by ray voting in plain NumPy: slow, dense and short.

The judge of the kernel (see the format page, `docs/format.md#votes`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from carlasc.core.grids import GridSpec
from carlasc.groundtruth.voting.ballot import Observation


def plain_votes(
    observations: Iterable[Observation],
    spec: GridSpec,
    num_channels: int = 25,
    *,
    rule: str = "sensor",
    free_step_m: float = 1.5,
) -> NDArray[np.int64]:
    """Return the votes, (V, num_channels) int64, free votes in channel 0."""
    votes = np.zeros(spec.num_voxels * num_channels, np.int64)
    for observation in observations:
        seen = np.zeros(len(votes), np.bool_)
        for voxels, labels in plain_samples(observation, spec, free_step_m):
            keys = (voxels * num_channels + labels)[voxels >= 0]
            if rule == "sensor":
                seen[keys] = True
            else:
                np.add.at(votes, keys, 1)
        votes += seen
    return votes.reshape(-1, num_channels)


def plain_samples(
    observation: Observation, spec: GridSpec, free_step_m: float
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Yield the voxels (-1 outside) and labels of all samples of a step, step by step: 0 is the
    endpoints, the rest free.
    """
    taking_part = observation.labels != 0
    points, labels = (
        observation.points[taking_part],
        observation.labels[taking_part].astype(np.int64),
    )
    with np.errstate(all="ignore"):
        units = points / np.linalg.norm(points, axis=1)[:, None]
        step = 0
        while len(points):
            samples = points - units.astype(np.float64) * (step * free_step_m)
            kept = (samples[:, 0] / units[:, 0] > 0) & (units[:, 0] != 0)
            points, units, labels, samples = points[kept], units[kept], labels[kept], samples[kept]
            yield spec.flat_index(to_grid_frame(observation, samples)), labels
            step, labels = step + 1, np.zeros_like(labels)


def to_grid_frame(observation: Observation, samples: NDArray[np.float64]) -> NDArray[np.float64]:
    """R @ p + t, summed from the left whatever the CPU's matrix product does."""
    (x, y, z), R, t = samples.T, observation.grid_T_sensor[:3, :3], observation.grid_T_sensor[:3, 3]
    return np.stack([R[a, 0] * x + R[a, 1] * y + R[a, 2] * z + t[a] for a in range(3)], axis=1)


def plain_grid(
    votes: NDArray[np.int64], spec: GridSpec
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return labels and counts, (X, Y, Z) each: argmax takes the lowest id of a tie."""
    return votes.argmax(axis=1).reshape(spec.size), votes.sum(axis=1).reshape(spec.size)
