"""The model of a rigid actor: its points so far with the planes around them, and the registration
of an observation to these planes.

Registration finds the position and the yaw of an upright actor at which its points lie on the
planes.

The model grows with each observation, and only the new part is computed. Each point keeps the sums
that give its plane. New points are added to the sums of their neighbours in the order of a sum over
all points, so the planes have the same bits as if computed again.
"""

from __future__ import annotations

import math

import numpy as np

from carlasc.core.arrays import BoolArray, FloatArray, IntArray
from carlasc.core.cells import cells_of, first_of_cells
from carlasc.core.compiling import cached
from carlasc.core.geometry import Transform, rotation_z, thin
from carlasc.motion.solving import principal_axes, solve_positive

_CELL_M, _POINTS = 0.15, 1200  # a model has one point per cell, and at most this number of points
_PLANE_M = 0.5  # radius of the neighbourhood in which planes are estimated
_LINE_M = 0.06  # points with a smaller standard deviation across are a line and have no plane
SUMS = 10  # 1, x, y, z, xx, xy, xz, yy, yz, zz
# positions of the last six in a (3, 3) matrix
SQUARES = np.array([[4, 5, 6], [5, 7, 8], [6, 8, 9]])


class Planes:
    """The points of an actor so far, and the planes around them.

    Attributes:
        points: (M, 3) metres, actor frame.
        normals: (M, 3) normals of the planes. Their length, at most 1, grows with the flatness of
            the points. The normal of a single point or of a line has length 0.
        in_order: (M, 3) points, sorted along the axis of their largest extent, the (M,) index of
            each in `points`, and this axis; known after `add`.
    """

    def __init__(self) -> None:
        """Start without points: add some before the first registration."""
        self.points, self.normals, self._sums = (
            np.empty((0, 3)),
            np.empty((0, 3)),
            np.empty((0, SUMS)),
        )

    def add(self, points: FloatArray) -> None:
        """Add the (N, 3) points, metres, actor frame, that are in cells without a point."""
        joined, known = np.concatenate([self.points, points]), len(self.points)
        joined = joined[first_of_cells(cells_of(joined, _CELL_M))]
        if len(joined) > _POINTS:
            joined, known = thin(joined, _POINTS), 0
        elif len(joined) == known:
            return
        normals = np.zeros((len(joined), 3))
        sums = np.zeros((len(joined), SUMS))
        normals[:known] = self.normals[:known]
        sums[:known] = self._sums[:known]
        changed = extend_sums(joined, known, _PLANE_M, sums)
        normals[changed] = _normals(covariances(sums[changed]))
        self.points, self.normals, self._sums = joined, normals, sums
        widest = int(np.ptp(joined, axis=0).argmax())
        order = np.argsort(joined[:, widest], kind="stable")
        self.in_order = joined[order], order, widest


def covariances(sums: FloatArray) -> FloatArray:
    """Return the (N, 3, 3) covariances of points from their (N, 10) sums: see `extend_sums`."""
    counts, totals = sums[:, 0, None, None], sums[:, 1:4]
    return sums[:, SQUARES] / counts - totals[:, :, None] * totals[:, None, :] / (counts * counts)


def _normals(covariances: FloatArray) -> FloatArray:
    """Return the (N, 3) normals of planes through points with (N, 3, 3) covariances."""
    values, vectors = principal_axes(covariances)
    flat = np.clip(1 - 3 * values[:, 0] / np.maximum(values[:, 1], 1e-6), 0.0, 1.0)
    flat[values[:, 1] < _LINE_M**2] = 0.0
    return vectors[:, :, 0] * np.sqrt(flat)[:, None]


