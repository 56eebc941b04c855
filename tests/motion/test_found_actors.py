"""Actors are followed over time, and only actors whose observations align better along a path than
without motion are found.
"""

from dataclasses import replace

import numpy as np
import pytest
from helpers.references.whole_drives import find_actors, link_segments
from helpers.scenes.moving_scenes import CAR, PERSON, WALL, WALLS, box, car, film, person

from carlasc.captures.settings import Lidar
from carlasc.motion import found_actors
from carlasc.motion.evidence import FreeSpaceEvidence, MovedCluster, find_evidence
from carlasc.motion.found_actors import ActorFollower
from carlasc.motion.paths import Segment
from carlasc.motion.tracks import MovingActors


def actors(scene, frames=40, **options):
    return find_actors([scan for scan, _ in film(scene, frames, **options)])


def test_a_passing_car_is_one_actor_with_its_velocity():
    found = actors(lambda t: [*WALLS, car(-16.0 + 8.0 * t, 6.0), car(5.0, -6.0)])
    (actor,) = found.tracked
    assert actor.rigid
    assert len(actor.segments) >= 35
    velocities = np.stack([segment.velocity for segment in actor.segments])
    assert np.abs(velocities - (8.0, 0.0, 0.0)).max() < 0.5
    assert {segment.instance for segment in found.segments} == {1}


def test_someone_who_walks_is_an_actor_that_changes_its_shape():
    (actor,) = actors(lambda t: [*WALLS, person(-3.0 + 1.4 * t, 7.0)], noise_m=0.01).tracked
    assert not actor.rigid
    assert abs(np.median([segment.velocity[0] for segment in actor.segments]) - 1.4) < 0.2


def test_two_cars_that_meet_are_two_actors():
    def meet(seconds):
        return [*WALLS, car(-16.0 + 8.0 * seconds, 4.0), car(16.0 - 8.0 * seconds, 8.0)]

    speeds = sorted(
        float(np.median([s.velocity[0] for s in m.segments])) for m in actors(meet).tracked
    )
    assert np.allclose([speeds[0], speeds[-1]], [-8.0, 8.0], atol=0.4)
    assert all(abs(abs(speed) - 8.0) < 1.0 for speed in speeds)


def test_numbers_and_classes_can_be_given():
    scans = [scan for scan, _ in film(lambda t: [*WALLS, car(-16.0 + 8.0 * t, 6.0)])]
    found = find_actors(scans, first_instance=500, default_label=3)
    assert {(segment.instance, segment.label) for segment in found.segments} == {(500, 3)}


def test_labels_say_what_moved():
    def both(seconds):
        return [*WALLS, car(-16.0 + 8.0 * seconds, 6.0), person(-3.0 + 1.4 * seconds, -7.0)]

    scans = [scan for scan, _ in film(both, labels=True)]
    found = find_actors(scans, movable={CAR, PERSON}, deformable={PERSON})
    assert sorted((m.segments[0].label, m.rigid) for m in found.tracked) == [
        (PERSON, False),
        (CAR, True),
    ]


def test_segments_become_tracks_as_those_of_labelled_actors():
    found = actors(lambda t: [*WALLS, car(-16.0 + 8.0 * t, 6.0)])
    (track,) = link_segments(found.segments, {frame: 0.1 * frame for frame in range(40)})
    assert track.moves
    assert np.allclose(track.velocity_at(20), (8.0, 0.0, 0.0), atol=0.4)
    assert abs(track.pose(20)[0, 3]) < 0.6


def test_moved_points_are_told_for_every_frame():
    found = actors(lambda t: [*WALLS, car(-16.0 + 8.0 * t, 6.0)], 20)
    assert sorted(found.moved) == list(range(20))
    for segment in found.segments:
        assert np.isin(segment.members, found.moved[segment.frame]).all()


def test_what_is_free_on_one_side_in_time_only_does_not_move_by_itself():
    follower, near = ActorFollower(), np.empty(0, np.int64)
    clusters = tuple(
        MovedCluster(Segment(0, 0, np.arange(10) + first, np.full((10, 3), x), None), 10, passed, 0)
        for first, x, passed in ((0, 0.0, 1), (10, 30.0, 9))
    )
    follower.add(FreeSpaceEvidence(0, 0.0, 20, clusters, np.eye(4), near))
    assert follower.moved[0].tolist() == list(range(10, 20))


def test_nothing_moves_without_scans_or_with_one():
    assert actors(lambda _: [*WALLS], 0).tracked == ()
    assert actors(lambda t: [*WALLS, car(8.0 * t, 6.0)], 1).tracked == ()


COARSE = Lidar(channels=16, points=16 * 1800, noise_m=0.0)
LEAVES = (
    np.random.default_rng(3).uniform((-0.1, 0.1, 0.2, 0.9), (0.1, 0.3, 0.5, 1.3), (113, 4)).tolist()
)
STATIC = {
    "fence": (8.0, [box(x, 6.0, (0.1, 0.1, 1.2), WALL) for x in np.arange(-15.0, 30.0, 0.5)]),
    "rail": (4.0, [box(x, 4.0, (4.0, 0.1, 0.3), WALL) for x in np.arange(-15.0, 30.0, 4.5)]),
    "hedge": (
        4.0,
        [box(-15.0 + 0.4 * i, 6.0 + y, size, WALL) for i, (y, *size) in enumerate(LEAVES)],
    ),
}
"""What repeats: the speed of the sensor, m/s, at which most of it seems to move, and the boxes."""


