"""Held-out rays: scans that are left out are hidden completely, and their rays tell good grids from
bad ones.
"""

import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import passing_car

import carlasc
from carlasc import Grid, GridSpec, Run
from carlasc.core.frames import FrameRange
from carlasc.core.geometry import rotation_z, transform_points, translation
from carlasc.core.tables import CARLA
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.groundtruth import FromScans, Voting
from carlasc.groundtruth.from_scans.feed import WithoutScans
from carlasc.groundtruth.from_scans.frame import merge_frame
from carlasc.groundtruth.from_scans.motion_pass import find_actors
from carlasc.groundtruth.from_scans.sequences import ScanSequence
from carlasc.groundtruth.inputs import GridPlan
from carlasc.inspection import HeldOutScores, HoldoutResult, holdout
from carlasc.inspection.heldout_scores import VEHICLE_M, depth_errors, swept_voxels
from carlasc.storage import FolderSink, layout

FRAMES = 17
OBSERVE = FromScans(window=(-6, 6))
SMALL = GridSpec("cartesian", (10, 4, 2), (0.0, -2.0, -1.0), (10.0, 2.0, 1.0))


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return passing_car.write_sequence(tmp_path_factory.mktemp("street"), frames=FRAMES)


def sequence_of(folder):
    return next(iter(carlasc.open(folder).sequences().values()))


def plan_of(observe):
    return GridPlan(passing_car.SPEC, "evaluation", observe, Voting(), FrameRange.of(None))


def grid_without(folder, frame, observe=OBSERVE):
    plan = plan_of(observe)
    feed = ScanSequence(sequence_of(folder), plan, observe).feed.without([frame])
    return merge_frame(plan, feed, find_actors(feed), frame, feed.reaching(frame, plan.spec)).grid


def test_a_hidden_scan_is_not_listed_and_reads_as_empty(street):
    whole = sequence_of(street)
    part = pickle.loads(pickle.dumps(WithoutScans(whole, [3])))
    assert part.frames("points").tolist() == [f for f in range(FRAMES) if f != 3]
    assert {name: part.read(name, 3).shape for name in ("points", "labels", "flow")} == {
        "points": (0, 4),
        "labels": (0,),
        "flow": (0, 3),
    }
    assert np.array_equal(part.read("points", 4), whole.read("points", 4))
    assert np.array_equal(part.read_pose(3), whole.read_pose(3))


def test_hiding_scans_keeps_the_lines_of_poses_that_go_by_the_order_of_the_scans(tmp_path):
    writer = FolderSink(tmp_path).sequence("cartesian")
    for frame in (5, 7, 9):
        writer.write("points", frame, np.zeros((1, 4), np.float32))
    poses = np.stack([translation((float(i), 0.0, 0.0)) for i in range(3)])
    writer.write_document(layout.POSES, layout.encode_poses(poses))
    part = WithoutScans(sequence_of(tmp_path), [7])
    assert [part.read_pose(frame)[0, 3] for frame in (5, 7, 9)] == [0, 1, 2]


def test_a_left_out_scan_changes_nothing_in_the_grid_at_its_frame(tmp_path):
    folder = passing_car.write_sequence(tmp_path, frames=FRAMES)
    before = grid_without(folder, 8)
    writer = FolderSink(folder.parent.parent).sequence("Val/Street/cartesian")
    rng = np.random.default_rng(0)
    writer.write("points", 8, rng.uniform(-20, 20, (500, 4)).astype(np.float32))
    writer.write("labels", 8, np.full(500, 10, np.uint32))
    writer.write("flow", 8, np.full((500, 3), 4.0, np.float32))
    after = grid_without(folder, 8)
    assert np.array_equal(before.labels, after.labels)
    assert np.array_equal(before.counts, after.counts)
    assert (before.labels == 10).any()


def test_the_frames_own_scan_has_no_vote(street):
    plan = plan_of(OBSERVE)
    with_own = ScanSequence(sequence_of(street), plan, OBSERVE).frames[8].make(plan).grid
    assert grid_without(street, 8).counts.sum() < with_own.counts.sum()


def small_grid():
    """A free row along x with a wall at the end, one vehicle voxel half-way, and an unknown voxel."""
    labels, counts = np.zeros(SMALL.size, np.uint8), np.ones(SMALL.size, np.uint16)
    labels[8, 2, 1], labels[4, 2, 1], labels[:, 1, 1] = 1, 10, 7
    counts[3, 3, 1] = 0
    return Grid(SMALL, labels, counts)


