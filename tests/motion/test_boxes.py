"""Tracks from annotated boxes: what stands stands in every frame, what moves follows its path, and
nobody swallows the road.
"""

import numpy as np
import pytest
from carlasc_recorders import TownDrive
from helpers.scenes.box_actors import PERIOD_S, MovingBox, scan_of

from carlasc import Boxes, Scan
from carlasc.core.geometry import invert, rotation_z, transform_points, translation
from carlasc.core.tables import CARLA
from carlasc.motion import segment_by_boxes, tracks_from_boxes
from carlasc.motion.boxes import register_boxes

VEHICLE, PEDESTRIAN, ROAD = 10, 4, 7
SIZE = np.array([4.5, 1.9, 1.6])


def sensor_pose(frame: int) -> np.ndarray:
    """A vehicle that drives 0.8 m a frame on a bend, and nods."""
    pose = translation((0.8 * frame, 0.01 * frame**2, 0.0)) @ rotation_z(0.02 * frame)
    nod = 0.02 * np.sin(frame)
    pose[:3, :3] = pose[:3, :3] @ [
        [np.cos(nod), 0, np.sin(nod)],
        [0, 1, 0],
        [-np.sin(nod), 0, np.cos(nod)],
    ]
    return pose


def tracked(paths, frames=range(40), seconds=0.1, size=SIZE, label=VEHICLE):
    """Return the tracks of objects whose world poses at a frame `paths[number](frame)` gives; None
    where there is no box.
    """
    boxes, poses = {}, {frame: sensor_pose(frame) for frame in frames}
    for frame in frames:
        seen = {number: pose for number, path in paths.items() if (pose := path(frame)) is not None}
        world = np.stack([*seen.values()]) if seen else np.empty((0, 4, 4))
        boxes[frame] = Boxes.from_poses(
            np.array([*seen], np.uint32),
            np.full(len(seen), label, np.uint32),
            invert(poses[frame]) @ world,
            np.tile(size, (len(seen), 1)),
        )
    return tracks_from_boxes(boxes, poses, {frame: frame * seconds for frame in frames})


def straight(speed, heading=0.0, seconds=0.1):
    return lambda frame: rotation_z(heading) @ translation((speed * seconds * frame, 0, 0))


def jittering(step_m, drift_m, seed=0):
    """Boxes of a parked van: each moves by some decimetres, and slowly away and back while it is
    passed.
    """
    rng = np.random.default_rng(seed)
    moves = rng.normal(size=(200, 3)) * [step_m, step_m, step_m / 3]
    turns = rng.normal(size=200) * 0.02

    def path(frame):
        drift = drift_m * np.sin(frame / 12)
        return (
            translation((20, 5, 0))
            @ translation(moves[frame] + [drift, 0, 0])
            @ rotation_z(1 + turns[frame])
        )

    return path


def test_a_parked_van_whose_boxes_jitter_stands_exactly_in_all_frames():
    parked = jittering(0.1, 0.25)
    shown = {1: lambda frame: parked(frame) if 10 <= frame < 70 else None}
    (track,) = tracked(shown, range(80))
    jumps = [np.linalg.norm(parked(f + 1)[:3, 3] - parked(f)[:3, 3]) for f in range(10, 69)]
    assert max(jumps) > 0.34  # that is 3.4 m/s
    assert not track.moves and not track.velocity.any()
    assert track.first == 0 and len(track.world_T_actor) == 80
    assert (track.world_T_actor == track.world_T_actor[0]).all()
    assert np.abs(track.pose(0)[:3, 3] - [20, 5, 0]).max() < 0.1
    assert np.abs(track.pose(0)[:3, :3] - rotation_z(1)[:3, :3]).max() < 0.02


@pytest.mark.parametrize("speed", [0.5, 1.2, 14.0])
def test_what_moves_follows_its_path_at_its_speed(speed):
    (track,) = tracked({3: straight(speed, 0.7)})
    assert track.moves and track.instance == 3 and track.label == VEHICLE
    for frame in range(40):
        assert np.abs(track.pose(frame) - straight(speed, 0.7)(frame)).max() < 1e-6
        assert (
            np.abs(track.velocity_at(frame) - speed * np.array([np.cos(0.7), np.sin(0.7), 0])).max()
            < 1e-6
        )


