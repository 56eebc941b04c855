"""Places that repeat: the second pass is elsewhere, where all looks as it did in the first one."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from helpers.scenes.walls import close, drive, level, record, wall

from carlasc.core.geometry import translation

LENGTH = 24.0  # of a pass


def box(x, y, across, along, height, low=0.0):
    """Return the four sides of a box with a corner (x, y)."""
    corners = [(x, y), (x + along, y), (x + along, y + across), (x, y + across), (x, y)]
    sides = [wall(*ends, height, 24) for ends in pairwise(corners)]
    return np.concatenate(sides) + (0.0, 0.0, low)


def row_house(side=1):
    """Return a house of 7 m and the gap to the next one, which its porch shows."""
    near, porch = sorted((side * 8, side * 16)), sorted((side * 6.5, side * 8))
    return np.concatenate([box(0, near[0], 8, 7, 6), box(2, porch[0], 1.5, 2, 3)])


def both(piece):
    """Return a piece on both sides of the street."""
    return np.concatenate([piece, piece * (1, -1, 1)])


def bare_tunnel():
    return np.concatenate([both(wall((0, 6), (10, 6), 5)), level((0, -6), (10, 6), 5.0, 8.0)])


def niches():
    """Return a tunnel with a niche every 10 m."""
    return np.concatenate([bare_tunnel(), both(box(4, 6, 1.5, 2, 2.5))])


def arcade():
    return np.concatenate(
        [both(box(0, 4, 0.8, 0.8, 4)), both(wall((0, 8), (5, 8), 4)), level((0, -8), (5, 8), 4, 6)]
    )


def parking_aisle():
    """Return pillars between parked cars, under a low ceiling."""
    cars = [box(x, y, 4, 1.8, 1.5) for x in (0.8, 3.4) for y in (5, -9)]
    pillars = [box(0, y, 0.5, 0.5, 2.5) for y in (4, -4.5, 12, -12.5)]
    return np.concatenate([*cars, *pillars, level((0, -14), (5.2, 14), 2.5, 6)])


def crossing():
    """Return a block of a colony, and the lane to the next one."""
    houses = [box(x, y, 7, 7, 6) for x in (0, 8) for y in (8, 20, -15, -27)]
    return np.concatenate([*houses, both(box(3, 5.5, 0.3, 9, 1.2))])


def hedge():
    """Return two hedges, whose leaves are not flat."""
    rng = np.random.default_rng(2)
    leaves = both(wall((0, 5), (10, 5), 2.0, 16))
    return leaves + rng.normal(0, 0.12, leaves.shape)


def avenue():
    """Return a tree on each side, and a house behind it."""
    return np.concatenate([both(box(0, 5, 0.4, 0.4, 5)), both(box(1, 12, 8, 8, 6))])


def noise_barrier():
    panels = both(wall((0, 9), (6, 9), 4.0))
    return np.concatenate([panels, both(box(0, 8.7, 0.3, 0.3, 4.5))])


def containers():
    """Return two stacked containers, and the gap to the next ones."""
    return np.concatenate([both(box(0, 6, 2.4, 12.2, 5.2)), both(box(0, 9.5, 2.4, 12.2, 2.6))])


def shelves():
    """Return a hall's shelves across the drive: boards, and a ceiling."""
    boards = [both(box(0, 3, 9, 1.2, 0.3, low)) for low in (0.2, 1.5, 2.8, 4.1)]
    return np.concatenate([*boards, level((0, -12), (4, 12), 6.0, 6)])


def bridge():
    rail = [both(box(x, 5, 0.15, 0.15, 1.2)) for x in (0, 2, 4)]
    return np.concatenate([*rail, both(wall((0, 5), (6, 5), 0.4)), both(box(0, 7, 1.5, 0.6, 9))])


PLACES = {
    "row houses": (lambda: np.concatenate([row_house(), row_house(-1)]), 8.0),
    "row houses on one side": (row_house, 8.0),
    "bare tunnel": (bare_tunnel, 10.0),
    "tunnel with niches": (niches, 10.0),
    "arcade": (arcade, 5.0),
    "parking aisle": (parking_aisle, 5.2),
    "colony with crossings": (crossing, 22.0),
    "hedges": (hedge, 10.0),
    "avenue": (avenue, 11.0),
    "noise barrier": (noise_barrier, 6.0),
    "containers": (containers, 13.5),
    "shelves of a hall": (shelves, 4.0),
    "bridge": (bridge, 6.0),
}
"""A piece of each place, and after how many metres it repeats."""


def two_passes(piece, period):
    """Return the scans and the given poses of two passes of a place. The drive leaves it so far
    that poses may be off by one period when it returns; and they are.
    """
    low, high = (int(np.floor(end / period)) for end in (-36, LENGTH + period + 36))
    world = np.concatenate(
        [
            level((-40, -20), (LENGTH + period + 40, 20), 0.0, 8.0),
            *(piece + (k * period, 0, 0) for k in range(low, high + 1)),
        ]
    )
    first = drive([(0, -2), (LENGTH, -2)])
    true = [first, translation((period, 0, 0)) @ first]
    given = [first, translation((0.4, -0.3, 0.05)) @ first]
    scans = [record(world, one, seed) for seed, one in enumerate(true)]
    away = translation((0, -50 * period - 50, 1.7))[None]
    nothing = [level((-5, -5), (5, 5), -1.7).astype(np.float32)]
    return [*scans[0], *nothing, *scans[1]], np.concatenate([given[0], away, given[1]])


@pytest.mark.slow
@pytest.mark.parametrize("name", PLACES)
def test_places_that_repeat_are_not_joined_one_period_off(name):
    piece, period = PLACES[name]
    scans, given = two_passes(piece(), period)
    poses, loops = close(scans, given)
    assert len(loops) == 0 and np.array_equal(poses, given)