def test_each_return_is_counted_by_where_it_ends_and_what_it_passes():
    points = np.array(
        [
            [8.4, 0.4, 0.4],
            [6.5, 0.5, 0.5],
            [3.5, 1.6, 0.2],
            [30.0, 0, 0],
            [4.6, 0.3, 0.5],
            [5.5, -0.5, 0.5],
        ]
    )
    scores = HeldOutScores.of(
        small_grid(), CARLA, points, np.array([1, 10, 10, 1, 10, 7], np.uint8)
    )
    rays = scores.all
    assert rays.returns == 5  # one is outside
    assert rays.free == pytest.approx(1 / 5)
    assert rays.unknown == pytest.approx(1 / 5)
    assert rays.occupied == pytest.approx(3 / 5)
    # two behind the vehicle, and one that passes the road
    assert rays.passed == pytest.approx(3 / 5)
    assert rays.passed_object == pytest.approx(2 / 5)
    assert scores.by_class()["Vehicle"].returns == 3
    assert scores.by_class()["Vehicle"].free == pytest.approx(1 / 3)
    assert scores.by_distance()["0-10 m"].returns == 5


def test_the_error_of_the_first_hit_is_its_distance_from_the_return():
    labels = np.zeros(SMALL.size, np.uint8)
    labels[8, 2, 1] = 1
    grid = Grid(SMALL, labels, np.ones(SMALL.size, np.uint16))
    scores = HeldOutScores.of(grid, CARLA, np.array([[5.0, 0.001, 0.001]]), np.array([1], np.uint8))
    assert scores.all.error_median_m == pytest.approx(3.5, abs=0.02)
    assert scores.all.missed == 0
    nothing = Grid(SMALL, np.zeros(SMALL.size, np.uint8), np.ones(SMALL.size, np.uint16))
    empty = HeldOutScores.of(nothing, CARLA, np.array([[5.0, 0.1, 0.1]]), np.array([1], np.uint8))
    assert empty.all.missed == 1
    assert empty.all.error_median_m is None


def test_without_labels_the_two_lowest_voxels_of_a_column_are_taken_for_ground():
    spec = GridSpec("cartesian", (10, 4, 6), (0.0, -2.0, -3.0), (10.0, 2.0, 3.0))
    ray = np.array([[9.5, 0.5, 0.5]])  # through the fourth layer
    for first, wanted in ((3, 0), (2, 0), (1, 1)):
        labels = np.zeros(spec.size, np.uint8)
        labels[4, 2, first:4] = CARLA.geometry_id
        scores = HeldOutScores.of(Grid(spec, labels, np.ones(spec.size)), CARLA, ray, None)
        assert (scores.all.passed, scores.all.passed_object) == (1, wanted)
        assert scores.by_class() == {}


def test_merged_scores_are_those_of_all_frames():
    points = np.array([[8.4, 0.4, 0.4], [6.5, 0.5, 0.5], [3.5, 1.6, 0.2], [2.2, 0.3, 0.1]])
    labels = np.array([1, 10, 10, 7], np.uint8)
    pose = [translation((4.0, 0.0, 0.5))]
    whole = HeldOutScores.of(small_grid(), CARLA, points, labels)
    parts = [
        HeldOutScores.of(small_grid(), CARLA, points[i : i + 2], labels[i : i + 2], pose)
        for i in (0, 2)
    ]
    merged = parts[0].merge(parts[1])
    assert merged.all == whole.all
    assert merged.frames == 2
    assert merged.swept_voxels == 2 * parts[0].swept_voxels > 0


def test_swept_voxels_are_those_whose_centre_the_vehicle_covers():
    spec = GridSpec.published()
    poses = [
        translation((3.0, -1.0, 0.2)) @ rotation_z(0.7),
        translation((40.0, 0.0, 0.0)),
        translation((25.0, 0, 0)),
    ]
    centers = spec.centers().reshape(-1, 3)
    wanted = np.zeros(spec.num_voxels, bool)
    for pose in poses:
        body = transform_points(np.linalg.inv(pose), centers)
        wanted |= ((body > VEHICLE_M[0]) & (body < VEHICLE_M[1])).all(axis=1)
    assert np.array_equal(swept_voxels(spec, poses).reshape(-1), wanted)
    assert wanted.any()


def test_traces_are_told_from_a_clean_grid(street):
    scores = {
        dynamic: holdout(
            street,
            passing_car.SPEC,
            observe=FromScans(window=(-6, 6), dynamic=dynamic),
            every=4,
            run=Run(workers=1),
        ).total
        for dynamic in ("tube", "align", "current")
    }
    tube, align, current = (
        scores[name].by_class()["Vehicle"] for name in ("tube", "align", "current")
    )
    assert scores["tube"].all.passed_object > 1.5 * scores["align"].all.passed_object
    assert current.free > 2 * align.free  # a car that is in no other scan's place is missing
    assert tube.returns == align.returns > 100
    assert scores["align"].swept_voxels > 0
    assert scores["align"].swept_share == 0


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    return passing_car.write_sequence(tmp_path_factory.mktemp("bare"), fields=(), frames=9)


