"""Which rays of which scans vote where: scenes of a few points, with actors whose motion is given."""

from dataclasses import replace

import numpy as np
import pytest

from carlasc.core.frames import FrameRange
from carlasc.core.geometry import invert, rotation_z, transform_points, translation
from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLA, SEMANTICKITTI
from carlasc.groundtruth import FromScans, Voting
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.merging import STATIC, Merger, PreparedScan
from carlasc.groundtruth.from_scans.sequences import free_weight
from carlasc.groundtruth.inputs import Plan
from carlasc.motion import Segment, Track
from carlasc.storage import FolderSink, FolderSource, layout

ROAD, VEHICLE, PEDESTRIAN = CARLA.id_of("Road"), CARLA.id_of("Vehicle"), CARLA.id_of("Pedestrian")
FRAMES = range(31)
SPEC = GridSpec("cartesian", (40, 40, 8), (-10, -10, -2), (10, 10, 2))


def actor_pose(frame):
    """Return where the actor is: 5 m ahead of the sensor's start, moving to the left at 2 m/s."""
    return translation((5.0, -3.0 + 0.2 * frame, 0.0))


def sensor_pose(frame):
    return translation((0.0, 0.0, 0.01 * frame))


def scan(frame, label=VEHICLE):
    """A scan of three points: one of the road, one of the actor, and one of a wall behind the actor."""
    actor = actor_pose(frame)[:3, 3]
    world = np.array([[3.0, 8.0, -1.5], actor, 2 * actor])
    points = transform_points(invert(sensor_pose(frame)), world).astype(np.float32)
    return PreparedScan.of(frame, points, np.array([ROAD, label, 1], np.uint16), sensor_pose(frame))


def track(label=VEHICLE, half=(1.0, 0.5, 1.0), frames=FRAMES):
    poses = np.stack([actor_pose(frame) for frame in frames])
    segments = {
        frame: Segment(frame, label, np.array([1]), actor_pose(frame)[None, :3, 3], np.array([0, 2.0, 0]))
        for frame in frames
    }
    velocity = np.tile([0, 2.0, 0], (len(poses), 1))
    return Track(label, 0, segments, frames[0], poses, velocity, -np.array(half), np.array(half))


def merger(label=VEHICLE, dynamic="align", tracks=None):
    scans = {frame: scan(frame, label) for frame in FRAMES}
    moving = {frame: np.array([1]) for frame in FRAMES}
    return Merger(scans, [track(label)] if tracks is None else tracks, moving, CARLA, dynamic)


def observe(merging, frame=15, window=FRAMES):
    """Return the observations of the static scene and of the actor."""
    seen = list(merging.observations(frame, window, merging.regions(frame, SPEC)))
    return seen[: len(window)], seen[len(window) :]


def test_a_persons_shape_is_used_for_eight_frames_and_a_vehicles_for_all():
    assert PEDESTRIAN in CARLA.deformable and VEHICLE not in CARLA.deformable
    assert len(observe(merger(PEDESTRIAN))[1]) == 16
    assert len(observe(merger(PEDESTRIAN), frame=2)[1]) == 2 + 8
    assert len(observe(merger(VEHICLE))[1]) == 30


def test_an_actors_points_are_carried_to_where_it_is_and_vote_in_its_box_only():
    _, actor = observe(merger())
    for observation in actor:
        assert observation.hit_region == observation.free_region == 1
        hit = observation.points[observation.hits]
        place = transform_points(observation.grid_T_sensor, hit)
        truth = transform_points(invert(sensor_pose(15)), actor_pose(15)[None, :3, 3])
        assert np.abs(place[np.argmin(np.linalg.norm(place - truth, axis=1))] - truth).max() < 1e-5


def test_rays_that_miss_the_box_are_not_carried():
    _, actor = observe(merger())
    labels = np.concatenate([observation.labels for observation in actor])
    assert (labels != ROAD).all()
    assert set(labels.tolist()) == {VEHICLE, 1}


def test_the_frames_own_rays_count_everywhere_those_of_others_outside_the_actors():
    static, _ = observe(merger())
    assert [observation.free_region for observation in static] == [None if f == 15 else STATIC for f in FRAMES]
    assert all(observation.hit_region is None for observation in static)


