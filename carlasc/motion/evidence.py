"""Evidence of motion: points at places that were free space at other times.

It needs no flow, instances or labels.

Each point that is not ground is looked up in scans up to `HORIZON_S` before and after. A point
moved if rays passed through its place more often than they ended there, or if all scans on one side
in time saw it free. Such points are grouped into clusters. A cluster also gets the points around it
that are not known to be static.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from carlasc.core.arrays import BoolArray, Float32Array, FloatArray, IntArray, LabelArray
from carlasc.core.cells import as_pose, distinct, numbered
from carlasc.core.compiling import cached
from carlasc.core.geometry import Transform, invert, multiply, thin, transform_points
from carlasc.core.scans import finite, runs_of_origins
from carlasc.errors import FormatError
from carlasc.motion.ground import ground_points
from carlasc.motion.visibility import SAME_PLACE_M, SortedReturns, look_up, undecided

HORIZON_S = 5.0  # fact: horizon
"""Scans up to this many seconds before and after a scan are looked up."""

_OFFSETS_S = (0.3, 0.5, 0.8, 1.2, 1.6, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0)
_AGREEING = 2  # least number of scans that saw a place free
_IN_A_ROW = 4  # the same, if all scans on one side in time, from the farthest inwards, saw it free
_CELL_M = 0.35  # points of one object are in neighbouring cells of this size, seen from above
_MIN_POINTS = 3  # smaller clusters are noise
_JUDGED_CELL_M = 0.15  # one point per cell of this size is looked up, and decides for the others
_BAND_M = (
    0.3  # static points so far below or above a cluster, in its cells or beside them, are around it
)
_FLAGGED_SHARE = 0.6  # a cluster with this share of moved points moved as a whole
_PERIOD_S = 0.1  # period of scans whose times do not increase


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
    """

    frame: int
    points: Float32Array
    world_T_sensor: Transform
    seconds: float
    ground: BoolArray | None = None
    labels: LabelArray | None = None
    explained: BoolArray | None = None
    origins: Float32Array | None = None

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise FormatError("points", expected="shape (N, 3)", found=str(self.points.shape))
        for name in ("ground", "labels", "explained"):
            values = getattr(self, name)
            if values is not None and values.shape != (len(self.points),):
                raise FormatError(
                    name, expected=f"shape ({len(self.points)},)", found=str(values.shape)
                )


@dataclass(frozen=True)
class FreeSpaceEvidence:
    """The clusters of points that moved in one scan.

    Attributes:
        frame: frame number.
        seconds: time of the scan.
        count: number of points of the scan.
        clusters: (M,) int64 indices of the points of each cluster.
        points: (M, 3) float64 of the same points, metres, world.
        labels: most frequent class of each cluster; 0 without labels.
        freed: number of points of each cluster at places that were free at other times.
        around: number of static points around each cluster, at its height. It is large for pieces
            of static objects.
        world_T_sensor: (4, 4) pose of the scan.
    """

    frame: int
    seconds: float
    count: int
    clusters: tuple[IntArray, ...]
    points: tuple[FloatArray, ...]
    labels: tuple[int, ...]
    freed: tuple[int, ...]
    around: tuple[int, ...]
    world_T_sensor: Transform

    def thinned(self, most: int = 400) -> FreeSpaceEvidence:
        """Return the same with at most `most` of the `points` of each cluster; `clusters` stay
        complete.
        """
        return replace(self, points=tuple(thin(points, most) for points in self.points))

    @property
    def moved(self) -> BoolArray:
        """(N,) bool: which points of the scan are in a cluster."""
        flags = np.zeros(self.count, np.bool_)
        for members in self.clusters:
            flags[members] = True
        return flags


