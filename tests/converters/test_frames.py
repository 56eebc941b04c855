"""From a frame of another data set to the fields of the layout, on frames in memory."""

import numpy as np
import pytest
from helpers.datasets.recordings import MemoryFrame, MemoryRecording, MemoryWriter

from carlasc.converting import Cloud, Sensor, Trajectory, VoxelContent
from carlasc.converting.assembling import (
    AxesAndClasses,
    LayoutOptions,
    Rig,
    VehicleMotion,
    assemble,
    make_fields,
)
from carlasc.converting.plans import (
    begin,
    choose_recordings,
    frame_times,
    jitter,
    plan_recording,
    read_trajectory,
    scan_poses,
)
from carlasc.converting.protocol import check_outside
from carlasc.converting.stages import Block, ScanJob, ScanStage
from carlasc.core import REMAPS, SEMANTICKITTI, Boxes, GridSpec
from carlasc.core.boxes import mirror_boxes
from carlasc.core.geometry import mirror_points, mirror_poses, rotation_z, translation
from carlasc.core.grids import mirror_grid, mirror_spec
from carlasc.errors import ConflictError, FormatError, MissingDataError, StorageError
from carlasc.motion import PoseOptions
from carlasc.storage import Metadata, layout

VOXELS = GridSpec("cartesian", (3, 4, 2), (0.0, -1.0, -1.0), (3.0, 3.0, 1.0))
GRID = layout.grid_folder(VOXELS)
TO_CARLA = REMAPS["semantickitti_to_carla"]
LEFT = AxesAndClasses(SEMANTICKITTI, TO_CARLA, mirrored=True)
RIGHT = AxesAndClasses(SEMANTICKITTI, None, mirrored=False)
RIG = Rig((Sensor(),), np.eye(4))


def frame_of(labels, instances=None, number=0):
    points = np.arange(4 * len(labels), dtype=np.float32).reshape(-1, 4) + 1
    instances = (
        np.zeros(len(labels), np.uint32) if instances is None else np.array(instances, np.uint32)
    )
    return MemoryFrame(number, Cloud(points, np.array(labels, np.uint16), instances))


def test_only_y_of_points_and_vectors_changes_its_sign():
    points = np.array([[1, 2, 3, 4]], np.float32)
    assert mirror_points(points).tolist() == [[1, -2, 3, 4]]
    assert mirror_points(points[:, :3]).tolist() == [[1, -2, 3]]
    assert mirror_points(points).dtype == np.float32


def test_mirrored_poses_move_mirrored_points_to_the_mirrored_place():
    pose = translation((1, 2, 3)) @ rotation_z(0.4)
    point = np.array([5.0, 6.0, 7.0, 1.0])
    signs = np.array([1, -1, 1, 1])
    np.testing.assert_allclose(mirror_poses(pose) @ (point * signs), (pose @ point) * signs)
    np.testing.assert_array_equal(mirror_poses(mirror_poses(pose)), pose)


def some_boxes():
    poses = np.stack(
        [translation((10, 3, -1)) @ rotation_z(0.4), translation((5, -2, 0)) @ rotation_z(-3)]
    )
    tracks, labels = np.array([2, 9], np.uint32), np.array([10, 30], np.uint32)
    return Boxes.from_poses(
        tracks, labels, poses, np.array([[4, 2, 1.5], [0.5, 0.6, 1.8]]), np.array([True, False])
    )


def test_mirrored_boxes_hold_the_mirrored_points():
    boxes, points = (
        some_boxes(),
        np.random.default_rng(0).uniform((4, -4, -2), (13, 6, 1), (5000, 3)),
    )
    mirrored = mirror_boxes(boxes)
    assert boxes.contains(points).sum(axis=1).min() > 0
    np.testing.assert_array_equal(mirrored.contains(points * [1, -1, 1]), boxes.contains(points))
    headings = np.arctan2(mirrored.sensor_T_box[:, 1, 0], mirrored.sensor_T_box[:, 0, 0])
    np.testing.assert_allclose(headings, [-0.4, 3])
    np.testing.assert_allclose(mirror_boxes(mirrored).quaternions, boxes.quaternions, atol=1e-15)


def test_a_mirrored_grid_has_its_classes_at_the_mirrored_places():
    grid = np.arange(VOXELS.num_voxels).reshape(VOXELS.size)
    mirrored = mirror_spec(VOXELS)
    assert (mirrored.lower, mirrored.upper) == ((0.0, -3.0, -1.0), (3.0, 1.0, 1.0))
    centers = VOXELS.centers().reshape(-1, 3)
    places = mirrored.flat_index(centers * [1, -1, 1])
    np.testing.assert_array_equal(mirror_grid(grid).reshape(-1)[places], grid.reshape(-1))