@pytest.mark.parametrize(
    ("dynamic", "own", "others"),
    [("align", True, False), ("current", True, False), ("drop", False, False), ("tube", True, True)],
)
def test_which_moving_points_vote(dynamic, own, others):
    static, _ = observe(merger(dynamic=dynamic))
    for frame, observation in zip(FRAMES, static, strict=True):
        votes = np.ones(3, bool) if observation.hits is None else observation.hits
        assert votes.tolist() == [True, own if frame == 15 else others, True]


def test_points_of_a_track_that_were_not_known_to_move_are_left_out_too():
    merging = Merger({frame: scan(frame) for frame in FRAMES}, [track()], {}, CARLA, "align")
    assert merging.static(3).tolist() == [True, False, True]


def test_a_track_that_never_moves_is_part_of_the_static_scene():
    still = track()
    still.velocity[:] = 0
    assert merger(tracks=[still]).tracks == []
    assert not merger(tracks=[still]).regions(15, SPEC).any()


def test_a_region_has_the_voxels_that_the_box_touches_at_the_frame():
    centers = SPEC.centers().reshape(-1, 3)
    merging = merger()
    for frame in (0, 15, 30):
        offset = np.abs(centers - transform_points(invert(sensor_pose(frame)), actor_pose(frame)[None, :3, 3]))
        expected = (offset < np.array([1.0, 0.5, 1.0]) + 0.25).all(axis=1)
        assert np.array_equal(merging.regions(frame, SPEC) == 1, expected)
    assert not merger(tracks=[track(frames=range(10, 20))]).regions(25, SPEC).any()
    assert not merger(dynamic="current").regions(15, SPEC).any()


def test_where_boxes_overlap_the_smaller_one_takes_precedence():
    small, large = track(PEDESTRIAN, (0.3, 0.3, 0.3)), track(VEHICLE, (2.0, 2.0, 1.0))
    for tracks, number in (([small, large], 1), ([large, small], 2)):
        regions = merger(tracks=tracks).regions(15, SPEC)
        voxel = SPEC.flat_index(transform_points(invert(sensor_pose(15)), actor_pose(15)[None, :3, 3]))
        assert regions[voxel] == number
        assert {1, 2} <= set(regions.tolist())


def around(turn, points):
    """A scan of points that are turned around the sensor by an angle, and the box that stays 4 m away in this direction."""
    turned = transform_points(rotation_z(turn), np.array(points, float)).astype(np.float32)
    scan = PreparedScan.of(0, turned, np.ones(len(turned), np.uint16), np.eye(4))
    return scan.rays_through(rotation_z(-turn), np.array([4.0, -1.0, -1.0]), np.array([6.0, 1.0, 1.0])).tolist()


@pytest.mark.parametrize("turn", np.linspace(-np.pi, np.pi, 9))
def test_rays_through_a_box_end_in_it_or_behind_it(turn):
    ends = [
        (5, 0, 0),
        (9, 0.5, 0.5),
        (3.9, 0, 0),
        (-9, 0, 0),
        (9, 2.5, 0),
        (4.5, 0.99, 0.99),
        (9, 0, 3),
        (9, -1.2, -1.2),
    ]
    assert sorted(around(turn, ends)) == [0, 1, 5, 7]


def test_a_box_around_below_or_beside_the_sensor_is_seen_whole():
    points = np.array([(5, 0, -2), (-5, 0, -2), (0, 5, -2), (0, -5, -2)], np.float32)
    scan = PreparedScan.of(0, points, np.ones(4, np.uint16), np.eye(4))
    below = scan.rays_through(np.eye(4), np.array([-6.0, -6.0, -3.0]), np.array([6.0, 6.0, -1.0]))
    assert sorted(below.tolist()) == [0, 1, 2, 3]
    beside = scan.rays_through(np.eye(4), np.array([-6.0, 0.1, -3.0]), np.array([6.0, 6.0, -1.0]))
    assert beside.tolist() == [2]
    corner = scan.rays_through(np.eye(4), np.array([-6.0, -0.1, -3.0]), np.array([-0.1, 0.1, -1.0]))
    assert corner.tolist() == [1]


