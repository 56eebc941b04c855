"""Labels as a network gets them wrong: at random, or in clumps."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

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
