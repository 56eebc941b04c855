"""Which rays of which scans vote where: scenes of a few points, with actors whose motion is given."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.errors import raises

from carlasc.core.geometry import invert, rotation_z, transform_points, translation
from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLA, SEMANTICKITTI
from carlasc.errors import FormatError
from carlasc.groundtruth import FromScans
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.merging import (
    STATIC,
    BodyRegions,
    Instant,
    Merger,
    PreparedScan,
)
from carlasc.groundtruth.voting.ballot import Ballot
from carlasc.motion import Extent, Track
from carlasc.motion.tracks import MovingActors
from carlasc.storage import FolderSink, FolderSource, layout

ROAD, VEHICLE, PEDESTRIAN = CARLA.id_of("Road"), CARLA.id_of("Vehicle"), CARLA.id_of("Pedestrian")
FRAMES = range(31)
SPEC = GridSpec("cartesian", (40, 40, 8), (-10, -10, -2), (10, 10, 2))


def actor_pose(frame):
    """Return where the actor is: 5 m ahead of the sensor's start, moving to the left at 2 m/s."""
    return translation((5.0, -3.0 + 0.2 * frame, 0.0))


def sensor_pose(frame):
    return translation((0.0, 0.0, 0.01 * frame))


def instant(frame):
    return Instant(frame, 0.1 * frame, sensor_pose(frame))


def scan(frame, label=VEHICLE):
    """A scan of three points: one of the road, one of the actor, and one of a wall behind the
    actor.
    """
    actor = actor_pose(frame)[:3, 3]
    world = np.array([[3.0, 8.0, -1.5], actor, 2 * actor])
    points = transform_points(invert(sensor_pose(frame)), world).astype(np.float32)
    labels = np.array([ROAD, label, 1], np.uint16)
    return PreparedScan.of(
        frame, points, labels, sensor_pose(frame), seconds=0.1 * frame, moving=np.array([1])
    )


def track(label=VEHICLE, half=(1.0, 0.5, 1.0), frames=FRAMES, faces=(True, True, True, True)):
    poses = np.stack([actor_pose(frame) for frame in frames])
    members = {frame: np.array([1], np.int32) for frame in frames}
    velocity = np.tile([0, 2.0, 0], (len(poses), 1))
    lower, upper = -np.array(half), np.array(half)
    extent = Extent(lower, upper, faces, 100)
    return Track(
        label,
        0,
        members,
        frames[0],
        poses,
        velocity,
        lower,
        upper,
        extent,
        rigid=label not in CARLA.deformable,
    )


def merger(label=VEHICLE, dynamic="align", tracks=None):
    scans = {frame: scan(frame, label) for frame in FRAMES}
    tracks = [track(label)] if tracks is None else tracks
    return Merger(scans.__getitem__, MovingActors.of(tracks), CARLA, dynamic)


def regions_of(merging, frame=15):
    return BodyRegions.at(merging, instant(frame), FRAMES, SPEC)


def classes(merging, other, frame=15):
    """Return the classes of the points of a scan that vote on a frame."""
    return [label for label, *_ in merging.points(instant(frame), [other])]


def in_bodies(merging, frame=15, window=FRAMES, **options):
    """Return the class of the points in the body of the actor, and the points of each scan."""
    now = instant(frame)
    seen = [
        one.points for one in merging.bodies(now, window, regions_of(merging, frame), **options)
    ]
    return [(label, one) for label, points, *_ in seen for one in points]


def in_world(one, frame=15):
    grid_T_points = np.vstack([np.reshape(one.grid_T_points, (3, 4)), [0, 0, 0, 1]])
    return transform_points(sensor_pose(frame) @ grid_T_points, one.points.T)


def test_a_persons_shape_is_used_for_eight_frames_and_a_vehicles_for_all():
    assert PEDESTRIAN in CARLA.deformable and VEHICLE not in CARLA.deformable
    assert len(in_bodies(merger(PEDESTRIAN))) == 16
    assert len(in_bodies(merger(PEDESTRIAN), frame=2)) == 2 + 8
    assert len(in_bodies(merger(VEHICLE))) == 30


