import numpy as np
import pytest

from carlasc.converting.actors import labels_nearby
from carlasc.core.tables import CARLA

ROAD, BUILDING, POLE, VEHICLE, PERSON, SIDEWALK = 7, 1, 5, 10, 4, 8


def near(points, labelled, ground=None):
    points = np.array(points, np.float64).reshape(-1, 3)
    ground = np.zeros(len(points), np.bool_) if ground is None else np.array(ground)
    scans = [
        (np.array(places, np.float64).reshape(-1, 3), np.array(labels, np.uint8))
        for places, labels in labelled
    ]
    return labels_nearby(points, ground, scans, CARLA).tolist()


def test_the_class_of_most_labelled_points_in_the_smallest_cell_is_taken():
    places = [[5.0, 5.0, 1.0]] * 2 + [[5.1, 5.1, 1.1]] + [[5.6, 5.6, 1.6]] * 9
    labels = [BUILDING, BUILDING, POLE] + [POLE] * 9
    assert near([[5.05, 5.05, 1.05]], [(places, labels)]) == [BUILDING]
    assert near([[5.9, 5.9, 1.9]], [(places, labels)]) == [POLE]


def test_all_labelled_scans_count():
    one, other = ([[1.0, 1, 1]], [POLE]), ([[1.0, 1, 1]] * 2, [BUILDING] * 2)
    assert near([[1.01, 1, 1]], [one, other]) == near([[1.01, 1, 1]], [other, one]) == [BUILDING]


def test_nothing_is_taken_from_far_away():
    assert near([[3.0, 0, 0], [-2.0, 0, 0]], [([[0.0, 0, 0]], [BUILDING])]) == [0, 0]
    assert near([[3.0, 0, 0]], []) == [0]
    assert near([], [([[0.0, 0, 0]], [BUILDING])]) == []


@pytest.mark.parametrize("label", [0, VEHICLE, PERSON])
def test_what_has_no_class_or_may_have_moved_gives_none(label):
    assert near([[0.0, 0, 0]], [([[0.0, 0, 0]], [label])]) == [0]


def test_points_on_the_ground_get_classes_of_the_ground_from_farther_away_and_others_do_not():
    labelled = [([[0.0, 0, 0], [0.1, 0, 0.1]], [ROAD, BUILDING])]
    assert near([[0.05, 0, 0], [0.05, 0, 0]], labelled, [True, False]) == [ROAD, BUILDING]
    assert near([[1.5, 0, 0.5], [1.5, 0, 0.5]], labelled, [True, False]) == [ROAD, 0]
    assert near([[0.05, 0, 0]], [([[0.0, 0, 0]], [BUILDING])], [True]) == [0]


def test_the_order_of_points_and_the_place_of_the_world_do_not_matter():
    random = np.random.default_rng(3)
    points, places = random.uniform(-9, 9, (300, 3)), random.uniform(-9, 9, (900, 3))
    labels = random.choice([ROAD, SIDEWALK, BUILDING, POLE], 900)
    ground = random.random(300) < 0.5
    first = near(points, [(places, labels)], ground)
    order = random.permutation(900)
    assert near(points, [(places[order], labels[order])], ground) == first
    assert (
        near(points, [(places[:500], labels[:500]), (places[500:], labels[500:])], ground) == first
    )
    assert np.count_nonzero(first) > 0
    assert set(np.array(first)[ground]) <= {0, ROAD, SIDEWALK}
    assert set(np.array(first)[~ground]) <= {0, BUILDING, POLE}
