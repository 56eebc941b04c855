"""From a frame of another data set to the fields of the layout, on frames in memory."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.recordings import MemoryFrame, MemoryRecording, MemoryWriter

from carlasc.converting import (
    FrameContent,
    VoxelContent,
    mirror_boxes,
    mirror_grid,
    mirror_points,
    mirror_poses,
    mirror_spec,
)
from carlasc.converting.frames import Block, FrameJob, Target, convert_block, make_fields
from carlasc.converting.places import check_outside
from carlasc.converting.plans import choose_recordings, plan_recording, write_documents
from carlasc.converting.results import Steps
from carlasc.converting.trajectory import read_poses, times_from_first
from carlasc.core import REMAPS, SEMANTICKITTI, Boxes, GridSpec
from carlasc.core.geometry import rotation_z, translation
from carlasc.errors import ConflictError, FormatError, MissingDataError, StorageError
from carlasc.storage import Metadata, layout

VOXELS = GridSpec("cartesian", (3, 4, 2), (0.0, -1.0, -1.0), (3.0, 3.0, 1.0))
GRID = layout.grid_folder(VOXELS)
TO_CARLA = REMAPS["semantickitti_to_carla"]
LEFT = Target(SEMANTICKITTI, TO_CARLA, mirrored=True)
RIGHT = Target(SEMANTICKITTI, None, mirrored=False)


def frame_of(labels, instances=None, number=0):
    points = np.arange(4 * len(labels), dtype=np.float32).reshape(-1, 4) + 1
    instances = np.zeros(len(labels), np.uint32) if instances is None else np.array(instances, np.uint32)
    return MemoryFrame(number, FrameContent(points, np.array(labels, np.uint16), instances))


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
    poses = np.stack([translation((10, 3, -1)) @ rotation_z(0.4), translation((5, -2, 0)) @ rotation_z(-3)])
    tracks, labels = np.array([2, 9], np.uint32), np.array([10, 30], np.uint32)
    return Boxes.from_poses(tracks, labels, poses, np.array([[4, 2, 1.5], [0.5, 0.6, 1.8]]), np.array([True, False]))


def test_mirrored_boxes_hold_the_mirrored_points():
    boxes, points = some_boxes(), np.random.default_rng(0).uniform((4, -4, -2), (13, 6, 1), (5000, 3))
    mirrored = mirror_boxes(boxes)
    assert boxes.contains(points).sum(axis=1).min() > 0
    np.testing.assert_array_equal(mirrored.contains(points * [1, -1, 1]), boxes.contains(points))
    headings = np.arctan2(mirrored.sensor_T_box[:, 1, 0], mirrored.sensor_T_box[:, 0, 0])
    np.testing.assert_allclose(headings, [-0.4, 3])
    np.testing.assert_allclose(mirror_boxes(mirrored).quaternions, boxes.quaternions, atol=1e-15)


def test_boxes_are_mirrored_and_get_the_classes_that_are_written():
    boxes = some_boxes()
    frame = MemoryFrame(0, FrameContent(np.ones((1, 4), np.float32), boxes=boxes))
    left = Boxes.from_table(make_fields(frame.read(), FrameJob(frame, True), LEFT)[0]["boxes"])
    right = make_fields(frame.read(), FrameJob(frame, True), RIGHT)[0]["boxes"]
    assert left.labels.tolist() == [10, 4] and left.centers.tolist() == [[10, -3, -1], [5, 2, 0]]
    assert left.tracks.tolist() == [2, 9] and left.annotated.tolist() == [True, False]
    assert right.tobytes() == boxes.to_table().tobytes()
    strange = FrameContent(np.ones((1, 4), np.float32), boxes=replace(boxes, labels=boxes.labels + np.uint32(200)))
    with pytest.raises(FormatError, match=r"boxes of .*: expected class ids of semantickitti, found 210"):
        make_fields(strange, FrameJob(frame, True), LEFT)


def test_a_mirrored_grid_has_its_classes_at_the_mirrored_places():
    grid = np.arange(VOXELS.num_voxels).reshape(VOXELS.size)
    mirrored = mirror_spec(VOXELS)
    assert (mirrored.lower, mirrored.upper) == ((0.0, -3.0, -1.0), (3.0, 1.0, 1.0))
    centers = VOXELS.centers().reshape(-1, 3)
    places = mirrored.flat_index(centers * [1, -1, 1])
    np.testing.assert_array_equal(mirror_grid(grid).reshape(-1)[places], grid.reshape(-1))


def test_flow_is_the_velocity_of_each_points_actor_and_is_mirrored_with_the_points():
    frame = frame_of([252, 252, 40, 254], [5, 6, 0, 7])
    job = FrameJob(frame, True, {5: (1.0, 2.0, 3.0), 7: (0.0, 0.5, 0.0)})
    right, without = make_fields(frame.read(), job, RIGHT)
    assert right["flow"].tolist() == [[1, 2, 3], [0, 0, 0], [0, 0, 0], [0, 0.5, 0]]
    assert without == 1  # actor 6 moves, and its velocity is unknown
    left, _ = make_fields(frame.read(), job, LEFT)
    assert left["flow"].tolist() == [[1, -2, 3], [0, 0, 0], [0, 0, 0], [0, -0.5, 0]]
    assert left["points"].tolist() == (frame.read().points * [1, -1, 1, 1]).tolist()
    assert left["labels"].tolist() == [10, 10, 7, 4]
    assert "flow" not in make_fields(frame.read(), FrameJob(frame, True), RIGHT)[0]
    assert list(left)[-1] == "points"


def test_ids_beyond_16_bits_are_unknown_ids_and_not_wrapped():
    with pytest.raises(FormatError, match=r"scan: expected class ids of semantickitti, found 65546 \(2 times\)"):
        RIGHT.map_labels(np.array([10, 65546, 65546], np.uint32), "scan")


def test_only_the_first_unknown_ids_are_listed():
    with pytest.raises(FormatError, match=r"found 300 \(1 times\), .*307 \(1 times\) and 2 more: treat"):
        RIGHT.map_labels(np.arange(300, 310, dtype=np.uint16), "scan")


def voxels_of(labels, known=None):
    return VoxelContent(labels, np.ones(VOXELS.size, bool) if known is None else known, {"000000.label": b"kept"})


def convert_voxels(target, voxels, writer):
    frame = MemoryFrame(0, frame_of([0]).content, voxels)
    return convert_block(Block((FrameJob(frame, False),), target, writer))


def test_own_voxels_are_mapped_mirrored_and_kept():
    labels = np.zeros(VOXELS.size, np.uint16)
    labels[0, 0, 0], labels[1, 0, 0], labels[2, 3, 1] = 40, 1, 252  # road, outlier (no target), moving car
    known = np.ones(VOXELS.size, bool)
    known[2, 3, 1] = False
    writer = MemoryWriter()
    target = Target(SEMANTICKITTI, TO_CARLA, mirrored=True, voxels=VOXELS)
    result = convert_voxels(target, voxels_of(labels, known), writer)
    found, counts = result.outputs[0][f"{GRID}/labels"], result.outputs[0][f"{GRID}/counts"]
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
    target = Target(SEMANTICKITTI, None, mirrored=False, voxels=VOXELS)
    result = convert_voxels(target, voxels_of(np.zeros(VOXELS.size, np.uint16)), writer)
    assert result.outputs[0] == {}
    assert writer.texts == {}


def test_a_frame_that_cannot_be_read_is_a_failure_and_a_store_that_cannot_be_written_ends_the_run():
    jobs = (FrameJob(MemoryFrame(0, None), True), FrameJob(frame_of([0], number=1), True))
    result = convert_block(Block(jobs, RIGHT, MemoryWriter()))
    assert [frame for frame, _ in result.failures] == [0]
    assert list(result.outputs) == [1]

    class Full(MemoryWriter):
        def write_document(self, name, data):
            raise StorageError("disk", problem="is full")

    target = Target(SEMANTICKITTI, None, mirrored=False, voxels=VOXELS)
    with pytest.raises(StorageError):
        convert_voxels(target, voxels_of(np.zeros(VOXELS.size, np.uint16)), Full())


def recording_of(poses, times=None, frames=(0, 1)):
    return MemoryRecording([frame_of([0], number=number) for number in frames], poses, times)


def test_poses_and_times_are_relative_to_the_first_frame():
    world = np.stack([translation((5, 0, 0)) @ rotation_z(1.0), translation((6, 1, 0)) @ rotation_z(1.2)])
    relative = read_poses(recording_of(world), "auto", force=False)
    np.testing.assert_allclose(relative[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(world[0] @ relative[1], world[1])
    np.testing.assert_allclose(times_from_first(recording_of(world, np.array([3.0, 3.25]))), [0, 0.25])
    np.testing.assert_allclose(times_from_first(recording_of(world, frames=(0, 3))), [0, 0.1, 0.2, 0.3])


def test_poses_of_the_file_are_not_read_where_they_are_to_be_estimated():
    assert read_poses(recording_of(np.tile(np.eye(4), (2, 1, 1))), "kiss-icp", force=False) is None
    assert read_poses(recording_of(None), "auto", force=False) is None


class Lab:
    classes, to_carla, sensor, voxels = SEMANTICKITTI, TO_CARLA, None, None
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
    plan = plan_recording(recording_of(None), Lab, MemorySink(writer), "kiss-icp", flow=False, force=False)
    write_documents(plan, LEFT, Lab, Metadata(), Steps(None, 0))
    np.testing.assert_allclose(plan.poses, mirror_poses(stored), atol=1e-9)
    np.testing.assert_allclose(layout.decode_poses(writer.texts[layout.POSES], "poses"), stored, atol=1e-9)


def test_poses_of_another_origin_are_a_conflict():
    writer = MemoryWriter()
    writer.write_document(layout.METADATA, Metadata(extra={"poses": "kiss-icp"}).to_json())
    poses = np.tile(np.eye(4), (2, 1, 1))
    plan = plan_recording(recording_of(poses), Lab, MemorySink(writer), "file", flow=False, force=True)
    with pytest.raises(ConflictError, match="expected poses from file, found kiss-icp"):
        write_documents(plan, LEFT, Lab, Metadata(), Steps(None, 0))


def test_a_sequence_whose_scans_are_all_missing_is_named(tmp_path):
    empty = recording_of(None, frames=())
    with pytest.raises(MissingDataError, match="expected sequences with scans in the split all"):
        choose_recordings([empty], tmp_path, None, "all")
    empty.problems = lambda: [(0, "no scan")]
    with pytest.raises(MissingDataError, match="memory/velodyne: expected scans, found none"):
        choose_recordings([empty], tmp_path, None, "all")


def test_output_inside_the_source_is_refused_and_a_url_is_elsewhere(tmp_path):
    for out in (tmp_path, tmp_path / "below"):
        with pytest.raises(ConflictError, match="expected a place outside"):
            check_outside(out, str(tmp_path))
    check_outside(tmp_path.parent / "beside", str(tmp_path))
    check_outside(tmp_path, "s3://bucket/set")
