"""The cells of a map do not depend on the order of scans, nor on how many fit into memory."""

from pathlib import Path

import numpy as np
import pytest
from helpers.errors import raises
from numpy.testing import assert_array_equal

from carlasc.errors import StorageError
from carlasc.groundtruth.maps.growing_cells import (
    ROW_DTYPE,
    STATIC,
    UNDER,
    GrowingCells,
    cells_of,
    rows_of_scan,
    split,
)
from carlasc.storage.files import temporary_folder

CELL_M = 0.05


def scans(count, seed=0):
    """Yield scans of a long drive: each sees some places near it."""
    rng = np.random.default_rng(seed)
    for step in range(count):
        points = rng.normal(size=(300, 3)) * (4, 4, 1) + (-40 + 3.0 * step, 2.0 * step, 0)
        yield points, rng.integers(1, 4, 300).astype(np.uint16)


def filled(folder, every, most_rows):
    folder.mkdir()
    cells, most = GrowingCells(folder, CELL_M, most_rows), 0
    for points, labels in every:
        cells.add(split(*rows_of_scan(points, labels, None, STATIC, CELL_M)))
        most = max(most, cells._held)
    cells.finish()
    return np.concatenate(list(cells.points())), most


def test_memory_is_bounded_and_changes_nothing(tmp_path):
    whole, most = filled(tmp_path / "a", scans(60), 10**9)
    few, least = filled(tmp_path / "b", scans(60), 1000)
    assert most > 15_000 and least <= 1000 + 300
    assert_array_equal(few, whole)
    backwards, _ = filled(tmp_path / "c", reversed(list(scans(60))), 1000)
    assert_array_equal(backwards, whole)


@pytest.mark.parametrize("most_rows", [10**9, 1])
def test_ground_below_an_actor_is_kept_only_at_the_height_of_the_road(tmp_path, most_rows):
    road = np.array([[x, 0.11, 0.01] for x in (0.01, 0.31, 0.61)])
    asked = np.array([[0.12, 0.02, 0.03], [0.12, 0.02, 0.12], [0.37, 0.2, 0.08], [30, 7, 0.12]])
    cells = GrowingCells(tmp_path, CELL_M, most_rows)
    for group, points in ((UNDER, asked), (STATIC, road)):
        labels = np.ones(len(points), np.uint16)
        cells.add(split(*rows_of_scan(points, labels, None, group, CELL_M)))
    cells.finish()
    made = cells_of(np.concatenate(list(cells.points())), CELL_M).tolist()
    # what is 0.07 and 0.11 m above the road is a foot; where no road was seen, nobody knows
    expected = np.floor(np.concatenate([road, asked[[0, 3]]]) / CELL_M).astype(int).tolist()
    assert sorted(made) == sorted(expected)


def test_each_cell_has_one_point_inside_it_wherever_it_is(tmp_path):
    far = [(points + (9000.0, -9000.0, 300.0), labels) for points, labels in scans(3)]
    made, _ = filled(tmp_path / "a", far, 10**9)
    expected = np.unique(
        np.floor(np.concatenate([points for points, _ in far]) / CELL_M).astype(int), axis=0
    )
    assert_array_equal(np.unique(cells_of(made, CELL_M), axis=0), expected)
    assert len(made) == len(expected)


def test_scans_vote_once_and_the_lowest_of_equal_classes_wins(tmp_path):
    here = np.full((4, 3), 0.01)
    many = (np.repeat(here[:1], 9, axis=0), np.full(9, 2, np.uint16))
    made, _ = filled(
        tmp_path / "a",
        [(here, np.array([3, 3, 1, 3], np.uint16)), many, (here, np.full(4, 3, np.uint16))],
        10,
    )
    assert made["label"] == 3 and made["seen"] == 3
    assert made["confidence"] == pytest.approx((0.75 + 1) / 4, abs=1e-4)
    made, _ = filled(tmp_path / "b", [(here, np.array([2, 2, 1, 1], np.uint16))], 10)
    assert made["label"] == 1


def test_probabilities_weigh_votes(tmp_path):
    here = np.full((2, 3), 0.01)
    rows = [
        rows_of_scan(
            here, np.full(2, label, np.uint16), np.full(2, sure, np.float32), STATIC, CELL_M
        )
        for label, sure in ((1, 0.3), (1, 0.3), (2, 0.9))
    ]
    (tmp_path / "a").mkdir()
    cells = GrowingCells(tmp_path / "a", CELL_M)
    for scan in rows:
        cells.add(split(*scan))
    cells.finish()
    (point,) = cells.points()
    assert point["label"] == 2 and point["confidence"] == pytest.approx(0.9 / 4, abs=1e-4)


def test_a_scan_without_points_adds_nothing(tmp_path):
    made = split(*rows_of_scan(np.empty((0, 3)), np.empty(0, np.uint16), None, STATIC, CELL_M))
    assert made == []


def test_a_full_disk_is_named_with_the_file(tmp_path, monkeypatch):
    monkeypatch.setattr(GrowingCells, "_path", lambda *_: Path("/dev/full"))
    out = tmp_path / "map.ply"
    for most_rows in (10, 10**9):
        with raises(StorageError, where=str(out)), temporary_folder(out) as folder:
            filled(folder / "cells", scans(2), most_rows)
    assert not list(tmp_path.iterdir())


def test_rows_of_a_place_that_is_seen_again_and_again_do_not_fill_the_disk(tmp_path):
    (tmp_path / "a").mkdir()
    cells, most = GrowingCells(tmp_path / "a", CELL_M, 1000), 0
    (points, labels), *_ = scans(1)
    far = points + (500.0, 0, 0)
    for _ in range(60):
        for own in (points, far):
            cells.add(split(*rows_of_scan(own, labels, None, STATIC, CELL_M)) * 2)
        most = max(most, sum(path.stat().st_size for path in (tmp_path / "a").iterdir()))
    assert 0 < most <= 3 * 600 * ROW_DTYPE.itemsize