def test_a_walk_of_a_few_frames_is_a_motion_and_jitter_of_a_few_frames_is_none():
    (walk,) = tracked(
        {1: lambda frame: straight(1.4)(frame) if frame < 5 else None}, label=PEDESTRIAN
    )
    (parked,) = tracked(
        {1: lambda frame: jittering(0.1, 0.0, seed=1)(frame) if frame < 5 else None}
    )
    assert np.linalg.norm(walk.velocity_at(2)) == pytest.approx(1.4)
    assert not parked.velocity.any()
    # frames 0 to 4, and 4 more; none before the drive
    assert len(walk.world_T_actor) == 9 and walk.first == 0
    assert len(parked.world_T_actor) == 9  # too short to say where it is later


def test_pose_drift_does_not_make_a_parked_car_move():
    (track,) = tracked({1: lambda frame: translation((20 + 0.01 * frame, 5, 0))}, range(300))
    assert not track.velocity.any()  # 3 m in 30 s


def test_gaps_are_interpolated_and_boxes_of_two_a_second_are_enough():
    bend = lambda frame: rotation_z(0.01 * frame) @ translation((30, 0, 0)) @ rotation_z(np.pi / 2)  # noqa: E731
    for shown in ({f for f in range(60) if not 20 < f < 28}, set(range(0, 60, 5))):
        (track,) = tracked(
            {1: lambda frame, shown=shown: bend(frame) if frame in shown else None}, range(60)
        )
        for frame in range(max(shown)):
            assert np.linalg.norm(track.pose(frame)[:3, 3] - bend(frame)[:3, 3]) < 0.06
            assert np.abs(track.pose(frame)[:3, :3] - bend(frame)[:3, :3]).max() < 0.03
            assert np.linalg.norm(track.velocity_at(frame)) == pytest.approx(3.0, abs=0.1)


def test_noise_of_moving_boxes_is_smoothed():
    rng = np.random.default_rng(0)
    moves = rng.normal(size=(60, 3)) * 0.1
    (track,) = tracked(
        {1: lambda frame: translation(moves[frame]) @ straight(8.0)(frame)}, range(60)
    )
    errors = [np.linalg.norm(track.pose(f)[:3, 3] - straight(8.0)(f)[:3, 3]) for f in range(60)]
    assert np.mean(errors) < 0.6 * np.linalg.norm(moves, axis=1).mean()


def test_boxes_that_look_backwards_do_not_turn_the_actor():
    def path(frame):
        return straight(8.0, 0.3)(frame) @ rotation_z(np.pi if frame % 4 == 1 else 0.0)

    (track,) = tracked({1: path})
    assert (
        np.abs(np.stack([track.pose(f)[:3, :3] for f in range(40)]) - rotation_z(0.3)[:3, :3]).max()
        < 1e-6
    )


def test_a_number_that_is_used_for_two_objects_gives_two_tracks():
    far = translation((60, 30, 0))
    first, second = tracked(
        {5: lambda frame: straight(8.0)(frame) if frame < 20 else far @ straight(2.0)(frame)}
    )
    assert first.instance == second.instance == 5
    assert first.pose(19)[0, 3] == pytest.approx(15.2) and second.pose(20)[0, 3] == pytest.approx(
        64.0
    )
    assert np.linalg.norm(first.velocity, axis=1).max() < 8.01


def test_one_box_stands_where_it_was_and_no_boxes_give_no_tracks():
    (track,) = tracked({1: lambda frame: straight(5.0)(frame) if frame == 10 else None})
    assert not track.velocity.any() and track.pose(10)[0, 3] == pytest.approx(5.0)
    assert track.pose(30) is None
    assert tracked({}) == []


@pytest.mark.parametrize(
    "seconds", [[0.0] * 12, [0.1 * (f % 4) for f in range(12)], [0.1 * (12 - f) for f in range(12)]]
)
def test_times_that_do_not_rise_give_finite_tracks(seconds):
    one = (np.array([1], np.uint32), np.array([VEHICLE], np.uint32))
    boxes = {f: Boxes.from_poses(*one, straight(8.0)(f)[None], SIZE[None]) for f in range(12)}
    tracks = tracks_from_boxes(boxes, {f: np.eye(4) for f in range(12)}, dict(enumerate(seconds)))
    assert tracks and all(
        np.isfinite(t.world_T_actor).all() and np.isfinite(t.velocity).all() for t in tracks
    )


