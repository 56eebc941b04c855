"""Numbered actors: chains follow the numbers, unless another actor has the number for a while."""

from dataclasses import replace

import numpy as np
import pytest

from carlasc.motion import Linker, Segment

CAR = 10
CORNERS = (
    np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) / 2 * (4.0, 2.0, 1.5)
)
SPEEDS, LANES = {1: 8.0, 2: -6.0, 3: 0.0}, {1: 0.0, 2: 3.5, 3: 12.0}


def observation(frame, actor, *, number=None, has_flow=True, first=0, dx=0.0):
    """The corners of a car that drives along x in its own lane; `first` is the index of its first
    point.
    """
    points = CORNERS + (SPEEDS[actor] * 0.1 * frame + dx, LANES[actor], 0.0)
    velocity = np.array([SPEEDS[actor], 0.0, 0.0]) if has_flow else None
    return Segment(frame, CAR, np.arange(first, first + 8), points, velocity, number or actor)


def linked(scans):
    linker, chains = Linker(), []
    for frame, segments in sorted(scans.items()):
        chains += linker.add(frame, 0.1 * frame, segments)
    return chains + linker.finish()


@pytest.mark.parametrize("has_flow", [True, False])
def test_actors_that_swap_their_numbers_for_a_scan_are_followed_by_their_places(has_flow):
    scans = {f: [observation(f, actor, has_flow=has_flow) for actor in SPEEDS] for f in range(12)}
    # 1 and 3
    scans[6] = [observation(6, actor, number=4 - actor, has_flow=has_flow) for actor in SPEEDS]
    chains = linked(scans)
    assert [(chain[0].instance, len(chain)) for chain in chains] == [(1, 12), (2, 12), (3, 12)]
    assert all(np.ptp([s.center[1] for s in chain]) < 1e-9 for chain in chains)


@pytest.mark.parametrize("has_flow", [True, False])
def test_a_number_in_two_places_is_two_actors(has_flow):
    scans = {
        f: [observation(f, 1, has_flow=has_flow), observation(f, 2, has_flow=has_flow, first=8)]
        for f in range(12)
    }
    # the oncoming car, which is passing, has the number too
    scans[6][1] = replace(scans[6][1], instance=1)
    first, second = linked(scans)
    assert [len(first), len(second)] == [12, 12]
    assert all(len(segment.members) == 8 for segment in first + second)


def test_parts_of_one_number_are_one_actor():
    scans = {f: [observation(f, 1)] for f in range(6)}
    # another end of a lorry, behind a pillar
    scans[5].append(observation(5, 1, first=8, dx=4.0 + 3.0))
    (chain,) = linked(scans)
    assert chain[-1].members.tolist() == list(range(16))
    assert chain[-1].points.shape == (16, 3)


def test_parts_keep_the_times_of_their_points():
    parts = [
        replace(observation(1, 1, has_flow=False, dx=dx), times=np.full(8, late))
        for dx, late in ((0.0, 0.01), (3.0, 0.02))
    ]
    ((_, joined),) = linked({0: [observation(0, 1, has_flow=False)], 1: parts})
    assert joined.times.tolist() == [0.01] * 8 + [0.02] * 8
    assert np.allclose(joined.at_frame(np.ones(3)).points[8:], parts[1].points - 0.02)


def test_a_number_that_comes_back_is_the_same_actor_anywhere_and_after_ten_seconds_another_one():
    for pause, chains in ((12, 1), (98, 1), (102, 2)):
        assert (
            len(
                linked(
                    {
                        0: [observation(0, 1)],
                        1: [observation(1, 1)],
                        1 + pause: [observation(1, 1, dx=90.0)],
                    }
                )
            )
            == chains
        )


def test_a_number_soon_after_and_far_away_is_another_actor():
    scans = {f: [observation(f, 1)] for f in range(6)}
    scans[6] = [observation(6, 1, dx=30.0)]
    assert [len(chain) for chain in linked(scans)] == [6, 1]