@pytest.mark.slow
@pytest.mark.parametrize("name", STATIC)
def test_what_repeats_along_the_street_is_no_actor(name):
    speed, boxes = STATIC[name]
    filmed = film(
        lambda _: [*WALLS, *boxes], 24, ego_m_s=speed, noise_m=0.02, noise_deg=0.1, lidar=COARSE
    )
    assert find_actors(scan for scan, _ in filmed).tracked == ()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "speed", "y"),
    [((4.4, 1.8, 1.5), 8.0, 3.5), ((1.7, 0.5, 1.6), 5.0, 5.0), ((0.5, 0.5, 1.7), 1.4, -4.0)],
)
def test_actors_are_found_beside_what_repeats_and_are_sure(size, speed, y):
    def scene(seconds):
        return [*WALLS, *STATIC["rail"][1], box(-6.0 + speed * seconds, y - 1.0, size, CAR)]

    filmed = film(scene, 30, ego_m_s=4.0, noise_m=0.02, noise_deg=0.1)
    found = find_actors(scan for scan, _ in filmed).tracked
    assert [
        round(float(np.median([s.velocity[0] for s in m.segments])) / speed, 0) for m in found
    ] == [1.0]
    assert all(actor.confidence > 0.8 for actor in found)


def test_points_on_the_recording_vehicle_are_found_and_are_no_actor():
    rack = (
        np.random.default_rng(1)
        .uniform((-2.4, 0.2, -0.6), (-2.1, 0.5, -0.4), (25, 3))
        .astype(np.float32)
    )
    filmed = [
        replace(scan, points=np.concatenate([scan.points, rack]))
        for scan, _ in film(lambda _: WALLS, 24, ego_m_s=6.0, lidar=COARSE)
    ]
    found = find_actors(filmed)
    assert found.tracked == ()
    corners = np.stack(found.own)
    assert MovingActors(own=found.own).is_own(rack).all()
    assert np.ptp(corners.reshape(-1, 3), axis=0).max() < 1


def test_parts_of_the_recording_vehicle_may_be_anywhere_and_a_person_beside_it_is_none():
    rng = np.random.default_rng(1)
    sill = rng.uniform((-1.1, 1.2, -0.7), (-0.8, 1.45, -0.5), (25, 3)).astype(np.float32)
    filmed = film(
        lambda t: [*WALLS, person(t + 0.3 * np.sin(t), -1.6 + 0.2 * np.sin(2 * t))],
        40,
        ego_m_s=1.0,
    )
    found = find_actors(
        replace(scan, points=np.concatenate([scan.points, sill])) for scan, _ in filmed
    )
    assert MovingActors(own=found.own).is_own(sill).all()
    assert np.ptp(np.stack(found.own).reshape(-1, 3), axis=0).max() < 1  # the person is none
    (actor,) = found.tracked
    assert actor.segments[0].points[:, 1].mean() < 0


def test_a_car_beside_the_sensor_that_keeps_its_speed_is_not_the_recording_vehicle():
    filmed = film(lambda t: [*WALLS, car(6.0 * t + 1.0, 3.0)], 24, ego_m_s=6.0)
    found = find_actors(scan for scan, _ in filmed)
    (actor,) = found.tracked
    assert actor.confidence > 0.8 and found.own == ()


def test_a_rider_who_keeps_nearly_the_pace_beside_the_sensor_is_no_part_of_the_vehicle():
    rider = (1.7, 0.6, 1.6)
    filmed = film(
        lambda t: [*WALLS, box(6.1 * t - 0.9, -2.0, rider, CAR)], 24, ego_m_s=6.0, lidar=COARSE
    )
    found = find_actors(scan for scan, _ in filmed)
    (actor,) = found.tracked
    assert found.own == () and abs(actor.segments[0].velocity[0] - 6.1) < 0.3


def test_actors_are_estimated_again_while_scans_come(monkeypatch):
    """What is remembered of earlier estimates may be forgotten."""
    monkeypatch.setattr(found_actors, "_BESIDE", 2)
    filmed = film(
        lambda t: [*WALLS, person(t + 0.3 * np.sin(t), -1.6), car(-16.0 + 8.0 * t, 6.0)],
        40,
        ego_m_s=1.0,
    )
    follower, made = ActorFollower(), set()
    for evidence in find_evidence(scan for scan, _ in filmed):
        actors = [*follower.add(evidence), *follower.again(evidence.seconds - 0.5, 1)]
        made |= {actor.segments[0].instance for actor in actors}
        follower.forget_before(evidence.frame - 20)
        follower.find_own()
    assert len(made) > 6 and len(made - follower.replaced) == 2
    assert not follower.finish()[2:] and follower.own == []
