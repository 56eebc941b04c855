"""Sightings of a known box, registered to the planes of what was seen of it before."""

import numpy as np
import pytest
from helpers.scenes.box_actors import box_surface

from carlasc.core.geometry import transform_points
from carlasc.motion.planes import Planes
from carlasc.motion.registration import pose_of, register

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


def test_a_sighting_is_laid_on_the_planes_wherever_it_is_expected(box):
    model, seen = model_of(box[0]), transform_points(pose_of(STATE), box[1])
    for offset in ((0.2, 0, 0, 0), (0, -0.25, 0, 0.03), (-0.1, 0.1, 0.05, -0.04)):
        found = register(seen, model, STATE + offset, ERROR, STATE[:3], NO_SHIFTS)
        assert np.abs(found - STATE).max() < 0.02


def test_the_order_of_the_points_of_the_model_does_not_matter(box):
    seen = transform_points(pose_of(STATE), box[1])
    one, other = (
        register(seen, model_of(points), STATE + 0.1, ERROR, STATE[:3], NO_SHIFTS) for points in (box[0], box[0][::-1])
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
    assert np.array_equal(register(far, model_of(box[0]), STATE, ERROR, STATE[:3], NO_SHIFTS), STATE)
