"""Segments: the points of one actor in one scan, grouped by flow or by instance numbers."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np

from carlasc.core.arrays import AnyFloatArray, BoolArray, FloatArray, IntArray
from carlasc.core.cells import numbered
from carlasc.core.geometry import Transform, rotate_vectors, transform_points
from carlasc.core.scans import Scan
from carlasc.motion.paths import Segment

MIN_SPEED_M_S = 0.3  # slower points count as static: estimated flow is never exactly zero
_CELL_M = 0.4  # size of the cells in which moving points are grouped
# Cells of one actor, and points with one number, are closer than this along its motion: a pole in
# front does not split a vehicle.
_REACH_M = 2.0
# cells of one actor are closer than this across: vehicles in the next lane often have the same
# velocity
_BESIDE_M = 1.0
_SAME_VELOCITY_M_S = 0.5  # greatest difference of flow within one rigid actor

_REST_M = 0.5  # margin around an actor in which its static points are searched for
LINKED_M_S = 2.0  # maximum change of an actor's velocity between two segments


def is_fast(flow: AnyFloatArray, min_speed_m_s: float = MIN_SPEED_M_S) -> BoolArray:
    """Return (N,) bool, which of (N, 3) velocities, m/s, are finite and faster than a speed."""
    speed2 = np.square(np.asarray(flow, np.float64)).sum(axis=1)
    return np.isfinite(speed2) & (speed2 > min_speed_m_s**2)


def segment_by_flow(
    frame: int, scan: Scan, world_T_sensor: Transform, *, min_speed_m_s: float = MIN_SPEED_M_S
) -> list[Segment]:
    """Group the moving points of a scan into actors: the points of one actor are close together and
    have one velocity.

    Two actors side by side with the same velocity may become one segment, which has their velocity.
    Classes do not separate actors, because labels may be wrong.

    Args:
        frame: frame number.
        scan: points with labels and flow, m/s over ground; points whose flow is not finite count as
            static.
        world_T_sensor: (4, 4) pose of the scan.
        min_speed_m_s: slower points count as static.

    Returns:
        Segments in the order of their first point.
    """
    if scan.flow is None or scan.labels is None:
        return []
    moving = np.flatnonzero(is_fast(scan.flow, min_speed_m_s) & (scan.labels > 0))
    if not len(moving):
        return []
    points = transform_points(world_T_sensor, scan.points[moving])
    velocity = rotate_vectors(world_T_sensor, scan.flow[moving])
    labels = scan.labels[moving].astype(np.int64)
    actor = _join(points, velocity)
    return [
        Segment(
            frame,
            int(np.bincount(labels[own]).argmax()),
            moving[own],
            points[own],
            np.median(velocity[own], axis=0),
            origin=world_T_sensor[:3, 3],
        )
        for own in _groups(actor)
    ]


def segment_by_instances(
    frame: int, scan: Scan, world_T_sensor: Transform, *, ground: Collection[int] = ()
) -> list[Segment]:
    """Return the numbered actors of a scan, moving or not. Their tracks decide which of them move.

    A number at several places, metres apart, or with several velocities, has a segment for each:
    one of them may be another actor with a wrong number.

    Args:
        frame: frame number.
        scan: points with labels and instances.
        world_T_sensor: (4, 4) pose of the scan.
        ground: ids of the ground classes. Their points belong to no actor, even with a number.

    Returns:
        Segments in the order of the first point of each number.
    """
    if scan.instances is None or scan.labels is None:
        return []
    numbered = np.flatnonzero(
        (scan.instances > 0) & (scan.labels > 0) & ~np.isin(scan.labels, sorted(ground))
    )
    points = transform_points(world_T_sensor, scan.points[numbered])
    flow = None if scan.flow is None else rotate_vectors(world_T_sensor, scan.flow[numbered])
    segments, times = [], scan.others.get("seconds")
    numbers = scan.instances[numbered].astype(np.int64)
    spread = (
        points / _REACH_M
        if flow is None
        else np.column_stack([points / _REACH_M, flow / LINKED_M_S])
    )
    for own in (place for same in _groups(numbers) for place in _places(spread, same)):
        members = numbered[own]
        label = int(np.bincount(scan.labels[members]).argmax())
        velocity = None if flow is None else np.median(flow[own], axis=0)
        number, origin = int(scan.instances[members[0]]), world_T_sensor[:3, 3]
        seen_at = None if times is None or flow is not None else times[members]
        segments.append(
            Segment(frame, label, members, points[own], velocity, number, origin, seen_at)
        )
    return segments


@dataclass(frozen=True)
class StaticPoints:
    """The static points of a scan that may belong to an actor that moves at other times.

    Attributes:
        frame: frame number.
        members: (M,) int64 indices of the points in the scan.
        labels: (M,) their classes.
        points: (M, 3) float64 metres, world.
        origin: (3,) position of the sensor, metres, world.
    """

    frame: int
    members: IntArray
    labels: IntArray
    points: FloatArray
    origin: FloatArray = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def empty(cls, frame: int) -> StaticPoints:
        """Return an object without points."""
        return cls(frame, np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 3)))

    def segment_at(self, segment: Segment) -> Segment | None:
        """Return the static points of a segment's class at its position; None if the segment has
        far more points.
        """
        lower = segment.points.min(axis=0) - _REST_M
        upper = segment.points.max(axis=0) + _REST_M
        own = np.flatnonzero(
            (self.labels == segment.label)
            & ((self.points > lower) & (self.points < upper)).all(axis=1)
        )
        if len(own) < max(5, len(segment.members) // 5):
            return None
        return Segment(
            self.frame,
            segment.label,
            self.members[own],
            self.points[own],
            np.zeros(3),
            origin=self.origin,
        )


def static_actor_points(
    frame: int,
    scan: Scan,
    world_T_sensor: Transform,
    labels: Collection[int],
    *,
    min_speed_m_s: float = MIN_SPEED_M_S,
) -> StaticPoints:
    """Return the static points of a scan that are of movable classes; none without flow and labels.

    Args:
        frame: frame number.
        scan: points, with labels and flow.
        world_T_sensor: (4, 4) pose of the scan.
        labels: ids of the movable classes.
        min_speed_m_s: slower points are static.
    """
    if scan.flow is None or scan.labels is None:
        return StaticPoints.empty(frame)
    members = np.flatnonzero(
        ~is_fast(scan.flow, min_speed_m_s) & np.isin(scan.labels, sorted(labels))
    )
    points = transform_points(world_T_sensor, scan.points[members])
    return StaticPoints(
        frame, members, scan.labels[members].astype(np.int64), points, world_T_sensor[:3, 3]
    )


def _groups(key: IntArray) -> list[IntArray]:
    """Return the indices of each value of `key`, in the order in which the values occur first."""
    if not len(key):
        return []
    first, number = numbered(key[:, None])
    order = np.argsort(number, kind="stable")
    return np.split(order, np.searchsorted(number[order], np.arange(1, len(first))))


def _places(spread: FloatArray, own: IntArray) -> list[IntArray]:
    """Split points, rows `own` of (N, K) features, at each gap above 1 in one feature."""
    for column in range(spread.shape[1]):
        values = spread[own, column]
        if np.ptp(values) > 1:
            order = np.argsort(values, kind="stable")
            gaps = np.flatnonzero(np.diff(values[order]) > 1) + 1
            if len(gaps):
                return [
                    place
                    for part in np.split(own[order], gaps)
                    for place in _places(spread, np.sort(part))
                ]
    return [own]


def _join(points: FloatArray, velocity: FloatArray) -> IntArray:
    """Return the component number of each point: neighbouring cells of one velocity are joined."""
    keys = np.concatenate(
        [np.floor(points / _CELL_M), np.round(velocity / _SAME_VELOCITY_M_S)], axis=1
    ).astype(np.int64)
    _, cell = numbered(keys)
    count = np.bincount(cell)
    sums = np.array([np.bincount(cell, values) for values in (*points.T, *velocity.T)])
    center, speed = np.split((sums / count).T, 2, axis=1)
    offset = center[:, None] - center[None]
    ahead = speed / np.maximum(np.linalg.norm(speed, axis=1), 1e-9)[:, None]
    along2 = np.square(np.einsum("ijk,ik->ij", offset, ahead))
    across2 = np.square(offset).sum(axis=2) - along2
    near = (along2 < _REACH_M**2) & (across2 < _BESIDE_M**2)
    joined = (near | near.T) & (
        np.square(speed[:, None] - speed[None]).sum(axis=2) < _SAME_VELOCITY_M_S**2
    )
    component = np.arange(len(count))
    while True:  # each cell takes the lowest number of its joined cells, until nothing changes
        lowest = np.where(joined, component[None], len(count)).min(axis=1)
        lowest = lowest[lowest]
        if (lowest == component).all():
            return component[cell]
        component = lowest
