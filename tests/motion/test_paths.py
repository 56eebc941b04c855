"""Velocities from points alone, of actors with known motion; the compiled loops against plain
NumPy.
"""

import numpy as np
import pytest
from helpers.scenes.box_actors import PERIOD_S, MovingBox, box_surface, scan_of

from carlasc.core.arrays import FloatArray
from carlasc.motion.paths import (
    best_observation,
    corrections,
    ends,
    estimate_path,
    follow,
    headings_of_vehicle,
    is_static,
)
from carlasc.motion.solving import headings_of

FRAMES = range(25)
SECONDS = np.array(FRAMES) * PERIOD_S


def observations_of(actor, view=None, count=400):
    return [
        scan_of([actor], frame, count=count, view_from=view).points.astype(np.float64)
        for frame in FRAMES
    ]


def truth(actor):
    return np.stack([actor.velocity(time) for time in SECONDS])


@pytest.mark.parametrize("view", [None, (0, 0, 0.5)])
@pytest.mark.parametrize("yaw_rate", [0.0, 0.3])
@pytest.mark.parametrize("speed", [5.0, 12.0])
def test_a_vehicle_is_as_fast_as_it_is_whichever_side_is_seen(view, yaw_rate, speed):
    actor = MovingBox((10, 6, 0), heading=0.4, yaw_rate=yaw_rate, speed=speed)
    errors = np.linalg.norm(
        estimate_path(observations_of(actor, view), SECONDS, rigid=True)[1] - truth(actor), axis=1
    )
    assert np.median(errors) < 0.15


def test_a_vehicle_that_brakes_is_followed():
    actor = MovingBox((10, 6, 0), speed=lambda time: max(0.0, 8 - 4 * time))
    errors = np.linalg.norm(
        estimate_path(observations_of(actor), SECONDS, rigid=True)[1] - truth(actor), axis=1
    )
    assert np.median(errors) < 0.3
    assert errors[-1] < 0.5


def test_observations_of_few_points_inherit_from_their_track():
    actor = MovingBox((10, 6, 0), speed=8.0)
    observations = observations_of(actor)
    for frame in (9, 10, 24):
        observations[frame] = np.full((2, 3), 1000.0)  # two stray points far away
    velocities = estimate_path(observations, SECONDS, rigid=True)[1]
    assert np.abs(velocities[[9, 10, 24]] - (8, 0, 0)).max() < 0.5


def test_people_are_followed_by_their_middle():
    rng = np.random.default_rng(0)
    observations = [
        rng.uniform(-0.3, 0.3, (80, 3)) * (1, 1, 3) + (1.4 * time, 0, 1) for time in SECONDS
    ]
    velocities = estimate_path(observations, SECONDS, rigid=False)[1]
    assert np.abs(np.median(velocities, axis=0) - (1.4, 0, 0)).max() < 0.1


def test_an_actor_seen_once_or_never_has_no_velocity():
    once = [box_surface((4, 2, 1.5), 100)]
    assert not estimate_path(once, np.zeros(1), rigid=True)[1].any()
    assert (
        estimate_path([np.empty((0, 3))] * 3, np.arange(3.0), rigid=True)[1].tolist()
        == [[0, 0, 0]] * 3
    )


def people(rng, count=80):
    return [rng.uniform(-0.3, 0.3, (count, 3)) * (1, 1, 3) + (1.4 * time, 0, 1) for time in SECONDS]


def test_nine_points_are_too_few_to_follow_and_ten_are_enough():
    for count, used in ((9, False), (10, True)):
        observations = people(np.random.default_rng(1))
        for frame in range(4):
            observations[frame] = observations[frame][:count] + (4.0, 0, 0)
        velocity = estimate_path(observations, SECONDS, rigid=False)[1][4]
        assert (abs(velocity[0] - 1.4) > 0.8) == used


def test_a_velocity_changes_by_no_more_than_six_metres_per_second_squared():
    observations = people(np.random.default_rng(2))
    observations[-2:] = [points + (3.0, 0, 0) for points in observations[-2:]]
    changes = np.linalg.norm(
        np.diff(estimate_path(observations, SECONDS, rigid=False)[1], axis=0), axis=1
    )
    assert changes.max() == pytest.approx(6.0 * PERIOD_S)