class TestFeed:
    def feed(self, folder, frames=range(60), points=None, metadata=None, **options):
        writer = FolderSink(folder).sequence("Val/Street/cartesian")
        points = np.array([[4, 0, 0, 0], [30, 0, 0, 0]], np.float32) if points is None else points
        for frame in frames:
            writer.write("points", frame, points)
        poses = np.stack([translation((frame, 0.0, 0.0)) for frame in range(max(frames) + 1)])
        writer.write_document(layout.POSES, layout.encode_poses(poses))
        if metadata is not None:
            writer.write_document(layout.METADATA, metadata)
        (sequence,) = FolderSource(folder).sequences().values()
        return ScanFeed(sequence, FromScans(**options))

    def test_only_scans_that_reach_the_grid_are_read_for_it(self, tmp_path):
        feed = self.feed(tmp_path, window=(-59, 59))
        spec = GridSpec("cartesian", (4, 4, 4), (-3, -4, 0), (3, 4, 0.1))  # its corners are 5 m away
        assert feed.reaching(0, spec) == list(range(36))  # 5 + 30 m
        cylinder = GridSpec("cylindrical", (4, 4, 4), (0, -3, -3), (4, 3, 0.1))
        assert feed.reaching(0, cylinder) == list(range(36))

    def test_with_a_distance_at_most_thirty_scans_a_side_are_merged(self, tmp_path):
        feed = self.feed(tmp_path, window=(-59, 59), window_m=59.0)
        assert feed.window_of(0) == [0, *range(2, 60, 2)]  # 1 m apart, and at least 59 / 30 m
        assert self.feed(tmp_path / "near", window=(-59, 59), window_m=10.0).window_of(30) == list(range(20, 41))

    def test_scans_without_labels_are_one_class_of_geometry(self, tmp_path):
        assert set(self.feed(tmp_path).read(0).prepared.labels.tolist()) == {CARLA.id_of("Other")}
        kitti = self.feed(tmp_path / "kitti", metadata=b'{"classes": "semantickitti"}')
        assert set(kitti.read(0).prepared.labels.tolist()) == {SEMANTICKITTI.id_of("other-object")}

    def test_unlabelled_points_are_left_out(self, tmp_path):
        feed = self.feed(tmp_path)
        FolderSink(tmp_path).sequence("Val/Street/cartesian").write("labels", 3, np.array([0, ROAD], np.uint32))
        (feed.sequence,) = FolderSource(tmp_path).sequences().values()
        assert feed.read(3).prepared.labels.tolist() == [ROAD]

    def test_ranges_are_those_of_carlasc_json_unless_they_are_given(self, tmp_path):
        metadata = b'{"min_range_m": 5.0, "max_range_m": 20.0}'
        assert len(self.feed(tmp_path, metadata=metadata).read(0).prepared.points) == 0
        feed = self.feed(tmp_path, metadata=metadata, min_range_m=4.0, max_range_m=30.0)
        assert len(feed.read(0).prepared.points) == 2  # the bounds are inside

    def test_scans_are_forgotten_when_no_window_of_a_block_needs_them(self, tmp_path):
        feed = self.feed(tmp_path, window=(-2, 2))
        first = feed.read(0)
        for frame in range(1, 29):
            feed.read(frame)
        assert feed.read(0) is first  # 25 frames of a block and two on either side
        for frame in range(30, 59):
            feed.read(frame)
        assert feed.read(0) is not first


@pytest.mark.parametrize(("rule", "dynamic"), [(None, "align"), ("point", "drop"), ("sensor", "align"), (None, "tube")])
def test_free_space_is_outweighed_by_few_points_of_static_classes_and_many_of_movable_ones(tmp_path, rule, dynamic):
    feed = TestFeed().feed(tmp_path, frames=range(1), dynamic=dynamic)
    flat = replace(SPEC, size=(40, 40, 16))
    plan = Plan(flat, "evaluation", feed.options, Voting(rule), FrameRange())
    weight = free_weight(plan, feed)
    if rule == "sensor":
        assert weight is None
    elif dynamic == "tube":
        assert weight is not None and not weight.any()
    else:
        assert weight is not None  # the side of a voxel is 0.5 m wide and 0.25 m high
        assert weight[[ROAD, VEHICLE, PEDESTRIAN]].tolist() == [0.375, 4.0, 4.0]