def test_a_scan_is_mirrored_and_mapped_and_its_points_come_last():
    frame = frame_of([252, 252, 40, 254], [5, 6, 0, 7])
    scan = assemble(frame.read(), RIG, None, "scan")
    left = make_fields(scan, LEFT, "scan")
    assert left["points"].tolist() == (frame.content.points * [1, -1, 1, 1]).tolist()
    assert left["labels"].tolist() == [10, 10, 7, 4]
    assert left["instances"].tolist() == [5, 6, 0, 7]
    assert list(left)[-1] == "points"
    assert make_fields(scan, RIGHT, "scan")["points"] is frame.content.points


def test_ids_beyond_16_bits_are_unknown_ids_and_not_wrapped():
    with pytest.raises(
        FormatError, match=r"scan: expected class ids of semantickitti, found 65546 \(2 times\)"
    ):
        RIGHT.map_labels(np.array([10, 65546, 65546], np.uint32), "scan")


def test_only_the_first_unknown_ids_are_listed():
    with pytest.raises(
        FormatError, match=r"found 300 \(1 times\), .*307 \(1 times\) and 2 more: treat"
    ):
        RIGHT.map_labels(np.arange(300, 310, dtype=np.uint16), "scan")


def voxels_of(labels, known=None):
    return VoxelContent(
        labels, np.ones(VOXELS.size, bool) if known is None else known, {"000000.label": b"kept"}
    )


def convert_voxels(target, voxels, writer):
    frame = MemoryFrame(0, frame_of([0]).content, voxels)
    stage = ScanStage(target, writer, RIG, VOXELS)
    return Block(stage, (ScanJob(frame, write=False),)).convert()[0]


def test_own_voxels_are_mapped_mirrored_and_kept():
    labels = np.zeros(VOXELS.size, np.uint16)
    # road, outlier (no target), moving car
    labels[0, 0, 0], labels[1, 0, 0], labels[2, 3, 1] = (
        40,
        1,
        252,
    )
    known = np.ones(VOXELS.size, bool)
    known[2, 3, 1] = False
    writer = MemoryWriter()
    target = AxesAndClasses(SEMANTICKITTI, TO_CARLA, mirrored=True)
    result = convert_voxels(target, voxels_of(labels, known), writer)
    found, counts = result.fields[f"{GRID}/labels"], result.fields[f"{GRID}/counts"]
    assert found[0, -1, 0] == 7
    assert counts[0, -1, 0] == 1
    assert counts[1, -1, 0] == 0  # occupied, but of a class that has no target
    assert (found[2, 0, 1], counts[2, 0, 1]) == (0, 0)  # unknown voxels have no class
    assert np.count_nonzero(found) == 1
    assert counts.sum() == VOXELS.num_voxels - 2
    assert writer.texts == {"voxels_kitti/000000.label": b"kept"}


def test_voxels_that_are_written_already_are_not_read_again():
    writer = MemoryWriter()
    writer.write(f"{GRID}/counts", 0, np.ones(VOXELS.size))
    target = AxesAndClasses(SEMANTICKITTI, None, mirrored=False)
    result = convert_voxels(target, voxels_of(np.zeros(VOXELS.size, np.uint16)), writer)
    assert result.fields == {}
    assert writer.texts == {}


def test_a_frame_that_cannot_be_read_is_a_failure_and_a_store_that_cannot_be_written_ends_the_run():
    jobs = (ScanJob(MemoryFrame(0, None)), ScanJob(frame_of([0], number=1)))
    failed, read = Block(ScanStage(RIGHT, MemoryWriter(), RIG), jobs).convert()
    assert "expected points, found nothing" in failed.failure
    assert (failed.number, read.number, read.failure) == (0, 1, None)
    assert "points" in read.fields

    class Full(MemoryWriter):
        def write_document(self, name, data):
            raise StorageError("disk", problem="is full")

    target = AxesAndClasses(SEMANTICKITTI, None, mirrored=False)
    with pytest.raises(StorageError):
        convert_voxels(target, voxels_of(np.zeros(VOXELS.size, np.uint16)), Full())


def recording_of(poses, times=None, frames=(0, 1)):
    return MemoryRecording([frame_of([0], number=number) for number in frames], poses, times)


def times_of(recording):
    return frame_times(recording, recording.times())


def test_poses_are_relative_to_the_first_frame_and_in_the_frame_of_the_first_sensor():
    world = np.stack(
        [translation((5, 0, 0)) @ rotation_z(1.0), translation((6, 1, 0)) @ rotation_z(1.2)]
    )
    recording = recording_of(world)
    recording.sensors = (Sensor("roof", translation((1.0, 0.0, 1.5)) @ rotation_z(0.5)),)
    times = times_of(recording)
    trajectory = read_trajectory(recording, PoseOptions("auto"))
    poses = scan_poses(trajectory, recording, times)
    scans = world @ translation((1.0, 0.0, 1.5))  # the axes are those of the vehicle
    np.testing.assert_allclose(poses, np.linalg.inv(scans[0]) @ scans, atol=1e-12)


