"""Visibility: what another scan saw at the place of a point: free space, a surface, or nothing that tells.

A scan is kept as columns of azimuth, each sorted by elevation. A point of another scan is looked up by its direction. If the rays around
this direction ended well beyond the point, its place was free at that time; if they ended there, it was occupied; if they ended before, it was
hidden. Rays are looked up, not walked along, so the cost does not depend on their length, and LiDARs with few channels tell between their
channels too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlasc.core.cells import Pose, fast_azimuth, transform
from carlasc.core.compiling import cached, inlined

_COLUMNS = 1024
_PER_RAD = _COLUMNS / (2 * math.pi)
_MIN_RANGE_M = 1.0  # nearer returns are of the vehicle itself, or invalid
_SIDE_M, _SIDE_RAD = 0.12, 0.003  # half width of the window around a direction: size of surfaces, and errors of poses
_DEPTH_M, _DEPTH_SHARE = (
    0.25,
    0.003,
)  # a return within this distance, and share of the range, of a point is of the same surface
_GAP_M = 0.8  # maximum distance between two rays, one above the other, between which space is as free as along them

FREE, HIT = 1, 2


@dataclass(frozen=True)
class SortedReturns:
    """The returns of one scan, sorted for looking up directions.

    Attributes:
        start: (C + 1,) int32, first return of each column of azimuth.
        slope: (N,) float32 height over horizontal distance of each return, increasing within a column.
        distance: (N,) float32 metres from the sensor.
    """

    start: NDArray[np.int32]
    slope: NDArray[np.float32]
    distance: NDArray[np.float32]

    @classmethod
    def of(cls, points: NDArray[np.float32]) -> SortedReturns:
        """Sort the (N, 3) points of a scan, metres, sensor frame."""
        column, slope, distance = _directions(np.ascontiguousarray(points[:, :3], np.float32))
        kept = np.flatnonzero(distance >= _MIN_RANGE_M)
        # One key: columns are integers, and the arc tangent of the slope is within a column.
        key = column[kept] + (np.arctan(slope[kept]) / np.float32(np.pi) + np.float32(0.5)).astype(np.float64)
        order = kept[np.argsort(key)]
        start = np.zeros(_COLUMNS + 1, np.int32)
        start[1:] = np.cumsum(np.bincount(column[kept], minlength=_COLUMNS))
        return cls(start, slope[order], distance[order])


@cached
def _directions(points: NDArray[np.float32]) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]]:
    n = len(points)
    column, slope, distance = np.empty(n, np.int32), np.empty(n, np.float32), np.empty(n, np.float32)
    for i in range(n):
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        flat = math.sqrt(x * x + y * y)
        distance[i] = math.sqrt(flat * flat + z * z)
        slope[i] = z / max(flat, 1e-3)
        column[i] = _column(fast_azimuth(x, y)) if flat > 0 else 0
    return column, slope, distance


@inlined
def _column(azimuth: float) -> int:
    return int((azimuth + math.pi) * _PER_RAD) % _COLUMNS


@cached
def look_up(
    points: NDArray[np.float32],
    pose: Pose,
    start: NDArray[np.int32],
    slope: NDArray[np.float32],
    distance: NDArray[np.float32],
    bit: int,
    free: NDArray[np.uint32],
    hit: NDArray[np.uint32],
) -> None:
    """Set one bit of each point that another scan saw through, or saw a surface at.

    Args:
        points: (M, 3) metres.
        pose: from the points' frame to the sensor of the other scan.
        start: (C + 1,) first return of each column of azimuth of the other scan.
        slope: (N,) height over horizontal distance of its returns, increasing within a column.
        distance: (N,) metres from its sensor.
        bit: number of the bit that is set.
        free: (M,) gets the bit where the place of the point was free.
        hit: (M,) gets the bit where it was occupied.
    """
    flag = np.uint32(1) << np.uint32(bit)
    for i in range(len(points)):
        x, y, z = transform(pose, float(points[i, 0]), float(points[i, 1]), float(points[i, 2]))
        flat = math.sqrt(x * x + y * y)
        if flat < _MIN_RANGE_M:
            continue
        far = math.sqrt(flat * flat + z * z)
        answer = _look(fast_azimuth(x, y), z / flat, flat, far, start, slope, distance)
        if answer == FREE:
            free[i] |= flag
        elif answer == HIT:
            hit[i] |= flag


@inlined
def _first_above(least, lo, hi, slope):  # type: ignore[no-untyped-def]
    """Return the first return from `lo` to `hi` whose slope is not below `least`; `hi` if there is none."""
    while lo < hi:
        mid = (lo + hi) >> 1
        if slope[mid] < least:
            lo = mid + 1
        else:
            hi = mid
    return lo


@inlined
def _look(azimuth, steep, flat, far, start, slope, distance):  # type: ignore[no-untyped-def]
    """Return FREE, HIT or 0 for a direction and a distance."""
    half = _SIDE_M / flat + _SIDE_RAD
    high = half * (1 + steep * steep)
    near, beyond = far - _DEPTH_M - _DEPTH_SHARE * far, far + _DEPTH_M + _DEPTH_SHARE * far
    first = math.floor((azimuth - half + math.pi) * _PER_RAD)
    last = math.floor((azimuth + half + math.pi) * _PER_RAD)
    # Most places are occupied, and most of them show it in the middle: this column is looked at first.
    middle = math.floor((azimuth + math.pi) * _PER_RAD) % _COLUMNS
    lo, end = _first_above(steep - high, start[middle], start[middle + 1], slope), start[middle + 1]
    while lo < end and slope[lo] <= steep + high:
        if near <= distance[lo] <= beyond:
            return HIT
        lo += 1
    passed, hidden = 0, 0
    below, above = -1e9, 1e9
    below_range, above_range = 0.0, 0.0
    for c in range(first, last + 1):
        column = (c + _COLUMNS) % _COLUMNS
        lo, end = _first_above(steep - high, start[column], start[column + 1], slope), start[column + 1]
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
    if (above - below) * flat > _GAP_M:
        return 0
    if below_range > beyond and above_range > beyond:
        return FREE
    if near <= below_range <= beyond and near <= above_range <= beyond:
        return HIT
    return 0
