"""The structure of a scan: static, upright, neither near nor far."""

from __future__ import annotations

import numpy as np
import pytest

from carlasc.inspection.structure import static_structure
from carlasc.storage import FolderSink, FolderSource

BUILDING, ROAD, VEHICLE = 1, 7, 10


def scan(folder, points, labels=None, flow=None):
    """Write a scan, and return its structure."""
    writer = FolderSink(folder).sequence("cartesian")
    points = np.array(points, np.float32)
    writer.write("points", 0, np.concatenate([points, np.ones((len(points), 1), np.float32)], axis=1))
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
