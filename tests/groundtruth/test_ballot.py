"""The kernel against the plain NumPy version: every vote of every class, whatever the rays and the
grid.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from helpers.references.plain_voting import plain_grid, plain_votes
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from carlasc.core.cells import fast_azimuth
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import translation
from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLA, SEMANTICKITTI
from carlasc.groundtruth.voting.ballot import Ballot, Observation, Votes, count_votes

_PI32 = float(np.float32(np.pi))
SPECS = {
    "around the sensor": GridSpec.published().with_size((32, 32, 8)),
    "away from the sensor": GridSpec(
        "cartesian", (20, 15, 6), (8.0, -3.0, -4.0), (28.0, 12.0, 2.0)
    ),
    "bounds that are no float32": GridSpec(
        "cartesian", (31, 17, 5), (-9.3, -7.1, -2.2), (12.7, 8.9, 1.3)
    ),
    "size rounded to float32": GridSpec(
        "cartesian", (30, 30, 9), (-25.0, -25.0, -2.0), (26.0, 26.0, 1.0)
    ).with_bounds((-25.1, -24.9, -2.0), (25.7, 26.3, 1.2)),
    "one cell": GridSpec("cartesian", (1, 1, 1), (-5.0, -5.0, -5.0), (5.0, 5.0, 5.0)),
    "cylindrical, published bounds": GridSpec.published("cylindrical").with_size((32, 40, 8)),
    "cylindrical, exact pi": GridSpec(
        "cylindrical", (16, 32, 8), (0.0, -math.pi, -2.0), (30.0, math.pi, 1.0)
    ),
    "cylindrical, from 0 to 2 pi": GridSpec(
        "cylindrical", (16, 24, 4), (1.0, 0.0, -2.0), (20.0, 2 * math.pi, 1.0)
    ),
    "cylindrical, a sector behind": GridSpec(
        "cylindrical", (16, 9, 4), (2.0, 2.5, -2.0), (30.0, 4.0, 1.0)
    ),
    "cylindrical, a sector below": GridSpec(
        "cylindrical", (16, 9, 4), (2.0, -4.5, -2.0), (30.0, -1.0, 1.0)
    ),
}


def random_rotation(rng: np.random.Generator) -> NDArray[np.float64]:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else q[:, [1, 0, 2]]


def random_points(rng: np.random.Generator, count: int, spec: GridSpec) -> NDArray[np.float32]:
    """Points as LiDARs make them, and those that decide edges: on cell edges, whole steps away,
    with x = 0, far, at the sensor.
    """
    directions = rng.normal(size=(count, 3)) * (1, 1, 0.3)
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    ranges = rng.choice([3.0, 30.0, 250.0], count, p=[0.3, 0.6, 0.1]) * rng.random(count)
    points = directions * ranges[:, None]
    kind = rng.integers(0, 10, count)
    edges = np.stack([rng.choice(spec.edges(axis), count) for axis in range(3)], axis=1)
    on_edge = (kind[:, None] < 3) & (rng.random((count, 3)) < 0.6)
    points = np.where(
        on_edge, spec.from_axes(edges) if spec.coordinates == "cartesian" else edges, points
    )
    points[kind == 3, 0] = 0
    points[kind == 4] = np.round(points[kind == 4] * 2) / 2
    along = kind == 5
    points[along] = (
        np.eye(3)[rng.integers(0, 3, along.sum())]
        * rng.integers(-20, 20, along.sum())[:, None]
        * 0.75
    )
    points[0] = 0
    points[1] = (1e-30, 0, 1e-3)
    return points.astype(np.float32)


def random_observation(
    rng: np.random.Generator, spec: GridSpec, classes: ClassTable = CARLA, count: int = 150
) -> Observation:
    pose = translation(rng.choice([0.0, 1.0], 3) * rng.uniform(-15, 15, 3) * (1, 1, 0.2))
    if rng.random() < 0.7:
        pose[:3, :3] = random_rotation(rng)
    labels = rng.choice(list(classes.names), count) * (rng.random(count) < 0.9)
    return Observation(
        random_points(rng, count, spec),
        labels.astype(np.uint8 if max(classes.names) < 256 else np.uint16),
        pose,
    )


def dense(votes: Votes) -> NDArray[np.int64]:
    sparse = votes.to_sparse()
    out = np.zeros((votes.spec.num_voxels, votes.classes.num_channels), np.int64)
    np.add.at(out, (sparse["voxel"], sparse["label"]), sparse["votes"])
    return out


def assert_as_plain(observations: list[Observation], spec: GridSpec, **options: Any) -> None:
    votes = count_votes(observations, spec, **options)
    classes = options.pop("classes", CARLA)
    plain = plain_votes(observations, spec, classes.num_channels, **options)
    np.testing.assert_array_equal(dense(votes), plain)
    labels, counts = plain_grid(plain, spec)
    grid = votes.to_grid()
    assert grid.labels.dtype == classes.dtype
    np.testing.assert_array_equal(grid.labels, labels)
    np.testing.assert_array_equal(grid.counts, counts)
    np.testing.assert_array_equal(votes.free.reshape(-1), plain[:, 0])
    np.testing.assert_array_equal(votes.elect_occupied()[1], plain[:, 1:].sum(axis=1))


@pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)
@settings(max_examples=12, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32),
    vote=st.sampled_from(["sensor", "sample"]),
    free_step_m=st.sampled_from([1.5, 0.5, 0.4, 3.7, 60.0]),
)
def test_every_vote_is_that_of_the_plain_version(
    spec: GridSpec, seed: int, vote: str, free_step_m: float
) -> None:
    rng = np.random.default_rng(seed)
    observations = [random_observation(rng, spec) for _ in range(3)]
    assert_as_plain(observations, spec, rule=vote, free_step_m=free_step_m)


@pytest.mark.parametrize("vote", ["sensor", "sample"])
def test_ids_over_255_are_counted_apart(vote: str) -> None:
    rng = np.random.default_rng(1)
    spec = SPECS["around the sensor"]
    observations = [random_observation(rng, spec, SEMANTICKITTI, 600) for _ in range(3)]
    assert max(int(o.labels.max()) for o in observations) > 256
    assert_as_plain(observations, spec, classes=SEMANTICKITTI, rule=vote)
    assert count_votes(observations, spec, SEMANTICKITTI).to_sparse()["label"].dtype == np.uint16


@pytest.mark.parametrize(
    "spec", [GridSpec.published("fine"), GridSpec.published("cylindrical")], ids=str
)
def test_published_grids_are_those_of_the_plain_version(spec: GridSpec) -> None:
    rng = np.random.default_rng(2)
    assert_as_plain([random_observation(rng, spec, count=8_000) for _ in range(2)], spec)


def test_a_step_of_centimetres_is_counted_as_any_other() -> None:
    rng = np.random.default_rng(3)
    spec = SPECS["around the sensor"]
    observation = random_observation(rng, spec, count=40)
    keep = np.linalg.norm(observation.points, axis=1) < 30
    observation = Observation(
        observation.points[keep], observation.labels[keep], observation.grid_T_sensor
    )
    assert_as_plain([observation], spec, free_step_m=0.013, rule="sample")


def test_points_far_beyond_any_lidar_still_follow_the_rule() -> None:
    rng = np.random.default_rng(4)
    spec = SPECS["around the sensor"]
    step = 3e5
    directions = rng.normal(size=(400, 3)) * (1, 1, 0.05)
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    distances = rng.integers(1, 300, 400) * step + rng.uniform(0, 25, 400)
    points = (directions * distances[:, None]).astype(np.float32)
    observation = Observation(points, np.full(400, 7, np.uint8), translation((1, 2, 0)))
    assert_as_plain([observation], spec, free_step_m=step, rule="sample")
    assert count_votes([observation], spec, free_step_m=step).free.sum() > 20


def test_a_rotated_sensor_is_turned_by_its_rotation_and_not_by_the_transpose() -> None:
    spec = GridSpec("cartesian", (10, 10, 1), (-5.0, -5.0, -1.0), (5.0, 5.0, 1.0))
    pose = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], np.float64)
    grid = count_votes(
        [Observation(np.array([[3.5, 0, 0]], np.float32), np.array([7], np.uint8), pose)], spec
    ).to_grid()
    assert grid.labels[5, 8, 0] == 7
    assert np.argwhere(grid.known).tolist() == [[5, 5, 0], [5, 7, 0], [5, 8, 0]]


def test_a_ray_whose_x_is_zero_drops_out_altogether() -> None:
    observation = Observation(
        np.array([[0, 3, 0.1]], np.float32), np.array([7], np.uint8), np.eye(4)
    )
    votes = count_votes([observation], GridSpec.published())
    assert len(votes.to_sparse()) == 0


def test_points_labelled_zero_cast_no_vote_of_any_kind() -> None:
    observation = Observation(
        np.array([[9, 3, 0.1]], np.float32), np.array([0], np.uint8), np.eye(4)
    )
    assert len(count_votes([observation], GridSpec.published()).to_sparse()) == 0


def test_points_that_are_not_finite_cast_no_vote() -> None:
    bad = np.array(
        [
            [np.nan, 1, 1],
            [1, np.inf, 1],
            [np.inf, 1, 1],
            [1e30, 1, 1],
            [1e-30, 0, 0],
            [1, np.nan, 2],
        ],
        np.float32,
    )
    observation = Observation(bad, np.full(len(bad), 7, np.uint8), np.eye(4))
    for name in ("cartesian", "cylindrical"):
        for vote in ("sensor", "sample"):
            assert (
                len(count_votes([observation], GridSpec.published(name), rule=vote).to_sparse())
                == 0
            )


def test_azimuths_of_the_fast_path_are_within_its_error() -> None:
    angles = np.concatenate([np.linspace(-np.pi, np.pi, 20001), np.arange(-4, 5) * np.pi / 4])
    x, y = np.cos(angles), np.sin(angles)
    found = np.array([fast_azimuth(a, b) for a, b in zip(x, y, strict=True)])
    off = np.abs(found - np.arctan2(y, x))
    assert np.minimum(off, 2 * np.pi - off).max() < 3e-10


def test_ties_go_to_the_lowest_id_and_free_is_the_lowest() -> None:
    spec = GridSpec("cartesian", (4, 1, 1), (0.0, -1.0, -1.0), (4.0, 1.0, 1.0))

    def seen(x: float, label: int) -> Observation:
        return Observation(
            np.array([[x, 0, 0]], np.float32), np.array([label], np.uint8), np.eye(4)
        )

    grid = count_votes(
        [seen(3.2, 9), seen(3.6, 3), seen(2.5, 5), seen(2.5, 5)], spec, free_step_m=1.0
    ).to_grid()
    assert grid.labels[:, 0, 0].tolist() == [0, 0, 0, 3]
    assert grid.counts is not None
    assert grid.counts[:, 0, 0].tolist() == [4, 4, 4, 2]


def test_observations_can_be_added_as_they_come() -> None:
    rng = np.random.default_rng(5)
    spec = SPECS["around the sensor"]
    observations = [random_observation(rng, spec) for _ in range(4)]
    ballot = Ballot(spec)
    for count, observation in enumerate(observations, 1):
        ballot.add(observation)
        votes = ballot.votes()
        assert ballot.num_observations == count
        np.testing.assert_array_equal(dense(votes), dense(count_votes(observations[:count], spec)))
    before = dense(votes).copy()
    ballot.add(observations[0])
    np.testing.assert_array_equal(dense(votes), before)


def test_observations_may_be_read_only_and_strided() -> None:
    rng = np.random.default_rng(6)
    spec = SPECS["around the sensor"]
    plain = random_observation(rng, spec)
    wide = np.zeros((len(plain), 4), np.float32)
    wide[:, :3] = plain.points
    wide.setflags(write=False)
    labels = plain.labels.astype(np.uint32)
    labels.setflags(write=False)
    other = Observation(wide[:, :3], labels, plain.grid_T_sensor)
    np.testing.assert_array_equal(
        dense(count_votes([other], spec)), dense(count_votes([plain], spec))
    )
