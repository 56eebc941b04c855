"""The study of a real drive: its measures on a street of which everything is known, and its reading
of the archive where that is present.
"""

import sys
import tarfile
from pathlib import Path

import numpy as np
import pytest

import carlasc
from carlasc import Boxes, Grid, GridSpec
from carlasc.core.geometry import invert, rotation_z, transform_points, translation
from carlasc.core.tables import CARLA
from carlasc.storage import FolderSink, Metadata, layout

SPEC = GridSpec("cartesian", (100, 100, 15), (-20.0, -20.0, -2.0), (20.0, 20.0, 1.0))
FRAMES, FRAME, WINDOW = range(20, 41), 30, (-10, 10)
CAR = np.array([4.0, 1.8, 1.5])
ROAD_Z = -1.73


@pytest.fixture(autouse=True)
def studies(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "docs/studies"))
    yield
    for name in ("study", "real_drive", "real_measures"):
        sys.modules.pop(name, None)


def surface(size, count):
    """Return random points on the sides, the front, the back and the top of a box, in its frame."""
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (count, 3))
    faces = np.random.default_rng(1).integers(0, 5, count)
    points[np.arange(count), np.array([0, 0, 1, 1, 2])[faces]] = np.array(
        [-0.5, 0.5, -0.5, 0.5, 0.5]
    )[faces]
    return points * size


def pose_of(frame):
    return translation((0.5 * (frame - 20), 0.0, 0.0))


def van_at(frame):
    """A van ahead, which turns off to the left."""
    return translation(
        (6 + 0.7 * (frame - 20), 1 + 0.3 * (frame - 20), ROAD_Z + 0.75)
    ) @ rotation_z(0.4)


def follower_at(frame):
    return pose_of(frame) @ translation((-9.0, 1.5, ROAD_Z + 0.75))


