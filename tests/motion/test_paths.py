"""Velocities from points alone, of actors with known motion."""

import numpy as np
import pytest
from helpers.actors import PERIOD_S, MovingBox, box_surface, scan_of

from carlasc.motion.paths import estimate_path
from carlasc.motion.registration import follow

FRAMES = range(25)
SECONDS = np.array(FRAMES) * PERIOD_S


def sightings_of(actor, view=None, count=400):
    return [scan_of([actor], frame, count=count, view_from=view).points.astype(np.float64) for frame in FRAMES]


def truth(actor):
    return np.stack([actor.velocity(time) for time in SECONDS])


@pytest.mark.parametrize("view", [None, (0, 0, 0.5)])
@pytest.mark.parametrize("yaw_rate", [0.0, 0.3])
@pytest.mark.parametrize("speed", [5.0, 12.0])
def test_a_vehicle_is_as_fast_as_it_is_whichever_side_is_seen(view, yaw_rate, speed):
    actor = MovingBox((10, 6, 0), heading=0.4, yaw_rate=yaw_rate, speed=speed)
    errors = np.linalg.norm(estimate_path(sightings_of(actor, view), SECONDS, rigid=True)[1] - truth(actor), axis=1)
    assert np.median(errors) < 0.15


def test_a_vehicle_that_brakes_is_followed():
    actor = MovingBox((10, 6, 0), speed=lambda time: max(0.0, 8 - 4 * time))
    errors = np.linalg.norm(estimate_path(sightings_of(actor), SECONDS, rigid=True)[1] - truth(actor), axis=1)
    assert np.median(errors) < 0.3
    assert errors[-1] < 0.5


def test_sightings_of_few_points_inherit_from_their_track():
    actor = MovingBox((10, 6, 0), speed=8.0)
    sightings = sightings_of(actor)
    for frame in (9, 10, 24):
        sightings[frame] = np.full((2, 3), 1000.0)  # two stray points far away
    velocities = estimate_path(sightings, SECONDS, rigid=True)[1]
    assert np.abs(velocities[[9, 10, 24]] - (8, 0, 0)).max() < 0.5


def test_people_are_followed_by_their_middle():
    rng = np.random.default_rng(0)
    sightings = [rng.uniform(-0.3, 0.3, (80, 3)) * (1, 1, 3) + (1.4 * time, 0, 1) for time in SECONDS]
    velocities = estimate_path(sightings, SECONDS, rigid=False)[1]
    assert np.abs(np.median(velocities, axis=0) - (1.4, 0, 0)).max() < 0.1


def test_an_actor_seen_once_or_never_has_no_velocity():
    once = [box_surface((4, 2, 1.5), 100)]
    assert not estimate_path(once, np.zeros(1), rigid=True)[1].any()
    assert estimate_path([np.empty((0, 3))] * 3, np.arange(3.0), rigid=True)[1].tolist() == [[0, 0, 0]] * 3


def test_a_path_goes_on_evenly_on_both_sides_of_where_it_starts():
    actor = MovingBox((10, 6, 0), speed=8.0)
    path = follow(sightings_of(actor), SECONDS)
    assert np.abs(np.diff(path, axis=0) - (0.8, 0, 0)).max() < 0.1
