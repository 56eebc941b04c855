"""What convert says of data that are not as they should be, and that the rest is converted all the
same.
"""

import numpy as np
import pytest
from helpers.datasets.kitti import write_calibration
from helpers.datasets.tiny_kitti import write_labels, write_tiny_kitti

import carlasc
from carlasc.converting import LayoutOptions, convert
from carlasc.errors import ArgumentError, ConflictError, FormatError, MissingDataError
from carlasc.motion import PoseOptions
from carlasc.running import Run

PLAIN = {"grids": None, "layout": LayoutOptions(flow="none"), "run": Run(workers=1)}
SEQUENCE = "Train/KITTI_00/cartesian"


@pytest.fixture
def folder(tmp_path):
    return write_tiny_kitti(tmp_path / "in", frames=4)


def run(
    tmp_path,
    *,
    poses="auto",
    force=False,
    grids=None,
    sequences=None,
    split="all",
    flow="none",
    **layout,
):
    return convert(
        "kitti",
        tmp_path / "in",
        tmp_path / "out",
        sequences=sequences,
        split=split,
        layout=LayoutOptions(flow=flow, **layout),
        poses=PoseOptions(poses, force=force),
        grids=grids,
        run=Run(workers=1),
    )


def written(tmp_path, field="points"):
    return carlasc.open(tmp_path / "out").sequences()[SEQUENCE].frames(field).tolist()


def test_a_calibration_without_tr_is_refused_and_force_takes_the_poses_as_they_are(
    tmp_path, folder
):
    (folder / "calib.txt").write_text("P0: " + " ".join("0" * 12) + "\n")
    with pytest.raises(
        FormatError,
        match=r"calib.txt: expected Tr.*found only P0.*`poses=\"kiss-icp\"`.*`force=True`",
    ):
        run(tmp_path)
    assert not (tmp_path / "out").exists()
    run(tmp_path, force=True)
    (folder / "calib.txt").unlink()
    with pytest.raises(MissingDataError, match=r"calib.txt: expected Tr.*no such file"):
        convert("kitti", tmp_path / "in", tmp_path / "other", **PLAIN)


def test_a_calibration_with_extra_keys_is_read(tmp_path, folder):
    write_calibration(
        folder / "calib.txt",
        ["R0_rect: 1 0 0", "corner_dist: 9.95e-02", "calib_time: 09-Jan-2012", ""],
    )
    assert run(tmp_path).made == 4


def test_a_broken_tr_is_named(tmp_path, folder):
    (folder / "calib.txt").write_text("Tr: 1 0 0\n")
    with pytest.raises(FormatError, match=r"calib.txt: expected 12 numbers after Tr"):
        run(tmp_path)


def test_poses_one_line_short_are_refused(tmp_path, folder):
    lines = (folder / "poses.txt").read_text().splitlines()
    (folder / "poses.txt").write_text("\n".join(lines[:-1]) + "\n")
    with pytest.raises(FormatError, match="expected a pose for each frame up to 3, found 3 lines"):
        run(tmp_path)
    assert not (tmp_path / "out").exists()


def test_more_poses_than_scans_are_cut(tmp_path, folder):
    (folder / "velodyne" / "000003.bin").unlink()
    (folder / "labels" / "000003.label").unlink()
    run(tmp_path)
    assert len(carlasc.open(tmp_path / "out").sequences()[SEQUENCE].poses) == 3


def test_no_poses_are_a_missing_file_where_the_file_is_asked_for(tmp_path, folder):
    (folder / "poses.txt").unlink()
    with pytest.raises(MissingDataError, match=r"expected a file of poses, found none.*kiss-icp"):
        run(tmp_path, poses="file")


def test_labels_longer_than_points_fail_that_frame_only(tmp_path, folder):
    write_labels(folder, 1, np.zeros(61, np.uint32))
    result = run(tmp_path)
    assert [(failure.frame, result.made) for failure in result.failures] == [(1, 3)]
    assert (
        "labels/000001.label: expected a label for each of 60 points, found 61"
        in result.failures[0].message
    )
    assert written(tmp_path) == [0, 2, 3]


def test_unknown_classes_are_named_with_their_count_and_unlabelled_only_if_allowed(
    tmp_path, folder
):
    labels = np.full(60, 40, np.uint32)
    labels[:7] = 77
    labels[7] = 65535
    write_labels(folder, 2, labels)
    result = run(tmp_path)
    assert result.failures[0].frame == 2
    assert "found 77 (7 times), 65535 (1 times)" in result.failures[0].message
    assert "`allow_unknown=True`" in result.failures[0].message
    assert not run(tmp_path, allow_unknown=True).failures
    converted = carlasc.open(tmp_path / "out").sequences()[SEQUENCE].read("labels", 2)
    assert converted[:8].tolist() == [0] * 8
    assert set(converted[8:].tolist()) == {40}


def test_own_classes_are_checked_too(tmp_path, folder):
    write_labels(folder, 0, np.full(60, 200, np.uint32))
    result = run(tmp_path, classes="semantickitti")
    assert "200 (60 times)" in result.failures[0].message