@cached(error_model="python")
def extend_sums(model: FloatArray, known: int, radius: float, sums: FloatArray) -> BoolArray:
    """Add new points to the sums of the points within a radius of each point.

    Args:
        model: (M, 3) points.
        known: number of points, from the first, whose sums hold each other already.
        radius: of the neighbourhood.
        sums: (M, 10) sums over the neighbours of each point, of the offsets from it: 1, x, y, z,
            xx, xy, xz, yy, yz, zz. Is changed.

    Returns:
        (M,) whether the sums of a point changed.
    """
    changed = np.zeros(len(model), np.bool_)
    for i in range(len(model)):
        own = sums[i]
        for j in range(known if i < known else 0, len(model)):
            x, y, z = (
                model[j, 0] - model[i, 0],
                model[j, 1] - model[i, 1],
                model[j, 2] - model[i, 2],
            )
            if x * x + y * y + z * z < radius * radius:
                changed[i] = True
                terms = (1.0, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z)
                for k, term in enumerate(terms):
                    own[k] += term
    return changed


@cached(error_model="python")
def nearest_within(
    points: FloatArray,
    pose: FloatArray,
    model: FloatArray,
    order: IntArray,
    axis: int,
    squared: float,
) -> tuple[IntArray, IntArray]:
    """Pair each point with the nearest point of a model within a distance; the model is sorted
    along an axis.

    The search starts at the position of a point on the axis and goes outwards, until all other
    points are too far along this axis alone.

    Args:
        points: (N, 3) points.
        pose: (4, 4) from the frame of the model to the frame of the points, rigid.
        model: (M, 3) points, sorted.
        order: (M,) index of each point of the model before sorting.
        axis: the axis of sorting.
        squared: square of the greatest distance of a pair.

    Returns:
        (P,) indices of points that have a pair, increasing, and (P,) indices of their points of the
        model; the lowest index of equally near ones.
    """
    rows, nearest, moved = (
        np.empty(len(points), np.int64),
        np.empty(len(points), np.int64),
        np.empty(3),
    )
    place, count, last = np.empty(3), 0, len(model) - 1
    for a in range(3):  # the operations of `invert` and `transform_points`, in their order
        place[a] = -(pose[0, a] * pose[0, 3] + pose[1, a] * pose[1, 3] + pose[2, a] * pose[2, 3])
    for i in range(len(points)):
        for a in range(3):
            moved[a] = (
                points[i, 0] * pose[0, a] + points[i, 1] * pose[1, a] + points[i, 2] * pose[2, a]
            ) + place[a]
        before, after = -1, last + 1
        while after - before > 1:
            middle = (before + after) // 2
            if model[middle, axis] < moved[axis]:
                before = middle
            else:
                after = middle
        best, closest = squared, -1
        behind = moved[axis] - model[before, axis] if before >= 0 else np.inf
        ahead = model[after, axis] - moved[axis] if after <= last else np.inf
        while behind * behind <= best or ahead * ahead <= best:
            if behind < ahead:
                k, before = before, before - 1
                behind = moved[axis] - model[before, axis] if before >= 0 else np.inf
            else:
                k, after = after, after + 1
                ahead = model[after, axis] - moved[axis] if after <= last else np.inf
            x = moved[0] - model[k, 0]
            y = moved[1] - model[k, 1]
            z = moved[2] - model[k, 2]
            distance = x * x + y * y + z * z
            if distance < best or (distance == best and order[k] < closest):
                best, closest = distance, order[k]
        if closest >= 0:
            rows[count], nearest[count] = i, closest
            count += 1
    return rows[:count], nearest[:count]


