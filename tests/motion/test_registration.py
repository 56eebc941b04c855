"""The compiled loops of the registration against plain NumPy."""

import numpy as np

from carlasc.motion.registration import covariances, nearest_points


def test_covariances_are_those_of_the_points_within_the_radius():
    model = np.random.default_rng(0).uniform(-1, 1, (60, 3)) * (1, 1, 0.1)
    found = covariances(model, 0.5)
    for point, covariance in zip(model, found, strict=True):
        near = model[np.square(model - point).sum(axis=1) < 0.25]
        assert np.allclose(covariance, np.cov(near, rowvar=False, bias=True) if len(near) > 1 else 0, atol=1e-12)


def test_nearest_points_are_those_of_all_pairs():
    rng = np.random.default_rng(1)
    points, model = rng.uniform(-1, 1, (50, 3)), rng.uniform(-1, 1, (40, 3))
    index, squared = nearest_points(points, model)
    pairs = np.square(points[:, None] - model[None]).sum(axis=2)
    assert np.array_equal(index, pairs.argmin(axis=1))
    assert np.allclose(squared, pairs.min(axis=1))
