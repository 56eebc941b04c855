"""Small linear problems against LAPACK."""

import numpy as np
import pytest

from carlasc.core.geometry import rotation_z
from carlasc.motion.solving import (
    least_squares,
    nearest_rotation,
    principal_axes,
    resample,
    smooth,
    smooth_at,
)


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (2, 2), (4, 2), (9, 3), (60, 3), (4, 4)])
def test_parameters_are_those_of_lapack(rows, columns):
    rng = np.random.default_rng(rows)
    design, values = rng.normal(size=(rows, columns)), rng.normal(size=(rows, 3))
    assert np.allclose(
        least_squares(design, values), np.linalg.lstsq(design, values, rcond=None)[0], atol=1e-12
    )


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


TIMES = np.arange(40) * 0.1


def test_parabolas_and_their_slopes_are_kept():
    values = np.column_stack([3 + 2 * TIMES - 0.5 * TIMES**2, TIMES])
    smoothed, slopes = smooth(values, TIMES, np.ones(40), 0.5)
    assert np.allclose(smoothed, values)
    assert np.allclose(slopes, np.column_stack([2 - TIMES, np.ones(40)]))


def test_noise_is_averaged_over_the_whole_window():
    noise = np.random.default_rng(0).normal(0, 0.1, (40, 3))
    smoothed = [
        np.std(smooth(noise, TIMES, np.ones(40), half_s)[0][10:30]) for half_s in (0.5, 1.0)
    ]
    assert smoothed[1] < smoothed[0] < 0.065


def test_a_single_outlier_does_not_bend_the_path():
    values = np.column_stack([8 * TIMES])
    values[20] += 5.0
    smoothed, slopes = smooth(values, TIMES, np.ones(40), 0.5)
    assert np.abs(np.delete(smoothed[:, 0] - 8 * TIMES, 20)).max() < 0.1
    assert np.abs(slopes - 8).max() < 0.2


@pytest.mark.parametrize("count", [1, 2, 4])
def test_few_values_give_a_line_or_a_constant(count):
    smoothed, slopes = smooth(5 * TIMES[:count, None], TIMES[:count], np.ones(count), 0.01)
    assert np.allclose(smoothed[:, 0], 5 * TIMES[:count])
    assert np.allclose(slopes, 5 if count > 1 else 0)


def test_a_path_goes_on_at_its_last_velocity():
    positions, velocities = np.array([[0.0, 0, 0], [2, 0, 0]]), np.array([[1.0, 0, 0], [3, 0, 0]])
    path, speed = resample(np.array([-1.0, 0.5, 3.0]), np.array([0.0, 1.0]), positions, velocities)
    assert path[:, 0].tolist() == [-1.0, 1.0, 8.0]
    assert speed[:, 0].tolist() == [1.0, 2.0, 3.0]


def test_one_time_alone_is_smoothed_as_among_all():
    values = np.random.default_rng(1).normal(size=(40, 3))
    weights = np.random.default_rng(2).uniform(1, 200, 40)
    smoothed, slopes = smooth(values, TIMES, weights, 0.4)
    for index in (0, 7, 39):
        assert np.array_equal(
            smooth_at(index, values, TIMES, weights, 0.4), (smoothed[index], slopes[index])
        )
