"""Small linear problems against LAPACK."""

import numpy as np
import pytest

from carlasc.core.geometry import rotation_z
from carlasc.motion.solving import least_squares, nearest_rotation, principal_axes


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (2, 2), (4, 2), (9, 3), (60, 3), (4, 4)])
def test_parameters_are_those_of_lapack(rows, columns):
    rng = np.random.default_rng(rows)
    design, values = rng.normal(size=(rows, columns)), rng.normal(size=(rows, 3))
    assert np.allclose(least_squares(design, values), np.linalg.lstsq(design, values, rcond=None)[0], atol=1e-12)


def test_a_column_that_says_nothing_new_gets_no_parameter():
    column = np.arange(1.0, 6.0)
    fit = least_squares(np.column_stack([column, 2 * column, np.zeros(5)]), 3 * column[:, None])
    assert np.allclose(fit, [[3.0], [0.0], [0.0]])


def test_axes_are_eigenvectors():
    points = np.random.default_rng(0).normal(size=(200, 12, 3)) * (2.0, 0.5, 0.05)
    covariances = np.einsum("nki,nkj->nij", points, points) / 12
    values, vectors = principal_axes(covariances)
    assert np.allclose(values, np.linalg.eigvalsh(covariances), atol=1e-12)
    assert np.allclose(covariances @ vectors, vectors * values[:, None, :], atol=1e-12)
    assert np.allclose(np.swapaxes(vectors, 1, 2) @ vectors, np.eye(3), atol=1e-12)


def test_points_at_one_place_and_on_a_line_have_axes_too():
    values, vectors = principal_axes(np.stack([np.zeros((3, 3)), np.diag([0.0, 4.0, 0.0])]))
    assert values.tolist() == [[0.0, 0.0, 0.0], [0.0, 0.0, 4.0]]
    assert np.abs(vectors[1, :, 2]).tolist() == [0.0, 1.0, 0.0]


def test_the_nearest_rotation_is_that_of_the_polar_decomposition():
    turns = np.random.default_rng(1).normal(0.3, 0.2, 20)
    mean = np.mean([rotation_z(turn)[:3, :3] for turn in turns], axis=0)
    left, _, right = np.linalg.svd(mean)
    assert np.allclose(nearest_rotation(mean), left @ right, atol=1e-12)


def test_rotations_without_a_mean_direction_count_as_none():
    assert np.array_equal(nearest_rotation(np.diag([0.0, 0.0, 1.0])), np.eye(3))
