"""Which segments become one track, and what the track says between and beyond them."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.references.whole_drives import link_segments
from helpers.scenes.box_actors import MovingBox, scan_of

from carlasc.motion import Segment, StaticPoints
from carlasc.motion.tracks import is_possible, make_track

CAR, PERSON = 10, 4
TIMES = {frame: 0.1 * frame for frame in range(100)}


def segment(frame, x, speed=8.0, *, y=0.0, label=CAR, instance=0, size=(4.0, 2.0, 1.5)):
    """The corners of a box, and its centre, at a place, seen from behind and beside it: its length
    and width are known.
    """
    corners = (
        np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)] + [[0, 0, 0]]) / 2
    )
    points = corners * size + (x, y, 0.0)
    return Segment(
        frame,
        label,
        np.arange(9),
        points,
        np.array([speed, 0.0, 0.0]),
        instance,
        np.array([x - 10, y - 10, 0]),
    )


def drive(frames, speed=8.0, **options):
    return [segment(frame, speed * 0.1 * frame, speed, **options) for frame in frames]


@pytest.mark.parametrize(("gap", "tracks"), [(15, 1), (16, 2)])
def test_an_actor_may_be_hidden_for_a_second_and_a_half(gap, tracks):
    assert len(link_segments(drive([0, 1, 2, 2 + gap, 3 + gap]), TIMES)) == tracks


@pytest.mark.parametrize(
    ("next_one", "tracks"),
    [
        (segment(1, 0.8), 1),
        (segment(1, 0.8, label=PERSON), 1),  # its label may be wrong
        (segment(1, 0.8, 9.9), 1),
        (segment(1, 0.8, 10.1), 2),
        (segment(1, 0.8 + 4.0 + 1.4), 1),  # the boxes are 1.4 m apart
        (segment(1, 0.8 + 4.0 + 1.6), 2),
        (segment(1, 0.8, y=2.0 + 1.4), 1),
        (segment(1, 0.8, y=2.0 + 1.6), 2),
    ],
)
def test_a_segment_continues_a_track_of_its_velocity_and_place(next_one, tracks):
    assert len(link_segments([segment(0, 0.0), next_one], TIMES)) == tracks


def test_each_track_continues_with_one_segment_the_nearest():
    first, second = link_segments([segment(0, 0.0), segment(1, 1.0, y=0.9), segment(1, 0.8)], TIMES)
    assert sorted(first.members) == [0, 1] and sorted(second.members) == [1]
    assert first.pose(1)[1, 3] == 0.0
    assert second.pose(1)[1, 3] == pytest.approx(0.9)


def test_a_track_extends_five_frames_beyond_its_segments_at_constant_velocity():
    (track,) = link_segments(drive(range(10, 20)), TIMES)
    assert track.first == 5
    assert track.pose(4) is None and track.pose(25) is None
    assert track.velocity_at(4) is None and track.velocity_at(25) is None
    for frame in (5, 10, 19, 24):
        assert track.pose(frame)[0, 3] == pytest.approx(0.8 * frame)
        assert track.velocity_at(frame)[0] == pytest.approx(8.0)


def test_times_beyond_the_scans_go_on_at_their_mean_period():
    times = {frame: 0.2 * frame for frame in range(10)}
    (track,) = link_segments([segment(frame, 1.6 * frame) for frame in range(10)], times)
    for frame in (-2, 0, 9, 11):
        assert track.pose(frame)[0, 3] == pytest.approx(1.6 * frame)
    # half a second is two frames and a half
    assert track.pose(-3) is None and track.pose(12) is None


def test_the_box_holds_the_points_and_a_margin_but_not_single_outliers():
    (track,) = link_segments(drive(range(40)), TIMES)
    assert np.allclose(track.size, (4.2, 2.2, 1.7))
    segments = drive(range(40))
    outlier = np.concatenate([segments[20].points, [[16.0, 9.0, 0.0]]])
    segments[20] = Segment(
        20, CAR, np.arange(10), outlier, np.array([8.0, 0.0, 0.0]), origin=segments[20].origin
    )
    (track,) = link_segments(segments, TIMES)
    assert np.allclose(track.size, (4.2, 2.2, 1.7), atol=0.05)


@pytest.mark.parametrize(
    ("speed", "frames", "moves"),
    [(8.0, 10, True), (0.29, 60, False), (0.31, 60, True), (0.6, 3, True)],
)
def test_an_actor_moves_if_it_is_fast_and_gets_somewhere(speed, frames, moves):
    (track,) = link_segments(drive(range(frames), speed), TIMES)
    assert track.moves == moves


def test_an_actor_that_stays_in_place_does_not_move_however_fast_its_points_are():
    jitter = [segment(frame, 0.02 * (frame % 2), 0.4 if frame % 2 else -0.4) for frame in range(30)]
    assert not any(track.moves for track in link_segments(jitter, TIMES))


def static(frame, x):
    found = segment(frame, x)
    return StaticPoints(frame, np.arange(9), np.full(9, CAR), found.points)


def test_a_track_is_extended_back_to_where_its_actor_was_static():
    moving = drive(range(10, 15), 1.0)
    still = {frame: static(frame, 1.0) for frame in range(10)}
    (track,) = link_segments(moving, TIMES, still)
    assert sorted(track.members) == list(range(15))
    fast = drive(range(10, 15), 8.0)  # it cannot have been static a moment before
    (track,) = link_segments(fast, TIMES, {frame: static(frame, 8.0) for frame in range(10)})
    assert sorted(track.members) == list(range(10, 15))


def test_a_slow_actor_that_stops_is_followed_and_a_fast_one_is_not():
    for speed, last in ((1.0, 19), (8.0, 14)):
        still = {frame: static(frame, speed * 1.4) for frame in range(15, 20)}
        (track,) = link_segments(drive(range(10, 15), speed), TIMES, still)
        assert max(track.members) == last


def test_numbered_actors_are_linked_by_their_numbers_wherever_they_are():
    first, second = link_segments(
        [segment(0, 0.0, instance=3), segment(30, 500.0, instance=3), segment(0, 0.5, instance=4)],
        TIMES,
    )
    assert (first.instance, len(first.members)) == (3, 2)
    assert (second.instance, len(second.members)) == (4, 1)


def test_a_body_is_completed_away_from_the_face_that_was_seen():
    # it drives ahead
    behind = [replace(one, origin=one.center - (10, 0, 0)) for one in drive(range(20))]
    (track,) = link_segments(behind, TIMES)
    # 4.4 m, a usual length of cars, and the margins
    assert np.allclose(track.size, (4.6, 2.2, 1.7))
    rear = track.pose(10)[0, 3] + track.lower[0] + 0.1
    assert rear == pytest.approx(8.0 - 2.0)
    assert np.allclose(track.lower, -track.upper)  # the origin is the centre of the body
    assert track.extent.size[0] == pytest.approx(4.0)


def test_people_are_as_large_as_their_points():
    people = [
        replace(one, label=PERSON, origin=one.center - (10, 0, 0))
        for one in drive(range(20), size=(0.5, 0.5, 1.7))
    ]
    (track,) = link_segments(people, TIMES, deformable={PERSON})
    assert not track.rigid
    assert np.allclose(track.size, (0.7, 0.7, 1.9))


@pytest.mark.parametrize(("length", "moves"), [(28.0, True), (31.0, False)])
def test_what_is_longer_than_any_vehicle_is_several_things_and_does_not_move(length, moves):
    (track,) = link_segments(drive(range(20), size=(length, 2.5, 3.0)), TIMES)
    assert track.moves == moves


@pytest.mark.parametrize(
    ("size", "possible"),
    [
        ((11.2, 2.5, 3.1), True),
        ((2.5, 11.2, 3.1), True),  # its heading is wrong
        ((31.0, 2.5, 3.0), False),
        ((8.0, 6.0, 2.0), False),
        ((4.0, 2.0, 19.0), False),
    ],
)
def test_one_actor_is_not_larger_than_a_vehicle_in_any_direction(size, possible):
    assert is_possible(size) == possible


@pytest.mark.parametrize("turn", [1.5, 3.0, 4.5])
def test_a_vehicle_that_turns_far_keeps_its_size_and_its_place(turn):
    """Its path is known except for an offset, and each scan shows the sides that face the sensor."""
    car = MovingBox((6.0, 4.0, 0.0), speed=3.0, yaw_rate=turn / 4.0)
    chain = []
    for frame in range(40):
        points = scan_of([car], frame, view_from=(0.0, 0.0, 0.5)).points.astype(np.float64)
        velocity = car.velocity(0.1 * frame)
        chain.append(Segment(frame, CAR, np.arange(len(points)), points, velocity))
    track = make_track(chain, TIMES)
    off = [track.pose(frame)[:2, 3] - car.pose(0.1 * frame)[:2, 3] for frame in range(40)]
    assert np.linalg.norm(off, axis=1).max() < 0.3
    assert track.extent.size[:2] == pytest.approx(car.size[:2], abs=0.3)
