"""Labels as a network gets them wrong, and poses as an odometry or a satellite receiver gets them wrong."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import invert, multiply, rotations_of
from carlasc.errors import ArgumentError


def wrong_labels(
    labels: NDArray[np.unsignedinteger],
    points: NDArray[np.floating],
    share: float,
    *,
    clump_m: float | None = None,
    classes: Iterable[int] | None = None,
    seed: int = 0,
) -> NDArray[np.unsignedinteger]:
    """Return a copy of labels, some of which are wrong. Points with the class 0 keep it.

    Clumps are cubes. Which ones are wrong, and the class that they get, depends on their place and on `seed`: with points in the frame of the
    world and equal seeds, several scans have wrong labels in the same places, as a network that does not know an object; with another seed
    for each scan, or points in the frame of the sensor, in other places.

    Args:
        labels: (N,) class ids.
        points: (N, 3) or more columns, of which the first are x, y, z in metres.
        share: share of the labelled points that get another class, 0 to 1; with clumps the nearest that whole clumps give.
        clump_m: side of a clump in metres; None for single points at random.
        classes: ids that wrong labels have; None for those in `labels`. Two at least.
        seed: of the random numbers.

    Returns:
        (N,) class ids of the type of `labels`.

    Raises:
        ArgumentError: `share` or `clump_m` is not in its range, or there are fewer than two classes.
    """
    if not 0 <= share <= 1:
        raise ArgumentError("share", expected="a number from 0 to 1", found=str(share))
    if clump_m is not None and not clump_m > 0:
        raise ArgumentError("clump_m", expected="a length above 0", found=str(clump_m))
    result, places = labels.copy(), np.flatnonzero(labels)
    others = np.unique(labels[places] if classes is None else list(classes)).astype(labels.dtype)
    if not len(places) or not share:
        return result
    if len(others) < 2:
        raise ArgumentError("classes", expected="two classes or more", found=str(others.tolist()))
    if clump_m is None:
        rng = np.random.default_rng(seed)
        wrong = rng.permutation(places)[: round(share * len(places))]
        drawn = rng.integers(0, len(others), len(wrong))
    else:
        cubes = np.floor(points[places, :3].astype(np.float64) / clump_m).astype(np.int64)
        cubes, clump, counts = np.unique(cubes, axis=0, return_inverse=True, return_counts=True)
        rngs = [np.random.default_rng([seed, *cube]) for cube in (cubes & 0xFFFFFFFF).tolist()]
        order = np.argsort([rng.random() for rng in rngs])
        wanted = share * len(places)
        above = np.cumsum(counts[order]) - counts[order] / 2 < wanted  # of which more than half is within the share
        chosen = np.zeros(len(cubes), np.bool_)
        chosen[order[above]] = True
        classes_of = np.array([rng.integers(0, len(others)) for rng in rngs])
        clump = clump.reshape(-1)
        wrong, drawn = places[chosen[clump]], classes_of[clump[chosen[clump]]]
    same = others[drawn] == labels[wrong]
    result[wrong] = others[(drawn + same) % len(others)]
    return result


def wrong_poses(
    poses: NDArray[np.float64],
    *,
    jitter_m: float = 0.0,
    jitter_rad: float = 0.0,
    drift_m: float = 0.0,
    drift_rad: float = 0.0,
    height_drift_m: float = 0.0,
    seed: int = 0,
) -> NDArray[np.float64]:
    """Return poses with errors: the same for equal arguments.

    Args:
        poses: (F, 4, 4) world_T_sensor in order of time.
        jitter_m: standard deviation of an error of each position, along each axis of the world, that is independent of the others.
        jitter_rad: the same of each rotation, about each axis of the sensor.
        drift_m: standard deviation of an error of each motion from one pose to the next, along each axis of the sensor; these add up.
        drift_rad: the same of each rotation.
        height_drift_m: standard deviation of the steps of a random walk of the height alone.
        seed: of the random numbers.

    Returns:
        (F, 4, 4) world_T_sensor. Drift leaves the first pose as it is.

    Raises:
        ArgumentError: a standard deviation is negative or no number.
    """
    given = {"jitter_m": jitter_m, "jitter_rad": jitter_rad, "drift_m": drift_m, "drift_rad": drift_rad}
    for name, value in (given | {"height_drift_m": height_drift_m}).items():
        if not 0 <= value < np.inf:
            raise ArgumentError(name, expected="a standard deviation, 0 or more", found=str(value))
    rng = np.random.default_rng(seed)
    wrong = np.array(poses, np.float64)
    motions = multiply(invert(wrong[:-1]), wrong[1:])
    motions = multiply(motions, _turns(rng, len(motions), drift_rad))
    motions[:, :3, 3] += rng.normal(0.0, drift_m, (len(motions), 3))
    if drift_m or drift_rad:
        for row, motion in enumerate(motions):
            wrong[row + 1] = multiply(wrong[row], motion)
    wrong = multiply(wrong, _turns(rng, len(wrong), jitter_rad))
    wrong[:, :3, 3] += rng.normal(0.0, jitter_m, (len(wrong), 3))
    wrong[1:, 2, 3] += np.cumsum(rng.normal(0.0, height_drift_m, max(len(wrong) - 1, 0)))
    return wrong


def _turns(rng: np.random.Generator, count: int, deviation_rad: float) -> NDArray[np.float64]:
    """Return (count, 4, 4) small rotations."""
    turns = np.tile(np.eye(4), (count, 1, 1))
    half = rng.normal(0.0, deviation_rad, (count, 3)) / 2
    turns[:, :3, :3] = rotations_of(np.column_stack([np.ones(count), half]))
    return turns