def test_a_heading_is_that_of_the_motion_and_is_held_while_an_actor_is_slow():
    velocities = np.array([[5.0, 0, 0], [0.5, 0.8, 0], [-0.2, 0.9, 0], [0, 5.0, 0], [0, -0.9, 0]])
    assert np.allclose(headings_of(velocities), np.array([0, 1, 2, 3, 3]) * np.pi / 6)
    assert np.allclose(headings_of(velocities[1:2]), np.arctan2(0.8, 0.5))


def test_a_vehicle_in_a_bend_points_where_registration_says():
    """Its middle moves 5 degrees beside where it points; directions are off by 3 degrees in a scan."""
    turns = 0.4 * SECONDS
    noise = np.random.default_rng(4).normal(0, 0.05, len(SECONDS))
    motion = turns + 0.3 + np.where(SECONDS > 1.8, 0.09, 0.0) + noise
    velocities = 6 * np.column_stack([np.cos(motion), np.sin(motion), np.zeros(len(SECONDS))])
    by_turns, by_motion = (
        headings_of_vehicle(velocities, SECONDS, 0.0, turns) - turns - 0.3,
        headings_of(velocities) - turns - 0.3,
    )
    assert np.abs(by_turns[:12]).max() < 0.6 * np.abs(by_motion[:12]).max()


