from __future__ import annotations

import numpy as np
import pytest

from carlasc import Grid, GridSpec
from carlasc.core import translation
from carlasc.errors import ArgumentError, FormatError
from carlasc.metrics import Consistency, moved_grid

SPEC = GridSpec("cartesian", (10, 8, 2), (-5.0, -4.0, -1.0), (5.0, 4.0, 1.0))


def grid(seed, density=0.3):
    rng = np.random.default_rng(seed)
    labels = np.where(rng.random(SPEC.size) < density, rng.integers(1, 4, SPEC.size), 0).astype(
        np.uint8
    )
    return Grid(SPEC, labels, (rng.random(SPEC.size) < 0.9).astype(np.float32))


def test_a_grid_that_moves_by_whole_voxels_is_shifted():
    source = grid(0)
    moved = moved_grid(source, translation((2.0, -1.0, 0.0)))
    np.testing.assert_array_equal(moved.labels[2:, :-1], source.labels[:-2, 1:])
    np.testing.assert_array_equal(moved.known[2:, :-1], source.known[:-2, 1:])
    assert not moved.known[:2].any() and not moved.known[:, -1].any()


def test_a_world_that_stands_is_consistent_whatever_the_vehicle_does():
    world = grid(1)
    later_T_earlier = translation((-1.0, 0.0, 0.0))
    later = moved_grid(world, later_T_earlier)
    metric = Consistency(4, moving={3}).update(world, later, later_T_earlier)
    assert metric.compute() == 1.0
    assert metric.matrix.total > 0
    assert metric.update(world, later, np.eye(4)).compute() < 1.0


def test_things_that_may_move_are_left_out_and_so_is_what_is_ignored():
    earlier, later = grid(2), grid(2)
    later.labels[earlier.labels == 3] = 0
    appears = np.zeros(SPEC.size, bool)
    appears[3, 3] = True
    later = Grid(SPEC, np.where(appears, 1, later.labels).astype(np.uint8), later.counts)
    everything = Consistency(4, moving={3}).update(earlier, later, np.eye(4))
    assert Consistency(4, moving={3}).update(earlier, later, np.eye(4), appears).compute() == 1.0
    assert everything.compute() < 1.0
    merged = Consistency(4, moving={3}).merge(everything).merge(everything)
    assert merged.matrix.total == 2 * everything.matrix.total
    with pytest.raises(ArgumentError, match="a Consistency with moving"):
        everything.merge(Consistency(4, moving={2}))


def test_grids_of_other_geometry_are_refused():
    other = GridSpec("cartesian", (5, 4, 2), (-5.0, -4.0, -1.0), (5.0, 4.0, 1.0))
    with pytest.raises(FormatError, match="later"):
        Consistency(4, moving=()).update(
            grid(0), Grid(other, np.zeros(other.size, np.uint8)), np.eye(4)
        )
