"""Classes for the points of scans that nobody labelled, from labelled scans of the same recording that saw the same places."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.grids import most_frequent

_CELLS_M = (0.25, 0.5, 1.0)  # how near labelled points must be: the smallest cell that has any decides
_GROUND_CELLS_M = (0.5, 1.0, 2.0)  # in the plane: on the ground, the rings of two scans may be metres apart
_HALF = 1 << 14  # cells to each side of the origin


def labels_nearby(
    points: NDArray[np.floating],
    ground: NDArray[np.bool_],
    labelled: Sequence[tuple[NDArray[np.floating], NDArray[np.unsignedinteger]]],
    classes: ClassTable,
) -> NDArray[np.uint32]:
    """Return the class that most labelled points near each point have.

    Points on the ground get classes of the ground, others get other classes. Classes of what can move are not taken over: it may have
    moved since.

    Args:
        points: (N, 3) metres, in a frame whose z points up.
        ground: (N,) whether they are on the ground.
        labelled: (M, 3) points in the same frame and (M,) class ids of each labelled scan.
        classes: table of the ids.

    Returns:
        (N,) class ids, 0 where no labelled point is near.
    """
    found = np.zeros(len(points), np.uint32)
    if not labelled:
        return found
    places = np.concatenate([own for own, _ in labelled])
    labels = np.concatenate([own for _, own in labelled]).astype(np.int64)
    on_ground = np.isin(labels, sorted(classes.ground))
    fixed = (labels > 0) & ~np.isin(labels, sorted(classes.movable | classes.moving)) & ~on_ground
    for own, source, sizes, axes in (
        (ground, on_ground, _GROUND_CELLS_M, 2),
        (~ground, fixed, _CELLS_M, 3),
    ):
        for size in sizes:
            open_ = np.flatnonzero(own & (found == 0))
            if len(open_) and source.any():
                found[open_] = _by_cells(points[open_, :axes], places[source, :axes], labels[source], size)
    return found


def _by_cells(
    points: NDArray[np.floating], places: NDArray[np.floating], labels: NDArray[np.int64], size: float
) -> NDArray[np.uint32]:
    """Return the most frequent label in the cell of each point, the lowest of several; 0 where the cell is empty."""
    keys, winners = most_frequent(_cells(places, size), labels)
    wanted = _cells(points, size)
    rows = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.where(keys[rows] == wanted, winners[rows], 0).astype(np.uint32)


def _cells(places: NDArray[np.floating], size: float) -> NDArray[np.int64]:
    """Return one number per cell, below 2 ** 45. Cells beyond 4 km or more count as the last one."""
    index = np.clip(np.floor(places / size), -_HALF, _HALF - 1).astype(np.int64) + _HALF
    return index @ ((2 * _HALF) ** np.arange(index.shape[1]))
