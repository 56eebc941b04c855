"""Checks of files and poses on a small sequence with one fault each, and with values just inside
and outside the limits.
"""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from carlasc.core.boxes import Boxes
from carlasc.core.geometry import rotation_z, translation
from carlasc.core.grids import GridSpec
from carlasc.inspection.contents import check_documents, check_frames, check_shapes, check_values
from carlasc.inspection.pose_quality import check_poses, check_times
from carlasc.storage import FolderSink, FolderSource, layout

SPEC = GridSpec("cartesian", (4, 4, 2), (-2.0, -2.0, -1.0), (2.0, 2.0, 1.0))
PICTURE = np.frombuffer(b"\xff\xd8\xff\xe0", np.uint8)


@pytest.fixture
def folder(tmp_path):
    """Two sound frames of five points, with labels, flow, a picture and a grid."""
    writer = FolderSink(tmp_path).sequence("cartesian")
    writer.write_document(layout.params_file("evaluation"), json.dumps(SPEC.to_params()).encode())
    writer.write_document(layout.POSES, layout.encode_poses(np.tile(np.eye(4), (2, 1, 1))))
    writer.write_document(layout.TIMES, layout.encode_times(np.array([0.0, 0.1])))
    for frame in range(2):
        writer.write("points", frame, np.ones((5, 4), np.float32))
        writer.write("labels", frame, np.full(5, 7, np.uint32))
        writer.write("flow", frame, np.zeros((5, 3), np.float32))
        writer.write("bev", frame, PICTURE)
        writer.write("evaluation/labels", frame, np.full(SPEC.size, 7, np.uint32))
        writer.write("evaluation/counts", frame, np.ones(SPEC.size, np.float32))
    return tmp_path / "cartesian"


def open_sequence(folder):
    (sequence,) = FolderSource(folder.parent).sequences().values()
    return sequence


def findings(check, folder, *arguments):
    return [(f.severity, f.check, str(f)) for f in check(open_sequence(folder), *arguments)]


def rewrite(path, change):
    values = np.fromfile(path, "<f4")
    change(values)
    values.tofile(path)


def test_a_sound_sequence_has_no_findings(folder):
    for check in (check_documents, check_frames, check_poses, check_times):
        assert findings(check, folder) == []
    for check in (check_shapes, check_values):
        assert findings(check, folder, 0) == []


@pytest.mark.parametrize(("speed", "count"), [(100, 0), (101, 1), (-101, 1)])
def test_velocities_of_more_than_100_m_s_are_a_warning(folder, speed, count):
    rewrite(folder / "predictions/000000.bin", lambda flow: flow.__setitem__(4, speed))
    assert [(s, c) for s, c, _ in findings(check_values, folder, 0)] == [
        ("warning", "flow")
    ] * count


@pytest.mark.parametrize("count", [-1, 0.5, 1.5, np.inf])
def test_counts_are_whole_numbers_of_votes(folder, count):
    rewrite(folder / "evaluation/000000.bin", lambda counts: counts.__setitem__(slice(3), count))
    texts = [text for *_, text in findings(check_values, folder, 0)]
    assert (
        f"expected whole numbers of votes, 0 or more, found {count:g}, and 2 other such values"
        in texts[0]
    )


def test_a_grid_without_any_vote_is_a_warning(folder):
    for name in ("label", "bin"):
        rewrite(folder / f"evaluation/000000.{name}", lambda values: values.fill(0))
    ((severity, _, text),) = findings(check_values, folder, 0)
    assert (severity, "no vote in the whole grid" in text) == ("warning", True)


def test_a_picture_that_is_no_jpeg_is_a_warning(folder):
    (path,) = folder.glob("bev/000000.*")
    path.write_bytes(b"PNG")
    assert [finding[:2] for finding in findings(check_values, folder, 0)] == [("warning", "bev")]


def test_an_empty_scan_is_a_warning(folder):
    for name in ("velodyne/000000.bin", "labels/000000.label", "predictions/000000.bin"):
        (folder / name).write_bytes(b"")
    assert [finding[:2] for finding in findings(check_shapes, folder, 0)] == [
        ("warning", "empty-scan")
    ]