def test_an_actors_points_are_carried_to_where_it_is():
    for label, points in in_bodies(merger()):
        assert label == VEHICLE
        assert np.abs(in_world(points) - actor_pose(15)[:3, 3]).max() < 1e-5


def test_points_of_an_actor_outside_of_its_region_do_not_vote():
    merging, now = merger(), instant(15)
    regions = regions_of(merging)
    none = replace(regions, of_voxel=np.where(regions.of_voxel == 1, 2, 0).astype(np.uint16))
    votes = []
    for one in (regions, none):
        ballot = Ballot(SPEC, rule="ray")
        ballot.add_points(body.points for body in merging.bodies(now, FRAMES, one))
        votes.append(ballot.votes().occupied)
    assert votes[0]["votes"].sum() == 30 and not len(votes[1])


def test_rays_that_miss_the_box_are_not_carried():
    merging = merger()
    (body,) = merging.bodies(instant(15), FRAMES, regions_of(merging))
    assert list(body.casts) == [frame for frame in FRAMES if frame != 15]
    for frame, cast in body.casts.items():
        ends = transform_points(cast.map_T_places[0], cast.points)
        wall = actor_pose(frame)[:3, 3]  # it is as far behind the actor as the sensor is before it
        assert np.abs(ends - np.array([np.zeros(3), wall])).max() < 1e-5


def test_the_frames_own_rays_are_an_observation():
    merging = merger()
    assert sorted(merging.own(instant(15)).labels.tolist()) == classes(merging, 15)


@pytest.mark.parametrize(
    ("dynamic", "own", "others"),
    [
        ("align", True, False),
        ("current", True, False),
        ("drop", False, False),
        ("tube", True, True),
    ],
)
def test_which_moving_points_vote(dynamic, own, others):
    for frame in FRAMES:
        moves = own if frame == 15 else others
        expected = [1, ROAD, *([VEHICLE] if moves else [])]
        assert classes(merger(dynamic=dynamic), frame) == sorted(expected)


def test_points_of_a_track_that_were_not_known_to_move_are_left_out_too():
    unmarked = {frame: replace(scan(frame), moving=np.empty(0, np.int64)) for frame in FRAMES}
    assert Merger(unmarked.__getitem__, MovingActors(), CARLA, "align").static(3).tolist() == [
        True,
        True,
        True,
    ]
    assert Merger(unmarked.__getitem__, MovingActors.of([track()]), CARLA, "align").static(
        3
    ).tolist() == [
        True,
        False,
        True,
    ]
    untracked = MovingActors(moving={3: np.array([2])})
    assert Merger(unmarked.__getitem__, untracked, CARLA, "align").static(3).tolist() == [
        True,
        True,
        False,
    ]


def test_points_on_the_recording_vehicle_are_left_out_of_every_frame():
    merging = merger(tracks=[])
    merging.actors = MovingActors(own=(np.array([2.0, 7.0, -2.0, 4.0, 9.0, -1.0]),))
    assert classes(merging, 3) == [1] and classes(merging, 15) == sorted([1, VEHICLE])


def test_ground_in_a_body_that_is_higher_than_the_ground_around_it_is_not_static():
    road = [(x, y, -1.0) for x in (-1.4, 0.0, 1.4) for y in (-0.9, 0.9, 1.0)]
    local = np.array([*road, (0.0, 0.0, -1.0), (0.5, 0.2, -0.7)])
    points = transform_points(invert(sensor_pose(15)) @ actor_pose(15), local).astype(np.float32)
    labels = np.full(len(points), ROAD, np.uint16)

    def static(seen):
        one = PreparedScan.of(15, points[seen:], labels[seen:], sensor_pose(15), seconds=1.5)
        actors = MovingActors.of([replace(track(), members={})])
        return Merger({15: one}.__getitem__, actors, CARLA, "align").static(15)

    assert static(0).tolist() == [*[True] * 10, False]  # a foot
    assert static(6).all()  # too little ground is known