def test_filled_in_boxes_count_less():
    poses, frames = {f: np.eye(4) for f in range(20)}, range(20)
    boxes = {}
    for frame in frames:
        annotated = frame % 5 == 0
        place = translation((frame, 0.0 if annotated else 0.5, 0))
        one = (np.array([1], np.uint32), np.array([VEHICLE], np.uint32), place[None], SIZE[None])
        boxes[frame] = Boxes.from_poses(*one, np.array([annotated]))
    (mixed,) = tracks_from_boxes(boxes, poses, {f: f * 0.1 for f in frames})
    equal = {
        f: Boxes.from_poses(b.tracks, b.labels, b.sensor_T_box, b.sizes) for f, b in boxes.items()
    }
    (same,) = tracks_from_boxes(equal, poses, {f: f * 0.1 for f in frames})
    assert mixed.pose(10)[1, 3] < same.pose(10)[1, 3] - 0.02


def make_scan(points, labels):
    return Scan(
        np.array(points, np.float32), None if labels is None else np.array(labels, np.uint32)
    )


def test_points_in_the_box_are_members_but_not_the_road():
    (track,) = tracked({1: straight(8.0)}, range(20))
    world = [
        [8, 0, 0],
        [8, 0, -0.82],
        [8, 0, -0.7],
        [8, 1.03, 0],
        [8, 1.2, 0],
        [8, 0, 0.3],
        [np.nan, 0, 0],
    ]
    points = transform_points(invert(sensor_pose(10)), np.array(world))
    labelled = make_scan(points, [VEHICLE, ROAD, VEHICLE, VEHICLE, VEHICLE, ROAD, VEHICLE])
    (segment,) = segment_by_boxes(10, labelled, sensor_pose(10), [track], ground=CARLA.ground)
    # the margin belongs to the box; ground and what is beside it do not
    assert segment.members.tolist() == [
        0,
        2,
        3,
    ]
    assert (segment.instance, segment.label, segment.frame) == (1, VEHICLE, 10)
    assert np.allclose(segment.points, np.array(world)[[0, 2, 3]], atol=1e-5)
    assert np.allclose(segment.velocity, [8, 0, 0])
    (bare,) = segment_by_boxes(10, make_scan(points, None), sensor_pose(10), [track])
    assert bare.members.tolist() == [0, 3, 5]  # without labels, the lowest points are the ground
    assert segment_by_boxes(30, labelled, sensor_pose(30), [track]) == []


def test_a_point_in_two_boxes_belongs_to_the_smaller_one():
    (car,) = tracked({1: straight(8.0)}, range(20))
    (person,) = tracked(
        {2: straight(8.0)}, range(20), size=np.array([0.6, 0.6, 1.7]), label=PEDESTRIAN
    )
    points = transform_points(invert(sensor_pose(10)), np.array([[8, 0, 0.2], [9.5, 0, 0.2]]))
    for tracks in ([car, person], [person, car]):
        segments = segment_by_boxes(10, make_scan(points, None), sensor_pose(10), tracks)
        assert {segment.instance: segment.members.tolist() for segment in segments} == {
            2: [0],
            1: [1],
        }
        assert [segment.instance for segment in segments] == [track.instance for track in tracks]


@pytest.fixture(scope="module")
def town():
    """Frames of a simulated drive: scans, poses, and the true boxes of all actors but the ego
    vehicle, with noise and gaps.
    """
    rng, town, frames = np.random.default_rng(0), TownDrive(5, "light"), range(0, 30, 3)
    poses = {frame: town.sensor_poses(frame, 1)[0] for frame in frames}
    boxes = {}
    for frame in frames:
        actors = [
            actor
            for actor in town.snapshot(frame).actors.values()
            if actor.id != 1 and rng.random() < 0.8
        ]
        corners = [
            (actor.mesh.vertices.min(axis=0), actor.mesh.vertices.max(axis=0)) for actor in actors
        ]
        world = [
            a.world_T_actor @ translation((lo + hi) / 2)
            for a, (lo, hi) in zip(actors, corners, strict=True)
        ]
        moved = [translation(rng.normal(size=3) * [0.05, 0.05, 0]) @ pose for pose in world]
        boxes[frame] = Boxes.from_poses(
            np.array([actor.id for actor in actors], np.uint32),
            np.array([np.bincount(actor.mesh.labels).argmax() for actor in actors], np.uint32),
            invert(poses[frame]) @ np.stack(moved),
            np.array([hi - lo for lo, hi in corners]),
        )
    return town, poses, tracks_from_boxes(boxes, poses, {frame: frame * 0.1 for frame in frames})


