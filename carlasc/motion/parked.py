"""Parked actors that leave: things that stand at a place in one pass of a drive, and are gone in
another.

Points near the path that are not ground are looked up in scans of the other passes of the place, as
in `evidence`. Cells of which one pass saw points, and through which several rays of another pass
went, are grouped from above. A group counts if it has the size of a part of a vehicle, stands on
the ground, and holds little that both passes saw: edges of hedges and walls do.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from carlasc.core.arrays import (
    AnyFloatArray,
    BoolArray,
    Float32Array,
    FloatArray,
    Int32Array,
    IntArray,
)
from carlasc.core.cells import as_pose, cells_of, distinct, joined, numbered, run_starts
from carlasc.core.geometry import (
    Transform,
    invert,
    multiply,
    spread_rows,
    transform_points,
    translation,
)
from carlasc.motion.evidence import HORIZON_S, SortedReturns, look_up
from carlasc.motion.ground import ground_plane
from carlasc.motion.tracks import LONGEST_M

# Scans that are used are so far apart; another pass is so far away along the drive and in time, and
# so near in space and in height, as one that ends early sees what is ahead of it, too.
_STEP_M, _APART_M, _APART_S, _NEAR_M, _LEVEL_M = 1.0, 60.0, 2 * HORIZON_S, 30.0, 2.0
_AROUND_M = 12.0  # scans of a pass are used that are so much farther away than its nearest one
_PASSES, _VIEWS = 6, 10  # most passes, and scans of a pass, that a point is looked up in
_AGREEING, _SURE = 3, 4  # least number of them that saw its place free, also per one that did not
# Poses of passes may be wrong by so much: what another pass saw beside the place is no free space.
_SHIFTS_M = ((0.0, 0.0), (0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5))
_DISAGREEING = 0.4  # greatest share of what a pass saw free: above it, its poses are wrong
_REACH_M, _HIGH_M, _LOW_M = 20.0, 4.0, 0.8  # of points: from the sensor, and above the ground
_CELL_M = 0.2  # columns are two cells wide
# Of a group: least number of cells, of columns near the ground, length, height, and shares of what
# is gone in a column and in all.
_CELLS, _COLUMNS, _LONG_M, _TALL_M, _IN_COLUMN, _GONE = 30, 3, 1.2, 0.6, 0.5, 0.7

View = tuple[Transform, Sequence[SortedReturns]]
"""A pose, (4, 4) world_T_sensor, and the returns of its sensors."""

Compared = tuple[IntArray, Int32Array]
"""(K,) keys of cells, and (K, 3) numbers of scans: those of which another pass saw the cell free,
those of which none did and one saw it occupied, and those in which it is near the ground.
"""


def other_passes(positions: FloatArray, seconds: FloatArray) -> dict[int, list[IntArray]]:
    """Return the rows of scans of other passes, by the row of a scan that has any.

    Args:
        positions: (F, 3) metres, world.
        seconds: (F,) times.
    """
    steps = np.sqrt(np.square(np.diff(positions, axis=0)).sum(axis=1))
    along = np.append(0.0, np.cumsum(steps))
    used = np.unique(np.floor(along / _STEP_M), return_index=True)[1]
    found = dict[int, list[IntArray]]()
    for row in used.tolist():
        off = np.abs(positions - positions[row])
        away = np.hypot(off[:, 0], off[:, 1])
        near = (away[used] < _NEAR_M) & (off[used, 2] < _LEVEL_M)
        near &= np.abs(along[used] - along[row]) > _APART_M
        rows = used[near & (np.abs(seconds[used] - seconds[row]) > _APART_S)]
        if len(rows):
            ends = np.flatnonzero(np.diff(along[rows]) > 2 * _AROUND_M) + 1
            passes = [own[away[own] < away[own].min() + _AROUND_M] for own in np.split(rows, ends)]
            found[row] = [
                passes[number][spread_rows(len(passes[number]), _VIEWS)]
                for number in spread_rows(len(passes), _PASSES)
            ]
    return found


def compare_passes(
    points: Float32Array, compared: BoolArray, pose: Transform, passes: Iterable[Sequence[View]]
) -> Compared:
    """Look up a scan in other passes.

    Args:
        points: (N, 3) metres, sensor frame.
        compared: (N,) which points are looked up: static ones above the ground.
        pose: (4, 4) world_T_sensor.
        passes: scans of each.

    Returns:
        The cells in or beside columns that a pass saw free.
    """
    plane = ground_plane(points)
    if plane is None:
        return np.empty(0, np.int64), np.empty((0, 3), np.int32)
    world = transform_points(pose, points.astype(np.float64))
    rows = np.flatnonzero(compared & (np.hypot(points[:, 0], points[:, 1]) < _REACH_M))
    height = points[rows, 2] - points[rows, :2] @ plane[:2] - plane[2]
    rows, height = rows[height < _HIGH_M], height[height < _HIGH_M]
    first, _ = numbered(cells_of(world[rows], _CELL_M))
    rows, low = rows[first], height[first] < _LOW_M
    asked = np.ascontiguousarray(points[rows], np.float32)
    freed, held = np.zeros((2, len(rows)), np.bool_)
    for views in passes:
        left, stays = np.zeros((2, len(rows)), np.bool_)
        for shift in _SHIFTS_M:
            here, at = translation((*shift, 0.0)) @ pose, np.flatnonzero(left)
            at = at if any(shift) else np.arange(len(rows))
            free, hit = np.zeros((2, len(rows)), np.uint32)
            for bit, (other, returns) in enumerate(views):
                motion = as_pose(multiply(invert(other), here))
                for one in returns:
                    look_up(asked, at.astype(np.int32), motion, one, bit, free, hit)
            through, ended = np.bitwise_count(free), np.bitwise_count(hit)
            if any(shift):
                left &= ended <= through
            else:
                left = (through >= _AGREEING) & (through >= _SURE * ended)
                stays = ended > through
        held |= stays
        if left.sum() <= _DISAGREEING * (left | stays).sum():
            freed |= left
    keys = keys_of(world[rows])
    column = _column(keys)
    beside = np.array([-1, 0, 1]) + (np.array([-1, 0, 1]) << 21)[:, None]
    near = np.isin(column, column[freed][:, None] + beside.reshape(1, -1))
    return keys[near], np.stack([freed, held & ~freed, low], axis=1)[near].astype(np.int32)


def summed(found: Iterable[Compared]) -> Compared:
    """Return the cells of several scans, each once and in order, with the sums of their counts."""
    keys, counts = map(np.concatenate, zip(*found, strict=True))
    order = np.argsort(keys, kind="stable")
    begins = run_starts(keys[order])
    sums = np.add.reduceat(counts[order], begins, axis=0) if len(begins) else counts
    return keys[order][begins], sums


def find_gone(keys: IntArray, counts: Int32Array) -> tuple[IntArray, int]:
    """Return the sorted keys of the cells of parked actors that leave, and their number.

    Args:
        keys: (K,) of all scans: see `summed`.
        counts: (K, 3) scans: see `Compared`.
    """
    left, stays = counts[:, 0] > counts[:, 1], counts[:, 1] > counts[:, 0]
    columns, number = distinct(_column(keys))
    free, all_seen = (np.bincount(number, one, len(columns)) for one in (left, left | stays))
    seeds = (free > 0) & (free >= _IN_COLUMN * all_seen)
    component = joined(columns, seeds, 1 << 21)[number]
    cells, gone, found = _cells(keys), [np.empty(0, np.int64)], 0
    order = np.argsort(component, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(component[order])) + 1):
        own = rows[left[rows]]
        if not len(own) or component[rows[0]] < 0:
            continue
        lower, upper = cells[own].min(axis=0), cells[own].max(axis=0)
        high = (cells[rows, 2] >= lower[2] - 1) & (cells[rows, 2] <= upper[2])
        standing = len(np.unique(number[own[counts[own, 2] > 0]]))
        length = float(np.hypot(*(upper - lower)[:2]))
        size = (upper - lower + 1) * _CELL_M
        if (
            len(own) >= _CELLS
            and standing >= _COLUMNS
            and _LONG_M <= length * _CELL_M <= LONGEST_M
            and size[2] >= _TALL_M
            and len(own) >= _GONE * (len(own) + (high & stays[rows]).sum())
        ):
            inside = high & ~stays[rows] & (seeds[number[rows]] | left[rows])
            gone.append(keys[rows[inside]])
            found += 1
    return np.sort(np.concatenate(gone)), found


def keys_of(points: AnyFloatArray) -> IntArray:
    """Return the keys of the cells of (N, 3) points, metres, world."""
    x, y, z = cells_of(points, _CELL_M).T
    return np.asarray(((x + (1 << 20)) << 41) | ((y + (1 << 20)) << 20) | (z + (1 << 19)))


def _cells(keys: IntArray) -> IntArray:
    return np.stack([keys >> 41, (keys >> 20) & 0x1FFFFF, keys & 0xFFFFF], axis=1)


def _column(keys: IntArray) -> IntArray:
    return np.asarray(((keys >> 42) << 21) | ((keys >> 21) & 0xFFFFF))