def test_a_track_that_never_moves_is_part_of_the_static_scene():
    still = track()
    still.velocity[:] = 0
    merging = merger(tracks=[still])
    assert not merging.actors.tracks
    assert not regions_of(merging).actors


def test_a_region_has_the_voxels_that_the_body_touches_at_the_frame():
    centers = SPEC.centers().reshape(-1, 3)
    merging = merger()
    for frame in (0, 15, 30):
        offset = np.abs(
            centers - transform_points(invert(sensor_pose(frame)), actor_pose(frame)[None, :3, 3])
        )
        expected = (offset < np.array([1.0, 0.5, 1.0]) + 0.25).all(axis=1)
        assert np.array_equal(regions_of(merging, frame).of_voxel == 1, expected)
    assert not regions_of(merger(tracks=[track(frames=range(10, 20))]), 25).actors
    assert not regions_of(merger(dynamic="current")).actors


def test_where_bodies_overlap_the_smaller_one_takes_precedence():
    small, large = track(PEDESTRIAN, (0.3, 0.3, 0.3)), track(VEHICLE, (2.0, 2.0, 1.0))
    for tracks, number in (([small, large], 0), ([large, small], 1)):
        regions = regions_of(merger(tracks=tracks))
        voxel = SPEC.flat_index(
            transform_points(invert(sensor_pose(15)), actor_pose(15)[None, :3, 3])
        )
        (region,) = regions.of_voxel[voxel].tolist()
        assert regions.actors[region] == number
        assert sorted(regions.actors.values()) == [0, 1]
        assert {*regions.actors} <= set(regions.of_voxel.tolist())


@pytest.mark.parametrize("dynamic", ["align", "current"])
def test_moving_points_without_a_body_have_a_region_in_which_the_frames_own_rays_alone_vote(
    dynamic,
):
    merging = merger(dynamic=dynamic, tracks=[])
    regions = regions_of(merging)
    place = transform_points(invert(sensor_pose(15)), actor_pose(15)[None, :3, 3])
    assert not regions.actors
    assert np.flatnonzero(regions.of_voxel != STATIC).tolist() == SPEC.flat_index(place).tolist()
    assert not in_bodies(merging)


@pytest.mark.parametrize("dynamic", ["drop", "tube"])
def test_other_rules_have_no_regions(dynamic):
    assert not regions_of(merger(dynamic=dynamic)).of_voxel.any()


def test_a_frame_without_its_own_scan_has_bodies_and_no_points():
    regions = BodyRegions.at(
        merger(), instant(15), [frame for frame in FRAMES if frame != 15], SPEC
    )
    assert list(regions.actors.values()) == [0]
    assert not BodyRegions.at(merger(tracks=[]), instant(15), [14, 16], SPEC).of_voxel.any()


def test_the_mirror_image_of_an_actor_has_its_points_on_the_other_side():
    merging = merger()
    merging.scan_of(20).points[1] += np.float32([0.0, 0.3, 0.1])
    ((_, plain),) = in_bodies(merging, window=[20])
    ((label, mirrored),) = in_bodies(merging, window=[20], mirror=True)
    one, other = (
        transform_points(invert(actor_pose(15)), in_world(one)) for one in (plain, mirrored)
    )
    assert np.abs(one).max() > 0.2 and np.abs(one * [1, -1, 1] - other).max() < 1e-5
    assert label == VEHICLE
    assert not in_bodies(merger(PEDESTRIAN), mirror=True)


def test_what_passes_is_where_it_was_seen():
    merging = merger()
    for frame in FRAMES:
        passing = transform_points(sensor_pose(frame), merging.moving(frame))
        assert np.abs(passing - actor_pose(frame)[:3, 3]).max() < 1e-5