@cached(error_model="python")
def nearest_points(points: FloatArray, model: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return (N,) the index of the model point nearest to each point, and (N,) the squared
    distance, by comparing all pairs.
    """
    index = np.zeros(len(points), np.int64)
    squared = np.full(len(points), np.inf)
    for i in range(len(points)):
        for j in range(len(model)):
            dx, dy, dz = (
                points[i, 0] - model[j, 0],
                points[i, 1] - model[j, 1],
                points[i, 2] - model[j, 2],
            )
            distance = dx * dx + dy * dy + dz * dz
            if distance < squared[i]:
                squared[i], index[i] = distance, j
    return index, squared


_ITERATIONS = 8
# maximum distance of paired points; it decreases with each iteration
_FIRST_REACH_M, _LAST_REACH_M = (
    1.0,
    0.3,
)
_DEVIATIONS = 2.0  # least first reach, in standard deviations of the prediction
# error of a point, and the number of points with independent errors
_POINT_M, _INDEPENDENT = (
    0.05,
    200,
)
_VARIANCE_M2 = _POINT_M**2
_ROBUST = 0.3  # fraction of the reach; pairs farther from their plane get less weight
_ENDS_M = 0.12  # error of the displacement of the ends of the visible part
_FEWEST = 3  # least number of pairs that count


def pose_of(state: FloatArray) -> Transform:
    """Return the (4, 4) pose of an upright actor with the (4,) state x, y, z in metres, and yaw in
    radians.
    """
    pose = rotation_z(float(state[3]))
    pose[:3, 3] = state[:3]
    return pose


def register(
    points: FloatArray,
    model: Planes,
    predicted: FloatArray,
    error: FloatArray,
    previous: FloatArray,
    shifts: FloatArray,
) -> FloatArray:
    """Return the state, near the predicted one, that registers points to the planes of the model.

    Args:
        points: (N, 3) points of the observation, metres, world.
        model: the points of the actor so far, and their planes.
        predicted: (4,) predicted state: x, y, z in metres, and yaw in radians.
        error: (4,) standard deviation of the prediction.
        previous: (3,) position at the previous observation, metres, world.
        shifts: (K, 4) directions in which the ends of the visible part moved since then, and their
            displacement, metres.
    """
    state: FloatArray = _register(
        points, *model.in_order, model.points, model.normals, predicted, error, previous, shifts
    )
    return state


@cached(error_model="python")
def _register(
    points: FloatArray,
    ordered: FloatArray,
    order: IntArray,
    axis: int,
    model: FloatArray,
    normals: FloatArray,
    predicted: FloatArray,
    error: FloatArray,
    previous: FloatArray,
    shifts: FloatArray,
) -> FloatArray:
    """As `register`, with the (M, 3) points and normals of the model, and the results of
    `Planes.in_order`.
    """
    state, prior = predicted.copy(), 1 / (error * error)
    first_reach = max(_FIRST_REACH_M, _DEVIATIONS * max(error[0], error[1]))
    pose, slope = np.eye(4), np.empty(4)
    for iteration in range(_ITERATIONS):
        reach = first_reach * (_LAST_REACH_M / first_reach) ** (iteration / (_ITERATIONS - 1))
        cos, sin = math.cos(state[3]), math.sin(state[3])
        pose[0, 0], pose[0, 1], pose[1, 0], pose[1, 1] = cos, -sin, sin, cos
        pose[:3, 3] = state[:3]
        information, right = np.diag(prior), prior * (predicted - state)
        for shift in shifts:  # the ends of the visible part are measured too
            left = shift[3]
            for a in range(3):
                left += shift[a] * (previous[a] - state[a])
            for a in range(3):
                right[a] += shift[a] * left / _ENDS_M**2
                for b in range(3):
                    information[a, b] += shift[a] * shift[b] / _ENDS_M**2
        rows, nearest = nearest_within(points, pose, ordered, order, axis, reach * reach)
        scale, share = (
            max(2 * _POINT_M, _ROBUST * reach),
            min(1.0, _INDEPENDENT / max(len(rows), 1)),
        )
        for p in range(len(rows) if len(rows) >= _FEWEST else 0):
            k, point = nearest[p], points[rows[p]]
            arm_x, arm_y = (
                model[k, 0] * cos - model[k, 1] * sin,
                model[k, 0] * sin + model[k, 1] * cos,
            )
            slope[0], slope[1] = (
                normals[k, 0] * cos - normals[k, 1] * sin,
                normals[k, 0] * sin + normals[k, 1] * cos,
            )
            slope[2], slope[3] = normals[k, 2], arm_x * slope[1] - arm_y * slope[0]
            off = (point[0] - state[0] - arm_x) * slope[0] + (point[1] - state[1] - arm_y) * slope[
                1
            ]
            off += (point[2] - state[2] - model[k, 2]) * slope[2]
            weight = share / _VARIANCE_M2 / (1 + (off / scale) ** 2)
            for a in range(4):
                right[a] += slope[a] * weight * off
                for b in range(a + 1):  # the lower half is read
                    information[a, b] += slope[a] * weight * slope[b]
        state += solve_positive(information, right)
    return state
