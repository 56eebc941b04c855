import numpy as np
import pytest

from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError
from carlasc.groundtruth.voting.ballot import Ballot, count_votes
from carlasc.groundtruth.voting.observations import Observation

SPEC = GridSpec("cartesian", (16, 16, 4), (-8, -8, -2), (8, 8, 2))


def observation(seed=0, count=500, **options):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-9, 9, (count, 3)).astype(np.float32) * (1, 1, 0.25)
    labels = rng.integers(1, 12, count).astype(np.uint16)
    return Observation(points.astype(np.float32), labels, np.eye(4), **options)


def tally(observations, rule="sensor", regions=None):
    ballot = Ballot(SPEC, rule=rule, free_step_m=0.7, regions=regions)
    for one in observations:
        ballot.add(one)
    return ballot.votes()


def occupied(votes):
    return {(int(r["voxel"]), int(r["label"])): int(r["votes"]) for r in votes.occupied}


def test_points_that_do_not_hit_leave_their_rays():
    one = observation()
    hits = np.arange(500) % 3 == 0
    part = tally([observation(hits=hits)])
    assert (part.free == tally([one]).free).all()
    only = tally([Observation(one.points[hits], one.labels[hits], one.grid_T_sensor)])
    assert occupied(part) == occupied(only)


def test_votes_stay_in_their_regions():
    regions = np.random.default_rng(3).integers(0, 3, SPEC.num_voxels).astype(np.uint16)
    whole = tally([observation()])
    part = tally([observation(hit_region=1, free_region=2)], regions=regions)
    assert (part.free.reshape(-1) == np.where(regions == 2, whole.free.reshape(-1), 0)).all()
    assert occupied(part) == {key: n for key, n in occupied(whole).items() if regions[key[0]] == 1}


def test_regions_are_forgotten_by_the_next_observation():
    regions = np.zeros(SPEC.num_voxels, np.uint16)
    both = tally([observation(1, free_region=5), observation(2)], regions=regions)
    assert (both.free == tally([observation(2)]).free).all()


def test_every_point_counts_and_free_space_once():
    observations = [observation(seed) for seed in range(3)]
    point, sensor, sample = (tally(observations, vote) for vote in ("point", "sensor", "sample"))
    assert (point.free == sensor.free).all()
    assert occupied(point) == occupied(sample)


def test_a_vote_for_free_space_weighs_what_the_class_says():
    votes = tally([observation(seed) for seed in range(3)], "point")
    things, free = votes.occupied_counts(), votes.free
    nothing = votes.to_grid(np.zeros(25))
    assert ((nothing.labels > 0) == (things > 0)).all()
    assert (nothing.counts == things + free).all()
    weight = np.where(np.arange(25) == 10, 3.0, 0.5)
    weighed = votes.to_grid(weight)
    expected = np.where(things > weight[nothing.labels] * free, nothing.labels, 0)
    assert (weighed.labels == expected).all()
    assert 0 < np.count_nonzero(weighed.labels) < np.count_nonzero(nothing.labels)


def test_regions_that_do_not_fit_are_refused():
    with pytest.raises(ArgumentError, match="regions: expected"):
        Ballot(SPEC, regions=np.zeros(3, np.uint16))
    with pytest.raises(ArgumentError, match="regions: expected"):
        Ballot(SPEC, rule="sample", regions=np.zeros(SPEC.num_voxels, np.uint16))
    with pytest.raises(ArgumentError, match="observation: expected no region, as the ballot has none"):
        count_votes([observation(free_region=0)], SPEC)
