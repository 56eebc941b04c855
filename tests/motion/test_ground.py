"""Ground is found without labels: flat, sloping, and beside objects."""

import numpy as np
import pytest
from helpers.moving_scenes import GROUND, WALLS, car, cast, person

from carlasc.motion.ground import ground_points


@pytest.mark.parametrize("slope", [0.0, 0.05])
def test_objects_are_above_the_ground(slope):
    pose = np.eye(4)
    pose[2, 3] = 1.8
    points, labels = cast(pose, [*WALLS, car(8.0, 5.0), person(5.0, -4.0)])
    points[:, 2] += (slope * points[:, 0]).astype(np.float32)
    ground = ground_points(points)
    assert ground[labels == GROUND].mean() > 0.99
    high = points[:, 2] - slope * points[:, 0] > -1.8 + 0.35
    assert not ground[high].any()


def test_no_points_have_no_ground():
    assert ground_points(np.empty((0, 3), np.float32)).shape == (0,)
