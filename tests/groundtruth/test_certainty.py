"""What hits and free paths say of a voxel, whatever the number of rays."""

import numpy as np
import pytest

from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLA
from carlasc.groundtruth.voting.certainty import (
    GROUND_PER_M,
    MOVABLE_PER_M,
    SOLID_PER_M,
    UNKNOWN,
    Matter,
    is_occupied,
    matter_of,
    probability,
)

COARSE, FINE = (GridSpec.published().with_resolution(r) for r in (0.4, 0.2))
EVERY = list(Matter)


def posterior(hits, free_m, matter, spec=COARSE, in_body=None):
    hits, free_m = np.broadcast_arrays(
        np.atleast_1d(hits), np.atleast_1d(np.asarray(free_m, float))
    )
    body = matter in (Matter.BODY, Matter.MIRRORED) if in_body is None else in_body
    kinds = np.full(len(hits), matter, np.int8)
    return probability(hits, free_m, kinds, np.full(len(hits), body), spec, 1.5).astype(float)


@pytest.mark.parametrize("spec", [COARSE, FINE], ids=["coarse", "fine"])
@pytest.mark.parametrize("matter", EVERY)
def test_more_hits_make_it_more_likely_and_more_free_path_less(matter, spec):
    rising = posterior(np.arange(1, 300), 12.0, matter, spec)
    assert (np.diff(rising) > 0).all()
    falling = posterior(20, np.arange(0, 400, 1.5), matter, spec)
    assert (np.diff(falling) < 0).all()
    empty = posterior(0, np.arange(1.5, 400, 1.5), matter, spec)
    assert (np.diff(empty) <= 0).all() and empty[-1] < empty[0] < UNKNOWN
    assert ((rising > 0) & (rising < 1)).all()


@pytest.mark.parametrize("matter", EVERY)
def test_a_lidar_with_two_or_four_times_the_rays_says_the_same(matter):
    for hits, free_m in ((40, 15.0), (40, 150.0), (40, 600.0)):
        lidars = [posterior(hits * rays, free_m * rays, matter)[0] for rays in (1, 2, 4)]
        assert np.ptp(lidars) < 0.04
        for rays in (1, 2, 4):
            args = np.array([hits * rays]), np.array([free_m * rays]), np.array([matter], np.int8)
            assert is_occupied(*args) == is_occupied(np.array([hits]), np.array([free_m]), args[2])


def test_nothing_seen_is_unknown():
    assert posterior(0, 0.0, Matter.SOLID) == UNKNOWN


@pytest.mark.parametrize(
    ("matter", "per_m"),
    [
        (Matter.GROUND, GROUND_PER_M),
        (Matter.SOLID, SOLID_PER_M),
        (Matter.MOVABLE, MOVABLE_PER_M),
        (Matter.BODY, SOLID_PER_M),
        (Matter.MIRRORED, SOLID_PER_M),
    ],
)
def test_occupied_is_what_has_more_hits_per_metre_than_its_kind_needs(matter, per_m):
    hits = np.array([10, 10, 0, 1, 0])
    free_m = np.array([10 / per_m * 1.001, 10 / per_m * 0.999, 0.0, 0.0, 1.5])
    found = is_occupied(hits, free_m, np.full(5, matter, np.int8))
    assert found.tolist() == [False, True, False, True, False]


def test_ground_needs_least_and_what_can_leave_most():
    assert GROUND_PER_M < SOLID_PER_M < MOVABLE_PER_M


def test_what_a_class_is_depends_on_whether_it_is_in_a_body():
    road, building, vehicle = (CARLA.id_of(name) for name in ("Road", "Building", "Vehicle"))
    labels = np.array([road, building, vehicle] * 2)
    in_body = np.arange(6) > 2
    assert matter_of(labels, in_body, CARLA).tolist() == [
        *(Matter.GROUND, Matter.SOLID, Matter.MOVABLE),
        *(Matter.GROUND, Matter.SOLID, Matter.BODY),
    ]


def test_free_space_within_a_body_is_less_sure_than_outside():
    outside, inside = (posterior(0, 30.0, Matter.SOLID, in_body=body)[0] for body in (False, True))
    assert outside < inside < UNKNOWN


def test_each_voxel_has_the_probability_that_it_has_alone_however_many_there_are():
    rng = np.random.default_rng(1)
    count = 40_000
    hits, samples = (
        rng.integers(0, 4, count) * rng.integers(0, 50, count),
        rng.integers(0, 200, count),
    )
    matter, body = rng.integers(0, len(EVERY), count).astype(np.int8), rng.random(count) < 0.1
    whole = probability(hits, samples * 1.5, matter, body, FINE, 1.5)
    for chosen in (slice(None, 3), slice(16_380, 16_390), slice(-1, None), slice(7, None, 1999)):
        part = probability(
            hits[chosen], samples[chosen] * 1.5, matter[chosen], body[chosen], FINE, 1.5
        )
        assert whole[chosen].tobytes() == part.tobytes()