def test_the_scans_of_an_instant_are_those_within_a_quarter_of_a_second():
    assert len(list(merger().recent(instant(15), FRAMES))) == 5
    assert len(list(merger().recent(instant(0), FRAMES))) == 3


def around(turn, points):
    """A scan of points that are turned around the sensor by an angle, and the box that stays 4 m
    away in this direction.
    """
    turned = transform_points(rotation_z(turn), np.array(points, float)).astype(np.float32)
    scan = PreparedScan.of(0, turned, np.ones(len(turned), np.uint16), np.eye(4))
    box = np.array([4.0, -1.0, -1.0]), np.array([6.0, 1.0, 1.0])
    return scan.rays.through(rotation_z(-turn)[None], *box)[0].tolist()


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
    below = scan.rays.through(
        np.eye(4)[None], np.array([-6.0, -6.0, -3.0]), np.array([6.0, 6.0, -1.0])
    )
    assert sorted(below[0].tolist()) == [0, 1, 2, 3]
    beside = scan.rays.through(
        np.eye(4)[None], np.array([-6.0, 0.1, -3.0]), np.array([6.0, 6.0, -1.0])
    )
    assert beside[0].tolist() == [2]
    corner = scan.rays.through(
        np.eye(4)[None], np.array([-6.0, -0.1, -3.0]), np.array([-0.1, 0.1, -1.0])
    )
    assert corner[0].tolist() == [1]


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
        # its corners are 5 m away
        spec = GridSpec("cartesian", (4, 4, 4), (-3, -4, 0), (3, 4, 0.1))
        assert feed.reaching(0, spec) == list(range(36))  # 5 + 30 m
        cylinder = GridSpec("cylindrical", (4, 4, 4), (0, -3, -3), (4, 3, 0.1))
        assert feed.reaching(0, cylinder) == list(range(36))

    def test_with_a_distance_at_most_thirty_scans_a_side_are_merged(self, tmp_path):
        feed = self.feed(tmp_path, window=(-59, 59), window_m=59.0)
        assert feed.window_of(0) == [0, *range(2, 60, 2)]  # 1 m apart, and at least 59 / 30 m
        assert self.feed(tmp_path / "near", window=(-59, 59), window_m=10.0).window_of(30) == list(
            range(20, 41)
        )

    def test_scans_without_labels_are_one_class_of_geometry_on_ground_that_is_found(self, tmp_path):
        x, y = np.meshgrid(np.arange(-20, 21.0), np.arange(-20, 21.0))
        floor = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -1.8), np.zeros(x.size)])
        points = np.concatenate([floor, [[6.2, 0.3, 0.5, 0.0]]]).astype(np.float32)
        labels = self.feed(tmp_path, range(6), points).read(0).labels
        assert labels[-1] == CARLA.id_of("Other")
        assert np.mean(np.isin(labels[:-1], sorted(CARLA.ground))) > 0.9
        kitti = self.feed(
            tmp_path / "kitti", range(6), points, metadata=b'{"classes": "semantickitti"}'
        )
        assert kitti.read(0).labels[-1] == SEMANTICKITTI.id_of("other-object")

    def test_unlabelled_points_are_left_out(self, tmp_path):
        feed = self.feed(tmp_path)
        FolderSink(tmp_path).sequence("Val/Street/cartesian").write(
            "labels", 3, np.array([0, ROAD], np.uint32)
        )
        (feed.sequence,) = FolderSource(tmp_path).sequences().values()
        assert feed.read(3).labels.tolist() == [ROAD]

    def test_ranges_are_those_of_carlasc_json_unless_they_are_given(self, tmp_path):
        metadata = b'{"min_range_m": 5.0, "max_range_m": 20.0}'
        assert len(self.feed(tmp_path, metadata=metadata).read(0).points) == 0
        feed = self.feed(tmp_path, metadata=metadata, min_range_m=4.0, max_range_m=30.0)
        assert len(feed.read(0).points) == 2  # the bounds are inside

    def test_as_many_scans_are_kept_as_a_window_has(self, tmp_path):
        feed = self.feed(tmp_path, window=(-2, 2))
        first = feed.read(0)
        for frame in range(1, 6):
            feed.read(frame)
        assert feed.read(0) is first  # read again, so it is now the most recent one
        for frame in range(6, 12):
            feed.read(frame)
        assert feed.read(0) is not first

    def test_ground_is_found_only_where_labels_do_not_name_it(self, tmp_path):
        folder = FolderSink(tmp_path).sequence("Val/Street/cartesian")
        assert self.feed(tmp_path, frames=range(6)).must_find_ground
        for frame, labels in ((3, [1, 1]), (4, [ROAD, 1])):
            folder.write("labels", frame, np.array(labels, np.uint32))
            (sequence,) = FolderSource(tmp_path).sequences().values()
            assert ScanFeed(sequence, FromScans()).must_find_ground == (ROAD not in labels)


