"""Measured rays followed through a grid, against samples every thousandth of the way."""

import numpy as np
import pytest

from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError
from carlasc.metrics.casting import follow_rays

SPEC = GridSpec("cartesian", (9, 7, 5), (-2.25, -1.75, -1.0), (2.25, 1.75, 1.5))


def sampled(solid, spec, origin, point, steps=20000):
    """Return the distance of the middle of the path through the first solid voxel, and what is
    passed, by dense samples.
    """
    end = spec.index(point[None])[0][0]
    direction = point - origin
    parameters = np.linspace(0, 6, 6 * steps + 1)
    cells, inside = spec.index(origin + parameters[:, None] * direction)
    passed, run = 0, []
    for t, cell, within in zip(parameters, cells, inside, strict=True):
        value = solid[tuple(cell)] if within else 0
        if run and tuple(cell) != run[0][1]:
            break
        if value:
            run.append((t, tuple(cell)))
    for t, cell, within in zip(parameters, cells, inside, strict=True):
        if within and t < 1 and np.abs(cell - end).max() > 1:
            passed |= int(solid[tuple(cell)])
    middle = np.mean([run[0][0], run[-1][0]]) * np.linalg.norm(direction) if run else np.inf
    return middle, passed


@pytest.mark.slow
@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (-4.0, 0.3, 0.2), (0.1, 0.2, 3.0)])
def test_rays_meet_and_pass_what_dense_samples_meet_and_pass(origin):
    rng = np.random.default_rng(3)
    solid = np.where(rng.random(SPEC.size) < 0.06, rng.integers(1, 4, SPEC.size), 0).astype(
        np.uint8
    )
    points = rng.uniform(SPEC.lower, SPEC.upper, (25, 3))
    first, passed = follow_rays(solid, SPEC, np.array(origin), points)
    for point, distance, bits in zip(points, first, passed, strict=True):
        wanted, wanted_bits = sampled(solid, SPEC, np.array(origin), point)
        assert distance == pytest.approx(wanted, abs=2e-3)
        assert bits == wanted_bits


def test_the_voxel_of_the_point_and_its_neighbours_are_not_passed():
    solid = np.zeros(SPEC.size, np.uint8)
    solid[6:8, 3, 2] = 1
    point = np.array([[1.5, 0.0, 0.25]])  # in voxel 7
    first, passed = follow_rays(solid, SPEC, np.array([-2.0, 0.0, 0.25]), point)
    assert passed[0] == 0
    assert first[0] == pytest.approx(3.0)  # the middle of voxel 6
    solid[5, 3, 2] = 2
    first, passed = follow_rays(solid, SPEC, np.array([-2.0, 0.0, 0.25]), point)
    assert passed[0] == 2
    assert first[0] == pytest.approx(2.5)


def test_a_ray_goes_on_behind_its_point():
    solid = np.zeros(SPEC.size, np.uint8)
    solid[8, 3, 2] = 1
    first, passed = follow_rays(solid, SPEC, np.zeros(3), np.array([[0.6, 0.0, 0.1]]))
    assert np.isfinite(first[0])
    assert passed[0] == 0


def test_a_cylindrical_grid_is_refused():
    with pytest.raises(ArgumentError, match="Cartesian"):
        follow_rays(
            np.zeros((128, 128, 8), np.uint8),
            GridSpec.published("cylindrical"),
            np.zeros(3),
            np.ones((1, 3)),
        )