@pytest.mark.parametrize(
    ("channels", "sound"), [(23, True), (22, False), ("23", False), (None, False)]
)
def test_params_say_as_many_channels_as_there_are_classes(folder, channels, sound):
    path = folder / "evaluation/params.json"
    path.write_text(json.dumps(SPEC.to_params() | {"num_channels": channels}))
    found = findings(check_documents, folder)
    assert [finding[:2] for finding in found] == ([] if sound else [("warning", "params")])


def test_a_grid_in_other_coordinates_than_its_folder_is_a_warning(folder):
    spec = GridSpec("cylindrical", SPEC.size, (0.0, -np.pi, -1.0), (2.0, np.pi, 1.0))
    (folder / "evaluation/params.json").write_text(json.dumps(spec.to_params()))
    (finding,) = findings(check_documents, folder)
    assert "expected a cartesian grid, as the folder says, found a cylindrical one" in finding[2]


def test_a_grid_without_counts_is_a_warning_unless_a_network_predicted_it(folder):
    for path in folder.glob("evaluation/*.bin"):
        path.unlink()
    ((severity, check, _),) = findings(check_documents, folder)
    assert (severity, check) == ("warning", "frame-counts")
    path = folder / "evaluation/params.json"
    path.write_text(
        json.dumps(json.loads(path.read_text()) | {"carlasc": {"network": "lmscnet_ss"}})
    )
    assert findings(check_documents, folder) == []


def test_a_grid_without_labels_is_an_error(folder):
    for path in folder.glob("evaluation/*.label"):
        path.unlink()
    ((severity, check, text),) = findings(check_frames, folder)
    assert (severity, check) == ("error", "frame-counts")
    assert "expected labels of the grid, found only counts" in text


def test_a_gap_between_grids_alone_is_only_a_note(folder):
    for name in ("velodyne", "labels", "predictions", "bev"):
        for path in (folder / name).iterdir():
            path.unlink()
    for path in list(folder.glob("evaluation/000001.*")):
        path.rename(path.with_stem("000005"))
    assert [finding[:2] for finding in findings(check_frames, folder)] == [("note", "frame-gaps")]


def write_poses(folder, poses, frames=None):
    """Write poses, and only the scans of some frames."""
    (folder / layout.POSES).write_bytes(layout.encode_poses(np.asarray(poses)))
    for path in [
        *folder.glob("*/00000*.label"),
        *folder.glob("*/00000*.bin"),
        *folder.glob("bev/*"),
    ]:
        path.unlink()
    for frame in range(len(poses)) if frames is None else frames:
        np.ones((5, 4), "<f4").tofile(folder / f"velodyne/{frame:06d}.bin")


def drive(steps, turns=None):
    """Return the poses after steps along x, in metres, and turns about z, in radians."""
    poses = [np.eye(4)]
    for step, turn in zip(steps, turns or [0.0] * len(steps), strict=True):
        motion = rotation_z(turn)
        motion[0, 3] = step
        poses.append(poses[-1] @ motion)
    return np.array(poses)


@pytest.mark.parametrize(
    ("steps", "turns", "jumps"),
    [
        ([6.9] * 5, None, 0),
        ([7.1] * 5, None, 1),  # 71 m/s, faster than any vehicle
        ([1.0, 1.0, 1.0, 2.4, 1.0, 1.0], None, 0),
        ([1.0, 1.0, 1.0, 2.6, 1.0, 1.0], None, 1),  # 16 m/s faster than before and after
        ([1.0] * 3, [0.0, np.deg2rad(24), 0.0], 0),
        ([1.0] * 3, [0.0, np.deg2rad(26), 0.0], 1),  # 260 degrees per second
        ([1.0] * 3, [0.0, np.deg2rad(-26), 0.0], 1),
    ],
)
def test_steps_that_a_vehicle_cannot_make_are_errors(folder, steps, turns, jumps):
    write_poses(folder, drive(steps, turns))
    assert [finding[:2] for finding in findings(check_poses, folder)] == [
        ("error", "pose-jump")
    ] * jumps


def test_a_step_over_missing_frames_may_be_longer(folder):
    poses = drive([1.0] * 8)
    write_poses(folder, poses, frames=[0, 1, 2, 6, 7, 8])
    assert findings(check_poses, folder) == []


