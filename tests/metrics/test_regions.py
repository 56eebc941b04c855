from __future__ import annotations

import numpy as np
import pytest

from carlasc import Grid, GridSpec, Scan
from carlasc.errors import ArgumentError
from carlasc.metrics import Breakdown, distance_bands, height_bands, motion, visibility

SPEC = GridSpec("cartesian", (16, 16, 4), (-4.0, -4.0, -1.0), (4.0, 4.0, 1.0))


def test_bands_share_the_grid_out():
    bands = distance_bands(SPEC, (0, 2, 4, 9))
    assert list(bands) == ["0-2 m", "2-4 m", "4-9 m"]
    np.testing.assert_array_equal(sum(band.astype(int) for band in bands.values()), 1)
    heights = height_bands(SPEC, (-1, 0, 1))
    assert heights["-1-0 m up"][..., :2].all() and not heights["-1-0 m up"][..., 2:].any()
    with pytest.raises(ArgumentError, match="rising"):
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
            labels[tuple(v)] and np.all(((places - low) / size).astype(int) == v, axis=1).sum() < 8 for v in crossed
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
    points = np.array([[-2.75, -2.75, 0.1], [-1.25, -1.25, 0.1], [0.75, 0.75, 0.1], [99, 0, 0]], np.float32)
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
