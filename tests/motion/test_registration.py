"""The compiled loops of the registration against plain NumPy."""

import numpy as np
import pytest

from carlasc.core.geometry import rotation_z
from carlasc.motion.paths import ends, lay, nearest_points


def test_nearest_points_are_those_of_all_pairs():
    rng = np.random.default_rng(1)
    points, model = rng.uniform(-1, 1, (50, 3)), rng.uniform(-1, 1, (40, 3))
    index, squared = nearest_points(points, model)
    pairs = np.square(points[:, None] - model[None]).sum(axis=2)
    assert np.array_equal(index, pairs.argmin(axis=1))
    assert np.allclose(squared, pairs.min(axis=1))


def test_points_are_laid_on_planes_with_the_bits_of_numpy():
    rng = np.random.default_rng(2)
    points, arm, normal = rng.normal(size=(3, 80, 3))
    place, scale, share = rotation_z(0.7)[:3, 0] * 30, 0.3, 0.4
    slope, weighted, off = lay(points, place, arm, normal, scale, share)
    distance = ((points - place - arm) * normal).sum(axis=1)
    turning = arm[:, 0] * normal[:, 1] - arm[:, 1] * normal[:, 0]
    weight = 1 / (1 + (distance / scale) ** 2) * share / 0.05**2
    assert np.array_equal(off, distance)
    assert np.array_equal(slope, np.column_stack([normal, turning]))
    assert np.array_equal(weighted, slope * weight[:, None])


@pytest.mark.parametrize("count", [1, 2, 20, 21, 26, 50, 51, 101, 400])
def test_ends_are_quantiles(count):
    values = np.random.default_rng(count).normal(size=count)
    assert ends(values) == pytest.approx(np.quantile(values, (0.02, 0.98)), abs=1e-15)