def test_a_first_pose_that_is_not_the_identity_is_a_note_only_for_frame_0(folder):
    poses = drive([1.0] * 3)
    write_poses(folder, poses[1:])
    ((severity, check, text),) = findings(check_poses, folder)
    assert (severity, check) == ("note", "poses")
    assert "expected the identity as the first pose, found another pose" in text
    write_poses(folder, poses, frames=[1, 2, 3])
    assert findings(check_poses, folder) == []


@pytest.mark.parametrize(("scale", "sound"), [(1.0004, True), (1.001, False)])
def test_poses_are_rigid_up_to_a_thousandth(folder, scale, sound):
    poses = drive([1.0] * 3)
    poses[1:, :3, :3] *= scale
    write_poses(folder, poses)
    found = findings(check_poses, folder)
    assert [finding[:2] for finding in found] == ([] if sound else [("error", "poses")])
    if not sound:
        assert "line 2: expected a rigid transform" in found[0][2]
        assert "(and 2 more such lines)" in found[0][2]


@pytest.mark.parametrize(
    ("times", "text"), [([0.0, 0.0], "0 s in line 2 after 0 s"), ([0.0, np.nan], "line 2")]
)
def test_times_increase(folder, times, text):
    (folder / layout.TIMES).write_bytes(layout.encode_times(np.array(times)))
    ((severity, check, found),) = findings(check_times, folder)
    assert (severity, check) == ("error", "times")
    assert text in found


def test_times_have_a_line_per_frame(folder):
    (folder / layout.TIMES).write_bytes(layout.encode_times(np.array([0.0])))
    assert "expected 2 lines, up to frame 1, found 1 lines" in findings(check_times, folder)[0][2]


def write_boxes(folder, frame, **changes):
    """Write two boxes of a frame, with other values in some columns of the second one."""
    poses = np.stack([translation((5, 0, -1)), translation((9, 3, -1))])
    tracks, labels = np.array([1, 2], np.uint32), np.array([10, 4], np.uint32)
    table = Boxes.from_poses(tracks, labels, poses, np.ones((2, 3))).to_table()
    for name, value in changes.items():
        table[name][1] = value
    FolderSink(folder.parent).sequence("cartesian").write("boxes", frame, table)


def test_frames_without_boxes_were_not_annotated_and_are_no_finding(folder):
    write_boxes(folder, 1)
    assert findings(check_frames, folder) == []
    assert findings(check_values, folder, 1) == []
    write_boxes(folder, 7)
    ((severity, check, text),) = findings(check_frames, folder)
    assert (severity, check) == ("warning", "frame-counts") and "boxes" in text and "000007" in text


@pytest.mark.parametrize(
    ("changes", "severity", "check", "message"),
    [
        (
            {"x": np.nan},
            "error",
            "boxes",
            r"boxes/000000.bin.*finite numbers.*in box 1 \(track 2\)",
        ),
        ({"height": 0}, "error", "boxes", "positive lengths, widths and heights"),
        ({"qz": 0.5}, "error", "boxes", "a quaternion of length 1"),
        ({"track": 1}, "error", "boxes", "one box per track in a frame"),
        ({"label": 77}, "error", "class-ids", r"class ids of carla, found 77 \(1 times\)"),
        (
            {"y": 501},
            "warning",
            "boxes",
            r"boxes within 500 m, found track 2 at \[9.0, 501.0, -1.0\]",
        ),
    ],
)
def test_boxes_that_are_wrong_are_found(folder, changes, severity, check, message):
    write_boxes(folder, 0, **changes)
    ((found, name, text),) = findings(check_values, folder, 0)
    assert (found, name) == (severity, check)
    assert re.search(message, text), text


def test_a_file_of_boxes_cut_short_is_an_error(folder):
    write_boxes(folder, 0)
    file = folder / "boxes/000000.bin"
    file.write_bytes(file.read_bytes()[:-1])
    ((severity, check, text),) = findings(check_shapes, folder, 0)
    assert (severity, check) == ("error", "file-size") and "a multiple of 89 bytes" in text