@dataclass(frozen=True)
class _Kept:
    """A scan in the window."""

    scan: EvidenceScan
    seconds: float
    views: tuple[SortedReturns, ...]

    @classmethod
    def of(cls, scan: EvidenceScan, seconds: float) -> _Kept:
        """Sort the points of each sensor of a scan by their directions."""
        if scan.origins is None:
            return cls(scan, seconds, (SortedReturns.of(scan.points),))
        views = (
            SortedReturns.of(scan.points[own], scan.origins[own]) for own in _sensors(scan.origins)
        )
        return cls(scan, seconds, tuple(views))


def find_evidence(
    scans: Iterable[EvidenceScan], *, movable: Collection[int] = ()
) -> Iterator[FreeSpaceEvidence]:
    """Yield the evidence of each scan of a drive, when the scans of the `HORIZON_S` after it were
    read.

    Only scans within this time are held, so memory does not grow with the drive.

    Args:
        scans: the scans in order of time. Times that do not increase are replaced by 0.1 s per
            scan.
        movable: classes of actors. Points of different movable classes are not grouped together.

    Yields:
        The evidence of each scan, in the order of the scans.
    """
    window: deque[_Kept] = deque()
    current, last = 0, -np.inf
    for scan in scans:
        seconds = (
            scan.seconds
            if scan.seconds > last
            else (last + _PERIOD_S if np.isfinite(last) else 0.0)
        )
        last = seconds
        # Invariant: `window` holds the scans within the horizon of the current one, which is the
        # first whose evidence is not given yet. It is complete when a scan lies beyond its horizon.
        window.append(_Kept.of(scan, seconds))
        while window[-1].seconds - window[current].seconds > HORIZON_S:
            yield _evidence(window, current, movable)
            current += 1
            while window[current].seconds - window[0].seconds > HORIZON_S:
                window.popleft()
                current -= 1
    for index in range(current, len(window)):
        yield _evidence(window, index, movable)


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
    asked_first, same = numbered(np.floor(world / _JUDGED_CELL_M).astype(np.int64))
    verdict = _judge(
        scan, candidates[asked_first], [window[i] for i in before], [window[i] for i in after]
    )
    moved, left, static = (answers[same] for answers in verdict)
    kind = np.zeros(len(candidates), np.int64)
    if scan.labels is not None and movable:
        labels = scan.labels[candidates].astype(np.int64)
        kind = np.where(np.isin(labels, sorted(movable)), labels, 0)
    groups = _clusters(world, kind, moved, left, static)
    freed = tuple(int((moved | left)[group].sum()) for group in groups)
    clusters = [candidates[group] for group in groups]
    points = [
        transform_points(scan.world_T_sensor, scan.points[members].astype(np.float64))
        for members in clusters
    ]
    classes = [
        0 if scan.labels is None else int(np.bincount(scan.labels[own]).argmax())
        for own in clusters
    ]
    around = _count_around(world, groups, static)
    parts = (tuple(clusters), tuple(points), tuple(classes), freed, around)
    return FreeSpaceEvidence(scan.frame, own.seconds, len(scan.points), *parts, scan.world_T_sensor)


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
) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Return which candidates are at places that were free most of the time, free on one side in
    time, and occupied (static).
    """
    points = np.ascontiguousarray(scan.points[candidates], np.float32)
    free, hit = np.zeros((2, 2, len(points)), np.uint32)
    asked, left = np.arange(len(points), dtype=np.int32), [len(before), len(after)]
    while any(left):  # from the farthest inwards: most places are decided before the nearest scans
        for side, others in enumerate((before, after)):
            if left[side]:
                left[side] -= 1
                other = others[left[side]]
                pose = as_pose(multiply(invert(other.scan.world_T_sensor), scan.world_T_sensor))
                for view in other.views:
                    look_up(points, asked, pose, view, left[side], free[side], hit[side])
        asked = undecided(asked, free, hit, (left[0], left[1]), (_AGREEING, _IN_A_ROW))
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
    return moved, left, ~(moved | left) & (occupied > seen_through)


def _clusters(
    world: FloatArray,
    kind: IntArray,
    moved: BoolArray,
    left: BoolArray,
    static: BoolArray,
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

    Returns:
        Indices of the points of each cluster.
    """
    either = moved | left
    flagged = np.flatnonzero(either)
    if len(flagged) < _MIN_POINTS:
        return []
    cell = np.floor(world[:, :2] / _CELL_M).astype(np.int64)
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
    component = _join(keys, seeds, int(width))[flat]
    groups: list[IntArray] = []
    kept = np.flatnonzero(component >= 0)
    order = kept[np.argsort(component[kept], kind="stable")]
    for group in np.split(order, np.flatnonzero(np.diff(component[order])) + 1):
        members = inside[group]
        core = members[seeds[flat[group]]]
        count = int(either[members].sum())
        if count < _MIN_POINTS:
            continue
        # Of an object that moved as a whole, static points belong to it too: its sides often pass
        # the places of its own earlier surface. Otherwise static points are of something behind it.
        if count < _FLAGGED_SHARE * len(core):
            members = members[~static[members]]
        else:
            members = np.union1d(core, members[~static[members]])
        groups.append(np.sort(members))
    return groups


