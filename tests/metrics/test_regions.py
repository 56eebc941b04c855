from __future__ import annotations

import math

import numpy as np
import pytest

from carlasc import Grid, GridSpec, Scan
from carlasc.errors import ArgumentError
from carlasc.metrics import (
    Breakdown,
    distance_band,
    distance_bands,
    field_of_view,
    height_bands,
    motion,
    visibility,
)

SPEC = GridSpec("cartesian", (16, 16, 4), (-4.0, -4.0, -1.0), (4.0, 4.0, 1.0))
SMALL = GridSpec("cartesian", (8, 8, 2), (-4.0, -4.0, -1.0), (4.0, 4.0, 1.0))


def test_bands_share_the_grid_out():
    bands = distance_bands(SPEC, (0, 2, 4, 9))
    assert list(bands) == ["0-2 m", "2-4 m", "4-9 m"]
    np.testing.assert_array_equal(sum(band.astype(int) for band in bands.values()), 1)
    heights = height_bands(SPEC, (-1, 0, 1))
    assert heights["-1-0 m up"][..., :2].all() and not heights["-1-0 m up"][..., 2:].any()
    with pytest.raises(ArgumentError, match="increasing"):
        height_bands(SPEC, (1, 0))


def test_a_voxel_is_hidden_exactly_where_something_lies_before_it():
    labels = np.zeros(SPEC.size, np.uint8)
    rng = np.random.default_rng(0)
    labels[rng.random(SPEC.size) < 0.05] = 2
    labels[7:9, 7:9] = 0
    origin = np.array([0.02, 0.03, 0.01])
    visible = visibility(Grid(SPEC, labels), origin)["visible"]
    low, size = np.array(SPEC.lower), SPEC.voxel_size
    for voxel in np.argwhere(np.ones(SPEC.size, bool))[::7]:
        center = low + (voxel + 0.5) * size
        places = origin + np.linspace(0, 1, 4001)[:, None] * (center - origin)
        crossed = np.unique(((places - low) / size).astype(int), axis=0)
        blocked = any(labels[tuple(v)] for v in crossed if tuple(v) != tuple(voxel))
        grazed = any(
            labels[tuple(v)] and np.all(((places - low) / size).astype(int) == v, axis=1).sum() < 8
            for v in crossed
        )
        if not grazed:  # a corner that is only touched may fall on either side of the sampling
            assert visible[tuple(voxel)] == (not blocked), voxel


def test_an_unknown_voxel_hides_nothing():
    labels = np.zeros(SPEC.size, np.uint8)
    labels[12] = 2
    known = np.ones(SPEC.size, np.float32)
    known[12] = 0
    assert visibility(Grid(SPEC, labels, known), (0.0, 0.01, 0.01))["visible"].all()


def test_moving_and_standing_things_are_told_by_the_flow_of_the_points_in_them():
    labels = np.zeros(SPEC.size, np.uint8)
    labels[2, 2], labels[5, 5], labels[9, 9] = 3, 3, 1
    points = np.array(
        [[-2.75, -2.75, 0.1], [-1.25, -1.25, 0.1], [0.75, 0.75, 0.1], [99, 0, 0]], np.float32
    )
    flow = np.array([[2, 0, 0], [0, 0, 0], [5, 0, 0], [5, 0, 0]], np.float32)
    masks = motion(Grid(SPEC, labels), Scan(points, flow=flow), [3])
    assert np.argwhere(masks["moving"]).tolist() == [[2, 2, 2]]
    assert np.argwhere(masks["standing"]).tolist() == [[5, 5, 2]]
    with pytest.raises(ArgumentError, match="flow"):
        motion(Grid(SPEC, labels), Scan(points), [3])


def test_a_breakdown_is_a_matrix_for_each_region():
    rng = np.random.default_rng(1)
    pred, truth = rng.integers(0, 4, (2, *SPEC.size))
    masks = distance_bands(SPEC, (0, 3, 9))
    counted = rng.random(SPEC.size) < 0.5
    part = Breakdown(4).update(pred, truth, masks, counted)
    assert part.compute()["0-3 m"].total == (masks["0-3 m"] & counted).sum()
    merged = Breakdown(4).merge(part).merge(part).compute()
    assert merged["3-9 m"].total == 2 * (masks["3-9 m"] & counted).sum()
    part.reset()
    assert part.compute() == {}


def test_distance_bands_tile_the_grid():
    bands = [distance_band(SMALL, low, high) for low, high in ((0, 2), (2, 4), (4, math.inf))]
    np.testing.assert_array_equal(np.sum(bands, axis=0), np.ones(SMALL.size))
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
    seen = field_of_view(SMALL, math.pi / 2)
    x, y, _ = np.moveaxis(SMALL.centers(), -1, 0)
    np.testing.assert_array_equal(seen, np.abs(y) <= x)
    assert field_of_view(SMALL).all()


def test_vertical_field_of_view_leaves_out_what_is_above():
    seen = field_of_view(SMALL, vertical_rad=(-math.pi / 2, 0.0))
    assert seen[..., 0].all()
    assert not seen[..., 1].any()


# centres at x = 0.5..3.5, y = 0, z = -1..1
LINE = GridSpec("cartesian", (4, 1, 3), (0.0, -0.5, -1.5), (4.0, 0.5, 1.5))


def test_a_distance_band_includes_its_near_end_and_not_its_far_end():
    np.testing.assert_array_equal(
        distance_band(LINE, 1.5, 2.5)[:, 0, 0], [False, True, False, False]
    )


def test_a_vertical_field_of_view_includes_both_ends_and_is_measured_from_the_horizontal_distance():
    np.testing.assert_array_equal(
        field_of_view(LINE, vertical_rad=(0.0, 1.5))[0, 0], [False, True, True]
    )
    np.testing.assert_array_equal(
        field_of_view(LINE, vertical_rad=(-1.5, 0.0))[0, 0], [True, True, False]
    )
    # elevation of (1, 1, 1): 35.3 degrees
    corner = GridSpec("cartesian", (1, 1, 1), (0.5, 0.5, 0.5), (1.5, 1.5, 1.5))
    assert field_of_view(corner, vertical_rad=(0.0, math.radians(36))).all()
    assert not field_of_view(corner, vertical_rad=(0.0, math.radians(35))).any()


def test_masks_that_can_hold_nothing_are_refused():
    with pytest.raises(
        ArgumentError, match="far_m: expected more than 5, the value of `near_m`, found 5"
    ):
        distance_band(SMALL, 5, 5)
    with pytest.raises(ArgumentError, match="near_m: expected 0 or more, found -1"):
        distance_band(SMALL, -1, 5)
    for angle in (0.0, 6.3):
        with pytest.raises(
            ArgumentError, match=r"horizontal_rad: expected an angle in \(0, 2 pi\]"
        ):
            field_of_view(SMALL, angle)
    with pytest.raises(ArgumentError, match="vertical_rad"):
        field_of_view(SMALL, vertical_rad=(0.1, 0.1))
