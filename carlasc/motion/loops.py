"""Loops: places that a drive meets again, and the one trajectory that is consistent at them.

The drive is cut into submaps: the planes of the scans of some metres, under poses that are right
over such a distance. Where the poses say that two submaps may show the same place, their walls,
seen from above, are laid over each other, and then their planes. A loop is accepted only if planes
of several directions coincide in both submaps and determine all directions, if no other position
fits nearly as well, and if its neighbours agree. Loops and the motions between submaps are then one
system of equations. The poses change only if places that are met again agree clearly better.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from carlasc.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from carlasc.core.cells import cells_of, distinct
from carlasc.core.geometry import (
    Transform,
    invert,
    multiply,
    rotate_vectors,
    rotation_z,
    slerp,
    small_motions,
    transform_points,
    translation,
)
from carlasc.motion.joint_alignment import clusters, move
from carlasc.motion.planes import covariances
from carlasc.motion.solving import principal_axes, solve_positive, squares_of

_STEP_M, _SUBMAP_M, _REACH_M = 1.0, 10.0, 30.0  # between used scans; length; of points, sideways
# Of a plane: see `SubmapPlanes`.
_CELL_M, _POINTS, _FLAT, _THICK_M, _WIDE_M2 = 1.0, 10, 0.1, 0.08, 0.02
_PIXEL_M, _PIXELS, _LEVELS = 0.5, 256, 3  # of images: pixels with points at so many levels
_APART_M, _NEAR_M, _PASSES = 60.0, 12.0, 3  # of two submaps: along the drive; away; passes tried
# What poses may be off, per metre of the drive between two submaps, and at least; less in height,
# and under a ceiling, where another storey may look the same.
_DRIFT, _DRIFT_M, _MOST_M = 0.01, 1.0, 30.0
_CLIMB, _COVERED_M = 0.001, 1.2  # of the height: a ramp looks like the one above it
_TURN, _TURN_RAD, _MOST_RAD = np.radians(0.005), np.radians(1.0), np.radians(12.0)
_YAW_RAD, _MARGIN_M = np.radians(0.75), 8.0  # steps; other positions that are looked at
_PEAKS, _PEAK_M, _PEAK = 5, 1.5, 0.6
_GATES_M = (1.0, 1.0, 1.0, 0.7, 0.7, 0.5, 0.5, 0.35, 0.35, 0.25, 0.25, 0.2, 0.2, 0.2)
_ALIKE, _SIDEWAYS_M = 0.9, 1.5  # cosine between normals, and distance along planes
_UPRIGHT, _LEVEL = 0.5, 0.8  # |z| of the normals of walls, and of ground
_INSIDE_M, _SAME_M = 22.0, 0.15
_SHARE, _AMBIGUOUS, _LOOSE, _OTHER_M = 0.45, 0.85, 0.25, 0.5
_DETERMINED, _FEWEST, _ROUGH_M = 0.02, 12.0, 0.06
# Errors of a motion over a submap, and of a loop, metres and radians.
_UNKNOWNS = 200  # most loops that count, and most submaps without loops whose poses are unknown
_ODOMETRY = np.array([0.02, 0.02, 0.02, 0.0007, 0.0007, 0.0007])
_LOOP = np.array([0.01, 0.01, 0.01, 0.0003, 0.0003, 0.0003])
_TOGETHER_M, _AGREE_M, _AGREE_RAD = 60.0, 0.25, np.radians(0.5)


class SubmapPlanes(NamedTuple):
    """The planes of a submap, at most one per cell.

    Attributes:
        keys: (P,) of their cells, increasing.
        centres: (P, 3) metres, frame of the submap.
        normals: (P, 3) unit vectors.
    """

    keys: IntArray
    centres: FloatArray
    normals: FloatArray

    @classmethod
    def of(cls, points: Float32Array) -> SubmapPlanes:
        """Return the planes of (N, 3) points."""
        _, sums = clusters(points, np.eye(4), _CELL_M, 0.0)
        sums = sums[sums[:, 0] >= _POINTS]
        values, vectors = principal_axes(covariances(sums))
        flat = (values[:, 0] < np.minimum(_THICK_M**2, _FLAT * values[:, 1])) & (
            values[:, 1] > _WIDE_M2
        )
        centres = sums[flat, 1:4] / sums[flat, :1]
        keys = _keys(cells_of(centres, _CELL_M))
        order = np.argsort(keys)
        return cls(keys[order], centres[order], vectors[flat, :, 0][order])

    def moved(self, pose: Transform) -> tuple[FloatArray, FloatArray]:
        """Return the centres and the normals in another frame."""
        return transform_points(pose, self.centres), rotate_vectors(pose, self.normals)


Pairs = tuple[IntArray, IntArray]
"""(M,) rows of planes of one submap, and (M,) rows of planes of another one that lie on them."""


class Submap(NamedTuple):
    """The scans of some metres of a drive.

    Attributes:
        row: of the scan in its middle.
        along_m: distance driven until then.
        origin: (3,) position of this scan: the origin of the submap, on the axes of the world.
        planes: of the points that are aligned.
        held: of the points that take no part.
        pixels: (K, 2) cells, seen from above, with something upright.
        covered: whether there is a ceiling.
    """

    row: int
    along_m: float
    origin: FloatArray
    planes: SubmapPlanes
    held: SubmapPlanes
    pixels: IntArray
    covered: bool


class Loop(NamedTuple):
    """Two submaps of one place.

    Attributes:
        first: number of the earlier submap.
        second: number of the later one.
        motion: (4, 4) first_T_second.
        held: number of common planes across the direction that fewest of them hold.
    """

    first: int
    second: int
    motion: Transform
    held: float


class Submaps:
    """Collects the submaps of a drive, scan after scan."""

    def __init__(self) -> None:
        self.done: list[Submap] = []
        self._along_m, self._at = 0.0, np.full(3, np.nan)
        self._scans: list[tuple[int, float, Transform, Float32Array, Float32Array]] = []

    def add(self, row: int, used: Float32Array, measured: Float32Array, pose: Transform) -> None:
        """Add a scan with its final pose, world_T_sensor; its points are in the frame of the
        sensor.
        """
        step = float(np.sqrt(np.square(pose[:3, 3] - self._at).sum()))
        if step < _STEP_M:
            return
        self._along_m += 0.0 if np.isnan(step) else step
        self._at = pose[:3, 3]
        self._scans.append((row, self._along_m, pose, used, measured))
        if self._along_m - self._scans[0][1] >= _SUBMAP_M - _STEP_M:
            self.finish()

    def finish(self) -> None:
        """Make a submap of the scans since the last one."""
        if not self._scans:
            return
        row, along_m, middle, _, _ = self._scans[len(self._scans) // 2]
        origin = middle[:3, 3].copy()
        used = _near([(one, pose) for _, _, pose, one, _ in self._scans], origin)
        held = _near([(one, pose) for _, _, pose, _, one in self._scans], origin)
        planes = SubmapPlanes.of(used)
        heights = planes.centres[np.abs(planes.normals[:, 2]) > _LEVEL, 2]
        covered = bool((heights > 0.3).sum() > 0.3 * (heights < -0.3).sum())
        self.done.append(
            Submap(row, along_m, origin, planes, SubmapPlanes.of(held), _upright(used), covered)
        )
        self._scans = []


def _near(scans: Iterable[tuple[Float32Array, Transform]], origin: FloatArray) -> Float32Array:
    """Return the points of scans with their poses, relative to an origin that is not far away."""
    points = np.concatenate([transform_points(pose, own) - origin for own, pose in scans])
    return points[np.hypot(points[:, 0], points[:, 1]) < _REACH_M].astype(np.float32)


def _keys(cells: IntArray) -> IntArray:
    x, y, z = (cells + 1024).T
    return np.asarray((x << 22) | (y << 11) | z)


def _upright(points: Float32Array) -> IntArray:
    """Return the (K, 2) pixels in which (N, 3) points are at several levels."""
    levels, _ = distinct(_keys(cells_of(points, _PIXEL_M)))
    columns, number = distinct(levels >> 11)
    tall = columns[np.bincount(number) >= _LEVELS]
    return np.stack([tall >> 11, tall & 2047], axis=1) - 1024


def close_loops(submaps: Sequence[Submap], poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Find the loops of a drive, and return poses that are consistent at them.

    Args:
        submaps: of the whole drive.
        poses: (F, 4, 4) world_T_sensor of each scan.

    Returns:
        (F, 4, 4) poses, those given if there is no loop, and (L, 4) of each loop: the rows of its
        two scans, and the distance of the planes of the two passes before and after, metres, where
        the points took no part.
    """
    found = [loop for pair in _pairs(submaps) for loop in _lay(submaps, *pair)]
    loops = _agreeing(submaps, found) if found else []
    if not loops:
        return poses, np.empty((0, 4))
    loops = loops[:: -(-len(loops) // _UNKNOWNS)]
    # Of a long drive without loops, some submaps are enough: the system has few unknowns.
    every = range(0, len(submaps), -(-len(submaps) // _UNKNOWNS))
    chosen = sorted({*every, len(submaps) - 1, *(end for loop in loops for end in loop[:2])})
    place = {number: index for index, number in enumerate(chosen)}
    rows = np.array([submaps[number].row for number in chosen], np.float64)
    start = np.stack([translation(submaps[number].origin) for number in chosen])
    loops = [loop._replace(first=place[loop.first], second=place[loop.second]) for loop in loops]
    loops, solved = _solve(start, np.diff(chosen), loops)
    at = np.clip(np.arange(len(poses), dtype=np.float64), rows[0], rows[-1])
    moved = multiply(slerp(solved, rows, at), invert(slerp(start, rows, at)), poses)
    distances = []
    for first, second, *_ in loops:
        one, other = chosen[first], chosen[second]
        was, now = (multiply(invert(way[first]), way[second]) for way in (start, solved))
        pairs = _matches(submaps[one].held, submaps[other].held, now, _SAME_M)
        if len(pairs[0]):
            apart = [
                _apart(submaps[one].held, submaps[other].held, motion, pairs)
                for motion in (was, now)
            ]
            distances.append([rows[first], rows[second], *apart])
    return moved, np.array(distances).reshape(-1, 4)


def _window(gap_m: float, covered: bool) -> tuple[float, float]:
    """Return how far poses may be off sideways and in height over a distance."""
    window = min(_DRIFT_M + _DRIFT * gap_m, _MOST_M)
    return window, min(window, _COVERED_M + (0.0 if covered else _CLIMB * gap_m))


def _pairs(submaps: Sequence[Submap]) -> Iterator[tuple[int, int]]:
    """Yield pairs of submaps that may show the same place: of each later one, the nearest of each
    earlier pass.
    """
    if not submaps:
        return
    along = np.array([one.along_m for one in submaps])
    origins = np.stack([one.origin for one in submaps])
    for second, later in enumerate(submaps):
        off = origins[:second] - later.origin
        away, taken = np.hypot(off[:, 0], off[:, 1]), list[float]()
        for first in np.argsort(away, kind="stable").tolist():
            gap = later.along_m - float(along[first])
            window, height = _window(gap, later.covered or submaps[first].covered)
            if len(taken) == _PASSES or away[first] > _NEAR_M + _MOST_M:
                break
            near = away[first] < _NEAR_M + window and abs(off[first, 2]) < height + 1.0
            fresh = all(abs(along[first] - other) > 2 * _NEAR_M for other in taken)
            if gap > _APART_M and near and fresh:
                taken.append(float(along[first]))
                yield first, second


def _lay(submaps: Sequence[Submap], first: int, second: int) -> Iterator[Loop]:
    """Yield the loop of two submaps if one position of the second one fits well, and only one."""
    one, other = submaps[first], submaps[second]
    gap = other.along_m - one.along_m
    window, height = _window(gap, one.covered or other.covered)
    given = translation(other.origin - one.origin)
    fits: list[tuple[float, Transform, Pairs]] = []
    for start in _positions(one, other, given, window, min(_TURN_RAD + _TURN * gap, _MOST_RAD)):
        start[2, 3] += _rise(one.planes, other.planes, start, height)
        motion = _register(one.planes, other.planes, start)
        pairs = _matches(one.planes, other.planes, motion, _SAME_M)
        fits.append((_common(one.planes, other.planes, motion, pairs), motion, pairs))
    if not fits:
        return
    best, motion, pairs = max(fits, key=lambda fit: fit[0])
    off = motion[:3, 3] - given[:3, 3]
    values, axes = principal_axes(_spread(one.planes, pairs)[None])
    weakest = axes[0, :, 0]
    rivals = [
        theirs
        for common, where, theirs in fits
        if np.square(where[:3, 3] - motion[:3, 3]).sum() > _OTHER_M**2
        and common > _AMBIGUOUS * best
    ]
    # along a street, all positions have its walls in common: what stands across it decides
    alone = best > _SHARE and all(
        weakest @ _spread(one.planes, rival) @ weakest < _LOOSE * values[0, 0] for rival in rivals
    )
    possible = np.hypot(off[0], off[1]) < window and abs(off[2]) < height
    held = values[0, 0] > _DETERMINED * values.sum()
    if alone and possible and held and _apart(one.planes, other.planes, motion, pairs) < _ROUGH_M:
        yield Loop(first, second, motion, float(values[0, 0]))


def _positions(
    one: Submap, other: Submap, given: Transform, window: float, turn: float
) -> Iterator[Transform]:
    """Yield the motions at which what is upright in two submaps, seen from above, overlaps most."""
    if not len(one.pixels) or not len(other.pixels):
        return
    steps = int(np.ceil(turn / _YAW_RAD))
    yaws = np.arange(-steps, steps + 1) * _YAW_RAD
    images = np.zeros((1 + len(yaws), _PIXELS, _PIXELS))
    images[0][tuple((one.pixels + _PIXELS // 2).T)] = 1.0
    middles = np.column_stack([(other.pixels + 0.5) * _PIXEL_M, np.zeros(len(other.pixels))])
    for image, yaw in zip(images[1:], yaws.tolist(), strict=True):
        turned = transform_points(rotation_z(yaw), middles)[:, :2]
        image[tuple(cells_of(turned, _PIXEL_M).T + _PIXELS // 2)] = 1.0
    overlap, shifts = overlaps(images[:1], images[1:], _PIXEL_M)
    x, y = shifts[:, None] - given[0, 3], shifts - given[1, 3]
    best, which = overlap.max(axis=0), overlap.argmax(axis=0)
    best[np.hypot(x, y) > 2 * window + _MARGIN_M] = 0.0
    least = _PEAK * best.max()
    for _ in range(_PEAKS):
        row, column = np.unravel_index(np.argmax(best), best.shape)
        if best[row, column] < max(least, 1.0):
            return
        motion = rotation_z(float(yaws[which[row, column]]))
        motion[:3, 3] = shifts[row], shifts[column], given[2, 3]
        yield motion
        best[np.hypot(shifts[:, None] - shifts[row], shifts - shifts[column]) < _PEAK_M] = 0.0


def overlaps(
    images: FloatArray, others: FloatArray, pixel_m: float
) -> tuple[FloatArray, FloatArray]:
    """Return (N, P, P) how many pixels (N, P, P) images of zeros and ones share with the others, if
    these are shifted in circles along both axes, and the (P,) shifts along an axis, metres.
    """
    count = images.shape[-1]
    waves = np.fft.rfft2(images) * np.fft.rfft2(others).conj()
    shared = np.fft.irfft2(waves, s=(count, count)).round()
    return shared, np.fft.fftfreq(count, 1.0 / count) * pixel_m


def _rise(one: SubmapPlanes, other: SubmapPlanes, motion: Transform, most: float) -> float:
    """Return how much higher the ground of the first submap lies than that of the second one."""
    lowest = []
    for centres, normals in (one.moved(np.eye(4)), other.moved(motion)):
        level = centres[np.abs(normals[:, 2]) > _LEVEL]
        level = level[np.argsort(level[:, 2], kind="stable")]
        cells = cells_of(level[:, :2], _CELL_M) + 1024
        keys, rows = np.unique((cells[:, 0] << 11) | cells[:, 1], return_index=True)
        lowest.append((keys, level[rows, 2]))
    (keys, heights), (others, lower) = lowest
    _, a, b = np.intersect1d(keys, others, return_indices=True)
    rise = float(np.median(heights[a] - lower[b])) if len(a) else 0.0
    return rise if abs(rise) < most else 0.0


def _matches(one: SubmapPlanes, other: SubmapPlanes, motion: Transform, gate_m: float) -> Pairs:
    """Return the planes of the first submap on which planes of the second one lie, and these."""
    centres, normals = other.moved(motion)
    cells = cells_of(centres, _CELL_M)
    nearest, squared = np.full(len(centres), -1), np.full(len(centres), np.inf)
    if not len(one.keys):
        return nearest[:0], nearest[:0]
    for step in np.ndindex(3, 3, 3):
        keys = _keys(cells + np.array(step) - 1)
        row = np.minimum(np.searchsorted(one.keys, keys), len(one.keys) - 1)
        off = centres - one.centres[row]
        along = (off * one.normals[row]).sum(axis=1)
        away = np.square(off).sum(axis=1)
        alike = np.abs((normals * one.normals[row]).sum(axis=1)) > _ALIKE
        chosen = (one.keys[row] == keys) & alike & (np.abs(along) < gate_m) & (away < squared)
        chosen &= away < _SIDEWAYS_M**2
        nearest[chosen], squared[chosen] = row[chosen], away[chosen]
    rows = np.flatnonzero(nearest >= 0)
    return nearest[rows], rows


def _apart(one: SubmapPlanes, other: SubmapPlanes, motion: Transform, pairs: Pairs) -> float:
    """Return the root mean square distance of pairs of planes."""
    a, b = pairs
    centres, _ = other.moved(motion)
    off = ((centres[b] - one.centres[a]) * one.normals[a]).sum(axis=1)
    return float(np.sqrt(np.square(off).mean()))


def _register(one: SubmapPlanes, other: SubmapPlanes, start: Transform) -> Transform:
    """Return the motion, near a first one, that lays planes of the second submap on the first."""
    poses = start[None].copy()
    for gate in _GATES_M:
        a, b = _matches(one, other, poses[0], gate)
        centres, turned = other.moved(poses[0])
        arms, normals = centres[b] - poses[0, :3, 3], one.normals[a]
        signs = np.sign((turned[b] * normals).sum(axis=1))[:, None]
        normals = normals + signs * turned[b]
        normals /= np.sqrt(np.square(normals).sum(axis=1))[:, None]
        off = ((centres[b] - one.centres[a]) * normals).sum(axis=1)
        slopes = np.concatenate([normals, np.cross(arms, normals)], axis=1)
        weights = (1.0 + np.square(off / (0.3 * gate))) ** -2.0
        matrix = np.diag([1.0] * 3 + [100.0] * 3) + squares_of(slopes, weights)
        right = -(weights * off)[:, None] * slopes
        move(poses, solve_positive(matrix, right.sum(axis=0))[None], 0)
    return np.asarray(poses[0])


def _inside(centres: FloatArray, motion: Transform) -> BoolArray:
    """Return which of (P, 3) centres, frame of the first submap, are near both origins."""
    x, y, _ = centres.T
    away = np.maximum(np.hypot(x, y), np.hypot(x - motion[0, 3], y - motion[1, 3]))
    return away < _INSIDE_M


def _common(one: SubmapPlanes, other: SubmapPlanes, motion: Transform, pairs: Pairs) -> float:
    """Return the least share of planes of a submap that the other one has too, of walls and of
    all.
    """
    a, b = pairs
    centres, _ = other.moved(motion)
    shares = []
    for planes, rows, near in (
        (one, a, _inside(one.centres, motion)),
        (other, b, _inside(centres, motion)),
    ):
        common = np.zeros(len(near), np.bool_)
        common[rows] = True
        wall = near & (np.abs(planes.normals[:, 2]) < _UPRIGHT)
        shares += [float(common[k].sum()) / max(int(k.sum()), 1) for k in (near, wall)]
    return min(shares)


def _spread(one: SubmapPlanes, pairs: Pairs) -> FloatArray:
    """Return how many of the common planes of two submaps lie across each direction: (3, 3)."""
    normals = one.normals[pairs[0]]
    return squares_of(normals, np.ones(len(normals)))


def _agreeing(submaps: Sequence[Submap], loops: list[Loop]) -> list[Loop]:
    """Return the loops that most of the loops near them agree with, at least one, if together they
    have enough planes across every direction.
    """
    chosen = []
    ends = [(submaps[loop.first], submaps[loop.second]) for loop in loops]
    along = np.array([(one.along_m, other.along_m) for one, other in ends])
    held = np.array([loop.held for loop in loops])
    offs = np.array([small_motions(loop.motion[None])[0] for loop in loops])
    offs[:, :3] -= np.array([other.origin - one.origin for one, other in ends])
    for row, loop in enumerate(loops):
        apart = np.abs(along - along[row]).sum(axis=1)
        near = apart < _TOGETHER_M
        near[row] = False
        away = np.linalg.norm(offs[:, :3] - offs[row, :3], axis=1)
        turned = np.abs(offs[:, 3:] - offs[row, 3:]).max(axis=1)
        agree = near & (away < _AGREE_M + _DRIFT * apart) & (turned < _AGREE_RAD)
        if 2 * agree.sum() > near.sum() and loop.held + held[agree].sum() > _FEWEST:
            chosen.append(loop)
    return chosen


def _solve(
    start: FloatArray, lengths: IntArray, loops: list[Loop]
) -> tuple[list[Loop], FloatArray]:
    """Return the loops that the motions between submaps allow, and the poses of the submaps.

    Args:
        start: (N, 4, 4) their poses without loops.
        lengths: (N - 1,) number of submaps from each one to the next one.
        loops: between them.
    """
    steps = [
        ((i, j, multiply(invert(start[i]), start[j])), _ODOMETRY * np.sqrt(lengths[i]))
        for i, j in pairwise(range(len(start)))
    ]
    while loops:
        solved = start.copy()
        for _ in range(3):
            matrix = np.zeros((6 * len(start),) * 2)
            right = np.zeros(6 * len(start))
            matrix[np.arange(6), np.arange(6)] = 1e12  # the first pose stays
            for (i, j, motion), error in [*steps, *((loop[:3], _LOOP) for loop in loops)]:
                _add(matrix, right, solved, i, j, motion, error)
            move(solved, solve_positive(matrix, right).reshape(-1, 6), 0)
        left = [
            np.abs(small_motions(multiply(invert(solved[i]), solved[j], invert(motion))[None])[0])
            for i, j, motion, _ in loops
        ]
        limits = np.repeat([_AGREE_M, _AGREE_RAD], 3)
        off = [float((one / limits).max()) for one in left]
        if max(off) < 1.0:
            return loops, solved
        loops = [
            loop for loop, value in zip(loops, off, strict=True) if value < max(1.0, max(off) / 2)
        ]
    return loops, start


def _add(
    matrix: FloatArray,
    right: FloatArray,
    poses: FloatArray,
    i: int,
    j: int,
    motion: Transform,
    error: FloatArray,
) -> None:
    """Add the motion from one pose to another to the normal equations of all."""
    should = multiply(poses[i], motion)
    off = np.append(
        poses[j, :3, 3] - should[:3, 3],
        small_motions(multiply(poses[j], invert(should))[None])[0, 3:],
    )
    x, y, z = should[:3, 3] - poses[i, :3, 3]
    # of `off` by the steps of the two poses: see `move`
    slope = np.hstack([-np.eye(6), np.eye(6)])
    slope[:3, 3:6] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    weights = error**-2.0
    rows = np.append(np.arange(6 * i, 6 * i + 6), np.arange(6 * j, 6 * j + 6))
    matrix[np.ix_(rows, rows)] += squares_of(slope, weights)
    right[rows] -= ((weights * off)[:, None] * slope).sum(axis=0)
