"""What scans agree on: labels that are wrong at random, in patches, or always in the same way, on a
street of which the classes are known.
"""

import numpy as np
import pytest

from carlasc import GridSpec
from carlasc.core.tables import CARLA
from carlasc.groundtruth.voting.ballot import OCCUPIED_DTYPE
from carlasc.groundtruth.voting.certainty import agree

ROAD, SIDEWALK, BUILDING, POLE, OTHER = (
    CARLA.id_of(n) for n in ("Road", "Sidewalk", "Building", "Pole", "Other")
)
SPEC = GridSpec("cartesian", (60, 40, 8), (-30, -20, -2), (30, 20, 2))
CLASSES = (ROAD, SIDEWALK, BUILDING, POLE, OTHER)


@pytest.fixture(scope="module")
def street():
    """(X, Y, Z) classes: a road, a sidewalk with a pole every 10 voxels, and a facade behind it."""
    truth = np.zeros(SPEC.size, np.int64)
    truth[:, :24, 0], truth[:, 24:34, 0], truth[:, 34, :] = ROAD, SIDEWALK, BUILDING
    truth[5::10, 29, 1:] = POLE
    return truth


def votes_of(truth, wrong, seed=0, scans=(1, 1, 2, 5, 20)):
    """Return the votes of scans, each with 1 to 4 points in a voxel; `wrong(rng, labels)` returns
    the labels that they have.
    """
    rng = np.random.default_rng(seed)
    voxels = np.flatnonzero(truth)
    count = rng.choice(scans, len(voxels))
    each = np.repeat(voxels, count)
    scan = np.concatenate([np.arange(n) for n in count])
    points = rng.integers(1, 5, len(each))
    voxel, scan = np.repeat(each, points), np.repeat(scan, points)
    labels = wrong(rng, truth.reshape(-1)[voxel])
    pairs, place = np.unique(voxel * 100 + labels, return_inverse=True)
    rows = np.zeros(len(pairs), OCCUPIED_DTYPE)
    rows["voxel"], rows["label"] = np.divmod(pairs, 100)
    rows["votes"] = rows["sure"] = np.bincount(place)
    voters = np.unique(place * 1000 + scan)
    rows["voters"] = np.bincount(voters // 1000, minlength=len(pairs))
    return rows


def majority(votes):
    labels = np.zeros(SPEC.num_voxels, np.int64)
    # the last one written has most
    order = np.lexsort((-votes["label"].astype(int), votes["votes"]))
    labels[votes["voxel"][order]] = votes["label"][order]
    return labels


def right(labels, truth):
    seen = truth.reshape(-1) > 0
    return float((labels[seen] == truth.reshape(-1)[seen]).mean())


def at_random(share):
    def wrong(rng, labels):
        return np.where(rng.random(len(labels)) < share, rng.choice(CLASSES, len(labels)), labels)

    return wrong


def road_for_sidewalk(rng, labels):
    return np.where((labels == SIDEWALK) & (rng.random(len(labels)) < 0.35), ROAD, labels)


def test_right_labels_stay_and_are_certain(street):
    votes = votes_of(street, lambda rng, labels: labels)
    found = agree(votes, SPEC, CARLA)
    np.testing.assert_array_equal(found.labels, street.reshape(-1))
    assert found.wrong <= 0.001
    assert len(found.shares) == np.count_nonzero(street)
    assert found.shares["votes"].min() > 65_000


@pytest.mark.parametrize("share", [0.1, 0.25, 0.5])
def test_how_often_labels_are_wrong_is_estimated_and_most_of_it_is_repaired(street, share):
    votes = votes_of(street, at_random(share))
    found = agree(votes, SPEC, CARLA)
    # one in five random classes is the right one
    assert found.wrong == pytest.approx(0.8 * share, abs=0.03)
    before, after = right(majority(votes), street), right(found.labels, street)
    assert 1 - after < 0.25 * (1 - before)


def test_thin_things_are_not_erased_by_what_is_around_them(street):
    votes = votes_of(street, at_random(0.25), scans=(2, 5, 20))
    poles = street.reshape(-1) == POLE
    assert (agree(votes, SPEC, CARLA).labels[poles] == POLE).mean() > 0.95


def test_what_one_class_is_taken_for_is_learned(street):
    votes = votes_of(street, road_for_sidewalk)
    sidewalk, road = street.reshape(-1) == SIDEWALK, street.reshape(-1) == ROAD
    found = agree(votes, SPEC, CARLA)
    assert (majority(votes)[sidewalk] == SIDEWALK).mean() < 0.86
    assert (found.labels[sidewalk] == SIDEWALK).mean() > 0.97
    assert (found.labels[road] == ROAD).mean() > 0.99


def test_shares_say_how_often_the_class_is_right(street):
    found = agree(votes_of(street, at_random(0.25)), SPEC, CARLA)
    top = np.zeros(SPEC.num_voxels)
    np.maximum.at(top, found.shares["voxel"], found.shares["votes"] / 65535)
    seen = street.reshape(-1) > 0
    assert top[seen].mean() == pytest.approx(
        (found.labels == street.reshape(-1))[seen].mean(), abs=0.08
    )
    assert np.bincount(found.shares["voxel"], found.shares["votes"]).max() <= 65535


def test_a_voxel_with_two_things_keeps_the_shares_of_both(street):
    votes = votes_of(street, lambda rng, labels: labels)
    place = SPEC.num_voxels - 1  # far from everything
    mixed = np.array([(place, BUILDING, 60, 20, 60), (place, POLE, 40, 20, 40)], OCCUPIED_DTYPE)
    found = agree(np.concatenate([votes, mixed]), SPEC, CARLA)
    shares = {
        int(row["label"]): row["votes"] / 65535 for row in found.shares if row["voxel"] == place
    }
    assert found.labels[place] == BUILDING
    assert shares == pytest.approx({BUILDING: 0.6, POLE: 0.4}, abs=0.1)


def test_scans_count_and_not_their_points(street):
    """One scan with many points in a wall is wrong; three others with few are right."""
    votes = votes_of(street, at_random(0.25))
    voxel = np.flatnonzero(street.reshape(-1) == BUILDING)[100]
    others = votes[votes["voxel"] != voxel]
    own = np.array([(voxel, BUILDING, 6, 3, 6), (voxel, OTHER, 5, 1, 5)], OCCUPIED_DTYPE)
    rows = np.concatenate([others[others["voxel"] < voxel], own, others[others["voxel"] > voxel]])
    assert agree(rows, SPEC, CARLA).labels[voxel] == BUILDING


def test_no_votes_and_one_class():
    nothing = agree(np.empty(0, OCCUPIED_DTYPE), SPEC, CARLA)
    assert not nothing.labels.any() and not len(nothing.shares)
    one = agree(np.array([(3, ROAD, 2, 1, 2), (9, ROAD, 1, 1, 1)], OCCUPIED_DTYPE), SPEC, CARLA)
    assert one.labels[[3, 9]].tolist() == [ROAD, ROAD]
    assert one.shares["votes"].tolist() == [65535, 65535]


def test_votes_of_which_a_network_is_not_sure_count_less(street):
    """Half of the points are wrong, and a network says of them, and of one in four right ones, that
    it is not sure.
    """
    rng = np.random.default_rng(3)
    voxels = np.flatnonzero(street)
    rows = np.zeros(2 * len(voxels), OCCUPIED_DTYPE)
    rows["voxel"], rows["votes"], rows["voters"] = np.repeat(voxels, 2), 5, 5
    own = street.reshape(-1)[voxels]
    other = np.array(CLASSES)[
        (np.searchsorted(np.sort(CLASSES), own) + rng.integers(1, 5, len(own))) % 5
    ]
    other = np.where(other == own, np.where(own == ROAD, OTHER, ROAD), other)
    pair = np.sort(np.stack([own, other], axis=1), axis=1)
    rows["label"] = pair.reshape(-1)
    rows["sure"] = np.where(rows["label"] == np.repeat(own, 2), 4.0, 1.5)
    found = agree(rows, SPEC, CARLA)
    rows["sure"] = 5
    assert right(found.labels, street) > 0.99
    assert right(agree(rows, SPEC, CARLA).labels, street) < 0.9
