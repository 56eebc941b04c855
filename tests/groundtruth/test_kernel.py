"""The compiled search for the voxels of points against the rule in NumPy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from carlasc.core.cells import count_points
from carlasc.core.geometry import rotation_z, transform_points, translation
from carlasc.core.grids import GridSpec

SPECS = {
    "cartesian": GridSpec.published().with_size((16, 16, 8)),
    "away from the sensor": GridSpec(
        "cartesian", (20, 15, 6), (8.0, -3.0, -4.0), (28.0, 12.0, 2.0)
    ),
    "cylindrical": GridSpec.published("cylindrical").with_size((16, 20, 8)),
    "a sector": GridSpec("cylindrical", (16, 9, 4), (2.0, 2.5, -2.0), (30.0, 4.0, 1.0)),
}


def by_the_rule(points, grid_T_points, spec):
    found = spec.flat_index(transform_points(grid_T_points, points))  # -1 is outside
    return np.bincount(found[found >= 0], minlength=spec.num_voxels)


@pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)
@given(st.integers(0, 2**32 - 1))
def test_the_voxels_are_those_of_the_rule(spec, seed):
    rng = np.random.default_rng(seed)
    points = np.concatenate([rng.uniform(-32, 32, (80, 3)) * (1, 1, 0.1), np.zeros((1, 3))])
    # an azimuth is exact to one unit in the last place
    for axis in range(3) if spec.coordinates == "cartesian" else (2,):
        points[20 * axis : 20 * axis + 40, axis] = rng.choice(spec.edges(axis), 40)
    pose = (
        translation(rng.uniform(-5, 5, 3)) @ rotation_z(rng.uniform(-np.pi, np.pi))
        if seed % 2
        else np.eye(4)
    )
    for given_points in (points, points.astype(np.float32)):
        np.testing.assert_array_equal(
            count_points(given_points, [pose], spec), by_the_rule(given_points, pose, spec)
        )


def test_points_are_counted_in_each_of_their_places():
    spec = SPECS["cartesian"]
    places = [(1.0, 2.0, 0.0), (-3.0, 0.5, -1.0), (99.0, 0.0, 0.0), (1.0, 2.0, 0.0)]
    counts = count_points(np.zeros((1, 3)), [translation(place) for place in places], spec)
    wanted = np.bincount(spec.flat_index(np.array(places[:2] + places[:1])), minlength=len(counts))
    np.testing.assert_array_equal(counts, wanted)
