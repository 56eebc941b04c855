"""The velocities of numbered actors, on points in memory whose motion is known."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from carlasc.converting.actors import ActorMotion, find_actors
from carlasc.core import SEMANTICKITTI, SEMANTICPOSS
from carlasc.core.geometry import invert, rotation_z, transform_points, translation
from carlasc.running import Run

MOVING_CAR, CAR, PERSON = 252, 10, 254
POSS_CAR, POSS_PERSON = 7, 4
BOX = np.random.default_rng(0).uniform(-0.5, 0.5, (150, 3)) * (4.4, 1.8, 1.5)


def scan_of(number, actors, pose):
    """Return points, labels and numbers of boxes that drive straight on: actor -> (class, first
    place, m/s, frames that see it).
    """
    points, labels, instances = [np.full((1, 3), 50.0)], [40], [0]
    for actor, (label, place, velocity, seen) in actors.items():
        if number in seen:
            world = BOX + np.array(place) + 0.1 * number * np.array(velocity)
            points.append(transform_points(invert(pose), world))
            labels += [label] * len(BOX)
            instances += [actor] * len(BOX)
    stacked = np.pad(np.concatenate(points), ((0, 0), (0, 1))).astype(np.float32)
    return stacked, np.array(labels, np.uint16), np.array(instances, np.uint32)


def estimate(frames, actors, classes=SEMANTICKITTI, poses=None, damaged=(), run=Run(1)):  # noqa: B008 (frozen)
    motion = ActorMotion(classes, run)
    for number in frames:
        pose = np.eye(4) if poses is None else poses[number]
        points, labels, instances = scan_of(number, actors, pose)
        if number in damaged:
            points[5] = np.nan
        motion.add(number, 0.1 * number, pose, find_actors(points, labels, instances, classes))
    return motion.finish()


def test_only_actors_of_moving_classes_get_a_velocity_where_a_table_has_them():
    frames = range(12)
    actors = {
        1: (MOVING_CAR, (10, 0, 0), (6, 0, 0), frames),
        2: (CAR, (10, 8, 0), (6, 0, 0), frames),
    }
    velocities = estimate(frames, actors)
    assert {actor for by_actor in velocities.values() for actor in by_actor} == {1}
    np.testing.assert_allclose(velocities[6][1], (6, 0, 0), atol=0.3)


def test_velocities_are_in_the_frame_of_each_scans_sensor():
    frames = range(12)
    poses = np.stack([rotation_z(np.pi / 2) @ translation((0.1 * frame, 0, 0)) for frame in frames])
    velocities = estimate(frames, {1: (MOVING_CAR, (0, 12, 0), (0, 5, 0), frames)}, poses=poses)
    # the sensor looks along the world's y
    np.testing.assert_allclose(velocities[6][1], (5, 0, 0), atol=0.3)


def test_an_actor_that_was_hidden_for_long_is_estimated_anew():
    """It turns while nobody sees it: one path over the gap would mix both motions."""
    motion = ActorMotion(SEMANTICKITTI, Run(workers=1))
    before = {1: (MOVING_CAR, (10, 0, 0), (6, 0, 0), range(8))}
    after = {1: (MOVING_CAR, (40, 0, 0), (0, 4, 0), range(30, 38))}
    for number in [*range(8), *range(30, 38)]:
        scan = scan_of(number, before | after if number >= 30 else before, np.eye(4))
        motion.add(number, 0.1 * number, np.eye(4), find_actors(*scan, SEMANTICKITTI))
    velocities = motion.finish()
    assert sorted(velocities) == [*range(8), *range(30, 38)]
    np.testing.assert_allclose(velocities[7][1], (6, 0, 0), atol=0.4)
    np.testing.assert_allclose(velocities[30][1], (0, 4, 0), atol=0.4)


def test_without_moving_classes_actors_that_stay_where_they_are_get_zero():
    frames = range(15)
    actors = {
        1: (POSS_CAR, (10, 0, 0), (5, 0, 0), frames),
        2: (POSS_CAR, (10, 8, 0), (0, 0, 0), frames),
    }
    velocities = estimate(frames, actors, SEMANTICPOSS)
    np.testing.assert_allclose(velocities[7][1], (5, 0, 0), atol=0.3)
    assert velocities[7][2] == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("seconds", [0.5, 0.7, 2.0])
def test_a_person_who_walks_moves_however_short_the_way_is(seconds):
    frames = range(round(10 * seconds) + 1)
    walking = {
        1: (POSS_PERSON, (6, 2, 0), (1.4, 0, 0), frames),
        2: (POSS_PERSON, (6, -3, 0), (0, 0, 0), frames),
    }
    velocities = estimate(frames, walking, SEMANTICPOSS)
    np.testing.assert_allclose(velocities[len(frames) // 2][1], (1.4, 0, 0), atol=0.2)
    assert velocities[len(frames) // 2][2] == (0.0, 0.0, 0.0)


def test_points_that_are_not_finite_are_left_out():
    frames = range(12)
    actors = {1: (MOVING_CAR, (10, 0, 0), (6, 0, 0), frames)}
    velocities = estimate(frames, actors, damaged={6})
    np.testing.assert_allclose(velocities[6][1], (6, 0, 0), atol=0.3)


@pytest.mark.parametrize("label", [PERSON, MOVING_CAR])
def test_people_are_followed_by_their_centre_and_vehicles_by_their_planes(label, monkeypatch):
    from carlasc.converting import actors

    rigid = []
    estimate_path = actors.estimate_path
    monkeypatch.setattr(
        actors,
        "estimate_path",
        lambda *args, **options: rigid.append(options["rigid"]) or estimate_path(*args, **options),
    )
    estimate(range(6), {1: (label, (10, 0, 0), (1, 0, 0), range(6))})
    assert rigid == [label == MOVING_CAR]


def test_long_observations_are_estimated_in_pieces_and_every_frame_has_a_velocity(monkeypatch):
    from carlasc.converting import actors

    lengths = []
    monkeypatch.setattr(
        actors,
        "estimate_path",
        lambda points, *_, **__: (
            lengths.append(len(points)) or (None, np.zeros((len(points), 3)), None)
        ),
    )
    velocities = estimate(range(900), {1: (MOVING_CAR, (10, 0, 0), (0, 0, 0), range(900))})
    assert sum(lengths) == len(velocities) == 900
    assert max(lengths) <= 400


def test_points_of_actors_that_left_are_not_kept():
    """Paths are estimated as soon as a batch of actors was not seen for a while, so memory does not
    grow with the drive.
    """
    motion = ActorMotion(SEMANTICKITTI, Run(workers=1))
    held = []
    for number in range(600):
        actors = {number // 4 + 1: (MOVING_CAR, (10, 0, 0), (0, 0, 0), range(number, number + 1))}
        motion.add(
            number,
            0.1 * number,
            np.eye(4),
            find_actors(*scan_of(number, actors, np.eye(4)), SEMANTICKITTI),
        )
        held.append(len(motion._chains) + len(motion._ended))
    assert max(held) < 45
    assert len(motion.finish()) == 600


def test_an_executor_gives_the_same():
    frames = range(20)
    actors = {n: (MOVING_CAR, (10, 4 * n, 0), (6, 0, 0), frames) for n in range(1, 4)}
    with ThreadPoolExecutor(2) as executor:
        assert estimate(frames, actors, run=Run(2, executor)) == estimate(frames, actors)