def test_a_missing_scan_in_the_middle_is_a_failure_and_the_others_keep_their_numbers(
    tmp_path, folder
):
    (folder / "velodyne" / "000001.bin").unlink()
    result = run(tmp_path)
    assert [failure.frame for failure in result.failures] == [1]
    assert "000001.bin: expected a scan beside its labels" in result.failures[0].message
    assert written(tmp_path) == [0, 2, 3]
    sequence = carlasc.open(tmp_path / "out").sequences()[SEQUENCE]
    assert sequence.read_pose(2)[0, 3] == pytest.approx(1.0)
    assert "1 of the 4 frames from 0 to 3 have no scan" in result.notes[0]


def test_a_missing_label_file_is_a_failure(tmp_path, folder):
    (folder / "labels" / "000002.label").unlink()
    assert "000002.label: expected a file" in run(tmp_path).failures[0].message


def test_an_empty_scan_and_one_that_is_cut_short_are_failures(tmp_path, folder):
    (folder / "velodyne" / "000000.bin").write_bytes(b"")
    (folder / "velodyne" / "000002.bin").write_bytes(b"0" * 50)
    messages = {failure.frame: failure.message for failure in run(tmp_path, flow="auto").failures}
    assert "000000.bin: expected points, found an empty file" in messages[0]
    assert "000002.bin: expected a multiple of 16 bytes, found 50" in messages[2]
    assert written(tmp_path) == [1, 3]


def test_voxels_of_some_frames_only_give_grids_of_those(tmp_path):
    folder = write_tiny_kitti(tmp_path / "in", frames=6, voxels=True)
    for frame in (1, 2, 3, 4):
        for path in (folder / "voxels").glob(f"{frame:06d}.*"):
            path.unlink()
    (folder / "voxels" / "000005.label").write_bytes(b"short")
    result = run(tmp_path, grids="voxels")
    assert written(tmp_path, "evaluation_256x256x32/counts") == [0]
    assert [failure.frame for failure in result.failures] == [5]
    assert "000005.label: expected 4194304 bytes" in result.failures[0].message


def test_out_inside_src_is_refused(tmp_path, folder):
    before = sorted((tmp_path / "in").rglob("*"))
    for out in (tmp_path / "in", tmp_path / "in" / "sequences" / "out"):
        with pytest.raises(ConflictError, match="expected a place outside"):
            convert("kitti", tmp_path / "in", out, **PLAIN)
    assert sorted((tmp_path / "in").rglob("*")) == before


def test_a_second_run_goes_on_where_the_first_stopped(tmp_path, folder):
    run(tmp_path)
    target = tmp_path / "out" / SEQUENCE
    whole = {path: path.read_bytes() for path in sorted(target.rglob("*")) if path.is_file()}
    # written last: a frame without points is not complete
    (target / "velodyne" / "000002.bin").unlink()
    for path in ("velodyne/000003.bin", "labels/000003.label"):
        (target / path).unlink()
    again = run(tmp_path)
    assert (again.made, again.skipped) == (2, 2)
    assert {
        path: path.read_bytes() for path in sorted(target.rglob("*")) if path.is_file()
    } == whole


def test_a_second_run_of_other_settings_stops(tmp_path, folder):
    run(tmp_path)
    with pytest.raises(ConflictError, match=r"carlasc.json: expected the axes right"):
        run(tmp_path, axes="right")
    with pytest.raises(ConflictError, match="expected the axes left and the classes carla"):
        run(tmp_path, classes="carla")


def test_arguments_that_make_no_sense_are_named(tmp_path, folder):
    for name, value in (
        ("classes", "semanticposs"),
        ("axes", "up"),
        ("poses", "gps"),
        ("flow", "icp"),
    ):
        with pytest.raises(ArgumentError, match=f"{name}: expected one of"):
            run(tmp_path, **{name: value})
    with pytest.raises(ArgumentError, match="grids: expected GridOptions"):
        run(tmp_path, grids="scans")
    with pytest.raises(ArgumentError, match=r"name: expected one of .*kitti.*, found 'kiti'"):
        convert("kiti", tmp_path / "in", tmp_path / "out")


def test_what_is_not_there_is_named(tmp_path, folder):
    with pytest.raises(MissingDataError, match="expected the sequences 03, found only 00"):
        run(tmp_path, sequences=["03"])
    with pytest.raises(MissingDataError, match=r"split val.*00 \(Train, 4 scans\)"):
        run(tmp_path, split="val")
    (tmp_path / "empty").mkdir()
    with pytest.raises(MissingDataError, match="expected sequences/00/velodyne/"):
        convert("kitti", tmp_path / "empty", tmp_path / "out", **PLAIN)
    with pytest.raises(MissingDataError, match="expected a folder, found nothing"):
        convert("kitti", tmp_path / "nowhere", tmp_path / "out", **PLAIN)


def test_times_one_line_short_are_refused(tmp_path, folder):
    (folder / "times.txt").write_text("0.0\n0.1\n0.2\n")
    with pytest.raises(FormatError, match="expected a time for each frame up to 3, found 3 times"):
        run(tmp_path)


def test_camera_poses_without_their_calibration_are_refused(simulated, tmp_path):
    from shutil import copytree

    copy = tmp_path / "in"
    copytree(simulated[0], copy)
    # what somebody may write when the file is missing
    (copy / "sequences" / "00" / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(
        FormatError,
        match=r"the likely cause is camera-frame poses.*inv\(Tr\) @ P @ Tr.*`force=True`",
    ):
        run(tmp_path)
    assert not (tmp_path / "out").exists()
    assert run(tmp_path, force=True).made == 24
