"""Space above vehicles and people that no scan saw."""

import numpy as np
import pytest

from carlasc import GridSpec
from carlasc.groundtruth.from_scans.frame import find_above

SPEC = GridSpec("cartesian", (6, 5, 8), (0, 0, 0), (2.4, 2.0, 3.2))  # voxels of 0.4 m
HIGH = 3  # number of voxels above a body


def found(bodies, free, solid=()):
    """Return the voxels above bodies, as (x, y, z)."""
    grids = np.zeros((3, *SPEC.size), bool)
    for grid, voxels in zip(grids, (bodies, free, solid), strict=True):
        for voxel in voxels:
            grid[voxel] = True
    there = grids[0] | grids[2]
    rows = find_above(there, there | grids[1], grids[0], SPEC)
    return {
        tuple(map(int, row))
        for row in np.argwhere(np.isin(np.arange(240), rows).reshape(SPEC.size))
    }


BODY = [(2, 2, 1), (2, 2, 2), (3, 2, 1)]  # a roof at level 2, and a bonnet at level 1


def test_the_space_above_the_roof_is_free_over_and_beside_a_body_whose_top_was_seen():
    columns = {(x, y) for x in range(1, 5) for y in range(1, 4)}
    expected = {(x, y, z) for x, y in columns for z in range(3, 3 + HIGH)} - {(3, 2, 3)}
    assert found(BODY, [(3, 2, 3)]) == expected


@pytest.mark.parametrize("free", [[], [(3, 2, 2)], [(0, 0, 3)]])
def test_nothing_is_free_above_a_body_whose_top_nobody_saw(free):
    assert found(BODY, free) == set()


def test_nothing_is_free_above_what_is_solid():
    branch = [(2, 2, 4), (1, 1, 3)]
    assert {z for x, y, z in found(BODY, [(3, 2, 3)], branch) if (x, y) == (2, 2)} == {3}
    assert not any((x, y) == (1, 1) for x, y, _ in found(BODY, [(3, 2, 3)], branch))


def test_a_body_at_the_end_of_a_row_does_not_touch_one_at_the_start_of_the_next():
    low, high = [(1, 4, 1)], [(2, 0, 4)]
    assert all(y >= 3 for _, y, _ in found([*low, *high], [(1, 4, 2)]))
    assert not found([*low, *high], [(2, 0, 3)])


def test_a_column_between_two_bodies_takes_the_higher_roof():
    made = found([(1, 2, 1), (3, 2, 3)], [(1, 2, 2), (3, 2, 4)])
    assert {z for x, y, z in made if (x, y) == (2, 2)} == {4, 5, 6}


def test_known_voxels_are_never_changed():
    rng = np.random.default_rng(0)
    for _ in range(30):
        solid, seen = rng.random((2, 240)) < 0.3
        bodies = solid & (rng.random(240) < 0.3)
        rows = find_above(solid, solid | seen, bodies, SPEC)
        assert (np.diff(rows) > 0).all() and not (solid | seen)[rows].any()
