"""The model of an actor grows point by point; it must be what one makes of all points at once."""

import numpy as np
import pytest
from helpers.scenes.box_actors import box_surface

from carlasc.core.cells import first_of_cells
from carlasc.core.geometry import invert, rotation_z, thin, transform_points, translation
from carlasc.motion.planes import (
    Planes,
    covariances,
    extend_sums,
    nearest_points,
    nearest_within,
    pose_of,
    register,
)

CELL_M, MOST, RADIUS_M = 0.15, 1200, 0.5


def planes_of(points):
    model = Planes()
    model.add(points)
    return model


def pairs(points, pose, model, squared):
    ordered, order, axis = model.in_order
    return nearest_within(points, pose, ordered, order, axis, squared)


def observation(rng, count=300):
    """Two sides of a car, some of whose points are in cells that another observation had."""
    points = rng.uniform(0, 1, (count, 3)) * (4.4, 1.8, 1.5)
    points[: count // 2, 1] = 0
    points[count // 2 :, 0] = 4.4
    return points + rng.normal(0, 0.02, points.shape)


def plain_sums(model):
    """Return the sums of each point's neighbours, added one after the other."""
    sums = np.zeros((len(model), 10))
    for number, point in enumerate(model):
        for x, y, z in (model - point)[np.sum((model - point) ** 2, axis=1) < RADIUS_M**2]:
            sums[number] += (1, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z)
    return sums


def plain_thin(points):
    _, first = np.unique(np.floor(points / CELL_M).astype(np.int64), axis=0, return_index=True)
    return thin(points[np.sort(first)], MOST)


def test_covariances_are_those_of_the_points_within_the_radius():
    model = np.random.default_rng(0).uniform(-1, 1, (60, 3)) * (1, 1, 0.1)
    sums = np.zeros((60, 10))
    assert extend_sums(model, 0, RADIUS_M, sums).all()
    for point, covariance in zip(model, covariances(sums), strict=True):
        near = model[np.square(model - point).sum(axis=1) < RADIUS_M**2]
        assert np.allclose(
            covariance, np.cov(near, rowvar=False, bias=True) if len(near) > 1 else 0, atol=1e-12
        )


def test_sums_that_grow_have_the_same_bits_as_sums_over_all_points():
    model, sums, known = observation(np.random.default_rng(1), 120), np.zeros((120, 10)), 0
    for count in (50, 51, 90, 120):
        before = sums[:count].copy()
        changed = extend_sums(model[:count], known, RADIUS_M, sums[:count])
        assert np.array_equal(sums[:count], plain_sums(model[:count]))
        assert np.array_equal(changed, (sums[:count] != before).any(axis=1))
        known = count
    assert not changed[:90].all()  # few of the old points are near the last ones


# the larger actor has more points than a model may have, so that it is thinned
@pytest.mark.parametrize("size", [1.0, 4.0])
def test_a_model_that_grows_is_the_model_of_all_points(size):
    rng = np.random.default_rng(2)
    model, plain, thinned = None, np.empty((0, 3)), False
    for _ in range(8):
        points = observation(rng) * size
        plain = plain_thin(np.concatenate([plain, points]))
        if model is None:
            model = planes_of(points)
        else:
            thinned |= len(plain) < len(model.points)
            model.add(points)
        assert np.array_equal(model.points, plain)
    assert thinned == (size > 1)
    anew = planes_of(model.points)
    assert np.array_equal(model.points, anew.points)
    assert np.array_equal(model.normals, anew.normals)


def test_points_in_cells_that_are_known_change_nothing():
    points = observation(np.random.default_rng(3))
    model = planes_of(points)
    before = model.points, model.normals
    model.add(points[::-1])
    assert (model.points, model.normals) == before


def test_a_side_has_its_normal_and_a_line_or_a_point_none():
    rng = np.random.default_rng(4)
    side = planes_of(rng.uniform(0, 1, (200, 3)) * (2, 0, 1.5))
    assert np.allclose(np.abs(side.normals), (0, 1, 0), atol=1e-6)
    assert not planes_of(np.linspace((0, 0, 0), (3, 0, 0), 50)).normals.any()
    assert not planes_of(np.ones((1, 3))).normals.any()


def test_first_rows_of_cells_are_those_that_numpy_finds():
    cells = np.random.default_rng(5).integers(-3, 3, (400, 3)) * (1, 1 << 40, 1)
    first = np.zeros(len(cells), np.bool_)
    first[np.unique(cells, axis=0, return_index=True)[1]] = True
    assert np.array_equal(first_of_cells(cells), first)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_pairs_are_those_of_all_distances(axis):
    """Coordinates on a raster have many equal distances, of which the first point counts."""
    rng = np.random.default_rng(axis)
    model, points = rng.integers(0, 6, (200, 3)) / 4.0, rng.integers(-4, 12, (80, 3)) / 4.0
    pose = translation((0.25, -0.5, 0))
    order = np.argsort(model[:, axis], kind="stable")
    squared = np.square(transform_points(invert(pose), points)[:, None] - model).sum(axis=2)
    for most in (0.0, 0.0625, 0.5, 9.0):
        rows, nearest = nearest_within(points, pose, model[order], order, axis, most)
        assert np.array_equal(rows, np.flatnonzero(squared.min(axis=1) < most))
        assert np.array_equal(nearest, squared.argmin(axis=1)[rows])


def test_pairs_of_a_turned_actor_have_the_bits_of_numpy():
    rng = np.random.default_rng(6)
    model, points = planes_of(observation(rng)), observation(rng) + (30, -20, 1)
    pose = translation((30.2, -20.1, 1)) @ rotation_z(0.1)
    squared = np.square(transform_points(invert(pose), points)[:, None] - model.points).sum(axis=2)
    rows, nearest = pairs(points, pose, model, 0.04)
    assert np.array_equal(rows, np.flatnonzero(squared.min(axis=1) < 0.04))
    assert np.array_equal(nearest, squared.argmin(axis=1)[rows])
    assert 50 < len(rows) < 300


def test_a_pose_that_is_not_finite_pairs_nothing():
    model = planes_of(observation(np.random.default_rng(7)))
    rows, nearest = pairs(model.points, np.full((4, 4), np.nan), model, 1.0)
    assert len(rows) == len(nearest) == 0


def test_nearest_points_are_those_of_all_pairs():
    rng = np.random.default_rng(1)
    points, model = rng.uniform(-1, 1, (50, 3)), rng.uniform(-1, 1, (40, 3))
    index, squared = nearest_points(points, model)
    pairs = np.square(points[:, None] - model[None]).sum(axis=2)
    assert np.array_equal(index, pairs.argmin(axis=1))
    assert np.allclose(squared, pairs.min(axis=1))


STATE = np.array([30.0, -8.0, 1.0, 0.7])
ERROR = np.array([0.2, 0.2, 0.05, 0.05])
NO_SHIFTS = np.empty((0, 4))


def model_of(points):
    model = Planes()
    model.add(points)
    return model


@pytest.fixture(scope="module")
def box():
    return box_surface((4.4, 1.8, 1.5), 800, 1), box_surface((4.4, 1.8, 1.5), 300, 2)


def test_an_observation_is_laid_on_the_planes_wherever_it_is_expected(box):
    model, seen = model_of(box[0]), transform_points(pose_of(STATE), box[1])
    for offset in ((0.2, 0, 0, 0), (0, -0.25, 0, 0.03), (-0.1, 0.1, 0.05, -0.04)):
        found = register(seen, model, STATE + offset, ERROR, STATE[:3], NO_SHIFTS)
        assert np.abs(found - STATE).max() < 0.02


def test_the_order_of_the_points_of_the_model_does_not_matter(box):
    seen = transform_points(pose_of(STATE), box[1])
    one, other = (
        register(seen, model_of(points), STATE + 0.1, ERROR, STATE[:3], NO_SHIFTS)
        for points in (box[0], box[0][::-1])
    )
    assert np.abs(one - other).max() < 0.03


def test_a_side_alone_says_nothing_along_it_but_the_shift_of_its_ends_does(box):
    side = box[0][np.abs(box[0][:, 1] + 0.9) < 1e-6]
    model, ahead = model_of(side), np.array([np.cos(0.7), np.sin(0.7), 0.0])
    now = STATE + np.append(0.5 * ahead, 0.0)
    seen, expected = transform_points(pose_of(now), side), STATE + np.append(0.3 * ahead, 0.0)
    error = np.array([0.5, 0.5, 0.01, 0.001])
    by_ends = register(seen, model, expected, error, STATE[:3], np.append(ahead, 0.5)[None])
    without = register(seen, model, expected, error, STATE[:3], NO_SHIFTS)
    assert np.abs(by_ends - now).max() < 0.1
    assert np.abs(without - expected)[:2].max() < np.abs(now - expected)[:2].max()


def test_what_has_no_pair_stays_where_it_is_expected(box):
    far = box[1][:50] + (500, 0, 0)
    assert np.array_equal(
        register(far, model_of(box[0]), STATE, ERROR, STATE[:3], NO_SHIFTS), STATE
    )
