"""Wrong labels: as many as asked for, each wrong, where they should be."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from carlasc.errors import ArgumentError
from carlasc.testing import wrong_labels

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-20, 20, (20_000, 3)).astype(np.float32)
LABELS = RNG.integers(0, 8, len(POINTS)).astype(np.uint8)


@pytest.mark.parametrize("clump_m", [None, 1.0])
@pytest.mark.parametrize("share", [0, 0.2, 0.5, 1])
def test_the_share_of_wrong_labels_is_that_asked_for_and_points_without_a_class_keep_it(
    share, clump_m
):
    made = wrong_labels(LABELS, POINTS, share, clump_m=clump_m)
    labelled = LABELS > 0
    assert made.dtype == LABELS.dtype and not made[~labelled].any()
    assert abs((made != LABELS)[labelled].mean() - share) < 1e-3
    assert set(made.tolist()) <= set(range(8)) and (made[labelled] > 0).all()


def test_the_labels_that_are_given_are_not_changed_and_a_seed_gives_the_same_ones():
    before = LABELS.copy()
    first, again, other = (wrong_labels(LABELS, POINTS, 0.3, seed=seed) for seed in (4, 4, 5))
    assert_array_equal(first, again)
    assert (first != other).any()
    assert_array_equal(LABELS, before)


def test_a_clump_is_wrong_as_a_whole_and_mostly_of_one_class():
    made = wrong_labels(LABELS, POINTS, 0.2, clump_m=4.0)
    cubes = np.unique(np.floor(POINTS / 4), axis=0, return_inverse=True)[1].reshape(-1)
    counts = []
    for cube in range(cubes.max() + 1):
        inside = (cubes == cube) & (LABELS > 0)
        wrong = made[inside] != LABELS[inside]
        assert wrong.all() or not wrong.any()
        if wrong.any():
            counts.append((np.bincount(made[inside]).max(), len(wrong)))
    of_one, of_all = np.sum(counts, axis=0)
    assert of_one > 0.75 * of_all  # the others had that class before


def test_clumps_of_one_seed_are_in_the_same_places_for_other_points():
    whole, half = (wrong_labels(LABELS[::k], POINTS[::k], 0.2, clump_m=2.0, seed=3) for k in (1, 2))
    same = (whole[::2] != LABELS[::2]) == (half != LABELS[::2])
    assert same.mean() > 0.97  # the last clumps are taken or not by their numbers of points
    other = wrong_labels(LABELS, POINTS, 0.2, clump_m=2.0, seed=4)
    assert ((whole != LABELS) == (other != LABELS)).mean() < 0.8


def test_wrong_classes_are_those_that_are_asked_for():
    made = wrong_labels(LABELS, POINTS, 0.5, classes=(3, 9))
    assert set(np.unique(made[made != LABELS]).tolist()) == {3, 9}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"share": 1.2}, "share: expected"),
        ({"share": -0.1}, "share"),
        ({"clump_m": 0.0}, "clump_m"),
        ({"classes": [4]}, "two"),
    ],
)
def test_arguments_out_of_range_are_refused(options, message):
    with pytest.raises(ArgumentError, match=message):
        wrong_labels(LABELS, POINTS, **{"share": 0.2, **options})


def test_scans_without_points_or_labels_stay_as_they_are():
    assert wrong_labels(LABELS[:0], POINTS[:0], 0.2, clump_m=1.0).shape == (0,)
    assert not wrong_labels(np.zeros(20_000, np.uint32), POINTS, 0.2).any()