def _count_around(world: FloatArray, groups: list[IntArray], static: BoolArray) -> tuple[int, ...]:
    """Return the number of static points, of (N, 3) points in metres, around each group: in its
    cells or beside them, at its height.
    """
    # Row and column in one number, so that neighbours are at fixed steps: 2^20 cells are 367 km.
    cell = np.floor(world[:, :2] / _CELL_M).astype(np.int64) + (1 << 20)
    key = (cell[:, 0] << 21) | cell[:, 1]
    rows = np.flatnonzero(static)
    rows = rows[np.argsort(key[rows], kind="stable")]
    keys, heights = key[rows], world[rows, 2]
    steps = np.array([(row << 21) + column for row in (-1, 0, 1) for column in (-1, 0, 1)])
    counts = []
    for group in groups:
        cells = np.unique(np.unique(key[group])[:, None] + steps)
        begin, end = np.searchsorted(keys, cells), np.searchsorted(keys, cells, side="right")
        lower, upper = world[group, 2].min() - _BAND_M, world[group, 2].max() + _BAND_M
        near = np.concatenate(
            [heights[a:b] for a, b in zip(begin.tolist(), end.tolist(), strict=True)]
        )
        # static points of the group itself count too
        counts.append(int(((near >= lower) & (near <= upper)).sum()))
    return tuple(counts)


@cached
def _join(keys: IntArray, seeds: BoolArray, width: int) -> IntArray:
    """Return the component of each cell: seeds that touch are one component, and other cells belong
    to a seed beside them; -1 without one.

    Args:
        keys: (C,) row times width plus column of each cell, increasing.
        seeds: (C,) which cells hold moved points.
        width: columns per row.
    """
    # Union-find: every cell points towards the lowest cell of its component, so components have the
    # same numbers whatever the order of joins. Half of the neighbours is enough: joins go both
    # ways.
    parent = np.arange(len(keys))
    for i in range(len(keys)):
        if not seeds[i]:
            continue
        for step in (1, width - 1, width, width + 1):
            j = np.searchsorted(keys, keys[i] + step)
            if j < len(keys) and keys[j] == keys[i] + step and seeds[j]:
                a, b = i, j
                while parent[a] != a:
                    a = parent[a]
                while parent[b] != b:
                    b = parent[b]
                parent[max(a, b)] = min(a, b)
    component = np.full(len(keys), -1, np.int64)
    for i in range(len(keys)):
        if seeds[i]:
            a = i
            while parent[a] != a:
                a = parent[a]
            component[i] = a
    for i in range(len(keys)):
        if not seeds[i]:
            for step in (-width - 1, -width, -width + 1, -1, 1, width - 1, width, width + 1):
                j = np.searchsorted(keys, keys[i] + step)
                if j < len(keys) and keys[j] == keys[i] + step and seeds[j]:
                    component[i] = component[j]
    return component
