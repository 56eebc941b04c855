"""Ground without labels: the points of a scan on the road and on other ground.

The area around the sensor is divided into sectors and rings. A plane through the lowest points
nearby gives the height of the ground below the sensor, and its slope, or the tilt of the sensor. In
each sector the ground is then followed outwards over the lowest points: the next ring is ground if
the step from this slope is possible for a road or a kerb. Elsewhere the ground is interpolated.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from carlasc.core.arrays import (
    AnyFloatArray,
    BoolArray,
    Float32Array,
    FloatArray,
    Int32Array,
    IntArray,
    LabelArray,
)
from carlasc.core.cells import fast_azimuth
from carlasc.core.compiling import cached
from carlasc.core.scans import finite
from carlasc.motion.solving import least_squares

_SECTORS, _RINGS, _RING_M = 120, 160, 0.5
_BLIND_M = 1.0  # nearer points are on the recording vehicle
# Greatest step between rings, and its growth with their distance up to a limit.
_STEP_M, _SLOPE, _FAR_M = 0.12, 0.08, 3.0
_TREND_M = 8.0  # the slope of the ground is measured over this distance
_KERB_M = 0.2  # highest step within a cell
_ABOVE_M, _BELOW_M = 0.12, 0.5  # points at most this far above or below the ground belong to it

_PLANE_RINGS = slice(4, 30)  # the plane is fitted to the lowest points at 2 to 15 m
_TRIALS, _STEEPEST = 300, 0.25  # number of trial planes, and greatest slope
_ON_PLANE_M = 0.1  # greatest distance of a point of the plane
_NEAR_M = 6.0  # farther points have less weight
_MIN_CELLS, _MIN_SHARE = 20, 0.2  # least number of cells on the plane, and their least share


def ground_points(points: AnyFloatArray) -> BoolArray:
    """Return which points of a scan lie on the ground.

    Points more than half a metre below the ground (returns of mirror images) and points that are
    not finite are not ground. Without a plane below the sensor, as in a scan of few points, no
    point is ground.

    Args:
        points: (N, 3 or more) float, metres, in the frame of a sensor that is upright within some
            degrees: x, y, z first.

    Returns:
        (N,) bool.
    """
    own = np.ascontiguousarray(points[:, :3], np.float32)
    known = finite(own)
    ground, own = np.zeros(len(own), np.bool_), own[known]
    sector, ring, lowest = _lowest(own)
    plane = _plane(own, lowest)
    if plane is not None:
        ground[known] = _ground(own, sector, ring, lowest, plane)
    return ground


def ground_height(points: AnyFloatArray) -> float:
    """Return z of the ground below the sensor: minus the height of the sensor, in the sensor's own
    frame.

    It is the height of the plane through most of the lowest points at 2 to 15 m, so a tilted
    sensor, a slope, and points below the ground do not change it. On a curved road, its error is
    the curve within some 10 m.

    Args:
        points: (N, 3 or more) float, metres, in the frame of a sensor that is upright within some
            degrees: x, y, z first. Points that are not finite are ignored.

    Returns:
        Metres; NaN if no plane is found.
    """
    plane = ground_plane(points)
    return float("nan") if plane is None else float(plane[2])


def ground_plane(points: AnyFloatArray, steepest: float = _STEEPEST) -> FloatArray | None:
    """Return (slope along x, slope along y, z below the sensor) of the ground around a sensor, as
    `ground_height` finds it; None without one.

    Args:
        points: (N, 3 or more) float, metres, in the frame of a sensor: x, y, z first.
        steepest: greatest slope, metres per metre.
    """
    own = np.ascontiguousarray(points[finite(points[:, :3]), :3], np.float32)
    return _plane(own, _lowest(own)[2], steepest)


@cached
def _lowest(
    points: Float32Array,
) -> tuple[Int32Array, Int32Array, IntArray]:
    """Return the (N,) sector and the (N,) ring of each point, and the (S, R) index of the lowest
    point of each cell, -1 without one.
    """
    lowest = np.full((_SECTORS, _RINGS), -1, np.int64)
    sector = np.empty(len(points), np.int32)
    ring = np.empty(len(points), np.int32)
    for i in range(len(points)):
        x, y = float(points[i, 0]), float(points[i, 1])
        flat = math.sqrt(x * x + y * y)
        s = (
            int((fast_azimuth(x, y) + math.pi) * (_SECTORS / (2 * math.pi))) % _SECTORS
            if flat > 0
            else 0
        )
        # minimum first: the ring of a far point may exceed an int
        r = int(min(flat / _RING_M, _RINGS - 1.0))
        sector[i], ring[i] = s, r
        if flat > _BLIND_M and (lowest[s, r] < 0 or points[i, 2] < points[lowest[s, r], 2]):
            lowest[s, r] = i
    return sector, ring, lowest


def _plane(
    points: Float32Array, lowest: IntArray, steepest: float = _STEEPEST
) -> FloatArray | None:
    """Return (slope along x, slope along y, z at the sensor) of the plane through most of the
    lowest points nearby; None without one.
    """
    near = lowest[:, _PLANE_RINGS]
    chosen = points[near[near >= 0]].astype(np.float64)
    if len(chosen) < _MIN_CELLS:
        return None
    rows = np.column_stack([chosen[:, :2], np.ones(len(chosen))])
    samples = np.random.default_rng(0).integers(0, len(chosen), (_TRIALS, 3))
    # from the first point to the others
    x, y, z = np.moveaxis(chosen[samples[:, 1:]] - chosen[samples[:, :1]], 2, 0)
    area = x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]  # twice the area of the triangle, square metres
    wide = np.abs(area) > 1.0
    x, y, z, area, corner = (own[wide] for own in (x, y, z, area, chosen[samples[:, 0]]))
    along_x = (z[:, 0] * y[:, 1] - z[:, 1] * y[:, 0]) / area
    along_y = (x[:, 0] * z[:, 1] - x[:, 1] * z[:, 0]) / area
    planes = np.column_stack(
        [along_x, along_y, corner[:, 2] - along_x * corner[:, 0] - along_y * corner[:, 1]]
    )
    planes = planes[np.hypot(planes[:, 0], planes[:, 1]) < steepest]
    if not len(planes):
        return None
    weight = 1.0 / np.maximum(np.hypot(chosen[:, 0], chosen[:, 1]) / _NEAR_M, 1.0)
    best = planes[int(_support(planes, chosen, weight).argmax())]
    on = (
        np.abs(best[0] * chosen[:, 0] + best[1] * chosen[:, 1] + best[2] - chosen[:, 2])
        < _ON_PLANE_M
    )
    if on.sum() < max(_MIN_CELLS, _MIN_SHARE * len(chosen)):
        return None
    plane: FloatArray = least_squares(
        rows[on] * weight[on, None], (chosen[on, 2] * weight[on])[:, None]
    )[:, 0]
    return plane


@cached
def _support(planes: FloatArray, points: FloatArray, weight: FloatArray) -> FloatArray:
    """Return, for each of (P, 3) planes, the sum of the (N,) weights of the (N, 3) points that are
    on it.
    """
    support = np.zeros(len(planes))
    for p in range(len(planes)):
        for i in range(len(points)):
            height = planes[p, 0] * points[i, 0] + planes[p, 1] * points[i, 1] + planes[p, 2]
            if abs(height - points[i, 2]) < _ON_PLANE_M:
                support[p] += weight[i]
    return support


@cached
def _ground(
    points: Float32Array,
    sector: Int32Array,
    ring: Int32Array,
    lowest: IntArray,
    plane: FloatArray,
) -> BoolArray:
    heights = np.empty((_SECTORS, _RINGS))  # above the plane
    least = np.empty(_RINGS)
    for s in range(_SECTORS):
        for r in range(_RINGS):
            least[r] = np.inf if lowest[s, r] < 0 else _above(points[lowest[s, r]], plane)
        _follow(least, heights[s])
    ground = np.zeros(len(points), np.bool_)
    for i in range(len(points)):
        s, r = sector[i], ring[i]
        # The median with the neighbours corrects a sector that was followed onto an object.
        a = heights[s - 1, r]
        b = heights[s, r]
        c = heights[(s + 1) % _SECTORS, r]
        middle = max(min(a, b), min(max(a, b), c))
        # The cell of a kerb has the height of the road, and holds points of the pavement too, which
        # has the height of the next ring.
        step = min(
            max(heights[s, r - 1] if r else b, b, heights[s, min(r + 1, _RINGS - 1)]) - b, _KERB_M
        )
        ground[i] = -_BELOW_M < _above(points[i], plane) - middle < _ABOVE_M + step
    return ground


@cached
def _above(point: Float32Array, plane: FloatArray) -> float:
    """Return the height of a point above a plane, metres along z."""
    return float(point[2] - (plane[0] * point[0] + plane[1] * point[1] + plane[2]))


@cached
def _follow(lowest: FloatArray, heights: FloatArray) -> None:
    """Fill the (R,) heights of the ground in the rings of one sector, from (R,) lowest points, both
    above the plane below the sensor.
    """
    last, at, slope = -1, 0.0, 0.0
    for r in range(_RINGS):
        if lowest[r] == np.inf:
            continue
        distance = (r - last) * _RING_M
        reached = min(distance, _FAR_M)
        step = lowest[r] - at
        limit = _STEP_M + _SLOPE * reached + (_ABOVE_M if last < 0 else 0.0)
        # the slope of a road continues
        if abs(step) > limit and abs(step - slope * distance) > limit:
            continue
        for k in range(last + 1, r + 1):
            heights[k] = at + step * ((k - last) / (r - last))
        last, at = r, lowest[r]
        before = r - int(_TREND_M / _RING_M)
        slope = (at - heights[before]) / _TREND_M if before >= 0 else 0.0
    for k in range(last + 1, _RINGS):
        heights[k] = at


_OF_EACH = 1000  # number of heights that represent one drive
_REACH_M = 25.0  # greatest horizontal distance of ground points


@dataclass(frozen=True)
class Ground:
    """The ground around a sensor.

    Attributes:
        heights_m: z of ground points around the sensor, sensor frame; at least one.
        below_m: height of the sensor above the ground under it.
    """

    heights_m: Float32Array
    below_m: float


def ground_of(
    points: Float32Array, labels: LabelArray | None, ground: Collection[int]
) -> Float32Array:
    """Return the points on the ground: by their labels, or by their heights if they have none.

    Args:
        points: (N, 3) metres, in the frame of the sensor.
        labels: (N,) class ids, or None.
        ground: ids of the ground classes; without any, heights decide.
    """
    on_ground = (
        ground_points(points) if labels is None or not ground else np.isin(labels, sorted(ground))
    )
    return points[on_ground]


def find_ground(scans: Iterable[Float32Array], reach_m: float = _REACH_M) -> Ground | None:
    """Return the ground in some scans, (N, 3) or (N, 4), within a horizontal distance of the
    sensor; None if there is none.
    """
    heights: list[Float32Array] = []
    near: list[float] = []
    for points in scans:
        ground = points[ground_points(points), :3]
        distance = np.hypot(ground[:, 0], ground[:, 1])
        heights.append(ground[distance < reach_m, 2])
        below = ground_height(points)
        near += [below] if np.isfinite(below) else []
    if not near or not sum(map(len, heights)):
        return None
    return Ground(np.concatenate(heights), -float(np.median(near)))


def joined(grounds: Sequence[Ground]) -> Ground:
    """Return the ground in the scans of one or more drives.

    Each drive has the same weight, for any number of points.
    """
    if len(grounds) == 1:
        return grounds[0]
    shares = np.linspace(0, 1, _OF_EACH)
    heights = [np.quantile(ground.heights_m, shares).astype(np.float32) for ground in grounds]
    return Ground(np.concatenate(heights), float(np.median([ground.below_m for ground in grounds])))
