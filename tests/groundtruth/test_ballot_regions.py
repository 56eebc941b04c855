import numpy as np
import pytest

from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, FormatError
from carlasc.groundtruth.voting.ballot import NOWHERE, Ballot, Observation, count_votes

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


def test_every_sample_counts_with_the_rule_ray_as_with_sample():
    observations = [observation(seed) for seed in range(3)]
    ray, sensor, sample = (tally(observations, rule) for rule in ("ray", "sensor", "sample"))
    assert (ray.free == sample.free).all()
    assert occupied(ray) == occupied(sample)
    assert (ray.free >= sensor.free).all() and (ray.free > sensor.free).any()


@pytest.mark.parametrize("rule", ["sensor", "sample", "ray"])
def test_votes_stay_in_their_regions_with_every_rule(rule):
    regions = np.random.default_rng(4).integers(0, 3, SPEC.num_voxels).astype(np.uint16)
    whole = tally([observation(5)], rule)
    part = tally([observation(5, hit_region=1, free_region=2)], rule, regions)
    assert (part.free.reshape(-1) == np.where(regions == 2, whole.free.reshape(-1), 0)).all()
    assert occupied(part) == {key: n for key, n in occupied(whole).items() if regions[key[0]] == 1}


def test_rays_of_a_region_that_has_no_voxels_leave_only_their_points():
    regions = np.zeros(SPEC.num_voxels, np.uint16)
    votes = tally([observation(free_region=NOWHERE)], "ray", regions)
    assert not votes.free.any()
    assert occupied(votes) == occupied(tally([observation()], "ray"))


def views_of(observations, rule="ray", regions=None):
    ballot = Ballot(SPEC, rule=rule, free_step_m=0.7, regions=regions, count_views=True)
    for one in observations:
        ballot.add(one)
    return ballot.views


def seen_by(one):
    """Return which voxels one observation votes in."""
    votes = tally([one], "ray")
    return ((votes.free > 0) | (votes.occupied_counts() > 0)).astype(int)


def test_views_count_the_observations_that_saw_a_voxel_however_often_each_did():
    observations = [observation(seed, count=150) for seed in range(3)]
    views = views_of(observations)
    assert (views == sum(seen_by(one) for one in observations)).all()
    assert set(np.unique(views)) == {0, 1, 2, 3}
    assert (views_of([observations[0], observations[0]]) == 2 * seen_by(observations[0])).all()


def test_views_are_a_copy():
    ballot = Ballot(SPEC, rule="ray", count_views=True)
    ballot.add(observation())
    before = ballot.views
    ballot.add(observation(1))
    assert before.max() == 1 and ballot.views.max() == 2


def test_regions_that_do_not_fit_are_refused():
    with pytest.raises(ArgumentError) as error:
        Ballot(SPEC, regions=np.zeros(3, np.uint16))
    assert error.value.where == "regions"
    with pytest.raises(ArgumentError) as error:
        Ballot(SPEC, rule="ray", regions=np.zeros(SPEC.num_voxels + 1, np.uint16))
    assert error.value.where == "regions"
    with pytest.raises(ArgumentError) as error:
        count_votes([observation(free_region=0)], SPEC)
    assert error.value.where == "observation"


@pytest.mark.parametrize("few", [True, False], ids=["few voxels apart", "many"])
def test_samples_outside_of_a_region_are_put_back_or_not_counted(few):
    regions = np.zeros(SPEC.num_voxels, np.uint16)
    regions[:: 20 if few else 3] = 1
    free = [tally([observation(seed)], "ray").free.reshape(-1) for seed in range(3)]
    regional = tally(
        [observation(0), observation(1, free_region=0), observation(2, free_region=1)],
        "ray",
        regions,
    )
    expected = free[0] + np.where(regions == 0, free[1], 0) + np.where(regions == 1, free[2], 0)
    assert (regional.free.reshape(-1) == expected).all()


@pytest.mark.parametrize("region", [None, 0])
def test_a_ray_that_stands_for_others_has_their_votes(region):
    weights = np.random.default_rng(5).integers(1, 5, 500).astype(np.uint8)
    sure = np.random.default_rng(6).choice([0.25, 0.5, 1.0], 500).astype(np.float32)
    one, regions = observation(sure=sure), np.arange(SPEC.num_voxels, dtype=np.uint16) % 40 // 39
    many = [np.repeat(values, weights, axis=0) for values in (one.points, one.labels, sure)]
    weighed = tally([observation(sure=sure, weights=weights, free_region=region)], "ray", regions)
    repeated = tally(
        [Observation(many[0], many[1], np.eye(4), sure=many[2], free_region=region)], "ray", regions
    )
    assert (weighed.free == repeated.free).all() and weighed.free.any()
    assert (weighed.occupied == repeated.occupied).all() and weighed.occupied["votes"].max() > 4


def test_voters_of_one_observation_vote_as_observations_do():
    poses = np.stack([np.eye(4), np.eye(4), np.eye(4)])
    poses[1:, :3, 3] = (1.0, 0.5, 0.2), (-2.0, 0.1, 0.0)
    one, ends = observation(), np.array([200, 200, 500])
    parts = [
        Observation(one.points[a:b], one.labels[a:b], pose)
        for pose, a, b in zip(poses, [0, *ends[:-1]], ends, strict=True)
    ]
    for rule in ("sensor", "ray"):
        together, apart = (
            tally([Observation(one.points, one.labels, poses, ends=ends)], rule),
            tally(parts, rule),
        )
        assert (together.free == apart.free).all() and (together.occupied == apart.occupied).all()


@pytest.mark.parametrize("ends", [None, [200], [200, 499], [600, 500]])
def test_the_ends_of_voters_fit_poses_and_points(ends):
    poses, one = np.stack([np.eye(4)] * 2), observation()
    with pytest.raises(FormatError) as error:
        Observation(one.points, one.labels, poses, ends=None if ends is None else np.array(ends))
    assert error.value.where == "observation ends"
