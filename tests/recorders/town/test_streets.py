from __future__ import annotations

import numpy as np
import pytest
from carlasc_recorders.town.streets import (
    HALF_ROAD_M,
    LANE_WIDTH_M,
    SIDEWALK_M,
    Streets,
    draw_streets,
    right_of,
)


@pytest.fixture(scope="module", params=range(4))
def streets(request: pytest.FixtureRequest) -> Streets:
    return draw_streets(np.random.default_rng(request.param))


def area(loop: np.ndarray) -> float:
    following = np.roll(loop, -1, axis=0)
    return float((loop[:, 0] * following[:, 1] - loop[:, 1] * following[:, 0]).sum() / 2)


def test_right_of_forward_is_y_because_the_frame_is_left_handed() -> None:
    np.testing.assert_array_equal(right_of(np.array([1.0, 0.0])), [0.0, 1.0])


def test_one_block_is_the_outside_and_all_others_have_their_inside_on_the_right(
    streets: Streets,
) -> None:
    assert [block.outside for block in streets.blocks].count(True) == 1
    for block in streets.blocks:
        assert (area(block.outline.at(HALF_ROAD_M)) > 0) != block.outside


def test_offsets_shrink_blocks_and_grow_the_outside(streets: Streets) -> None:
    for block in streets.blocks:
        near, far = (
            abs(area(block.outline.at(offset)))
            for offset in (HALF_ROAD_M, HALF_ROAD_M + SIDEWALK_M)
        )
        assert (far > near) == block.outside


def test_lanes_are_on_the_right_and_lead_to_other_lanes(streets: Streets) -> None:
    for lane in streets.lanes:
        assert lane.exits
        for follow in lane.exits:
            np.testing.assert_allclose(lane.path[-1], streets.lanes[follow].path[0], atol=1e-9)
        if not lane.turn:
            start, end = streets.nodes[lane.start], streets.nodes[lane.end]
            direction = (end - start) / np.linalg.norm(end - start)
            offsets = (lane.path - start) @ right_of(direction)
            np.testing.assert_allclose(offsets, LANE_WIDTH_M / 2, atol=1e-9)


def test_lanes_have_a_minimum_length_and_smooth_headings(streets: Streets) -> None:
    for lane in streets.lanes:
        assert lane.length_m > 6.0
        steps = np.diff(lane.path, axis=0)
        headings = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
        assert np.abs(np.diff(headings)).max(initial=0.0) < 0.3