def test_a_drive_without_labels_is_measured(bare):
    result = holdout(bare, observe=FromScans(window=(-3, 3)), every=3, run=Run(workers=1))
    assert result.total.all.occupied > 0.9
    assert result.to_dict()["total"]["by_class"] == {}


def test_frames_whose_window_is_cut_are_not_measured(bare):
    result = holdout(bare, observe=FromScans(window=(-3, 3)), every=2, run=Run(workers=1))
    assert result.total.frames == 2  # of frames 1, 3, 5 and 7, those with a whole window
    assert (
        holdout(
            bare, observe=FromScans(window=(-3, 3)), every=2, frames=(0, 2), run=Run(workers=1)
        ).total.frames
        == 1
    )
    with pytest.raises(MissingDataError) as caught:
        holdout(bare, every=2, frames=(2, 3))
    assert "leave out" in caught.value.expected


def test_executors_give_the_same_scores_and_progress_counts_frames(bare):
    steps = []
    one = holdout(bare, every=3, run=Run(workers=1, progress=lambda *step: steps.append(step)))
    with ThreadPoolExecutor(2) as threads:
        other = holdout(bare, every=3, run=Run(executor=threads, workers=2))
    assert one.to_dict() | {"elapsed_s": 0} == other.to_dict() | {"elapsed_s": 0}
    # nine scans for poses, six in which actors are found, three frames
    assert steps == [(done, 18) for done in range(19)]


def test_a_scan_that_cannot_be_read_is_reported_and_the_others_are_measured(tmp_path):
    folder = passing_car.write_sequence(tmp_path, frames=9)
    (folder / "cartesian" / "labels" / "000004.label").write_bytes(b"odd")
    result = holdout(folder, observe=FromScans(window=(-1, 1)), every=3, run=Run(workers=1))
    (failure,) = result.failures
    assert failure.frame == 4
    assert "000004.label" in failure.message
    assert result.total.frames == 2


def test_a_window_without_another_scan_is_a_failure(bare):
    result = holdout(bare, observe=FromScans(window=(-4, 4), stride=2), every=2, run=Run(workers=1))
    assert {failure.frame for failure in result.failures} == {3, 5}
    assert "other scans in its window" in result.failures[0].message
    assert result.total.frames == 0
    assert result.total.all.free is None


@pytest.mark.parametrize("wrong", [{"every": 1}, {"spec": GridSpec.published("cylindrical")}])
def test_wrong_arguments_are_refused(bare, wrong):
    with pytest.raises(ArgumentError):
        holdout(bare, **wrong)


@pytest.mark.parametrize(
    ("counts", "swept", "state", "fault"),
    [
        ((2000, 30, 0, 0, 600, 0), 10, "right", ""),
        ((2000, 50, 0, 0, 600, 0), 10, "wrong", "2.5% of the returns"),
        ((2000, 30, 0, 0, 1000, 0), 10, "wrong", "50.0% of the rays pass"),
        ((2000, 30, 0, 0, 600, 0), 60, "wrong", "60.0% of what the vehicle"),
        ((900, 800, 0, 0, 0, 0), 10, "untested", ""),
    ],
)
def test_the_rays_end_in_a_verdict(counts, swept, state, fault):
    empty = HeldOutScores.empty(CARLA)
    empty.counts[1, 0] = counts
    scores = replace(empty, swept_voxels=100, swept_known=100, swept_occupied=swept)
    result = HoldoutResult("here", GridSpec.published(), 10, {"A": scores})
    assert (result.state, result.to_dict()["state"]) == (state, state)
    assert result.faults.get("A", "").startswith(fault)


def test_depth_errors_are_those_of_the_first_surface_or_of_the_edge_of_the_grid():
    wall = np.zeros(SMALL.size, bool)
    wall[4] = True  # from x = 4 to 5 m
    origins = np.tile([0.5, 0.5, 0.5], (4, 1))
    points = np.array([[4.5, 0.5, 0.5], [9.5, 0.5, 0.5], [2.5, 0.5, 0.5], [0.5, 0.5, 0.5]])
    errors = depth_errors(wall, SMALL, origins, points)
    np.testing.assert_allclose(errors, [0, 5, 2, 0])
    errors = depth_errors(np.zeros_like(wall), SMALL, origins, points)
    np.testing.assert_allclose(errors, [5.5, 0.5, 7.5, 0])