def test_all_points_of_an_actor_vote_for_its_class():
    scans = {frame: scan(frame, PEDESTRIAN if frame % 4 else VEHICLE) for frame in FRAMES}
    actors = MovingActors({0: track(VEHICLE)})
    merger = Merger(scans.__getitem__, actors, CARLA, "align")
    for frame in FRAMES:
        assert merger.labels(frame).tolist() == [ROAD, VEHICLE, 1]
    assert scans[1].labels.tolist() == [ROAD, PEDESTRIAN, 1]  # the scan keeps its own
    assert Merger(scans.__getitem__, actors, CARLA, "tube").labels(1).tolist() == [
        ROAD,
        PEDESTRIAN,
        1,
    ]


def scan_in_turn(frame, late_s=0.08):
    """The scan of a LiDAR that reaches the actor some time after the frame."""
    instant = scan(frame)
    seconds = np.array([0.0, late_s, late_s], np.float32)
    points = instant.points.copy()
    points[1] += np.float32(late_s) * np.float32([0.0, 2.0, 0.0])
    places = np.column_stack([np.zeros((3, 3), np.float32), seconds])
    return PreparedScan.of(
        frame, points, instant.labels, instant.world_T_sensor, seconds=0.1 * frame, origins=places
    )


def test_points_of_an_actor_are_moved_by_its_motion_between_their_times_and_the_frame():
    scans, instants = ({frame: of(frame) for frame in FRAMES} for of in (scan_in_turn, scan))
    merger = Merger(scans.__getitem__, MovingActors({0: track()}), CARLA, "align")
    for frame in FRAMES:
        assert merger.static(frame).tolist() == [True, False, True]
        settled = merger.settled(frame)
        np.testing.assert_allclose(settled.points, instants[frame].points, atol=1e-5)
        np.testing.assert_allclose(settled.ends, settled.points, atol=1e-5)
        assert np.abs(scans[frame].points[1] - instants[frame].points[1]).max() > 0.1
    now = instant(15)
    regions = BodyRegions.at(merger, now, list(FRAMES), SPEC)
    (body,) = merger.bodies(now, list(FRAMES), regions)
    for carried in body.points.voters:
        np.testing.assert_allclose(carried.points, 0, atol=1e-5)
    assert len(body.points.voters) == len(FRAMES) - 1


def test_points_far_in_time_from_their_frame_are_an_error(tmp_path):
    for seconds in ([0.0, 5.0], [0.0, np.nan]):
        feed = TestFeed().feed(tmp_path)
        FolderSink(tmp_path).sequence("Val/Street/cartesian").write(
            "seconds", 3, np.array(seconds, np.float32)
        )
        (feed.sequence,) = FolderSource(tmp_path).sequences().values()
        with raises(FormatError, where="seconds of frame 3", found="at point 1"):
            feed.read(3)
