"""Small linear problems, solved with the same bits on every processor; smoothing and resampling
over time; headings; pairs of least cost.

`np.linalg` is not used: LAPACK rounds differently on different processors.
"""

from __future__ import annotations

import numpy as np

from carlasc.core.arrays import FloatArray, IntArray
from carlasc.core.compiling import cached, inlined

_HEADING_SPEED_M_S = 1.0  # above it, the heading is the direction of motion
_SWEEPS = 12  # greatest number for Jacobi's method, which takes about five


@cached(error_model="python")
def least_squares(design: FloatArray, values: FloatArray) -> FloatArray:
    """Return the (K, D) parameters x for which `design @ x` is nearest to the values; the columns
    are orthogonalised one after the other.

    Args:
        design: (N, K), N >= 1. The parameter of a column that depends on earlier columns is 0.
        values: (N, D).
    """
    count, columns, wide = design.shape[0], design.shape[1], values.shape[1]
    # Gram-Schmidt: invariant of the loop over k is that the first k columns of `basis` are
    # orthonormal or zero, and that design = basis @ upper. Loops, not `@`, add in the order that is
    # written.
    basis = design.copy()
    upper = np.zeros((columns, columns))
    fit = np.zeros((columns, wide))
    left = values.copy()
    for k in range(columns):
        whole = 0.0
        for i in range(count):
            whole += basis[i, k] * basis[i, k]
        for _ in range(2):  # the second pass removes the rounding errors of the first
            for j in range(k):
                along = 0.0
                for i in range(count):
                    along += basis[i, j] * basis[i, k]
                upper[j, k] += along
                for i in range(count):
                    basis[i, k] -= along * basis[i, j]
        length = 0.0
        for i in range(count):
            length += basis[i, k] * basis[i, k]
        # 1e-13 of its length is left, squared: the rounding errors of a column that is a sum of
        # others.
        if length <= 1e-26 * whole:
            for i in range(count):
                basis[i, k] = 0.0
            continue
        upper[k, k] = np.sqrt(length)
        for i in range(count):
            basis[i, k] /= upper[k, k]
        for d in range(wide):
            along = 0.0
            for i in range(count):
                along += basis[i, k] * left[i, d]
            fit[k, d] = along
            for i in range(count):
                left[i, d] -= along * basis[i, k]
    # Back substitution: the last parameter is alone in its equation, the others follow.
    for d in range(wide):
        for k in range(columns - 1, -1, -1):
            rest = fit[k, d]
            for j in range(k + 1, columns):
                rest -= upper[k, j] * fit[j, d]
            fit[k, d] = rest / upper[k, k] if upper[k, k] > 0 else 0.0
    return fit