def test_in_a_simulated_town_members_are_the_points_of_their_actors(town):
    simulated, poses, tracks = town
    right = wrong = missed = 0
    for frame in (6, 24):
        scan = simulated.scan(frame)
        numbered = {track.instance for track in tracks if track.pose(frame) is not None}
        truth = np.where(np.isin(scan.instances, sorted(numbered)), scan.instances, 0)
        found = np.zeros(len(scan), np.int64)
        for segment in segment_by_boxes(frame, scan, poses[frame], tracks, ground=CARLA.ground):
            found[segment.members] = segment.instance
        right += int(((found > 0) & (found == truth)).sum())
        wrong += int(((found > 0) & (found != truth)).sum())
        missed += int(((truth > 0) & (found == 0)).sum())
    assert right > 1000 and wrong < 0.01 * right and missed < 0.02 * right


@pytest.mark.slow
def test_in_a_simulated_town_what_is_parked_stands_and_what_drives_moves(town):
    simulated, _, tracks = town
    speeds = {}
    for frame in range(0, 30, 3):
        for actor in simulated.snapshot(frame).actors.values():
            speeds.setdefault(actor.id, []).append(float(np.linalg.norm(actor.velocity)))
    still = [track for track in tracks if max(speeds[track.instance]) == 0]
    moving = [
        track for track in tracks if min(speeds[track.instance]) > 1.0 and len(track.velocity) >= 10
    ]
    assert still and not any(track.velocity.any() for track in still)
    assert moving and all(track.moves for track in moving)


FRAMES = range(30)
TIMES = {frame: frame * PERIOD_S for frame in FRAMES}
CAR = MovingBox((10, 6, 0), heading=0.4, yaw_rate=0.3, speed=8.0)


def true_pose(actor, frame):
    return actor.pose(TIMES[frame]) @ translation((0, 0, actor.size[2] / 2))


def drawn(actor, metres=0.1, degrees=1.0, count=300, deformable=()):
    """Return the track of an actor's boxes as somebody drew them, the same as its points place it,
    and the segments.
    """
    rng, boxes = np.random.default_rng(6), {}
    for frame in FRAMES:
        turn = rotation_z(np.radians(rng.normal(0, degrees)))
        pose = translation(rng.normal(0, metres, 3) * (1, 1, 0.3)) @ true_pose(actor, frame) @ turn
        boxes[frame] = Boxes.from_poses(
            np.array([7], np.uint32), np.array([10], np.uint32), pose[None], np.array([actor.size])
        )
    (track,) = tracks_from_boxes(
        boxes, {frame: np.eye(4) for frame in FRAMES}, TIMES, deformable=deformable
    )
    scans = [scan_of([actor], frame, count=count, view_from=(0, 0, 1.5)) for frame in FRAMES]
    segments = [
        s for f, scan in enumerate(scans) for s in segment_by_boxes(f, scan, np.eye(4), [track])
    ]
    return track, register_boxes(track, segments, TIMES), segments


def blur(track, actor):
    """Return by how much the poses of a track differ from each other, seen from the actor: metres
    along and across, and radians.
    """
    off = np.stack([invert(true_pose(actor, frame)) @ track.pose(frame) for frame in FRAMES])
    return np.array(
        [*np.std(off[:, :2, 3], axis=0), np.std(np.arctan2(off[:, 1, 0], off[:, 0, 0]))]
    )


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


@pytest.mark.parametrize(
    "seconds", [[0.0] * 30, [0.1 * (f % 4) for f in FRAMES], [0.1 * (30 - f) for f in FRAMES]]
)
def test_boxes_follow_points_also_where_times_do_not_rise(seconds):
    track, _, segments = drawn(CAR)
    after = register_boxes(track, segments, dict(enumerate(seconds)))
    assert np.isfinite(after.world_T_actor).all() and np.isfinite(after.velocity).all()


def test_two_observations_in_one_scan_give_a_finite_track():
    """Boxes of one number that jump give two tracks, which both extend to some frames."""
    track, _, segments = drawn(CAR)
    after = register_boxes(track, [s for segment in segments for s in (segment, segment)], TIMES)
    assert np.isfinite(after.velocity).all()