def test_times_are_those_of_the_recording_or_a_tenth_of_a_second_apart():
    poses = np.tile(np.eye(4), (4, 1, 1))
    assert times_of(recording_of(poses, np.array([3.0, 3.25]))).tolist() == [3.0, 3.25]
    np.testing.assert_allclose(times_of(recording_of(poses, frames=(0, 3))), [0, 0.1, 0.2, 0.3])
    with pytest.raises(FormatError, match="expected a time for each frame up to 1, found 1 times"):
        times_of(recording_of(poses, np.array([3.0])))


@pytest.mark.parametrize("wrong", [1.7e18, -1e308, np.inf, np.nan])
def test_times_that_are_no_seconds_are_refused(wrong):
    poses = np.tile(np.eye(4), (2, 1, 1))
    with pytest.raises(
        FormatError, match=r"memory: expected times in seconds, below 1e\+11, found .* at row 1"
    ):
        times_of(recording_of(poses, np.array([0.0, wrong])))
    with pytest.raises(FormatError, match="poses: expected times"):
        Trajectory(poses, np.array([0.0, abs(wrong)]))


def test_one_pose_with_a_time_is_not_that_of_many_scans():
    recording = recording_of(None)
    recording.poses = lambda *, force=False: Trajectory(np.eye(4)[None], np.array([0.0]))
    with pytest.raises(
        FormatError, match="memory: expected poses over the time of 2 scans, found one pose: copy"
    ):
        read_trajectory(recording, PoseOptions("auto"))


def test_poses_at_their_own_times_are_interpolated():
    recording = recording_of(None)
    turning = np.stack([rotation_z(0.0), translation((2, 0, 0)) @ rotation_z(0.4)])
    recording.poses = lambda *, force=False: Trajectory(turning, np.array([10.0, 10.2]))
    recording.times = lambda: np.array([10.05, 10.1])
    times = times_of(recording)
    poses = scan_poses(read_trajectory(recording, PoseOptions("auto")), recording, times)
    half = translation((1, 0, 0)) @ rotation_z(0.2)
    quarter = translation((0.5, 0, 0)) @ rotation_z(0.1)
    np.testing.assert_allclose(poses[1], np.linalg.inv(quarter) @ half, atol=1e-12)


def test_the_jitter_of_poses_is_told_from_the_motion_of_the_vehicle():
    seconds = np.arange(200) * 0.1
    smooth = np.tile(np.eye(4), (200, 1, 1))
    smooth[:, 0, 3], smooth[:, 1, 3] = 12 * seconds + np.sin(seconds), 2 * np.sin(0.5 * seconds)
    noisy = smooth.copy()
    noisy[:, :3, 3] += np.random.default_rng(0).normal(scale=0.06, size=(200, 3))
    assert jitter(smooth) < 0.002
    assert 0.06 < jitter(noisy) < 0.14  # the length of three numbers of 6 cm


def test_poses_of_the_file_are_not_read_where_they_are_to_be_estimated():
    poses = np.tile(np.eye(4), (2, 1, 1))
    assert read_trajectory(recording_of(poses), PoseOptions("kiss-icp")) is None
    assert read_trajectory(recording_of(None), PoseOptions("auto")) is None
    with pytest.raises(MissingDataError, match="memory: expected a file of poses, found none"):
        read_trajectory(recording_of(None), PoseOptions("file"))
    with pytest.raises(FormatError, match="expected a pose for each frame up to 1, found 1 lines"):
        read_trajectory(recording_of(poses[:1]), PoseOptions("file"))


def driving(speed, seconds):
    """A vehicle that drives along x, with a pose every second."""
    at = np.arange(-2.0, 5.0)
    poses = np.tile(np.eye(4), (len(at), 1, 1))
    poses[:, 0, 3] = speed * at
    return VehicleMotion(Trajectory(poses, at), seconds)


def test_points_are_moved_to_the_time_of_the_frame_and_keep_the_place_of_their_ray():
    points = np.array([[10, 0, 0, 1], [10, 0, 0, 2], [10, 0, 0, 3]], np.float32)
    cloud = Cloud(points, seconds=np.array([-0.5, 0.0, 0.5]))
    rolling = Rig((Sensor("turns", deskewed=False),), np.eye(4))
    scan = assemble([cloud], rolling, driving(2.0, 1.0), "scan")
    np.testing.assert_allclose(scan.points, [[9, 0, 0, 1], [10, 0, 0, 2], [11, 0, 0, 3]], atol=1e-6)
    # neighbouring places count as one
    assert np.abs(scan.fields["origins"][:, 0] - [-1, 0, 1]).max() <= 0.13
    corrected = assemble([cloud], Rig((Sensor("corrected"),), np.eye(4)), driving(2.0, 1.0), "scan")
    assert corrected.points is points
    np.testing.assert_array_equal(corrected.fields["origins"], scan.fields["origins"])
    standing = assemble([cloud], rolling, driving(0.0, 1.0), "scan")
    assert not standing.fields["origins"].any()
    assert "origins" not in assemble([cloud], RIG, None, "scan").fields