PARKED = translation((12, -8, ROAD_Z + 0.75))


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A straight drive: a van that moves and a parked one with boxes, a follower without, a wall,
    and the road.
    """
    folder = tmp_path_factory.mktemp("drive")
    rng = np.random.default_rng(0)
    road = np.column_stack(
        [rng.uniform(-40, 60, 60000), rng.uniform(-12, 12, 60000), np.full(60000, ROAD_Z)]
    )
    wall = np.column_stack(
        [rng.uniform(-40, 60, 30000), np.full(30000, 12.05), rng.uniform(ROAD_Z, 2, 30000)]
    )
    with FolderSink(folder).sequence("cartesian") as writer:
        poses = np.stack([pose_of(frame) for frame in FRAMES])
        writer.write_document(layout.POSES, layout.encode_poses(poses))
        writer.write_document(layout.TIMES, layout.encode_times(np.arange(len(poses)) * 0.1))
        writer.write_document(layout.METADATA, Metadata("right", min_range_m=2.5).to_json())
        for frame in FRAMES:
            bodies = [
                transform_points(p, surface(CAR, 900))
                for p in (van_at(frame), PARKED, follower_at(frame))
            ]
            points = transform_points(invert(pose_of(frame)), np.concatenate([road, wall, *bodies]))
            points = np.column_stack([points, np.zeros(len(points))]).astype(np.float32)
            boxes = Boxes.from_poses(
                np.array([1, 4], np.uint32),
                np.array([10, 10], np.uint32),
                invert(pose_of(frame)) @ np.stack([van_at(frame), PARKED]),
                np.tile(CAR, (2, 1)),
            )
            writer.write("points", frame, points)
            writer.write("boxes", frame, boxes.to_table())
    (sequence,) = carlasc.open(folder).sequences().values()
    return sequence


@pytest.fixture
def judge(drive):
    from real_measures import Judge

    return Judge.of(drive, WINDOW)


def grid_of(world_points):
    """Return the grid of the judged frame in which the voxels of these points are occupied."""
    labels = np.zeros(SPEC.num_voxels, np.uint8)
    index = SPEC.flat_index(transform_points(invert(pose_of(FRAME)), world_points))
    labels[index[index >= 0]] = 3
    return Grid(SPEC, labels.reshape(SPEC.size), None)


def own_points(drive, frame=FRAME):
    return transform_points(pose_of(frame), drive.read("points", frame)[:, :3].astype(np.float64))


def test_it_finds_what_moves_what_stands_and_the_follower(judge):
    assert [body.name for body in judge.movers] == ["track 1"]
    assert [body.name for body in judge.standing] == ["track 4"]
    follower = judge.follower
    for frame in FRAMES:
        found = transform_points(
            follower.poses[frame], (follower.lower + follower.upper)[None] / 2
        )[0]
        assert np.linalg.norm((found - follower_at(frame)[:3, 3])[:2]) < 0.35
    assert follower.upper[1] - follower.lower[1] == pytest.approx(1.8, abs=0.1)


def test_the_frames_own_scan_is_a_grid_without_traces(judge, drive):
    measures = judge.measure(grid_of(own_points(drive)), FRAME)
    assert measures.trail.part == measures.own_path.part == measures.lane.part == 0
    assert min(measures.trail.whole, measures.own_path.whole) > 500 and measures.lane.whole > 200
    assert measures.kept.percent == 100 and measures.kept.whole > 5000


def test_scans_that_are_simply_added_leave_a_trail_and_a_lane(judge, drive):
    merged = np.concatenate([own_points(drive, frame) for frame in FRAMES])
    measures = judge.measure(grid_of(merged), FRAME)
    assert measures.trail.percent > 50 and measures.lane.percent > 50
    assert measures.own_path.part > 50  # the van crossed it
    assert measures.kept.percent == 100


def test_a_filled_or_an_empty_grid_has_all_or_nothing(judge, drive):
    full = judge.measure(Grid(SPEC, np.ones(SPEC.size, np.uint8), None), FRAME)
    assert all(share.percent == 100 for share in vars(full).values())
    empty = judge.measure(Grid(SPEC, np.zeros(SPEC.size, np.uint8), None), FRAME)
    assert all(share.part == 0 for share in vars(empty).values())
    both = full + empty
    assert both.trail.percent == 50 and both.kept.whole == 2 * full.kept.whole


def test_structure_is_neither_road_nor_vehicle(judge, drive):
    wall = own_points(drive)
    wall = wall[np.abs(wall[:, 1] - 12.05) < 0.1]
    assert judge.measure(grid_of(wall), FRAME).kept.percent == 100


def test_the_own_path_is_measured_with_and_without_what_is_there_now(judge, drive):
    measures = judge.measure(grid_of(own_points(drive)), FRAME)
    assert measures.own_path_all.whole > measures.own_path.whole  # the follower is there
    in_front = transform_points(pose_of(FRAME + 8), np.array([[0, 0, -0.5], [0.2, 0.3, -0.3]]))
    behind_the_back = judge.measure(grid_of(in_front), FRAME)
    assert behind_the_back.own_path.part == behind_the_back.own_path_all.part == 2


@pytest.mark.slow
def test_the_archive_is_read(real, tmp_path):
    file = real / "kitti_tracking_0000.tar.xz"
    if not file.exists():
        pytest.skip("the archive of the real drive is absent")
    from real_drive import FLOOR_M, label_points, read_boxes, read_scans

    with tarfile.open(file) as archive:
        archive.extractall(tmp_path, filter="data")
    (training,) = tmp_path.rglob("training")
    scans = read_scans(training.parent)
    boxes = read_boxes(training.parent)
    assert sorted(scans) == list(range(20, 105))
    assert {track for found in boxes.values() for track in found.tracks.tolist()} == {1, 2, 4}
    for frame in (20, 60, 104):
        scan, found = scans[frame][:, :3], boxes[frame]
        assert (np.linalg.norm(scan, axis=1) > 0).all()
        labels, instances = label_points(scan, found)
        assert set(np.unique(instances)) == {0, 1, 2, 4}
        assert set(np.unique(labels)) == {CARLA.geometry_only, 4, 10}
        # a box stands on the road, and most of its points are on its surface
        for row in range(len(found)):
            own = scan[instances == found.tracks[row]].astype(np.float64)
            body = transform_points(invert(found.sensor_T_box[row]), own)
            assert len(own) > 50 and (body[:, 2] + found.sizes[row, 2] / 2 > FLOOR_M).all()
            depth = (found.sizes[row] / 2 - np.abs(body)).min(axis=1)
            assert np.median(depth) < 0.4
