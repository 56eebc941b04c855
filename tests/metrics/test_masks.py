from __future__ import annotations

import math

import numpy as np
import pytest

from carlasc import Grid, GridSpec
from carlasc.errors import ArgumentError, FormatError
from carlasc.metrics import distance_band, field_of_view, known, score_truth

SPEC = GridSpec("cartesian", (8, 8, 2), (-4.0, -4.0, -1.0), (4.0, 4.0, 1.0))


def test_distance_bands_tile_the_grid():
    bands = [distance_band(SPEC, low, high) for low, high in ((0, 2), (2, 4), (4, math.inf))]
    np.testing.assert_array_equal(np.sum(bands, axis=0), np.ones(SPEC.size))
    assert bands[0][4, 4].all()  # centre (0.5, 0.5)
    assert not bands[0][0, 0].any()
    assert bands[2][0, 0].all()


def test_distance_bands_of_a_cylindrical_grid_follow_the_radius():
    spec = GridSpec("cylindrical", (10, 6, 2), (0.0, -math.pi, -1.0), (10.0, math.pi, 1.0))
    band = distance_band(spec, 2.0, 5.0)
    assert band[2:5].all()
    assert not band[:2].any()
    assert not band[5:].any()


def test_field_of_view_of_90_degrees_is_the_quarter_ahead():
    seen = field_of_view(SPEC, math.pi / 2)
    x, y, _ = np.moveaxis(SPEC.centers(), -1, 0)
    np.testing.assert_array_equal(seen, np.abs(y) <= x)
    assert field_of_view(SPEC).all()


def test_vertical_field_of_view_leaves_out_what_is_above():
    seen = field_of_view(SPEC, vertical_rad=(-math.pi / 2, 0.0))
    assert seen[..., 0].all()
    assert not seen[..., 1].any()


LINE = GridSpec("cartesian", (4, 1, 3), (0.0, -0.5, -1.5), (4.0, 0.5, 1.5))  # centres at x = 0.5..3.5, y = 0, z = -1..1


def test_a_distance_band_includes_its_near_end_and_not_its_far_end():
    np.testing.assert_array_equal(distance_band(LINE, 1.5, 2.5)[:, 0, 0], [False, True, False, False])


def test_a_vertical_field_of_view_includes_both_ends_and_is_measured_from_the_horizontal_distance():
    np.testing.assert_array_equal(field_of_view(LINE, vertical_rad=(0.0, 1.5))[0, 0], [False, True, True])
    np.testing.assert_array_equal(field_of_view(LINE, vertical_rad=(-1.5, 0.0))[0, 0], [True, True, False])
    corner = GridSpec("cartesian", (1, 1, 1), (0.5, 0.5, 0.5), (1.5, 1.5, 1.5))  # elevation of (1, 1, 1): 35.3 degrees
    assert field_of_view(corner, vertical_rad=(0.0, math.radians(36))).all()
    assert not field_of_view(corner, vertical_rad=(0.0, math.radians(35))).any()


def test_masks_that_can_hold_nothing_are_refused():
    with pytest.raises(ArgumentError, match="far_m: expected more than 5, where the band starts, found 5"):
        distance_band(SPEC, 5, 5)
    with pytest.raises(ArgumentError, match="near_m: expected 0 or more, found -1"):
        distance_band(SPEC, -1, 5)
    for angle in (0.0, 6.3):
        with pytest.raises(ArgumentError, match=r"horizontal_rad: expected an angle in \(0, 2 pi\]"):
            field_of_view(SPEC, angle)
    with pytest.raises(ArgumentError, match="vertical_rad"):
        field_of_view(SPEC, vertical_rad=(0.1, 0.1))


def test_known_is_a_count_above_zero():
    np.testing.assert_array_equal(known(np.array([0.0, 1.0, 7.0])), [False, True, True])


def test_truth_is_scored_over_voxels_known_to_both():
    spec = GridSpec("cartesian", (4, 1, 1), (0.0, 0.0, 0.0), (4.0, 1.0, 1.0))

    def grid(labels, counts):
        return Grid(spec, np.array(labels, np.uint8).reshape(4, 1, 1), np.array(counts, np.float32).reshape(4, 1, 1))

    score = score_truth(grid([1, 2, 0, 2], [1, 1, 0, 3]), grid([1, 1, 0, 2], [1, 2, 5, 0]), 3)
    assert (score.known, score.known_reference, score.known_both) == (3, 3, 2)
    assert score.coverage == pytest.approx(2 / 3)
    assert score.accuracy == pytest.approx(1 / 2)
    np.testing.assert_array_equal(score.matrix.false_positives, [0, 0, 1])
    total = score + score
    assert (total.known_both, total.matrix.total) == (4, 4)
    assert total.coverage == score.coverage


def test_truth_is_scored_only_where_the_mask_says():
    spec = GridSpec("cartesian", (4, 1, 1), (0.0, 0.0, 0.0), (4.0, 1.0, 1.0))
    grid = Grid(spec, np.array([1, 2, 0, 2], np.uint8).reshape(4, 1, 1), np.ones(spec.size, np.float32))
    score = score_truth(grid, grid, 3, np.array([True, True, False, False]).reshape(4, 1, 1))
    assert (score.known, score.known_reference, score.known_both, score.matrix.total) == (2, 2, 2, 2)
    empty = score_truth(grid, grid, 3, np.zeros(spec.size, bool))
    assert math.isnan(empty.coverage) and math.isnan(empty.accuracy)


def test_truth_of_another_grid_is_refused():
    grid = Grid(SPEC, np.zeros(SPEC.size, np.uint8))
    other = SPEC.with_size((4, 4, 2))
    with pytest.raises(FormatError, match="expected the reference's"):
        score_truth(grid, Grid(other, np.zeros(other.size, np.uint8)), 2)