def test_clouds_of_several_sensors_are_put_together_in_the_axes_of_the_vehicle():
    sensors = (
        Sensor("roof", translation((0, 0, 2)) @ rotation_z(np.pi / 2)),
        Sensor("front", translation((3, 0, 1))),
    )
    vehicle_T_scan = translation((0, 0, 2))
    ahead = np.array([[5, 0, 0, 1]], np.float32)
    clouds = [Cloud(ahead, np.array([10], np.uint8)), Cloud(ahead, sensor=1)]
    scan = assemble(clouds, Rig(sensors, vehicle_T_scan), None, "scan")
    np.testing.assert_allclose(scan.points, [[0, 5, 0, 1], [8, 0, -1, 1]], atol=1e-6)
    assert scan.labels.tolist() == [10, 0] and scan.instances is None
    assert scan.fields["sensor"].tolist() == [0, 1]
    np.testing.assert_allclose(scan.fields["origins"], [[0, 0, 0], [3, 0, -1]])


@pytest.mark.parametrize(
    ("cloud", "problem"),
    [
        (Cloud(np.zeros((2, 5), np.float32)), r"scan: points: expected shape \(N, 4\) float32"),
        (
            Cloud(np.zeros((2, 4), np.float32), np.zeros(3, np.uint8)),
            "scan: labels: expected one for each of 2 points",
        ),
        (Cloud(np.zeros((2, 4), np.float32), sensor=1), "scan: expected a sensor 0..0, found 1"),
    ],
)
def test_clouds_that_do_not_fit_are_named(cloud, problem):
    with pytest.raises(FormatError, match=problem):
        assemble([cloud], RIG, None, "scan")
    with pytest.raises(FormatError, match="expected points of at least one sensor"):
        assemble([], RIG, None, "scan")


class Lab:
    classes, to_carla, keeps_classes, sensor = SEMANTICKITTI, TO_CARLA, False, None
    min_range_m = max_range_m = None


class MemorySink:
    def __init__(self, writer):
        self.writer = writer

    def sequence(self, path):
        return self.writer


def test_estimated_poses_of_an_earlier_run_are_used_in_right_handed_axes():
    stored = np.stack([np.eye(4), translation((1, 0.5, 0)) @ rotation_z(0.3)])
    writer = MemoryWriter()
    writer.write_document(layout.POSES, layout.encode_poses(stored))
    writer.write_document(layout.METADATA, Metadata(extra={"poses": "kiss-icp"}).to_json())
    plan = plan_recording(
        recording_of(None),
        Lab,
        MemorySink(writer),
        LayoutOptions(flow="none"),
        PoseOptions("kiss-icp"),
        voxels=False,
    )
    begin(plan, LEFT, Metadata())
    np.testing.assert_allclose(plan.poses, mirror_poses(stored), atol=1e-9)
    np.testing.assert_allclose(
        layout.decode_poses(writer.texts[layout.POSES], "poses"), stored, atol=1e-9
    )


def test_poses_of_another_origin_are_a_conflict():
    writer = MemoryWriter()
    writer.write_document(layout.METADATA, Metadata(extra={"poses": "kiss-icp"}).to_json())
    poses = np.tile(np.eye(4), (2, 1, 1))
    plan = plan_recording(
        recording_of(poses),
        Lab,
        MemorySink(writer),
        LayoutOptions(flow="none"),
        PoseOptions("file", force=True),
        voxels=False,
    )
    with pytest.raises(ConflictError, match="expected poses from file, found kiss-icp"):
        begin(plan, LEFT, Metadata())


def test_a_sequence_whose_scans_are_all_missing_is_named(tmp_path):
    empty = recording_of(None, frames=())
    with pytest.raises(MissingDataError, match="expected sequences with scans in the split all"):
        choose_recordings([empty], tmp_path, None, "all")
    empty.problems = lambda: [(0, "no scan")]
    with pytest.raises(MissingDataError, match="memory: expected scans, found none"):
        choose_recordings([empty], tmp_path, None, "all")


def test_output_inside_the_source_is_refused_and_a_url_is_elsewhere(tmp_path):
    for out in (tmp_path, tmp_path / "below"):
        with pytest.raises(ConflictError, match="expected a place outside"):
            check_outside(out, str(tmp_path))
    check_outside(tmp_path.parent / "beside", str(tmp_path))
    check_outside(tmp_path, "s3://bucket/set")