@cached
def solve_positive(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Return the (N,) solution of a positive definite system, by Cholesky's method.

    Args:
        matrix: (N, N); its lower half is read, and overwritten.
        right: (N,).
    """
    count = len(right)
    solution, column = right.copy(), np.empty(count)
    # Forward elimination with the lower factor, column by column; `matrix` becomes the factor. The
    # systems are banded, since few scans see the same planes: rows of zeros are skipped.
    for k in range(count):
        root = np.sqrt(matrix[k, k])
        solution[k] /= root
        for i in range(k, count):
            matrix[i, k] /= root
            column[i] = matrix[i, k]
        for i in range(k + 1, count):
            lower = column[i]
            if lower != 0.0:
                solution[i] -= lower * solution[k]
                for j in range(k + 1, i + 1):
                    matrix[i, j] -= lower * column[j]
    # Then the transposed factor, from the last unknown to the first.
    for k in range(count - 1, -1, -1):
        solution[k] /= matrix[k, k]
        for i in range(k):
            solution[i] -= matrix[k, i] * solution[k]
    return solution


@inlined
def _turn(matrix: FloatArray, p: int, q: int, cos: float, sin: float) -> None:
    """Turn the columns `p` and `q` of a matrix in their plane."""
    for k in range(3):
        matrix[k, p], matrix[k, q] = (
            cos * matrix[k, p] - sin * matrix[k, q],
            sin * matrix[k, p] + cos * matrix[k, q],
        )


@cached(error_model="python")
def principal_axes(
    covariances: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the eigenvalues of symmetric matrices, increasing, and their eigenvectors, by Jacobi's
    method.

    Args:
        covariances: (N, 3, 3).

    Returns:
        (N, 3) eigenvalues and (N, 3, 3) unit eigenvectors in columns. The sign of a vector is
        reproducible, but follows no rule.
    """
    values = np.empty((len(covariances), 3))
    vectors = np.empty((len(covariances), 3, 3))
    for n in range(len(covariances)):
        # Invariant: covariance = v @ a @ v.T. Each turn makes one element off the diagonal zero,
        # and the sum of their squares falls, faster with each sweep (Golub and Van Loan, 8.5).
        a, v = covariances[n].copy(), np.eye(3)
        for _ in range(_SWEEPS):
            size = abs(a[0, 0]) + abs(a[1, 1]) + abs(a[2, 2])
            if abs(a[0, 1]) + abs(a[0, 2]) + abs(a[1, 2]) <= 1e-18 * size:
                break
            for p in range(2):
                for q in range(p + 1, 3):
                    if a[p, q] == 0.0:
                        continue
                    # The smaller of the two angles that make a[p, q] zero: with it, the method
                    # converges.
                    ratio = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
                    tangent = (1.0 if ratio >= 0 else -1.0) / (
                        abs(ratio) + np.sqrt(ratio * ratio + 1.0)
                    )
                    cos = 1.0 / np.sqrt(tangent * tangent + 1.0)
                    sin = tangent * cos
                    _turn(a, p, q, cos, sin)
                    _turn(a.T, p, q, cos, sin)
                    _turn(v, p, q, cos, sin)
        # The diagonal has no order; the normal of a plane is the vector of the smallest value.
        diagonal = np.diag(a)
        order = np.argsort(diagonal)
        values[n], vectors[n] = diagonal[order], v[:, order]
    return values, vectors


def squares_of(vectors: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the (K, K) sum of the (N,) weights times the squares, v v^T, of (N, K) vectors."""
    squares = weights[:, None, None] * vectors[:, :, None] * vectors[:, None, :]
    return np.asarray(squares.sum(axis=0))


def nearest_rotation(matrix: FloatArray) -> FloatArray:
    """Return the (3, 3) rotation nearest to a (3, 3) mean of rotations; the identity if these have
    no mean direction.
    """
    rotation = matrix
    # Newton's method for the polar decomposition: four or five steps for similar rotations
    for _ in range(30):
        rows = np.cross(rotation[[1, 2, 0]], rotation[[2, 0, 1]])
        volume = float((rotation[0] * rows[0]).sum())
        if volume < 1e-12:
            return np.eye(3)
        rotation = (rotation + rows / volume) / 2
    return rotation


def smooth(
    values: FloatArray,
    seconds: FloatArray,
    weights: FloatArray,
    half_s: float,
) -> tuple[FloatArray, FloatArray]:
    """Fit a parabola around each time, robustly; a straight line if there are few values.

    Args:
        values: (F, D).
        seconds: (F,) times, rising.
        weights: (F,) of the values.
        half_s: half width of the window of each fit, seconds. It grows until it holds four values.

    Returns:
        The (F, D) values of the fits, and their (F, D) derivatives per second.
    """
    smoothed, slopes = values.copy(), np.zeros_like(values)
    for index in range(len(seconds)):
        smoothed[index], slopes[index] = smooth_at(index, values, seconds, weights, half_s)
    return smoothed, slopes


@cached(error_model="python")
def smooth_at(
    index: int,
    values: FloatArray,
    seconds: FloatArray,
    weights: FloatArray,
    half_s: float,
) -> tuple[FloatArray, FloatArray]:
    """Return the (D,) value and the (D,) derivative of `smooth` at one index."""
    distance = np.abs(seconds - seconds[index])
    near = np.flatnonzero(distance <= half_s + 1e-9)
    if len(near) < 4:
        near = np.sort(np.argsort(distance, kind="mergesort")[:4])
    offsets, own = seconds[near] - seconds[index], values[near]
    degree = 2 if len(near) > 5 else 1 if len(near) > 1 else 0
    rows = np.ones((len(near), degree + 1))
    for k in range(degree):
        rows[:, k + 1] = rows[:, k] * offsets
    farthest = max(np.abs(offsets).max(), 1e-9)
    weight = weights[near] * (1 - 0.9 * (np.abs(offsets) / farthest) ** 3)
    fit = np.zeros((2, values.shape[1]))
    for _ in range(3):  # reweighted, so that partly hidden actors do not bend the path
        root = np.sqrt(weight).reshape(-1, 1)
        fit = least_squares(rows * root, own * root)
        left = own.copy()
        for k in range(degree + 1):
            left -= rows[:, k].copy().reshape(-1, 1) * fit[k]
        error = np.sqrt((left * left).sum(axis=1))
        weight = weight / (1 + (error / max(3 * np.median(error), 0.02)) ** 2)
    return fit[0], fit[1] if degree else np.zeros_like(fit[0])


def resample(
    at: FloatArray,
    seconds: FloatArray,
    positions: FloatArray,
    velocities: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return positions and velocities at other times: linear between the known times, at constant
    velocity beyond.

    Args:
        at: (A,) the other times, seconds.
        seconds: (F,) the known times, increasing.
        positions: (F, 3) metres.
        velocities: (F, 3) m/s.

    Returns:
        (A, 3) positions and (A, 3) velocities.
    """
    path, speed = (
        np.column_stack([np.interp(at, seconds, column) for column in values.T])
        for values in (positions, velocities)
    )
    beyond = np.minimum(at - seconds[0], 0) + np.maximum(at - seconds[-1], 0)
    return path + speed * beyond[:, None], speed


def headings_of(velocities: FloatArray) -> FloatArray:
    """Return (F,) headings in radians, unwrapped: the direction of (F, 3) velocities, interpolated
    while the actor is slow.
    """
    fast = fast_rows(velocities)
    if not len(fast):
        mean = velocities.mean(axis=0)
        return np.full(len(velocities), np.arctan2(mean[1], mean[0]))
    angles = np.unwrap(np.arctan2(velocities[fast, 1], velocities[fast, 0]))
    return np.interp(np.arange(len(velocities)), fast, angles)


def fast_rows(velocities: FloatArray) -> IntArray:
    """Return at which of (F, 3) velocities an actor moves fast enough to show where it points."""
    return np.flatnonzero(np.hypot(velocities[:, 0], velocities[:, 1]) > _HEADING_SPEED_M_S)


def best_pairs(costs: list[tuple[float, int, int]]) -> dict[int, int]:
    """Pair first and second numbers by (cost, first, second), the lowest cost first, each number
    once; return the second by the first.
    """
    taken: dict[int, int] = {}
    for _, i, j in sorted(costs):
        if i not in taken and j not in taken.values():
            taken[i] = j
    return taken
