"""The compiled loops of the fit of two scans against plain NumPy, bit for bit."""

import numpy as np
import pytest

from carlasc.core.geometry import rotation_z, transform_points, translation
from carlasc.inspection.misfit import add_squares, flat_cells, match

POINTS = np.random.default_rng(0).uniform(-9, 9, (3000, 3)) * (1, 1, 0.2)


@pytest.mark.parametrize("cell_m", [1.0, 0.7])
def test_cells_and_their_distributions_are_those_of_numpy(cell_m):
    lower = np.floor(POINTS.min(axis=0) / cell_m) - 1
    size = (np.floor(POINTS.max(axis=0) / cell_m) - lower + 2).astype(np.int64)
    flat = flat_cells(POINTS, cell_m, lower, size)
    cells = (np.floor(POINTS / cell_m) - lower).astype(np.int64)
    assert np.array_equal(flat, np.ravel_multi_index(tuple(cells.T), tuple(size)))

    _, row, expected = np.unique(flat, return_inverse=True, return_counts=True)
    mean = np.stack([np.bincount(row, POINTS[:, axis]) for axis in range(3)], axis=1) / expected[:, None]
    off = POINTS - mean[row]
    squares = np.zeros((len(expected), 3, 3))
    add_squares(POINTS, row, mean, squares)
    for i in range(3):
        for j in range(i, 3):
            assert np.array_equal(squares[:, i, j], np.bincount(row, off[:, i] * off[:, j]))


def test_the_motion_between_two_views_of_walls_is_measured():
    rng = np.random.default_rng(1)
    wall = rng.uniform(-8, 8, (6000, 3)) * (1, 0, 0.2)
    walls = np.concatenate([wall + (0, 7, 1), wall[:, [1, 0, 2]] + (6, 0, 1), wall + (0, -6, 1)])
    floor = rng.uniform(-8, 8, (3000, 3)) * (1, 1, 0)
    scene = np.concatenate([walls, floor]) + rng.normal(0, 0.01, (21_000, 3))
    motion = translation((0.3, -0.2, 0.05)) @ rotation_z(0.02)
    later = transform_points(np.linalg.inv(motion), scene)
    assert np.allclose(match(scene, later, np.eye(4)).motion, motion, atol=0.03)
