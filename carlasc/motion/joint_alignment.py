"""Joint alignment: the poses of many scans, estimated at once, so that the points of all scans on a
surface lie on one plane.

The points of each scan are grouped into the cells of a grid in the world. A group is a cluster, and
is kept as the sums of its points. The clusters of several scans in one cell give a plane if they
are flat together. The poses then move the clusters towards these planes: all poses are in one
linear system, from which the positions of the planes are eliminated. This is repeated, first with
large cells, then with small ones. (Liu et al., "Efficient and Consistent Bundle Adjustment on Lidar
Point Clouds", T-RO 2023, use the second derivative. With fixed normals the first one is enough, as
the errors here are small.)

A plane is made of the scans of one block, which are 60 consecutive ones, and blocks overlap by
half. Scans that are farther apart in time, and may have drifted, are therefore not aligned to each
other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from carlasc.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from carlasc.core.cells import run_starts
from carlasc.core.compiling import cached, jit
from carlasc.core.geometry import thin
from carlasc.motion.planes import SQUARES, SUMS
from carlasc.motion.solving import principal_axes, solve_positive, squares_of

HALF_BLOCK = 30
"""Half of the number of scans in a block.

Scans that are at most so far apart are always compared.
"""

_MIN_SCANS, _MIN_POINTS = 3, 8  # least numbers of a plane
POINT_M = 0.03  # error of a point
_EQUAL = 4  # greatest number of points of a cluster that count
_INDEPENDENT = 0.1  # share of the clusters whose errors are independent
# squared distance to a plane, in standard deviations, above which a cluster has less weight
_OUTLIER = 9.0
_DETERMINED = 0.003  # least share of the planes, by weight, that determine a direction
_STEEP, _SLANTED = 0.8, 0.3  # |z| of the normals of ground, and of slopes
_PER_DIRECTION = 300  # greatest number of planes per direction: more add little
# Standard deviations of the prior, metres and radians: of a pose about the given pose, and of the
# change of a pose about the change of the previous one; as weights.
_PRIOR = np.array([2.0, math.radians(4.0), 0.1, math.radians(0.5)]) ** -2.0
_MIX = np.int64(-7046029254386353131)  # spreads the keys of cells over a hash table
_BITS = 21  # of the index of a cell along an axis; indices that differ by 2^21 share a key


class AlignmentPass(NamedTuple):
    """One pass over the cells.

    Attributes:
        cell_m: size of a cell.
        repeats: number of steps.
        thick_m: greatest standard deviation of a plane along its normal.
        flat: greatest variance of a plane along its normal, as a share of the variance along its
            second axis.
        wide_m2: least variance of a plane along its second axis: narrower clusters are lines.
        joined: number of the passes before it whose planes count too.
    """

    cell_m: float
    repeats: int
    thick_m: float
    flat: float
    wide_m2: float = 0.02
    joined: int = 0


PASSES = (AlignmentPass(2.0, 5, 0.35, 0.1), AlignmentPass(1.0, 6, 0.12, 0.03))


class Clusters(NamedTuple):
    """The clusters of the scans of a block, sorted by cell.

    Attributes:
        start: (G + 1,) the first cluster of each cell.
        scan: (C,) row in the poses of the scan of each cluster.
        sums: (C, 10) sums of the points of each cluster, metres, from its sensor, on the axes of
            the world.
    """

    start: IntArray
    scan: IntArray
    sums: FloatArray


def align(
    points: Sequence[Float32Array],
    start: FloatArray,
    given: FloatArray,
    fixed: int = 0,
    passes: Sequence[AlignmentPass] = PASSES,
    prior: FloatArray = _PRIOR,
) -> FloatArray:
    """Return the poses under which scans agree best.

    Args:
        points: (N, 3) of each scan, metres, frame of the sensor.
        start: (F, 4, 4) initial world_T_sensor of the scans, in order of time, with errors of at
            most some decimetres.
        given: (F, 4, 4) poses of the prior, which hold where the scans do not determine a pose.
        fixed: number of scans at the beginning whose poses stay.
        passes: over the cells, one after the other.
        prior: (4,) weights of the prior: see `_PRIOR`.

    Returns:
        (F, 4, 4) world_T_sensor.
    """
    poses, free = start.copy(), len(points) - fixed
    if free < 1:
        return poses
    # Large cells first: they still hold the same surface in all scans while poses are wrong by
    # decimetres. Small cells are flat where large ones are not, and decide the last centimetres.
    for number, one in enumerate(passes):
        for repeat in range(one.repeats):
            matrix, right = np.zeros((6 * free, 6 * free)), np.zeros(6 * free)
            # Every other step moves the cells by half, so that no surface is cut at the same places
            # in all steps. Normals are found anew in each step, and are fixed within it.
            for size in passes[number - one.joined : number + 1]:
                for block in blocks(points, poses, size.cell_m, shift=0.5 * (repeat % 2)):
                    normals, thickness = planes(block, poses, size)
                    chosen = _choose(normals, thickness)
                    slopes = _determined(normals, thickness, chosen)
                    add_planes(
                        block, poses, normals, slopes, thickness, chosen, fixed, matrix, right
                    )
            add_given(poses, given, prior, fixed, matrix, right)
            move(poses, solve_positive(matrix, right).reshape(-1, 6), fixed)
    return poses


def blocks(
    points: Sequence[Float32Array], poses: FloatArray, cell_m: float, shift: float
) -> list[Clusters]:
    """Return the clusters of each block; `shift` moves the cells by a share of their size."""
    per_scan = [clusters(own, pose, cell_m, shift) for own, pose in zip(points, poses, strict=True)]
    grouped = []
    for first in range(0, max(len(points) - HALF_BLOCK, 1), HALF_BLOCK):
        block = per_scan[first : first + 2 * HALF_BLOCK]
        keys = np.concatenate([keys for keys, _ in block])
        # A stable sort keeps the scans of a cell in order, so sums are rounded the same everywhere.
        order = np.argsort(keys, kind="stable")
        begins = run_starts(keys[order])
        scan = np.repeat(np.arange(first, first + len(block)), [len(keys) for keys, _ in block])
        sums = np.concatenate([sums for _, sums in block])
        grouped.append(Clusters(np.append(begins, len(keys)), scan[order], sums[order]))
    return grouped


def _choose(normals: FloatArray, thickness: FloatArray) -> IntArray:
    """Return the planes that are used: about the same number for each of six directions, spread
    over the scene.
    """
    rows = np.flatnonzero(thickness >= 0)
    x, y, z = normals[rows].T
    upright = np.abs(z)
    # Four quarters of the compass for walls, by which axis is greater and by the sign of x y: a
    # normal and its opposite are in the same quarter. Without limits, ground would outvote walls.
    wall = 2 + 2 * (np.abs(x) > np.abs(y)) + (x * y > 0)
    direction = np.where(upright > _STEEP, 0, np.where(upright > _SLANTED, 1, wall))
    alike = (rows[direction == number] for number in range(6))
    return np.concatenate([thin(own, _PER_DIRECTION) for own in alike])


def _determined(normals: FloatArray, thickness: FloatArray, chosen: IntArray) -> FloatArray:
    """Return normals without their components along undetermined directions, as of a tunnel."""
    own = normals[chosen]
    weights = 1.0 / (POINT_M**2 + thickness[chosen])
    # The eigenvectors of the sum of all normals' squares are the directions in which planes hold
    # the poses. Where the sum is small, noise would move the poses: the prior holds them there.
    values, vectors = principal_axes(squares_of(own, weights)[None])
    slopes = normals.copy()
    for value, vector in zip(values[0], vectors[0].T, strict=True):
        if value < _DETERMINED * values.sum():
            slopes -= (normals * vector).sum(axis=1)[:, None] * vector
    return slopes


@jit
def cell_key(x: float, y: float, z: float) -> int:
    """Return the key of the cell of a position, which is given in sizes of a cell."""
    low = (1 << _BITS) - 1
    return (math.floor(x) & low) << 2 * _BITS | (math.floor(y) & low) << _BITS | math.floor(z) & low


@cached
def clusters(
    points: Float32Array, pose: FloatArray, cell_m: float, shift: float
) -> tuple[IntArray, FloatArray]:
    """Return the (C,) keys of the cells in which a scan has points, and the (C, 10) sums of these
    points.
    """
    # A hash table of a power of two, at most half full: a search ends after a few places. Rows are
    # given in the order of the points, so that sums do not depend on the table.
    size = 16
    while size < 2 * len(points):
        size *= 2
    table = np.full(size, -1, np.int64)
    keys = np.empty(len(points), np.int64)
    sums = np.zeros((len(points), SUMS))
    count = 0
    seen, at = np.empty(3), np.empty(3)
    for i in range(len(points)):
        for a in range(3):
            seen[a] = (
                pose[a, 0] * points[i, 0] + pose[a, 1] * points[i, 1] + pose[a, 2] * points[i, 2]
            )
            at[a] = (seen[a] + pose[a, 3]) / cell_m + shift
        key = cell_key(at[0], at[1], at[2])
        place = ((key * _MIX) >> 20) & (size - 1)
        while table[place] >= 0 and keys[table[place]] != key:
            place = (place + 1) & (size - 1)
        if table[place] < 0:
            table[place], keys[count] = count, key
            count += 1
        row, x, y, z = table[place], seen[0], seen[1], seen[2]
        for k, value in enumerate((1.0, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z)):
            sums[row, k] += value
    return keys[:count].copy(), sums[:count].copy()


def planes(
    block: Clusters, poses: FloatArray, limits: AlignmentPass
) -> tuple[FloatArray, FloatArray]:
    """Return the (G, 3) normals of the planes in cells, and their (G,) variances along the normals,
    metres squared; -1 without a plane.
    """
    enough, covariances = spread_of(block, poses, _MIN_SCANS)
    values, vectors = principal_axes(covariances)
    flat = enough & (values[:, 0] < limits.thick_m**2) & (values[:, 0] < limits.flat * values[:, 1])
    flat &= values[:, 1] > limits.wide_m2
    return vectors[:, :, 0], np.where(flat, np.maximum(values[:, 0], 0.0), -1.0)


@cached
def spread_of(block: Clusters, poses: FloatArray, scans: int) -> tuple[BoolArray, FloatArray]:
    """Return (G,) whether a cell has points of enough scans, and the (G, 3, 3) covariances of its
    points. The weight of a scan is limited.
    """
    start, scan, sums = block
    cells = len(start) - 1
    enough, covariances = np.zeros(cells, np.bool_), np.zeros((cells, 3, 3))
    total, to, center = np.empty(SUMS), np.empty(3), np.empty(3)
    for g in range(cells):
        first = start[g]
        if start[g + 1] - first < scans:
            continue
        for a in range(3):  # sums are relative to a nearby centre, so that rounding is small
            center[a] = poses[scan[first], a, 3] + sums[first, 1 + a] / sums[first, 0]
        total[:] = 0.0
        for r in range(first, start[g + 1]):
            # A near scan has hundreds of points in a cell and a far one has three: beyond `_EQUAL`,
            # points repeat what the others say, so that no scan alone gives the plane.
            weight = min(sums[r, 0], _EQUAL) / sums[r, 0]
            for a in range(3):
                to[a] = poses[scan[r], a, 3] - center[a]
            total[0] += weight * sums[r, 0]
            for a in range(3):
                total[1 + a] += weight * (sums[r, 1 + a] + sums[r, 0] * to[a])
                for b in range(a, 3):
                    k = SQUARES[a, b]
                    # The sums of squares about the new centre, by the theorem of parallel axes:
                    # clusters are summed once per step, and the points are not read again.
                    moved = (
                        sums[r, k]
                        + to[a] * sums[r, 1 + b]
                        + to[b] * sums[r, 1 + a]
                        + sums[r, 0] * to[a] * to[b]
                    )
                    total[k] += weight * moved
        enough[g] = total[0] >= _MIN_POINTS
        for a in range(3):
            for b in range(3):
                mean = total[1 + a] * total[1 + b] / (total[0] * total[0])
                covariances[g, a, b] = total[SQUARES[a, b]] / total[0] - mean
    return enough, covariances


@jit
def to_plane(
    scan: IntArray,
    sums: FloatArray,
    poses: FloatArray,
    normal: FloatArray,
    variance: float,
) -> tuple[FloatArray, FloatArray]:
    """Return the (C,) distances of clusters from their plane, along its normal, and their (C,)
    weights; outliers have less.
    """
    off, weight = np.empty(len(scan)), np.empty(len(scan))
    for i in range(len(scan)):
        off[i] = 0.0
        for a in range(3):
            off[i] += normal[a] * (sums[i, 1 + a] / sums[i, 0] + poses[scan[i], a, 3])
    # The position of a plane is the weighted mean of its clusters, so it is eliminated: distances
    # are relative to it. Weights and mean depend on each other, and settle within four rounds.
    for repeat in range(4):
        total = level = 0.0
        for i in range(len(scan)):
            robust = 1.0 if repeat == 0 else 1.0 / (1.0 + off[i] * off[i] / (_OUTLIER * variance))
            weight[i] = robust * robust * min(sums[i, 0], _EQUAL) / variance
            total += weight[i]
            level += weight[i] * off[i]
        off -= level / total
    return off, weight


@cached
def add_planes(
    block: Clusters,
    poses: FloatArray,
    normals: FloatArray,
    slopes: FloatArray,
    thickness: FloatArray,
    chosen: IntArray,
    fixed: int,
    matrix: FloatArray,
    right: FloatArray,
) -> None:
    """Add the chosen planes to the normal equations of the poses from `fixed` on: `right`, and the
    lower half of `matrix`.

    `slopes` are the normals without their undetermined components: see `_determined`.
    """
    for g in chosen:
        first, last, normal = block.start[g], block.start[g + 1], slopes[g]
        scan, sums = block.scan[first:last], block.sums[first:last]
        off, weight = to_plane(scan, sums, poses, normals[g], POINT_M * POINT_M + thickness[g])
        slope = np.empty((len(scan), 6))
        for i in range(len(scan)):
            x = sums[i, 1] / sums[i, 0]
            y = sums[i, 2] / sums[i, 0]
            z = sums[i, 3] / sums[i, 0]
            # The derivative of a distance by the step of its pose: the normal, and for the rotation
            # the cross product of the point, from the sensor, and the normal. See `move`.
            slope[i, :3] = normal
            slope[i, 3] = y * normal[2] - z * normal[1]
            slope[i, 4] = z * normal[0] - x * normal[2]
            slope[i, 5] = x * normal[1] - y * normal[0]
        total = weight.sum()
        for i in range(len(scan)):
            # Points of one cluster share the errors of their surface and of their scan: only a
            # share of their weight is counted as independent. Scans before `fixed` only hold the
            # plane.
            own, share = 6 * (scan[i] - fixed), _INDEPENDENT * weight[i]
            if own < 0:
                continue
            for k in range(6):
                right[own + k] -= share * off[i] * slope[i, k]
                for m in range(6):
                    matrix[own + k, own + m] += share * slope[i, k] * slope[i, m]
            # The plane's own position is eliminated (the Schur complement): what remains couples
            # each pair of scans that see it. Only the lower half is filled, because the matrix is
            # symmetric.
            for j in range(len(scan)):
                other = 6 * (scan[j] - fixed)
                if 0 <= other <= own:
                    both = share * weight[j] / total
                    for k in range(6):
                        for m in range(6):
                            matrix[own + k, other + m] -= both * slope[i, k] * slope[j, m]


@jit
def _turn_between(one: FloatArray, other: FloatArray, axis: int) -> float:
    """Return one component of the small rotation vector between the rotations of two poses, on the
    axes of the world.
    """
    low, high = (axis + 1) % 3, (axis + 2) % 3
    value = 0.0
    for k in range(3):
        value += other[high, k] * one[low, k] - other[low, k] * one[high, k]
    return value / 2.0


@cached
def add_given(
    poses: FloatArray,
    given: FloatArray,
    weights: FloatArray,
    fixed: int,
    matrix: FloatArray,
    right: FloatArray,
) -> None:
    """Add the prior to the normal equations: each pose is near the given one, and its change near
    the change of the previous one.
    """
    count = len(poses)
    change = np.empty((count, 6))
    for i in range(count):
        for a in range(3):
            change[i, a] = poses[i, a, 3] - given[i, a, 3]
            change[i, 3 + a] = _turn_between(given[i], poses[i], a)
    for i in range(fixed, count):
        own = 6 * (i - fixed)
        for k in range(6):
            held, near = weights[k // 3], weights[2 + k // 3]
            matrix[own + k, own + k] += held
            right[own + k] -= held * change[i, k]
            if i == 0:
                continue
            matrix[own + k, own + k] += near
            right[own + k] -= near * (change[i, k] - change[i - 1, k])
            if i > fixed:
                # The change between two free poses pulls both, with opposite signs.
                matrix[own + k - 6, own + k - 6] += near
                matrix[own + k, own + k - 6] -= near
                right[own + k - 6] += near * (change[i, k] - change[i - 1, k])


@cached
def move(poses: FloatArray, steps: FloatArray, fixed: int) -> None:
    """Change the poses from `fixed` on by (F - fixed, 6) small translations and rotation vectors on
    the axes of the world.
    """
    for i in range(len(steps)):
        pose, (x, y, z) = poses[fixed + i], steps[i, 3:]
        for a in range(3):
            pose[a, 3] += steps[i, a]
        half = math.sqrt(x * x + y * y + z * z) / 2.0
        # The quaternion of the rotation vector. For tiny angles, the quotient is its limit, 1/2.
        # Unlike I + [w]x, the rotation stays exact, so that poses need no repair after the steps.
        scale = 0.5 if half < 1e-9 else math.sin(half) / (2.0 * half)
        w, x, y, z = math.cos(half), scale * x, scale * y, scale * z
        turn = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        for b in range(3):
            p, q, r = pose[0, b], pose[1, b], pose[2, b]
            for a in range(3):
                pose[a, b] = turn[a, 0] * p + turn[a, 1] * q + turn[a, 2] * r
