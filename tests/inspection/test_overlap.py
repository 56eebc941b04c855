"""The overlap of scans, against plain NumPy, and what the check of poses reads for it."""

from collections import Counter

import numpy as np
import pytest

from carlasc.core.geometry import rotation_z, transform_points, translation
from carlasc.inspection.alignment import choose_pairs, diagnose_poses
from carlasc.inspection.structure import MAX_RANGE_M, MIN_RANGE_M, occupancy, overlap, within

POINTS = np.random.default_rng(0).uniform(-32, 32, (20_000, 3)) * (1, 1, 0.05)


def plain_overlap(occupied, points):
    cells = np.floor((points + 30.0) / 0.4)
    inside = np.all((cells >= 0) & (cells < 150), axis=1)
    return np.count_nonzero(occupied[tuple(cells[inside].astype(int).T)]) / len(points)


@pytest.mark.parametrize(
    "motion", [np.eye(4), translation((0.4, -0.8, 0.4)), translation((9, 2, 0.1)) @ rotation_z(0.3)]
)
def test_the_overlap_is_that_of_numpy(motion):
    occupied = occupancy(POINTS[:15_000])
    found = overlap(occupied, motion, POINTS)
    assert found == plain_overlap(occupied, transform_points(motion, POINTS))
    assert 0.01 < found < 0.9


def test_points_on_the_lower_bounds_are_inside_and_those_on_the_upper_ones_outside():
    edge = np.array([[-30.0, 0, 0], [30, 0, 0], [0, -30, 0], [0, 30, 0], [0, 0, -30], [0, 0, 30]])
    assert overlap(np.ones((150, 150, 150), np.bool_), np.eye(4), edge) == 0.5


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_ranges_have_the_bits_of_numpy(dtype):
    points = POINTS.astype(dtype)
    points[::50] *= dtype(30.0) / np.linalg.norm(points[::50], axis=1, keepdims=True)
    points[1], points[2, 0], points[3, 2] = np.nan, np.inf, -np.inf
    points[4:6] = ((3, 0, 0), (0, 30, 0))
    with np.errstate(invalid="ignore"):
        distance = np.linalg.norm(points, axis=1)
        expected = np.isfinite(points).all(axis=1) & (distance > MIN_RANGE_M) & (distance < MAX_RANGE_M)
    assert np.array_equal(within(points, dtype(MIN_RANGE_M), dtype(MAX_RANGE_M)), expected)


def test_each_scan_is_read_once():
    rng = np.random.default_rng(1)
    poses = np.stack([translation((0.6 * frame, 0, 0)) for frame in range(40)])
    world, reads = rng.uniform(-25, 45, (3000, 3)) * (1, 1, 0.05), Counter()

    def structure(index):
        reads[index] += 1
        return world - poses[index, :3, 3]

    assert diagnose_poses(structure, poses).share > 0.5
    assert reads == Counter(set(np.ravel(choose_pairs(poses, 24)).tolist()))
