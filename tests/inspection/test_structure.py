"""The structure of a scan: static, upright, neither near nor far."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from carlasc.core.geometry import rotation_z, transform_points, translation
from carlasc.inspection.alignment import (
    MAX_RANGE_M,
    MIN_RANGE_M,
    choose_pairs,
    diagnose_poses,
    occupancy,
    overlap,
    static_structure,
    within,
)
from carlasc.storage import FolderSink, FolderSource

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
        expected = (
            np.isfinite(points).all(axis=1) & (distance > MIN_RANGE_M) & (distance < MAX_RANGE_M)
        )
    assert np.array_equal(within(points, dtype(MIN_RANGE_M), dtype(MAX_RANGE_M)), expected)


def test_each_scan_is_read_once():
    rng = np.random.default_rng(1)
    poses = np.stack([translation((0.6 * frame, 0, 0)) for frame in range(40)])
    world, reads = rng.uniform(-25, 45, (3000, 3)) * (1, 1, 0.05), Counter()

    def structure(index):
        reads[index] += 1
        return world - poses[index, :3, 3]

    assert diagnose_poses(structure, poses, points=lambda index: np.empty((0, 3))).share > 0.5
    assert reads == Counter(set(np.ravel(choose_pairs(poses)).tolist()))


BUILDING, ROAD, VEHICLE = 1, 7, 10


def scan(folder, points, labels=None, flow=None):
    """Write a scan, and return its structure."""
    writer = FolderSink(folder).sequence("cartesian")
    points = np.array(points, np.float32)
    writer.write(
        "points", 0, np.concatenate([points, np.ones((len(points), 1), np.float32)], axis=1)
    )
    if labels is not None:
        writer.write("labels", 0, np.array(labels, np.uint32))
    if flow is not None:
        writer.write("flow", 0, np.array(flow, np.float32))
    (sequence,) = FolderSource(folder).sequences().values()
    return static_structure(sequence, 0)


def test_points_near_the_sensor_far_away_or_without_a_position_are_left_out(tmp_path):
    points = [[2.9, 0, 0], [3.1, 0, 0], [29.9, 0, 0], [30.1, 0, 0], [np.nan, 5, 0]]
    np.testing.assert_allclose(scan(tmp_path, points, [BUILDING] * 5)[:, 0], [3.1, 29.9], rtol=1e-6)


def test_ground_and_movable_classes_are_left_out(tmp_path):
    points = [[5, 0, 0], [6, 0, 0], [7, 0, 0], [8, 0, 0]]
    np.testing.assert_array_equal(scan(tmp_path, points, [BUILDING, ROAD, VEHICLE, 0])[:, 0], [5])


@pytest.mark.parametrize(("speed", "kept"), [(0.09, 1), (-0.11, 0), (0.11, 0)])
def test_points_that_move_are_left_out(tmp_path, speed, kept):
    assert len(scan(tmp_path, [[5, 0, 0]], [BUILDING], [[0, speed, 0]])) == kept


def test_without_labels_columns_of_points_that_stand_up_are_structure(tmp_path):
    wall = [[10.1, 0.1, z] for z in (0.0, 0.2, 0.4, 0.8)]  # the lowest 0.3 m are ground
    curb = [[14.1, 0.1, z] for z in (0.0, 0.2, 0.5)]
    np.testing.assert_allclose(scan(tmp_path, wall + curb)[:, 2], [0.4, 0.8], rtol=1e-6)


def test_labels_that_are_all_0_are_no_labels(tmp_path):
    assert len(scan(tmp_path, [[10.1, 0.1, z] for z in (0.0, 0.5, 1.0)], [0, 0, 0])) == 2
