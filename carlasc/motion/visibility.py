"""Visibility: whether another scan saw the place of a point free, occupied, or not at all.

A scan is kept as columns of azimuth, each sorted by elevation. A point of another scan is looked up
by its direction. If the rays around this direction end well beyond the point, its place is free in
that scan. If they end at the point, it is occupied; if they end before it, it is hidden. No ray is
traversed, so the cost does not depend on the length of rays, and places between the channels of a
LiDAR are decided too.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from carlasc.core.arrays import Float32Array, Int32Array, Uint32Array
from carlasc.core.cells import Pose, fast_azimuth, transform
from carlasc.core.compiling import cached, inlined

_COLUMNS = 1024
_PER_RAD = _COLUMNS / (2 * math.pi)
_MIN_RANGE_M = 1.0  # nearer returns are of the vehicle itself, or invalid
# half width of the window around a direction: size of surfaces, and errors of poses
_SIDE_M, _SIDE_RAD = (
    0.12,
    0.003,
)
# a return within this distance, and share of the range, is of the same surface
_DEPTH_M, _DEPTH_SHARE = (
    0.25,
    0.003,
)
SAME_PLACE_M = 0.3  # origins of rays within this distance count as one place
_GAP_M = 0.8  # maximum distance between two rays, one above the other, with free space between them

FREE, HIT = 1, 2


class SortedReturns(NamedTuple):
    """The returns of one scan, sorted for looking up directions.

    Attributes:
        start: (C + 1,) int32, first return of each column of azimuth.
        slope: (N,) float32 height over horizontal distance of each return, increasing within a
            column.
        distance: (N,) float32 metres from the origin of its ray.
        origin: (C, 3) float32 origin of the rays of each column, metres, in the frame of the scan.
    """

    start: Int32Array
    slope: Float32Array
    distance: Float32Array
    origin: Float32Array

    @classmethod
    def of(cls, points: Float32Array, origins: Float32Array | None = None) -> SortedReturns:
        """Sort the points of a scan by the directions of their rays.

        A column holds rays with one origin. Where the first and the last rays of a turn of a moving
        sensor overlap, the fewer are left out.

        Args:
            points: (N, 3) metres, sensor frame.
            origins: (N, 3) origins of the rays, metres, sensor frame; None: (0, 0, 0).
        """
        began = np.zeros_like(points[:, :3]) if origins is None else origins
        column, slope, distance = _directions(
            np.ascontiguousarray(points[:, :3] - began, np.float32)
        )
        start, order, origin = _by_column(column, slope, np.ascontiguousarray(began, np.float32))
        return cls(start, slope[order], distance[order], origin)


@cached
def _directions(
    points: Float32Array,
) -> tuple[Int32Array, Float32Array, Float32Array]:
    """Return the column of each point, seen from (0, 0, 0), or -1 if it is too near; its slope; and
    its distance.
    """
    n = len(points)
    column, slope, distance = (
        np.empty(n, np.int32),
        np.empty(n, np.float32),
        np.empty(n, np.float32),
    )
    for i in range(n):
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        flat = math.sqrt(x * x + y * y)
        distance[i] = math.sqrt(flat * flat + z * z)
        # The slope rises with the elevation, and needs no arctangent: to sort and to compare, it is
        # as good. The limit keeps it finite straight above the sensor.
        slope[i] = z / max(flat, 1e-3)
        column[i] = -1
        if distance[i] >= _MIN_RANGE_M:
            column[i] = _column(fast_azimuth(x, y)) if flat > 0 else 0
    return column, slope, distance


@cached
def _by_column(
    column: Int32Array, slope: Float32Array, began: Float32Array
) -> tuple[Int32Array, Int32Array, Float32Array]:
    """Return `start`, the indices of the points in the order of columns and slopes, and `origin`:
    see `SortedReturns`.
    """
    begin = np.zeros(_COLUMNS + 1, np.int64)
    for i in range(len(column)):
        begin[column[i] + 1] += column[i] >= 0
    begin = np.cumsum(begin)
    # A counting sort: `begin` are the places of the columns, and `filled` the next free place of
    # each. Both are exact, so the order of the points does not depend on the processor.
    filled, members = begin.copy(), np.empty(begin[_COLUMNS], np.int32)
    for i in range(len(column)):
        if column[i] >= 0:
            members[filled[column[i]]] = i
            filled[column[i]] += 1
    start, order, count = np.zeros(_COLUMNS + 1, np.int32), np.empty_like(members), 0
    origin = np.zeros((_COLUMNS, 3), np.float32)
    for c in range(_COLUMNS):
        own = members[begin[c] : begin[c + 1]]
        if len(own):
            # At the seam of a turn, a column holds rays of the first and of the last moment. The
            # middle ray has the origin of the majority, and rays from elsewhere would be looked up
            # wrongly.
            place = began[own[len(own) // 2]]
            origin[c] = place
            for k in np.argsort(slope[own]):
                x, y, z = (
                    began[own[k], 0] - place[0],
                    began[own[k], 1] - place[1],
                    began[own[k], 2] - place[2],
                )
                if x * x + y * y + z * z <= SAME_PLACE_M * SAME_PLACE_M:
                    order[count] = own[k]
                    count += 1
        start[c + 1] = count
    # Two rounds, because the column before the first one with rays is the last one of the turn.
    for c in range(2 * _COLUMNS):  # columns without rays get the origin of the column before
        if begin[c % _COLUMNS] == begin[c % _COLUMNS + 1]:
            origin[c % _COLUMNS] = origin[(c - 1) % _COLUMNS]
    return start, order[:count], origin


@inlined
def _column(azimuth: float) -> int:
    return int((azimuth + math.pi) * _PER_RAD) % _COLUMNS


@cached
def look_up(
    points: Float32Array,
    asked: Int32Array,
    pose: Pose,
    view: SortedReturns,
    bit: int,
    free: Uint32Array,
    hit: Uint32Array,
) -> None:
    """Set one bit of each point whose place another scan saw free or occupied.

    Args:
        points: (M, 3) metres.
        asked: (A,) indices of the points that are looked up.
        pose: from the frame of the points to the frame of the other scan.
        view: the returns of the other scan.
        bit: number of the bit to set.
        free: (M,) gets the bit where the place of the point is free.
        hit: (M,) gets the bit where it is occupied.
    """
    # A scan has one bit, and a side in time at most 32 scans: the bits of all scans are counted and
    # compared at once, without a table of points by scans.
    flag = np.uint32(1) << np.uint32(bit)
    start, slope, distance, origin = view
    moved = (origin != origin[0]).any()
    for i in asked:
        x, y, z = transform(pose, float(points[i, 0]), float(points[i, 1]), float(points[i, 2]))
        # from there, the point is in a column near this one, with nearly the same origin
        if moved and x * x + y * y > 0:
            place = origin[_column(fast_azimuth(x, y))]
            x, y, z = x - place[0], y - place[1], z - place[2]
        else:
            x, y, z = x - origin[0, 0], y - origin[0, 1], z - origin[0, 2]
        flat = math.sqrt(x * x + y * y)
        # Above, below and inside the vehicle, a direction says nothing about the place.
        if flat < _MIN_RANGE_M:
            continue
        far = math.sqrt(flat * flat + z * z)
        answer = _look(fast_azimuth(x, y), z / flat, flat, far, start, slope, distance)
        if answer == FREE:
            free[i] |= flag
        elif answer == HIT:
            hit[i] |= flag


@inlined
def _count(bits: np.int64) -> np.int64:
    """Return how many of the lower 32 bits are set."""
    # Neighbouring bits are added in pairs, then in fours, then in bytes (Warren, "Hacker's
    # Delight", 5-1); the product adds the four bytes in the highest one.
    bits -= (bits >> 1) & 0x55555555
    bits = (bits & 0x33333333) + ((bits >> 2) & 0x33333333)
    return (((bits + (bits >> 4)) & 0x0F0F0F0F) * 0x01010101 & 0xFFFFFFFF) >> 24


@cached
def undecided(
    asked: Int32Array,
    free: Uint32Array,
    hit: Uint32Array,
    left: tuple[int, int],
    least: tuple[int, int],
) -> Int32Array:
    """Return the points whose result the remaining scans may still change.

    Args:
        asked: (A,) indices of points.
        free: (2, M) bits of the scans before and after that saw the place of a point free. Higher
            bits are farther in time.
        hit: (2, M) bits of the scans that saw it occupied.
        left: number of scans before and after that are not looked up yet, all nearer in time than
            the others.
        least: least number of scans that see the place of a moved point free, and of scans in a row
            if it is free on one side only.
    """
    kept = np.empty_like(asked)
    count, rest = 0, left[0] + left[1]
    for i in asked:
        passed = _count(np.int64(free[0, i])) + _count(np.int64(free[1, i]))
        occupied = _count(np.int64(hit[0, i])) + _count(np.int64(hit[1, i]))
        # The rest of the scans can add at most `rest` to either count. A point is decided when no
        # such addition changes which count is greater, or the length of a row without a hit.
        moves = passed >= least[0] and passed > occupied + rest
        may_change = passed + rest >= occupied
        for side in range(2):  # a row ends at the first scan that saw it occupied
            h = np.int64(hit[side, i])
            # All bits below the highest hit are set, in five steps: 2^5 = 32 bits.
            for shift in (1, 2, 4, 8, 16):
                h |= h >> shift
            in_a_row = _count(np.int64(free[side, i]) & ~h) + (left[side] if h == 0 else 0)
            may_change = may_change or in_a_row >= least[1]
        if may_change and not moves:
            kept[count] = i
            count += 1
    return kept[:count]


@inlined
def _first_above(least, lo, hi, slope):  # type: ignore[no-untyped-def]
    """Return the index of the first return from `lo` to `hi` with a slope of at least `least`; `hi`
    without one.
    """
    while lo < hi:
        mid = (lo + hi) >> 1
        if slope[mid] < least:
            lo = mid + 1
        else:
            hi = mid
    return lo


@inlined
def _look(azimuth, steep, flat, far, start, slope, distance):  # type: ignore[no-untyped-def]
    """Return FREE, HIT or 0 (unknown) for a direction and a distance."""
    # The window has the same size in metres at all ranges, and errors of rotation widen it in
    # radians. A slope changes by 1 + slope^2 per radian of elevation: the derivative of tan.
    half = _SIDE_M / flat + _SIDE_RAD
    high = half * (1 + steep * steep)
    near, beyond = far - _DEPTH_M - _DEPTH_SHARE * far, far + _DEPTH_M + _DEPTH_SHARE * far
    # Most places are occupied, and the middle column usually shows it: it comes first.
    middle = math.floor((azimuth + math.pi) * _PER_RAD) % _COLUMNS
    lo, end = _first_above(steep - high, start[middle], start[middle + 1], slope), start[middle + 1]
    while lo < end and slope[lo] <= steep + high:
        if near <= distance[lo] <= beyond:
            return HIT
        lo += 1
    first = math.floor((azimuth - half + math.pi) * _PER_RAD)
    last = math.floor((azimuth + half + math.pi) * _PER_RAD)
    # A hit decides at once, for any ray. A ray that ends before the place hides it, even if others
    # pass: then the place is at an edge, and unknown. So all columns of the window are needed.
    passed, hidden = 0, 0
    below, above = -1e9, 1e9
    below_range, above_range = 0.0, 0.0
    for c in range(first, last + 1):
        column = (c + _COLUMNS) % _COLUMNS
        lo, end = (
            _first_above(steep - high, start[column], start[column + 1], slope),
            start[column + 1],
        )
        if lo > start[column] and slope[lo - 1] > below:
            below, below_range = slope[lo - 1], distance[lo - 1]
        while lo < end and slope[lo] <= steep + high:
            d = distance[lo]
            if d > beyond:
                passed += 1
            elif d >= near:
                return HIT
            else:
                hidden += 1
            lo += 1
        if lo < end and slope[lo] < above:
            above, above_range = slope[lo], distance[lo]
    if hidden:
        return 0
    if passed:
        return FREE
    # No ray is in the window: the rays above and below it decide, if they are so near to each other
    # that nothing of the size of an actor is between them. Both must agree.
    if (above - below) * flat > _GAP_M:
        return 0
    if below_range > beyond and above_range > beyond:
        return FREE
    if near <= below_range <= beyond and near <= above_range <= beyond:
        return HIT
    return 0
