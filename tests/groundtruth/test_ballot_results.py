"""What is refused, what is stored, and that ballots are independent."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from helpers.references.plain_voting import plain_votes
from helpers.scenes.lidar_frames import street_frame
from hypothesis import given
from hypothesis import strategies as st

from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLA
from carlasc.errors import ArgumentError, FormatError
from carlasc.groundtruth.voting.ballot import (
    OCCUPIED_DTYPE,
    Ballot,
    Observation,
    Votes,
    count_votes,
)
from carlasc.storage.field_files import VOTES_DTYPE

POINTS, LABELS, POSE = np.ones((4, 3), np.float32), np.full(4, 7, np.uint8), np.eye(4)


@pytest.mark.parametrize("free_step_m", [0.0, -1.5, float("nan"), float("inf")])
def test_a_free_step_that_is_no_positive_number_is_refused(free_step_m: float) -> None:
    with pytest.raises(ArgumentError) as error:
        count_votes([], GridSpec.published(), free_step_m=free_step_m)
    assert error.value.where == "free_step_m"


def test_an_unknown_rule_is_refused() -> None:
    with pytest.raises(ArgumentError) as error:
        count_votes([], GridSpec.published(), rule="point")  # type: ignore[arg-type]
    assert error.value.where == "rule" and error.value.found == "'point'"


def test_a_label_beyond_the_table_is_refused_and_casts_no_vote() -> None:
    ballot = Ballot(GridSpec.published())
    labels = np.array([7, 7, 25, 25], np.uint8)
    with pytest.raises(
        FormatError, match=r"expected class ids of carla, found 25 \(2 times\) of 4"
    ):
        ballot.add(Observation(POINTS, labels, POSE))
    assert len(ballot.votes().to_sparse()) == 0


@pytest.mark.parametrize(
    ("points", "labels", "pose", "match"),
    [
        (POINTS, LABELS[:3], POSE, r"expected shape \(4,\), one per point, found \(3,\)"),
        (POINTS[:, :2], LABELS, POSE, r"expected shape \(N, 3\) float32, found \(4, 2\)"),
        (POINTS.astype(np.float64), LABELS, POSE, r"float32, found \(4, 3\) float64"),
        (POINTS, LABELS.astype(np.int64), POSE, "expected unsigned integers, found int64"),
        (POINTS, LABELS, 2 * np.eye(4), "expected a rigid transform"),
    ],
)
def test_an_observation_whose_parts_disagree_is_refused(points, labels, pose, match) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(FormatError, match=match):
        Observation(points, labels, pose)


def test_no_observation_at_all_leaves_everything_unknown() -> None:
    grid = count_votes([], GridSpec.published()).to_grid()
    assert not grid.known.any()
    assert not grid.labels.any()


def test_an_observation_without_points_is_a_voter_without_votes() -> None:
    votes = count_votes([Observation(POINTS[:0], LABELS[:0], POSE)], GridSpec.published())
    assert len(votes.to_sparse()) == 0


def test_sparse_votes_are_sorted_and_those_that_do_not_fit_are_kept_as_the_most_that_does() -> None:
    spec = GridSpec("cartesian", (2, 1, 1), (0.0, 0.0, 0.0), (2.0, 1.0, 1.0))
    occupied = np.array(
        [(0, 7, 70_000, 1, 1), (1, 3, 65_535, 1, 1), (1, 9, 5, 1, 1)], OCCUPIED_DTYPE
    )
    votes = Votes(spec, CARLA, np.array([0, 100_000], np.int64).reshape(spec.size), occupied)
    sparse = votes.to_sparse()
    assert sparse.dtype == VOTES_DTYPE
    assert sparse.tolist() == [(0, 7, 65_535), (1, 0, 65_535), (1, 3, 65_535), (1, 9, 5)]
    counts = votes.to_grid().counts
    assert counts is not None
    assert counts[:, 0, 0].tolist() == [70_000, 165_540]


@given(st.integers(0, 2**32 - 1))
def test_rows_are_sorted_and_decide_what_a_table_of_all_classes_decides(seed: int) -> None:
    rng = np.random.default_rng(seed)
    spec, channels = (
        GridSpec("cartesian", (3, 2, 2), (0.0, 0.0, 0.0), (3.0, 2.0, 2.0)),
        CARLA.num_channels,
    )
    ballot = Ballot(spec, rule="sample", free_step_m=0.4)
    table = np.zeros((spec.num_voxels, channels), np.int64)
    for _ in range(rng.integers(0, 4)):
        points = rng.uniform(-0.5, 3.5, (rng.integers(0, 60), 3)).astype(np.float32)
        labels = rng.integers(0, len(CARLA.names), len(points)).astype(np.uint16)
        observation = Observation(points, labels, POSE)
        ballot.add(observation)
        table += plain_votes([observation], spec, channels, rule="sample", free_step_m=0.4)
    votes = ballot.votes()
    pairs = votes.occupied["voxel"].astype(np.int64) * channels + votes.occupied["label"]
    assert (np.diff(pairs) > 0).all()
    labels, counts = votes.elect_occupied()
    np.testing.assert_array_equal(
        labels, np.where(table[:, 1:].any(axis=1), table[:, 1:].argmax(axis=1) + 1, 0)
    )
    np.testing.assert_array_equal(counts, table[:, 1:].sum(axis=1))
    np.testing.assert_array_equal(ballot.hit, table[:, 1:].any(axis=1))
    np.testing.assert_array_equal(ballot.seen(), table.any(axis=1))
    grid = votes.to_grid()
    assert grid.counts is not None
    np.testing.assert_array_equal(grid.labels.reshape(-1), table.argmax(axis=1))
    np.testing.assert_array_equal(grid.counts.reshape(-1), table.sum(axis=1))
    voxels, classes = np.nonzero(table)
    expected = list(
        zip(voxels.tolist(), classes.tolist(), table[voxels, classes].tolist(), strict=True)
    )
    assert votes.to_sparse().tolist() == expected


def test_ballots_of_several_threads_do_not_meet() -> None:
    frame = street_frame(sensors=4, channels=16, columns=256, distinct=2)
    specs = [
        GridSpec.published(name)
        for name in ("cartesian", "cylindrical", "cartesian", "cylindrical")
    ]
    alone = [count_votes(frame, spec).to_sparse() for spec in specs]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda spec: count_votes(frame, spec).to_sparse(), specs))
    for one, other in zip(alone, together, strict=True):
        np.testing.assert_array_equal(one, other)
