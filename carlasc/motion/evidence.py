"""Evidence of motion: points at places that were free space at other times.

It needs no flow, instances or labels.

Each point that is not ground is looked up in scans up to `HORIZON_S` before and after. A point
moved if rays passed through its place more often than they ended there, or if all scans on one side
in time saw it free. Such points are grouped into clusters. A cluster also gets the points around it
that are not known to be static.

A scan is kept as columns of azimuth, each sorted by elevation. A point of another scan is looked up
by its direction. If the rays around this direction end well beyond the point, its place is free in
that scan. If they end at the point, it is occupied; if they end before it, it is hidden. No ray is
traversed, so the cost does not depend on the length of rays, and places between the channels of a
LiDAR are decided too.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import NamedTuple

import numpy as np

from carlasc.core.arrays import (
    AnyFloatArray,
    BoolArray,
    Float32Array,
    FloatArray,
    Int32Array,
    IntArray,
    LabelArray,
    Uint32Array,
)
from carlasc.core.cells import (
    Pose,
    as_pose,
    cells_of,
    distinct,
    fast_azimuth,
    joined,
    numbered,
    transform,
)
from carlasc.core.compiling import cached, inlined
from carlasc.core.geometry import Transform, invert, multiply, transform_points
from carlasc.core.scans import finite, runs_of_origins
from carlasc.errors import FormatError
from carlasc.motion.ground import ground_points
from carlasc.motion.paths import Segment

HORIZON_S = 5.0  # fact: horizon
"""Scans up to this many seconds before and after a scan are looked up."""

_OFFSETS_S = (0.3, 0.5, 0.8, 1.2, 1.6, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0)
_AGREEING = 2  # least number of scans that saw a place free
_IN_A_ROW = 4  # the same, if all scans on one side in time, from the farthest inwards, saw it free
# Every third scan is looked up first. A place that so many scans saw occupied, and none saw free,
# is static.
_EVERY, _SURE = 3, 4
_LATE = 8  # a place that scans from this offset on saw occupied, and none saw free, stays
_CELL_M = 0.35  # points of one object are in neighbouring cells of this size, seen from above
_MIN_POINTS = 3  # smaller clusters are noise
_JUDGED_CELL_M = 0.15  # one point per cell of this size is looked up, and decides for the others
_BAND_M = (
    0.3  # static points so far below or above a cluster, in its cells or beside them, are around it
)
_FLAGGED_SHARE = 0.6  # a cluster with this share of moved points moved as a whole
_PERIOD_S = 0.1  # period of scans whose times do not increase
_AROUND_M = 6.0  # ground so near to the sensor, along each axis, gives its height
OWN_CELL_M, OWN_CELLS = 0.2, 40
OWN_REACH_M = OWN_CELL_M * OWN_CELLS / 2
"""Parts of the recording vehicle are found in so many cells of this size along each axis, around
the sensor, up to this distance.
"""


@dataclass(frozen=True)
class EvidenceScan:
    """One scan in which evidence of motion is searched for.

    Attributes:
        frame: frame number.
        points: (N, 3) float32, metres, in the frame of a sensor that is mounted upright.
        world_T_sensor: (4, 4).
        seconds: time of the scan.
        ground: (N,) bool, which points are ground; None: found from their positions.
        labels: (N,) class ids; None if the scan has none.
        explained: (N,) bool, points of known actors, which are never evidence; None if there are
            none.
        origins: (N, 3) origins of the rays, metres, sensor frame; None: at the sensor. Points with
            one origin follow each other.
        times: (N,) seconds of the points after the time of the scan; None if they are unknown.
    """

    frame: int
    points: Float32Array
    world_T_sensor: Transform
    seconds: float
    ground: BoolArray | None = None
    labels: LabelArray | None = None
    explained: BoolArray | None = None
    origins: Float32Array | None = None
    times: AnyFloatArray | None = None

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise FormatError("points", expected="shape (N, 3)", found=self.points.shape)
        for name in ("ground", "labels", "explained"):
            values = getattr(self, name)
            if values is not None and values.shape != (len(self.points),):
                raise FormatError(name, expected=f"shape ({len(self.points)},)", found=values.shape)


class MovedCluster(NamedTuple):
    """Points of a scan that moved together.

    Attributes:
        segment: the points, without velocity; its class is 0 without labels.
        freed: number of points at places that were free at other times.
        passed: number of them at places that were free most of the time, not on one side in time
            only, as behind edges.
        around: number of static points around it, at its height. It is large for pieces of static
            objects.
    """

    segment: Segment
    freed: int
    passed: int
    around: int


@dataclass(frozen=True)
class FreeSpaceEvidence:
    """The clusters of points that moved in one scan.

    Attributes:
        frame: frame number.
        seconds: time of the scan.
        count: number of points of the scan.
        clusters: the clusters.
        world_T_sensor: (4, 4) pose of the scan.
        near: (K,) cells of the points around the sensor that are not ground: see `cells_around`.
        ground_m: height of the ground around the sensor, metres, sensor frame; NaN without any.
    """

    frame: int
    seconds: float
    count: int
    clusters: tuple[MovedCluster, ...]
    world_T_sensor: Transform
    near: IntArray
    ground_m: float = math.nan

    def thinned(self, most: int = 2000) -> FreeSpaceEvidence:
        """Return the same with at most `most` of the points of each cluster; members stay
        complete.
        """
        thin = (one._replace(segment=one.segment.thinned(most)) for one in self.clusters)
        return replace(self, clusters=tuple(thin))


@dataclass(frozen=True)
class _Kept:
    """A scan in the window."""

    scan: EvidenceScan
    seconds: float
    views: tuple[SortedReturns, ...]


def views_of(scan: EvidenceScan) -> tuple[SortedReturns, ...]:
    """Sort the points of each sensor of a scan by their directions."""
    if scan.origins is None:
        return (SortedReturns.of(scan.points),)
    return tuple(
        SortedReturns.of(scan.points[own], scan.origins[own]) for own in _sensors(scan.origins)
    )


class EvidenceWindow:
    """The scans among which evidence is searched for: those within the `HORIZON_S` of a scan, so
    memory does not grow with the drive.

    Args:
        movable: classes of actors. Points of different movable classes are not grouped together.
        frames: only the evidence of these frames is found; None: of all.
        after_s: scans up to so much later are waited for.
    """

    def __init__(
        self,
        movable: Collection[int] = (),
        frames: Collection[int] | None = None,
        after_s: float = HORIZON_S,
    ) -> None:
        self._movable, self._frames, self._after_s = movable, frames, after_s
        self._window: deque[_Kept] = deque()
        self._current, self._last = 0, -np.inf

    def add(self, scan: EvidenceScan) -> Iterator[FreeSpaceEvidence]:
        """Add the next scan, and yield the evidence of those that waited for it."""
        window, last, seconds = self._window, self._last, scan.seconds
        if not seconds > last:
            seconds = last + _PERIOD_S if np.isfinite(last) else 0.0
        self._last = seconds
        # Invariant: `window` holds the scans within the horizon of the current one, which is the
        # first whose evidence is not given yet.
        window.append(_Kept(scan, seconds, views_of(scan)))
        while seconds - window[self._current].seconds > self._after_s:
            yield from self._found(self._current)
            self._current += 1
            while window[self._current].seconds - window[0].seconds > HORIZON_S:
                window.popleft()
                self._current -= 1

    def finish(self) -> Iterator[FreeSpaceEvidence]:
        """Yield the evidence of the scans that still wait."""
        for index in range(self._current, len(self._window)):
            yield from self._found(index)

    def _found(self, index: int) -> Iterator[FreeSpaceEvidence]:
        if self._frames is None or self._window[index].scan.frame in self._frames:
            yield _evidence(self._window, index, self._movable)


def find_evidence(
    scans: Iterable[EvidenceScan],
    *,
    movable: Collection[int] = (),
    frames: Collection[int] | None = None,
) -> Iterator[FreeSpaceEvidence]:
    """Yield the evidence of each scan of a drive, when the scans of the `HORIZON_S` after it were
    read.

    Args:
        scans: the scans in order of time. Times that do not increase are replaced by 0.1 s per
            scan.
        movable: as in `EvidenceWindow`.
        frames: as there.

    Yields:
        The evidence of each of these scans, in their order.
    """
    window = EvidenceWindow(movable, frames)
    for scan in scans:
        yield from window.add(scan)
    yield from window.finish()


def _evidence(window: deque[_Kept], current: int, movable: Collection[int]) -> FreeSpaceEvidence:
    own = window[current]
    scan = own.scan
    ground = ground_points(scan.points) if scan.ground is None else scan.ground
    asked = ~ground if scan.explained is None else ~(ground | scan.explained)
    candidates = np.flatnonzero(asked & finite(scan.points))
    before, after = _others(window, current)
    world = transform_points(scan.world_T_sensor, scan.points[candidates].astype(np.float64))
    # One point per small cell is looked up: the others of the cell are of the same surface, and
    # looking up costs most of the time.
    asked_first, same = numbered(cells_of(world, _JUDGED_CELL_M))
    verdict = _judge(
        scan, candidates[asked_first], [window[i] for i in before], [window[i] for i in after]
    )
    moved, left, static, stays = (answers[same] for answers in verdict)
    kind = np.zeros(len(candidates), np.int64)
    if scan.labels is not None and movable:
        labels = scan.labels[candidates].astype(np.int64)
        kind = np.where(np.isin(labels, sorted(movable)), labels, 0)
    groups = _clusters(world, kind, moved, left, static, stays)
    clusters = []
    for group, around in zip(groups, _count_around(world, groups, static), strict=True):
        members = candidates[group]
        label = 0 if scan.labels is None else int(np.bincount(scan.labels[members]).argmax())
        times = None if scan.times is None else scan.times[members]
        origin = scan.world_T_sensor[:3, 3]
        segment = Segment(
            scan.frame, label, members, world[group], None, origin=origin, times=times
        )
        freed, passed = (int(flags[group].sum()) for flags in (moved | left, moved))
        clusters.append(MovedCluster(segment, freed, passed, around))
    near = cells_around(scan.points[candidates])
    below = scan.points[ground & (np.abs(scan.points[:, :2]) < _AROUND_M).all(axis=1), 2]
    height = float(np.median(below)) if len(below) else math.nan
    about = tuple(clusters), scan.world_T_sensor, near, height
    return FreeSpaceEvidence(scan.frame, own.seconds, len(scan.points), *about)


def cells_around(points: AnyFloatArray) -> IntArray:
    """Return the (K,) cells of (N, 3) points near the sensor, metres, sensor frame, each once:
    indices of a flat array of `OWN_CELLS` along each axis.
    """
    near = points[(np.abs(points) < OWN_REACH_M).all(axis=1)]
    if not len(near):
        return np.empty(0, np.int64)
    cells = cells_of(near, OWN_CELL_M) + OWN_CELLS // 2
    flags = np.zeros(OWN_CELLS**3, np.bool_)  # faster than `np.unique`
    flags[np.ravel_multi_index(tuple(cells.T), (OWN_CELLS,) * 3, mode="clip")] = True
    return np.flatnonzero(flags)


def _sensors(origins: Float32Array) -> list[IntArray]:
    """Return the points of each sensor, by the (N, 3) origins of their rays, metres: origins of one
    moving sensor are close to each other.
    """
    sensors: list[tuple[list[Float32Array], list[IntArray]]] = []
    for part, origin in runs_of_origins(origins, len(origins)):
        near = (
            own
            for own in sensors
            if np.linalg.norm(np.array(own[0]) - origin, axis=1).min() < SAME_PLACE_M
        )
        places, members = next(near, ([], []))
        if not places:
            sensors.append((places, members))
        places.append(origin)
        members.append(np.arange(part.start, part.stop))
    return [np.concatenate(members) for _, members in sensors]


def _others(window: deque[_Kept], current: int) -> tuple[list[int], list[int]]:
    """Return the scans to look up, before and after the current one, the nearest first."""
    seconds = np.array([kept.seconds for kept in window]) - window[current].seconds
    sides: tuple[list[int], list[int]] = ([], [])
    for side, sign in zip(sides, (-1, 1), strict=True):
        for offset in _OFFSETS_S:
            nearest = int(np.argmin(np.abs(seconds - sign * offset)))
            if (nearest - current) * sign > 0 and nearest not in side:
                side.append(nearest)
    return sides


def _judge(
    scan: EvidenceScan, candidates: IntArray, before: list[_Kept], after: list[_Kept]
) -> tuple[BoolArray, BoolArray, BoolArray, BoolArray]:
    """Return which candidates are at places that were free most of the time, free on one side in
    time, occupied (static), and occupied for seconds without ever being free.
    """
    points = np.ascontiguousarray(scan.points[candidates], np.float32)
    free, hit = np.zeros((2, 2, len(points)), np.uint32)
    asked = np.arange(len(points), dtype=np.int32)
    left = np.array([(1 << len(before)) - 1, (1 << len(after)) - 1], np.uint32)
    # From the farthest inwards, first some over the whole time: most places are decided before the
    # nearest scans.
    orders = [
        sorted(range(count), key=lambda bit: ((count - 1 - bit) % _EVERY > 0, -bit))
        for count in (len(before), len(after))
    ]
    for bits in zip_longest(*orders):
        for side, bit in enumerate(bits):
            if bit is not None:
                left[side] &= ~(np.uint32(1) << np.uint32(bit))
                other = (before, after)[side][bit]
                pose = as_pose(multiply(invert(other.scan.world_T_sensor), scan.world_T_sensor))
                for view in other.views:
                    look_up(points, asked, pose, view, bit, free[side], hit[side])
        asked = undecided(asked, free, hit, left, (_AGREEING, _IN_A_ROW, _SURE))
    seen_through = np.bitwise_count(free).sum(axis=0, dtype=np.int64)
    occupied = np.bitwise_count(hit).sum(axis=0, dtype=np.int64)
    # Bits above the highest hit belong to scans that are farther in time than all hits.
    # `smeared` has all bits below the highest hit too.
    smeared = hit.copy()
    for shift in (1, 2, 4, 8, 16):
        smeared |= smeared >> np.uint32(shift)
    in_a_row = np.bitwise_count(free & ~smeared).max(axis=0)
    moved = (seen_through >= _AGREEING) & (seen_through > occupied)
    left = ~moved & (in_a_row >= _IN_A_ROW)
    stays = (hit >> np.uint32(_LATE) > 0).any(axis=0) & (seen_through == 0)
    return moved, left, ~(moved | left) & (occupied > seen_through), stays


def _clusters(
    world: FloatArray,
    kind: IntArray,
    moved: BoolArray,
    left: BoolArray,
    static: BoolArray,
    stays: BoolArray,
) -> list[IntArray]:
    """Group moved points by cells, seen from above, and add the points around them that are not
    static.

    Args:
        world: (N, 3) metres.
        kind: (N,) points of different kinds are not grouped.
        moved: (N,) points at places that were free most of the time.
        left: (N,) points at places that were free before or after only. A cell needs a large share
            of them, because a thin surface may be invisible from one side.
        static: (N,) points at places that were occupied at other times.
        stays: (N,) those among them at places that were occupied seconds before or after, and never
            free.

    Returns:
        Indices of the points of each cluster.
    """
    either = moved | left
    flagged = np.flatnonzero(either)
    if len(flagged) < _MIN_POINTS:
        return []
    cell = cells_of(world[:, :2], _CELL_M)
    low, high = cell[flagged].min(axis=0) - 1, cell[flagged].max(axis=0) + 1
    x, y = ((axis >= a) & (axis <= b) for axis, a, b in zip(cell.T, low, high, strict=True))
    inside = np.flatnonzero(x & y)
    width = high[1] - low[1] + 1
    cells = int((high[0] - low[0] + 1) * width)
    place = kind[inside] * cells + (cell[inside, 0] - low[0]) * width + (cell[inside, 1] - low[1])
    keys, flat = distinct(place)
    share = np.bincount(flat, either[inside], minlength=len(keys)) / np.bincount(
        flat, minlength=len(keys)
    )
    # One point that moved makes a cell a seed: such points are rare on static things. Points that
    # were free on one side only are common behind edges, so a cell needs a large share of them.
    seeds = (np.bincount(flat, moved[inside], minlength=len(keys)) > 0) | (share >= _FLAGGED_SHARE)
    component = joined(keys, seeds, int(width))[flat]
    groups: list[IntArray] = []
    kept = np.flatnonzero(component >= 0)
    order = kept[np.argsort(component[kept], kind="stable")]
    for group in np.split(order, np.flatnonzero(np.diff(component[order])) + 1):
        members = inside[group]
        core = seeds[flat[group]]
        count = int(either[members].sum())
        if count < _MIN_POINTS:
            continue
        # Of an object that moved as a whole, static points belong to it too: its sides often pass
        # the places of its own earlier surface. What stays does not, and otherwise static points
        # are of something behind it.
        whole = count >= _FLAGGED_SHARE * np.count_nonzero(core)
        members = members[~static[members] | (core & whole & ~stays[members])]
        groups.append(np.sort(members))
    return groups


def _count_around(world: FloatArray, groups: list[IntArray], static: BoolArray) -> tuple[int, ...]:
    """Return the number of static points, of (N, 3) points in metres, around each group: in its
    cells or beside them, at its height.
    """
    # Row and column in one number, so that neighbours are at fixed steps: 2^20 cells are 367 km.
    cell = cells_of(world[:, :2], _CELL_M) + (1 << 20)
    key, rows = (cell[:, 0] << 21) | cell[:, 1], np.flatnonzero(static)
    rows = rows[np.argsort(key[rows], kind="stable")]
    keys = key[rows]
    heights = world[rows, 2]
    counted = np.zeros(len(rows), np.int64)
    return tuple(
        _count_beside(np.sort(key[group]), world[group, 2], keys, heights, counted, turn)
        for turn, group in enumerate(groups, 1)
    )


@cached
def _count_beside(
    cells: IntArray,
    inside: FloatArray,
    keys: IntArray,
    heights: FloatArray,
    counted: IntArray,
    turn: int,
) -> int:
    """Return how many points, by their sorted cells and their heights, are in or beside the sorted
    cells of a group, at the heights of its points; `counted` marks them with the turn of the group.
    """
    lower, upper, count = inside.min() - _BAND_M, inside.max() + _BAND_M, 0
    for k in range(len(cells)):
        if k and cells[k] == cells[k - 1]:
            continue
        for row in (-1, 0, 1):
            first = cells[k] + (row << 21) - 1
            at = np.searchsorted(keys, first)
            while at < len(keys) and keys[at] <= first + 2:
                # static points of the group itself count too
                if counted[at] != turn and lower <= heights[at] <= upper:
                    counted[at] = turn
                    count += 1
                at += 1
    return count


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
    start = np.zeros(_COLUMNS + 1, np.int32)
    order = np.empty_like(members)
    count = 0
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
        c = _column(fast_azimuth(x, y)) if moved and x * x + y * y > 0 else 0
        x, y, z = x - origin[c, 0], y - origin[c, 1], z - origin[c, 2]
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
def _count(flags: np.uint32 | np.int64) -> np.int64:
    """Return how many of the lower 32 bits are set."""
    bits = np.int64(flags)
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
    left: Uint32Array,
    least: tuple[int, int, int],
) -> Int32Array:
    """Return the points whose result the remaining scans may still change.

    Args:
        asked: (A,) indices of points.
        free: (2, M) bits of the scans before and after that saw the place of a point free. Higher
            bits are farther in time.
        hit: (2, M) bits of the scans that saw it occupied.
        left: (2,) bits of the scans before and after that are not looked up yet.
        least: least number of scans that see the place of a moved point free, of scans in a row if
            it is free on one side only, and of scans that saw a place occupied which none saw free:
            such a place is decided.
    """
    kept = np.empty_like(asked)
    count, rest = 0, _count(left[0]) + _count(left[1])
    for i in asked:
        passed = _count(free[0, i]) + _count(free[1, i])
        occupied = _count(hit[0, i]) + _count(hit[1, i])
        # The rest of the scans can add at most `rest` to either count. A point is decided when no
        # such addition changes which count is greater, or the length of a row without a hit.
        moves = passed >= least[0] and passed > occupied + rest
        may_change = passed + rest >= occupied
        for side in range(2):  # a row ends at the first scan that saw it occupied
            h = np.int64(hit[side, i])
            # All bits below the highest hit are set, in five steps: 2^5 = 32 bits.
            for shift in (1, 2, 4, 8, 16):
                h |= h >> shift
            in_a_row = _count(np.int64(free[side, i] | left[side]) & ~h)
            may_change = may_change or in_a_row >= least[1]
        if may_change and not moves and (passed or occupied < least[2]):
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
    near = far - _DEPTH_M - _DEPTH_SHARE * far
    beyond = far + _DEPTH_M + _DEPTH_SHARE * far
    first, middle, last = (
        math.floor((azimuth - half + math.pi) * _PER_RAD),
        math.floor((azimuth + math.pi) * _PER_RAD),
        math.floor((azimuth + half + math.pi) * _PER_RAD),
    )
    # A hit decides at once, for any ray. A ray that ends before the place hides it, even if others
    # pass: then the place is at an edge, and unknown. So all columns of the window are needed.
    passed, hidden = 0, 0
    below, above = -1e9, 1e9
    below_range, above_range = 0.0, 0.0
    for c in range(first - 1, last + 1):
        # Most places are occupied, and the middle column usually shows it: it comes first.
        if c == middle:
            continue
        column = (middle if c < first else c) % _COLUMNS
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
