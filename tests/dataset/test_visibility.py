"""What each scan of a stack saw, against plain sampling of its rays."""

import numpy as np
import pytest
from helpers.datasets.drives import bend, random_points, write_drive
from helpers.references.plain_voting import plain_votes

from carlasc.core.geometry import translation
from carlasc.core.grids import GridSpec
from carlasc.dataset import Dataset
from carlasc.dataset.stacking import stack_scans
from carlasc.dataset.transforms import flip
from carlasc.dataset.visibility import HIT, PASSED, UNSEEN, stack_visibility
from carlasc.groundtruth.voting.ballot import Observation

SPEC = GridSpec("cartesian", (16, 16, 4), (-8.0, -8.0, -2.0), (8.0, 8.0, 1.0))
CYLINDRICAL = GridSpec("cylindrical", (10, 16, 4), (0.0, -np.pi, -2.0), (20.0, np.pi, 1.0))


@pytest.mark.parametrize("spec, step_m", [(SPEC, 0.75), (CYLINDRICAL, 0.75)])
def test_voxels_are_hit_passed_or_unseen_as_plain_sampling_says(spec, step_m):
    scans = [random_points(np.random.default_rng(seed), 200) for seed in range(3)]
    moves = bend(3)
    seen = stack_visibility(scans, moves, spec)
    assert seen.dtype == np.uint8 and seen.shape == (3, *spec.size)
    for grid, points, move in zip(seen, scans, moves, strict=True):
        observation = Observation(
            np.ascontiguousarray(points[:, :3]), np.ones(len(points), np.uint16), move
        )
        votes = plain_votes([observation], spec, free_step_m=step_m)
        expected = np.where(votes[:, 1] > 0, HIT, np.where(votes[:, 0] > 0, PASSED, UNSEEN))
        np.testing.assert_array_equal(grid, expected.reshape(spec.size))
        assert {UNSEEN, PASSED, HIT} == set(np.unique(grid))


def test_rays_of_a_past_scan_begin_where_its_sensor_was():
    wall = np.array([[6.0, 0.1, 0.1]], np.float32)
    here, behind = stack_visibility(
        [wall, wall], np.stack([np.eye(4), translation((-5.0, 0, 0))]), SPEC
    )[..., 8, 2]
    assert here.tolist() == [UNSEEN] * 8 + [PASSED] * 6 + [HIT, UNSEEN]
    assert behind.tolist() == [UNSEEN] * 3 + [PASSED] * 6 + [HIT] + [UNSEEN] * 6


def test_rays_of_points_that_are_out_of_range_show_nothing():
    near, far = [[1.2, 0.1, 0.1]], [[0.1, 6.1, 0.1]]
    points = np.array(near + far, np.float32)
    seen = stack_visibility([points], np.eye(4)[None], SPEC, 2.0, None)[0]
    assert seen[8, 14, 2] == HIT and seen[9, 8, 2] == UNSEEN
    seen = stack_visibility([points], np.eye(4)[None], SPEC, None, 5.0)[0]
    assert seen[9, 8, 2] == HIT and not seen[8, 9:, 2].any()


def test_no_scan_and_a_scan_without_points_saw_nothing():
    empty = np.zeros((0, 4), np.float32)
    assert not stack_visibility([None, empty], np.tile(np.eye(4), (2, 1, 1)), SPEC).any()


@pytest.mark.parametrize("direction, axis", [("x", 1), ("y", 2)])
def test_samples_hold_it_beside_occupancy_and_are_flipped_with_it(tmp_path, direction, axis):
    write_drive(tmp_path / "Train" / "Town01_Light" / "cartesian", range(4), spec=SPEC, seed=1)
    sample = Dataset(tmp_path, history=3, fields=("visibility", "occupancy", "labels"))[1]
    np.testing.assert_array_equal(sample["visibility"] == HIT, sample["occupancy"] == 1)
    assert sample["valid"].tolist() == [False, True, True]
    assert not sample["visibility"][0].any() and (sample["visibility"][1:] == PASSED).any()
    alone = Dataset(tmp_path, history=3, fields=("visibility",), grid=SPEC)[1]
    np.testing.assert_array_equal(alone["visibility"], sample["visibility"])
    flipped = flip(sample, direction, SPEC)["visibility"]
    np.testing.assert_array_equal(flipped, np.flip(sample["visibility"], axis))


def test_what_is_hit_is_what_the_stack_of_occupancy_holds():
    points = random_points(np.random.default_rng(5), 2000)
    move = bend(3)[2:]
    hit = stack_visibility([points], move, SPEC) == HIT
    np.testing.assert_array_equal(hit, stack_scans([points], move, SPEC) == 1)


def test_of_a_dense_scan_some_rays_are_followed_and_all_hits_are_kept():
    points = random_points(np.random.default_rng(6), 120_000)
    seen = stack_visibility([points], np.eye(4)[None], SPEC)
    some = stack_visibility([points[::3]], np.eye(4)[None], SPEC)
    np.testing.assert_array_equal(seen == HIT, stack_scans([points], np.eye(4)[None], SPEC) == 1)
    np.testing.assert_array_equal(
        (seen == PASSED) | (seen == HIT), (some != UNSEEN) | (seen == HIT)
    )
