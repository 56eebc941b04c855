"""Annotated boxes that follow the points in them: nearer to the truth than what was drawn; what stands, walks or is hardly seen stays."""

import numpy as np
import pytest
from helpers.scenes.box_actors import PERIOD_S, MovingBox, scan_of

from carlasc import Boxes
from carlasc.core.geometry import invert, rotation_z, translation
from carlasc.motion import segment_by_boxes, tracks_from_boxes
from carlasc.motion.registered_boxes import register_boxes

FRAMES = range(30)
TIMES = {frame: frame * PERIOD_S for frame in FRAMES}
CAR = MovingBox((10, 6, 0), heading=0.4, yaw_rate=0.3, speed=8.0)


def true_pose(actor, frame):
    return actor.pose(TIMES[frame]) @ translation((0, 0, actor.size[2] / 2))


def drawn(actor, metres=0.1, degrees=1.0, count=300, deformable=()):
    """Return the track of an actor's boxes as somebody drew them, the same as its points place it, and the segments."""
    rng, boxes = np.random.default_rng(6), {}
    for frame in FRAMES:
        turn = rotation_z(np.radians(rng.normal(0, degrees)))
        pose = translation(rng.normal(0, metres, 3) * (1, 1, 0.3)) @ true_pose(actor, frame) @ turn
        boxes[frame] = Boxes.from_poses(
            np.array([7], np.uint32), np.array([10], np.uint32), pose[None], np.array([actor.size])
        )
    (track,) = tracks_from_boxes(boxes, {frame: np.eye(4) for frame in FRAMES}, TIMES, deformable=deformable)
    scans = [scan_of([actor], frame, count=count, view_from=(0, 0, 1.5)) for frame in FRAMES]
    segments = [s for f, scan in enumerate(scans) for s in segment_by_boxes(f, scan, np.eye(4), [track])]
    return track, register_boxes(track, segments, TIMES), segments


def blur(track, actor):
    """Return by how much the poses of a track differ from each other, seen from the actor: metres along and across, and radians."""
    off = np.stack([invert(true_pose(actor, frame)) @ track.pose(frame) for frame in FRAMES])
    return np.array([*np.std(off[:, :2, 3], axis=0), np.std(np.arctan2(off[:, 1, 0], off[:, 0, 0]))])


def test_boxes_come_nearer_to_the_truth():
    before, after, _ = drawn(CAR)
    assert (blur(after, CAR) < 0.6 * blur(before, CAR)).all()
    speeds = [np.linalg.norm(after.velocity_at(f) - CAR.velocity(TIMES[f])) for f in FRAMES]
    assert np.median(speeds) < 0.3


def test_exact_boxes_hardly_change():
    before, after, _ = drawn(CAR, metres=0.0, degrees=0.0)
    assert np.abs(after.world_T_actor - before.world_T_actor)[..., :3, 3].max() < 0.05


def test_what_few_rays_hit_stays_where_it_was_drawn():
    before, after, _ = drawn(CAR, count=8)
    assert after is before


def test_what_stands_and_what_changes_its_shape_stays():
    parked = MovingBox(CAR.start, heading=CAR.heading, speed=0.0)
    before, after, segments = drawn(parked)
    assert after is before and segments
    before, after, _ = drawn(CAR, deformable=(10,))
    assert after is before and not after.rigid


def test_frames_without_a_box_in_between_are_moved_too():
    track, all_seen, segments = drawn(CAR)
    after = register_boxes(track, [s for s in segments if not 10 <= s.frame < 15], TIMES)
    off = np.linalg.norm((after.world_T_actor - all_seen.world_T_actor)[9:16, :3, 3], axis=1)
    assert 0 < off.max() < 0.06


@pytest.mark.parametrize("seconds", [[0.0] * 30, [0.1 * (f % 4) for f in FRAMES], [0.1 * (30 - f) for f in FRAMES]])
def test_times_that_do_not_rise_give_finite_tracks(seconds):
    track, _, segments = drawn(CAR)
    after = register_boxes(track, segments, dict(enumerate(seconds)))
    assert np.isfinite(after.world_T_actor).all() and np.isfinite(after.velocity).all()


def test_two_sightings_in_one_scan_give_a_finite_track():
    """Boxes of one number that jump give two tracks, which both extend to some frames."""
    track, _, segments = drawn(CAR)
    after = register_boxes(track, [s for segment in segments for s in (segment, segment)], TIMES)
    assert np.isfinite(after.velocity).all()
