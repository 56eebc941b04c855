from dataclasses import replace

import numpy as np
import pytest
from helpers.references.whole_drives import link_segments
from helpers.scenes.box_actors import PERIOD_S, MovingBox, scan_of

from carlasc.core.geometry import invert, rotation_z, transform_points, translation
from carlasc.motion import segment_by_flow, segment_by_instances, static_actor_points

FRAMES = range(30)
TIMES = {frame: frame * PERIOD_S for frame in range(60)}


def sensor_pose(frame):
    return translation((0.3 * frame, 0.05 * frame, 0)) @ rotation_z(0.02 * frame)


def tracks_by_flow(actors, frames=FRAMES, hidden=(), **options):
    segments, static = [], {}
    for frame in frames:
        if frame not in hidden:
            scan = scan_of(actors, frame, sensor_pose(frame), **options)
            segments += segment_by_flow(frame, scan, sensor_pose(frame))
            static[frame] = static_actor_points(frame, scan, sensor_pose(frame), {10})
    return link_segments(segments, TIMES, static)


def carried_error(track, actor, frames):
    """How far, at most, the track carries points of the actor from where they really go, over pairs
    of frames.
    """
    corners = (
        np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (0, 2)])
        * np.array(actor.size)
        / 2
    )
    worst = 0.0
    for there in frames:
        for here in frames:
            moved = track.pose(here) @ invert(track.pose(there)) @ actor.pose(there * PERIOD_S)
            truth = actor.pose(here * PERIOD_S)
            worst = max(
                worst,
                np.abs(transform_points(moved, corners) - transform_points(truth, corners)).max(),
            )
    return worst


def test_a_scan_splits_into_its_actors():
    actors = [
        MovingBox((10, 5, 0)),
        MovingBox((10, 9, 0), speed=5.0),
        MovingBox((-10, 0, 0), heading=2.0),
    ]
    segments = segment_by_flow(0, scan_of(actors, 0), np.eye(4))
    assert len(segments) == 3
    assert sorted(len(segment.members) for segment in segments) == [600] * 3
    assert all(np.ptp(segment.points[:, 1]) < 5 for segment in segments)


def test_what_stands_is_no_segment_and_neither_is_a_flow_that_is_no_number():
    scan = scan_of([MovingBox((10, 5, 0), speed=0.1), MovingBox((20, 5, 0))], 0)
    flow = scan.flow.copy()
    flow[600:] = np.nan
    assert segment_by_flow(0, replace(scan, flow=flow), np.eye(4)) == []
    assert segment_by_flow(0, replace(scan, flow=None), np.eye(4)) == []


@pytest.mark.parametrize("yaw_rate", [0.0, 0.4, -0.4])
def test_flow_carries_an_actor_where_it_goes_in_turns_too(yaw_rate):
    actor = MovingBox((10, 5, 0), heading=0.5, yaw_rate=yaw_rate)
    (track,) = tracks_by_flow([actor])
    assert carried_error(track, actor, (0, 7, 15, 29)) < 0.08
    assert np.allclose(track.size - 0.2, actor.size, atol=0.25)


def test_an_actor_seen_from_one_side_only_is_carried_too():
    actor = MovingBox((10, 8, 0), heading=0.2, yaw_rate=0.3)
    (track,) = tracks_by_flow([actor], view_from=(0, 0, 0.5))
    assert carried_error(track, actor, (0, 10, 29)) < 0.3


def test_an_actor_hidden_for_a_second_stays_one_track():
    actor = MovingBox((10, 5, 0))
    (track,) = tracks_by_flow([actor], hidden=range(10, 20))
    assert track.pose(15) is not None
    assert carried_error(track, actor, (0, 15, 29)) < 0.08


def test_two_cars_that_meet_do_not_change_places():
    actors = [MovingBox((0, 0, 0)), MovingBox((24, 3, 0), heading=np.pi)]
    tracks = tracks_by_flow(actors)
    assert len(tracks) == 2
    errors = [[carried_error(track, actor, (0, 15, 29)) for actor in actors] for track in tracks]
    assert sorted(int(np.argmin(row)) for row in errors) == [0, 1]
    assert max(min(row) for row in errors) < 0.08


def test_a_car_that_stops_and_goes_on_is_one_track_from_its_first_to_its_last_scan():
    brakes = MovingBox((10, 5, 0), speed=lambda t: max(0.0, 5 - 2.5 * t) + max(0.0, 2.5 * (t - 4)))
    (track,) = tracks_by_flow([brakes], frames=range(60))
    assert sorted(track.members) == list(range(60))
    assert carried_error(track, brakes, (0, 15, 30, 45, 59)) < 0.15


def test_a_parked_car_is_no_track():
    assert tracks_by_flow([MovingBox((10, 5, 0), speed=0.0)]) == []


def test_an_actor_that_jumps_becomes_two():
    segments = []
    for frame in FRAMES:
        actor = MovingBox((10 if frame < 15 else 60, 5, 0))
        segments += segment_by_flow(frame, scan_of([actor], frame), np.eye(4))
    assert len(link_segments(segments, TIMES)) == 2


@pytest.mark.parametrize("one_sided", [False, True])
@pytest.mark.parametrize("yaw_rate", [0.0, 0.3])
def test_numbered_points_alone_carry_an_actor_where_it_goes(yaw_rate, one_sided):
    actor = MovingBox((12, 7, 0), heading=0.5, yaw_rate=yaw_rate)
    segments = []
    for frame in FRAMES:
        pose = sensor_pose(frame)
        scan = scan_of([actor], frame, pose, view_from=pose[:3, 3] if one_sided else None)
        segments += segment_by_instances(frame, replace(scan, flow=None), pose)
    (track,) = link_segments(segments, TIMES)
    assert track.instance == 7
    assert track.moves
    assert carried_error(track, actor, (2, 15, 27)) < 0.35
    speed = np.linalg.norm(track.velocity_at(15))
    assert speed == pytest.approx(8.0, abs=0.3)


def test_a_numbered_actor_that_stands_does_not_move():
    actor = MovingBox((12, 7, 0), speed=0.0)
    segments = []
    for frame in FRAMES:
        segments += segment_by_instances(
            frame, replace(scan_of([actor], frame), flow=None), np.eye(4)
        )
    (track,) = link_segments(segments, TIMES)
    assert not track.moves
