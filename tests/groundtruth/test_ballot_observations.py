import numpy as np
import pytest

from carlasc.core.cells import as_pose
from carlasc.core.grids import GridSpec
from carlasc.errors import FormatError
from carlasc.groundtruth.voting.ballot import Ballot, ClassPoints, Observation, SeenClass

SPEC = GridSpec("cartesian", (16, 16, 4), (-8, -8, -2), (8, 8, 2))


def observation(seed=0, count=500, **options):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-9, 9, (count, 3)).astype(np.float32) * (1, 1, 0.25)
    labels = rng.integers(1, 12, count).astype(np.uint16)
    return Observation(points.astype(np.float32), labels, np.eye(4), **options)


def tally(observations, rule="sensor"):
    ballot = Ballot(SPEC, rule=rule, free_step_m=0.7)
    for one in observations:
        ballot.add(one)
    return ballot.votes()


def occupied(votes):
    return {(int(r["voxel"]), int(r["label"])): int(r["votes"]) for r in votes.occupied}


def test_every_sample_counts_with_the_rule_ray_as_with_sample():
    observations = [observation(seed) for seed in range(3)]
    ray, sensor, sample = (tally(observations, rule) for rule in ("ray", "sensor", "sample"))
    assert (ray.free == sample.free).all()
    assert occupied(ray) == occupied(sample)
    assert (ray.free >= sensor.free).all() and (ray.free > sensor.free).any()


CYLINDER = GridSpec("cylindrical", (8, 24, 4), (0.0, -np.pi, -2), (8.0, np.pi, 2))


def by_class(observations, within=(), sure=None):
    """Return the points of observations class by class, each observation a voter."""
    for label in range(1, 12):
        yield SeenClass(
            label,
            [
                ClassPoints(
                    np.ascontiguousarray(one.points[one.labels == label].T),
                    as_pose(one.grid_T_sensor),
                    None if sure is None else sure[one.labels == label],
                )
                for one in observations
            ],
            *within,
        )


@pytest.mark.parametrize("spec", [SPEC, CYLINDER], ids=["cartesian", "cylindrical"])
@pytest.mark.parametrize("rule", ["sensor", "sample", "ray"])
def test_points_class_by_class_vote_as_the_points_of_observations_do(rule, spec):
    observations = [observation(seed) for seed in range(3)]
    whole, points = (Ballot(spec, rule=rule, keep_boxes=spec is SPEC) for _ in range(2))
    for one in observations:
        whole.add(one)
    points.add_points(by_class(observations))
    whole, points = whole.votes(), points.votes()
    assert (points.occupied == whole.occupied).all() and len(points.occupied) > 500
    assert not points.free.any() and whole.free.any()
    np.testing.assert_array_equal(points.boxes, whole.boxes)


def test_the_certainty_of_votes_is_the_sum_of_their_probabilities():
    one, likely = observation(), np.float32([0.25, 0.5, 1.0])[np.arange(500) % 3]
    ballot = Ballot(SPEC, rule="ray")
    ballot.add_points(by_class([one], sure=likely))
    for row in ballot.votes().occupied:
        inside = (SPEC.flat_index(one.points) == row["voxel"]) & (one.labels == row["label"])
        assert (np.count_nonzero(inside), likely[inside].sum()) == (row["votes"], row["sure"])


def test_points_of_a_region_vote_in_its_voxels_only():
    regions = np.random.default_rng(0).integers(0, 3, SPEC.num_voxels).astype(np.uint16)
    part, whole = (Ballot(SPEC, rule="ray", keep_boxes=True) for _ in range(2))
    part.add_points(by_class([observation()], (regions, 2)))
    whole.add_points(by_class([observation()]))
    part, whole = part.votes(), whole.votes()
    assert (part.occupied == whole.occupied[regions[whole.occupied["voxel"]] == 2]).all()
    inside = (regions == 2)[:, None]
    empty = Ballot(SPEC, keep_boxes=True).votes().boxes
    np.testing.assert_array_equal(part.boxes, np.where(inside, whole.boxes, empty))


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
