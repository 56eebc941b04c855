"""Registration: the position and the turn of an upright actor at which its points lie on the planes of what was seen of it before."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from carlasc.core.compiling import cached
from carlasc.core.geometry import Transform, rotation_z
from carlasc.motion.planes import Planes, nearest_within
from carlasc.motion.solving import solve_positive

_ITERATIONS = 8
_FIRST_REACH_M, _LAST_REACH_M = 1.0, 0.3  # maximum distance of paired points; it decreases with each iteration
_DEVIATIONS = 2.0  # the first reach is at least so many standard deviations of the prediction
_POINT_M, _INDEPENDENT = 0.05, 200  # error of a point, and the number of points with independent errors
_VARIANCE_M2 = _POINT_M**2
_ROBUST = 0.3  # fraction of the reach; pairs farther from their plane get less weight
_ENDS_M = 0.12  # error of the shift of the ends of what is seen
_FEWEST = 3  # pairs that count


def pose_of(state: NDArray[np.float64]) -> Transform:
    """Return the (4, 4) pose of an upright actor with the (4,) state x, y, z in metres, and yaw in radians."""
    pose = rotation_z(float(state[3]))
    pose[:3, 3] = state[:3]
    return pose


def register(
    points: NDArray[np.float64],
    model: Planes,
    predicted: NDArray[np.float64],
    error: NDArray[np.float64],
    previous: NDArray[np.float64],
    shifts: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the state, near the predicted one, that registers points to the planes of the model.

    Args:
        points: (N, 3) points of the sighting, metres, world.
        model: what was seen of the actor so far.
        predicted: (4,) predicted state: x, y, z in metres, and yaw in radians.
        error: (4,) standard deviation of the prediction.
        previous: (3,) position at the sighting before, metres, world.
        shifts: (K, 4) directions in which the ends of what is seen moved since then, and how far, in metres.
    """
    state: NDArray[np.float64] = _register(
        points, *model.in_order, model.points, model.normals, predicted, error, previous, shifts
    )
    return state


@cached(error_model="python")
def _register(
    points: NDArray[np.float64],
    ordered: NDArray[np.float64],
    order: NDArray[np.int64],
    axis: int,
    model: NDArray[np.float64],
    normals: NDArray[np.float64],
    predicted: NDArray[np.float64],
    error: NDArray[np.float64],
    previous: NDArray[np.float64],
    shifts: NDArray[np.float64],
) -> NDArray[np.float64]:
    """As `register`, with the model's (M, 3) points and normals, and what `Planes.in_order` gives."""
    state, prior = predicted.copy(), 1 / (error * error)
    first_reach = max(_FIRST_REACH_M, _DEVIATIONS * max(error[0], error[1]))
    pose, slope = np.eye(4), np.empty(4)
    for iteration in range(_ITERATIONS):
        reach = first_reach * (_LAST_REACH_M / first_reach) ** (iteration / (_ITERATIONS - 1))
        cos, sin = math.cos(state[3]), math.sin(state[3])
        pose[0, 0], pose[0, 1], pose[1, 0], pose[1, 1] = cos, -sin, sin, cos
        pose[:3, 3] = state[:3]
        information, pull = np.diag(prior), prior * (predicted - state)
        for way in shifts:  # the ends of what is seen are measured as well
            left = way[3]
            for a in range(3):
                left += way[a] * (previous[a] - state[a])
            for a in range(3):
                pull[a] += way[a] * left / _ENDS_M**2
                for b in range(3):
                    information[a, b] += way[a] * way[b] / _ENDS_M**2
        rows, nearest = nearest_within(points, pose, ordered, order, axis, reach * reach)
        scale, share = max(2 * _POINT_M, _ROBUST * reach), min(1.0, _INDEPENDENT / max(len(rows), 1))
        for p in range(len(rows) if len(rows) >= _FEWEST else 0):
            k, point = nearest[p], points[rows[p]]
            arm_x, arm_y = model[k, 0] * cos - model[k, 1] * sin, model[k, 0] * sin + model[k, 1] * cos
            slope[0], slope[1] = normals[k, 0] * cos - normals[k, 1] * sin, normals[k, 0] * sin + normals[k, 1] * cos
            slope[2], slope[3] = normals[k, 2], arm_x * slope[1] - arm_y * slope[0]
            off = (point[0] - state[0] - arm_x) * slope[0] + (point[1] - state[1] - arm_y) * slope[1]
            off += (point[2] - state[2] - model[k, 2]) * slope[2]
            weight = share / _VARIANCE_M2 / (1 + (off / scale) ** 2)
            for a in range(4):
                pull[a] += slope[a] * weight * off
                for b in range(a + 1):  # the lower half is read
                    information[a, b] += slope[a] * weight * slope[b]
        state += solve_positive(information, pull)
    return state
