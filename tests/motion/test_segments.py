"""Which points become one segment: by distance, class and velocity."""

import numpy as np
import pytest

from carlasc.core.geometry import spread_rows
from carlasc.core.scans import Scan
from carlasc.motion import Segment, segment_by_flow, segment_by_instances, static_actor_points

CAR, PERSON = 10, 4


def scan(*groups, instances=None):
    """A scan of groups (x, y, label, velocity in x) of twenty points each, within a tenth of a
    metre.
    """
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-0.1, 0.1, (20, 3)) + (x, y, 0) for x, y, _, _ in groups])
    labels = np.repeat([label for *_, label, _ in groups], 20).astype(np.uint32)
    flow = np.repeat([(speed, 0, 0) for *_, speed in groups], 20, axis=0).astype(np.float32)
    numbers = None if instances is None else np.repeat(instances, 20).astype(np.uint32)
    return Scan(points.astype(np.float32), labels, flow, numbers)


def count(*groups, **options):
    return len(segment_by_flow(0, scan(*groups), np.eye(4), **options))


def test_points_up_to_two_metres_apart_are_one_actor():
    assert count((0, 0, CAR, 8.0), (1.6, 0, CAR, 8.0)) == 1
    assert (
        count(
            (0, 0, CAR, 8.0),
            (1.6, 0, CAR, 8.0),
            (3.2, 0, CAR, 8.0),
            (4.8, 0, CAR, 8.0),
            (6.4, 0, CAR, 8.0),
        )
        == 1
    )
    assert count((0, 0, CAR, 8.0), (3.0, 0, CAR, 8.0)) == 2


def test_actors_of_different_velocities_are_kept_apart_and_wrong_classes_do_not_divide_one():
    assert count((0, 0, CAR, 8.0), (0.5, 0, PERSON, 8.0)) == 1
    (one,) = segment_by_flow(
        0, scan((0, 0, CAR, 8.0), (0.5, 0, CAR, 8.0), (0.2, 0, PERSON, 8.0)), np.eye(4)
    )
    assert one.label == CAR
    assert count((0, 0, CAR, 8.0), (0.5, 0, CAR, 7.2)) == 2
    assert count((0, 0, CAR, 8.0), (0.5, 0, CAR, 7.9)) == 1


def test_slow_and_unlabelled_points_are_in_no_segment():
    assert count((0, 0, CAR, 0.31)) == 1
    assert count((0, 0, CAR, 0.29)) == 0
    assert count((0, 0, CAR, 0.9), min_speed_m_s=1.0) == 0
    assert count((0, 0, 0, 8.0)) == 0


def test_a_segment_has_the_velocity_and_the_centre_of_its_points():
    (segment,) = segment_by_flow(3, scan((5, 2, CAR, 8.0), (9, 2, 7, 0.0)), np.eye(4))
    assert (segment.frame, segment.label, segment.instance) == (3, CAR, 0)
    assert segment.members.tolist() == list(range(20))
    assert segment.velocity.tolist() == [8.0, 0.0, 0.0]
    assert np.abs(segment.center - (5, 2, 0)).max() < 0.1


def test_numbered_actors_are_segments_whether_they_move_or_not():
    numbered = scan(
        (0, 0, CAR, 8.0), (1, 0, CAR, 0.0), (2, 0, 0, 8.0), (3, 0, 7, 0.0), instances=[5, 2, 6, 0]
    )
    segments = segment_by_instances(0, numbered, np.eye(4))
    assert [segment.instance for segment in segments] == [5, 2]
    assert [segment.velocity[0] for segment in segments] == [8.0, 0.0]


class TestStaticPoints:
    def segment(self, count=40, label=CAR):
        points = np.random.default_rng(1).uniform(-1, 1, (count, 3))
        return Segment(7, label, np.arange(count), points, np.array([1.0, 0, 0]))

    @pytest.mark.parametrize(("count", "found"), [(8, True), (7, False)])
    def test_a_fifth_of_the_points_is_enough_to_find_an_actor_that_stopped(self, count, found):
        seen = scan((0, 0, CAR, 0.0))
        part = Scan(seen.points[:count], seen.labels[:count], seen.flow[:count])
        static = static_actor_points(8, part, np.eye(4), {CAR})
        assert (static.segment_at(self.segment()) is not None) == found

    def test_at_least_five_points_are_needed(self):
        seen = scan((0, 0, CAR, 0.0))
        for number, found in ((5, True), (4, False)):
            part = Scan(seen.points[:number], seen.labels[:number], seen.flow[:number])
            static = static_actor_points(8, part, np.eye(4), {CAR})
            assert (static.segment_at(self.segment(5)) is not None) == found

    def test_only_points_of_its_class_at_its_place_count(self):
        static = static_actor_points(8, scan((0, 0, CAR, 0.0)), np.eye(4), {CAR})
        found = static.segment_at(self.segment())
        assert (found.frame, found.label, len(found.members)) == (8, CAR, 20)
        assert not found.velocity.any()
        assert static.segment_at(self.segment(label=PERSON)) is None
        for x, near in ((1.4, True), (1.7, False)):  # half a metre around the segment's points
            other = static_actor_points(8, scan((x, 0, CAR, 0.0)), np.eye(4), {CAR})
            assert (other.segment_at(self.segment()) is not None) == near

    def test_moving_points_and_other_classes_are_left_out(self):
        seen = scan((0, 0, CAR, 0.0), (5, 0, CAR, 8.0), (9, 0, 7, 0.0))
        assert static_actor_points(0, seen, np.eye(4), {CAR}).members.tolist() == list(range(20))


def test_ground_points_are_in_no_actor_whatever_their_number():
    numbered = scan((0, 0, CAR, 8.0), (0.3, 0, 7, 8.0), instances=[3, 3])
    (whole,) = segment_by_instances(0, numbered, np.eye(4))
    (segment,) = segment_by_instances(0, numbered, np.eye(4), ground={7})
    assert (len(whole.members), segment.members.tolist()) == (40, list(range(20)))


def test_a_number_in_two_places_or_of_two_velocities_has_a_segment_for_each():
    for other, parts in (((1.9, 0, CAR, 8.0), 1), ((2.5, 0, CAR, 8.0), 2), ((0.5, 0, CAR, 3.0), 2)):
        seen = scan((0, 0, CAR, 8.0), other, instances=[3, 3])
        segments = segment_by_instances(0, seen, np.eye(4))
        assert [segment.instance for segment in segments] == [3] * parts
        assert np.sort(np.concatenate([segment.members for segment in segments])).tolist() == list(
            range(40)
        )


@pytest.mark.parametrize("count", [0, 3, 400, 401, 8235])
def test_rows_are_spread_without_a_period(count):
    rows = spread_rows(count, 400)
    assert len(rows) == min(count, 400)
    assert (np.diff(rows) > 0).all()
    assert (rows < count).all()
    if count > 1000:
        assert np.bincount(rows % 32, minlength=32).min() >= 6  # points of all 32 channels
