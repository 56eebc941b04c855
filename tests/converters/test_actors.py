"""The velocities of a recording's actors, on points in memory whose motion is known."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from helpers.recordings import MemoryFrame, MemoryRecording

from carlasc.converting import FrameContent
from carlasc.converting.actors import estimate_actor_velocities
from carlasc.converting.results import Steps
from carlasc.core import SEMANTICKITTI, SEMANTICPOSS
from carlasc.core.geometry import invert, rotation_z, transform_points, translation

MOVING_CAR, CAR, PERSON = 252, 10, 254
POSS_CAR = 7
BOX = np.random.default_rng(0).uniform(-0.5, 0.5, (150, 3)) * (4.4, 1.8, 1.5)


def record(frames, actors, poses=None):
    """Return a recording of boxes that drive straight on: actor -> (class, first place, m/s, frames that see it)."""
    handles = []
    for number in frames:
        points, labels, instances = [np.full((1, 3), 50.0)], [40], [0]
        for actor, (label, place, velocity, seen) in actors.items():
            if number in seen:
                world = BOX + np.array(place) + 0.1 * number * np.array(velocity)
                pose = np.eye(4) if poses is None else poses[number]
                points.append(transform_points(invert(pose), world))
                labels += [label] * len(BOX)
                instances += [actor] * len(BOX)
        stacked = np.pad(np.concatenate(points), ((0, 0), (0, 1))).astype(np.float32)
        content = FrameContent(stacked, np.array(labels, np.uint16), np.array(instances, np.uint32))
        handles.append(MemoryFrame(number, content))
    return MemoryRecording(handles)


def estimate(recording, classes=SEMANTICKITTI, poses=None, **options):
    last = recording.frames[-1].number + 1
    poses = np.tile(np.eye(4), (last, 1, 1)) if poses is None else poses
    options = {"workers": 1, "executor": None, "steps": Steps(None, 0)} | options
    return estimate_actor_velocities(recording, poses, np.arange(last) * 0.1, classes, **options)


def test_only_actors_of_moving_classes_get_a_velocity_where_a_table_has_them():
    frames = range(12)
    actors = {1: (MOVING_CAR, (10, 0, 0), (6, 0, 0), frames), 2: (CAR, (10, 8, 0), (6, 0, 0), frames)}
    velocities = estimate(record(frames, actors))
    assert {actor for by_actor in velocities.values() for actor in by_actor} == {1}
    np.testing.assert_allclose(velocities[6][1], (6, 0, 0), atol=0.3)


def test_velocities_are_in_the_frame_of_each_scans_sensor():
    frames = range(12)
    poses = np.stack([rotation_z(np.pi / 2) @ translation((0.1 * frame, 0, 0)) for frame in frames])
    velocities = estimate(record(frames, {1: (MOVING_CAR, (0, 12, 0), (0, 5, 0), frames)}, poses), poses=poses)
    np.testing.assert_allclose(velocities[6][1], (5, 0, 0), atol=0.3)  # the sensor looks along the world's y


def test_an_actor_that_was_hidden_for_long_is_estimated_anew():
    """It turns while nobody sees it: one path over the gap would mix both motions."""
    seen = [*range(8), *range(30, 38)]
    before = {1: (MOVING_CAR, (10, 0, 0), (6, 0, 0), range(8))}
    after = {1: (MOVING_CAR, (40, 0, 0), (0, 4, 0), range(30, 38))}
    handles = [*record(range(8), before).frames, *record(range(30, 38), after).frames]
    velocities = estimate(MemoryRecording(handles))
    assert sorted(velocities) == seen
    np.testing.assert_allclose(velocities[7][1], (6, 0, 0), atol=0.4)
    np.testing.assert_allclose(velocities[30][1], (0, 4, 0), atol=0.4)


def test_without_moving_classes_actors_that_stay_where_they_are_get_zero():
    frames = range(15)
    actors = {1: (POSS_CAR, (10, 0, 0), (5, 0, 0), frames), 2: (POSS_CAR, (10, 8, 0), (0.3, 0, 0), frames)}
    velocities = estimate(record(frames, actors), SEMANTICPOSS)
    np.testing.assert_allclose(velocities[7][1], (5, 0, 0), atol=0.3)
    assert velocities[7][2] == (0.0, 0.0, 0.0)


def test_frames_that_cannot_be_read_and_points_that_are_not_finite_are_left_out():
    frames = range(12)
    recording = record(frames, {1: (MOVING_CAR, (10, 0, 0), (6, 0, 0), frames)})
    recording.frames[4].content = None
    recording.frames[6].content.points[5] = np.nan
    velocities = estimate(recording)
    assert 4 not in velocities
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
    estimate(record(range(6), {1: (label, (10, 0, 0), (1, 0, 0), range(6))}))
    assert rigid == [label == MOVING_CAR]


def test_long_sightings_are_estimated_in_pieces_and_every_frame_has_a_velocity(monkeypatch):
    from carlasc.converting import actors

    lengths = []
    monkeypatch.setattr(
        actors,
        "estimate_path",
        lambda sightings, *_, **__: lengths.append(len(sightings)) or (None, np.zeros((len(sightings), 3))),
    )
    frames = range(900)
    velocities = estimate(record(frames, {1: (MOVING_CAR, (10, 0, 0), (0, 0, 0), frames)}))
    assert lengths == [300, 300, 300]
    assert len(velocities) == 900


def test_steps_count_frames_and_actors_and_an_executor_gives_the_same():
    frames = range(20)
    recording = record(frames, {1: (MOVING_CAR, (10, 0, 0), (6, 0, 0), frames)})
    seen = []
    alone = estimate(recording, steps=Steps(lambda *step: seen.append(step), 0))
    assert seen[-1] == (21, 21)
    with ThreadPoolExecutor(2) as executor:
        assert estimate(recording, workers=2, executor=executor) == alone
