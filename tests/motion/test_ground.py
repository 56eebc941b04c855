"""Ground is found without labels: flat, sloping, under a tilted sensor, beside objects, above
mirror images.
"""

import math

import numpy as np
import pytest
from helpers.scenes.moving_scenes import GROUND, HEIGHT_M, WALLS, car, cast, person

from carlasc.core.geometry import Transform, translation
from carlasc.motion.ground import ground_height, ground_points
from carlasc.testing.drives import KINDS, SimulatedDrive

BOXES = [*WALLS, car(8.0, 5.0), person(5.0, -4.0)]


def tilted(height_m: float, degrees: float) -> Transform:
    """Return the pose of a sensor that is rolled to one side and pitched as much."""
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    roll, pitch = np.eye(4), np.eye(4)
    roll[1:3, 1:3] = [[cos, -sin], [sin, cos]]
    pitch[0, 0], pitch[0, 2], pitch[2, 0], pitch[2, 2] = cos, sin, -sin, cos
    return translation((0.0, 0.0, height_m)) @ pitch @ roll


@pytest.mark.parametrize("slope", [0.0, 0.05, 0.15])
def test_objects_are_above_the_ground(slope):
    points, labels = cast(translation((0.0, 0.0, HEIGHT_M)), BOXES)
    points[:, 2] += (slope * points[:, 0]).astype(np.float32)
    ground = ground_points(points)
    assert ground[labels == GROUND].mean() > 0.99
    high = points[:, 2] - slope * points[:, 0] > -HEIGHT_M + 0.4
    assert not ground[high].any()


@pytest.mark.parametrize(("height_m", "degrees"), [(1.0, 0.0), (1.8, 3.0), (2.5, -3.0)])
def test_the_height_and_the_tilt_of_the_sensor_do_not_matter(height_m, degrees):
    pose = tilted(height_m, degrees)
    points, labels = cast(pose, BOXES)
    ground = ground_points(points)
    assert ground[labels == GROUND].mean() > 0.99
    above = points @ pose[2, :3] + height_m
    assert not ground[above > 0.4].any()
    # along the sensor's own z axis
    assert ground_height(points) == pytest.approx(-height_m / pose[2, 2], abs=0.02)


def test_points_below_the_ground_do_not_pull_it_down():
    points, labels = cast(translation((0.0, 0.0, HEIGHT_M)), BOXES)
    images = np.arange(0, len(points), 50)
    points[images, 2] -= np.linspace(0.6, 3.0, len(images)).astype(np.float32)
    ground = ground_points(points)
    kept = np.setdiff1d(np.flatnonzero(labels == GROUND), images)
    assert ground[kept].mean() > 0.99
    assert not ground[images][labels[images] == GROUND].any()
    assert ground_height(points) == pytest.approx(-HEIGHT_M, abs=0.02)


def test_a_car_beside_the_sensor_is_not_taken_for_the_ground():
    row = [car(x, 2.6) for x in (-10.0, -5.0, 0.0, 5.0, 10.0)]
    points, labels = cast(translation((0.0, 0.0, HEIGHT_M)), [*WALLS, *row])
    assert ground_height(points) == pytest.approx(-HEIGHT_M, abs=0.02)
    assert ground_points(points)[labels == GROUND].mean() > 0.98


def test_a_sparse_scan_has_ground_too():
    scan = SimulatedDrive().scan(0)
    assert ground_height(scan.points) == pytest.approx(-1.73, abs=0.03)
    ground, truth = ground_points(scan.points), scan.kinds == KINDS.index("road")
    assert ground[truth].mean() > 0.98
    assert truth[ground].mean() > 0.96


@pytest.mark.parametrize("count", [0, 1, 500])
def test_a_scan_without_a_plane_has_no_ground(count):
    points = np.random.default_rng(0).uniform(-20, 20, (count, 3)).astype(np.float32)
    assert math.isnan(ground_height(points))
    assert not ground_points(points).any()
    assert ground_points(points).shape == (count,)


def test_points_beyond_every_ring_are_in_the_last_one():
    points, _ = cast(translation((0.0, 0.0, HEIGHT_M)), BOXES)
    far = np.array([[1e18, 0, 0], [0, -1e19, -1.7], [3e38, 0, 0]], np.float32)
    assert (
        ground_points(np.concatenate([points, far]))[: len(points)] == ground_points(points)
    ).all()
    assert ground_height(np.concatenate([far, points])) == pytest.approx(-HEIGHT_M, abs=0.02)