def manoeuvre(speeds: FloatArray, rates: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the headings and the velocities of the centre of a vehicle, 5 m long, that turns
    around a place beside its rear axle.
    """
    headings = 0.5 + np.cumsum(rates) * PERIOD_S
    along, aside = (
        np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(SECONDS))])
        for angle in (headings, headings + np.pi / 2)
    )
    return headings, speeds[:, None] * along + (rates * 0.3 * 5.0)[:, None] * aside


@pytest.mark.parametrize("is_registered", [False, True])
def test_a_vehicle_that_goes_back_and_forth_keeps_its_front(is_registered):
    back = SECONDS[-1] / 3 > SECONDS
    headings, velocities = manoeuvre(np.where(back, -4.0, 4.0), np.where(back, 0.0, 0.5))
    turns = headings - headings[0] if is_registered else None
    found = headings_of_vehicle(velocities, SECONDS, 5.0, turns)
    assert np.abs(np.angle(np.exp(1j * (found - headings)))).mean() < 0.08
    assert np.abs(np.angle(np.exp(1j * (headings_of(velocities) - headings)))).max() > 2.9


@pytest.mark.parametrize("speed", [-4.0, 4.0])
def test_sides_show_where_a_vehicle_points_in_a_steady_circle(speed):
    headings, velocities = manoeuvre(*np.tile([[speed], [0.6]], len(SECONDS)))
    sides = headings[0] - np.pi / 2  # a quarter of a turn does not matter
    found = headings_of_vehicle(velocities, SECONDS, 5.0, headings - headings[0], sides)
    assert np.abs(np.angle(np.exp(1j * (found - headings)))).max() < 0.1
    reverse = headings_of_vehicle(velocities, SECONDS, np.sign(speed) * 5.0) + (speed < 0) * np.pi
    assert np.abs(np.angle(np.exp(1j * (reverse - headings)))).max() < 0.02


def test_registration_shows_that_a_vehicle_is_in_reverse_in_a_bend():
    rates = np.where(SECONDS[-1] / 2 > SECONDS, 0.0, 0.6)
    headings, velocities = manoeuvre(np.full(len(SECONDS), -4.0), rates)
    found = headings_of_vehicle(velocities, SECONDS, 5.0, headings)
    assert np.abs(np.angle(np.exp(1j * (found - headings)))).mean() < 0.1
    without = headings_of_vehicle(velocities, SECONDS, 5.0)
    assert np.abs(np.angle(np.exp(1j * (without - headings)))).min() > 2.5


def test_observations_are_laid_on_each_other_near_what_is_known():
    actor = MovingBox((10, 6, 0), speed=8.0, yaw_rate=0.2)
    poses = [actor.pose(time) for time in SECONDS]
    true = np.array([[*pose[:3, 3], np.arctan2(pose[1, 0], pose[0, 0])] for pose in poses])
    # errors that change slowly, as those of a path do
    waves = np.sin(np.add.outer(SECONDS * np.pi, [0.0, 1.0, 2.0, 3.0]))
    wrong = true + waves * (0.12, 0.12, 0.0, 0.015)
    error = np.array([0.08, 0.08, 0.02, 0.01])
    laid = wrong + corrections(observations_of(actor), SECONDS, wrong, error, 12)[0]
    shape = lambda states: np.std(states - true, axis=0)  # noqa: E731 (a common error of all blurs nothing)
    assert (shape(laid)[:2] < 0.5 * shape(wrong)[:2]).all()
    few = [points[:2] for points in observations_of(actor)]
    assert np.allclose(wrong + corrections(few, SECONDS, wrong, error, 12)[0], wrong)


class TestStatic:
    def static(self, observations, velocity=(0.0, 0.0, 0.0)):
        positions = np.outer(SECONDS, velocity) + (10, 0, 0)
        path = positions, np.zeros_like(positions), np.zeros(len(SECONDS))
        return is_static(observations, path, SECONDS)

    def test_observations_at_one_place_are_of_a_static_actor(self):
        assert self.static([box_surface((4, 2, 1.5), 300, seed) for seed in range(25)], (0.5, 0, 0))

    def test_observations_that_overlap_only_after_their_motion_are_of_a_moving_one(self):
        moving = [
            box_surface((4, 2, 1.5), 300, seed) + (8 * time, 0, 0)
            for seed, time in enumerate(SECONDS)
        ]
        assert not self.static(moving, (8.0, 0, 0))

    def test_observations_that_never_overlap_are_not_of_a_static_one(self):
        rng = np.random.default_rng(3)
        assert not self.static([rng.uniform(-4, 4, (12, 3)) for _ in SECONDS])

    def test_a_single_observation_is_of_a_static_actor(self):
        path = np.zeros((1, 3)), np.zeros((1, 3)), np.zeros(1)
        assert is_static([np.zeros((5, 3))], path, np.zeros(1))


def test_a_path_goes_on_evenly_on_both_sides_of_where_it_starts():
    actor = MovingBox((10, 6, 0), speed=8.0)
    observations = observations_of(actor)
    path, *_ = follow(observations, SECONDS, best_observation(observations))
    assert np.abs(np.diff(path, axis=0) - (0.8, 0, 0)).max() < 0.1


@pytest.mark.parametrize("count", [1, 2, 20, 21, 26, 50, 51, 101, 400])
def test_ends_are_quantiles(count):
    values = np.random.default_rng(count).normal(size=count)
    found = np.ravel(ends(values[:, None]))
    assert found == pytest.approx(np.quantile(values, (0.02, 0.98)), abs=1e-15)


@pytest.mark.parametrize("rigid", [True, False])
def test_points_that_are_seen_one_after_the_other_show_the_path_at_the_times_of_the_scans(rigid):
    actor = MovingBox((10, 6, 0), speed=10.0)
    instant = observations_of(actor)
    # a LiDAR that turns sees the actor later in each scan, half of its points later than the others
    delays = [
        0.04 * (frame / 12 - 1) + np.where(np.arange(len(points)) % 2, 0.01, -0.01)
        for frame, points in enumerate(instant)
    ]
    seen = [
        points + np.outer(delay, (10.0, 0.0, 0.0))
        for points, delay in zip(instant, delays, strict=True)
    ]
    there, velocity, _ = estimate_path(seen, SECONDS, rigid=rigid, delays=delays)
    expected = estimate_path(instant, SECONDS, rigid=rigid)[0]
    smeared = estimate_path(seen, SECONDS, rigid=rigid)[0]

    def deviation(path):
        return np.ptp((path - expected)[:, 0])  # the origin of a body is arbitrary

    assert deviation(there) < 0.2
    assert deviation(smeared) > 0.5
    assert np.median(np.linalg.norm(velocity - truth(actor), axis=1)) < 0.3
