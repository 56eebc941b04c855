"""`validate` on sound data, on data with one known fault each, and on files that are damaged as
they are in practice.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.scenes.box_street import MIRROR, camera_poses, drive, write_drive

import carlasc
from carlasc import Run
from carlasc.core.geometry import invert
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.inspection.findings import ValidationResult
from carlasc.inspection.validation import validate
from carlasc.storage import FolderSource, layout

COARSE = GridSpec.published()
KITTI = GridSpec("cartesian", (128, 128, 16), (0.0, -25.6, -2.0), (51.2, 25.6, 4.4))


@pytest.fixture(scope="session")
def turning(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve frames round a bend, with labels and coarse grids: a sequence folder that holds
    cartesian/.
    """
    return _drive(tmp_path_factory, drive(12, turn_rad=0.05), spec=COARSE)


@pytest.fixture(scope="session")
def turning_kitti(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same in KITTI's right-handed frame, a grid ahead of the car every fourth frame."""
    return _drive(
        tmp_path_factory, drive(12, turn_rad=0.05), spec=KITTI, frame="kitti", grid_every=4
    )


def _drive(factory: pytest.TempPathFactory, poses: np.ndarray, **options: object) -> Path:
    folder = factory.mktemp("drive")
    write_drive(folder / "cartesian", poses, **options)  # type: ignore[arg-type]
    return folder


@pytest.fixture
def copy(turning: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(turning / "cartesian", tmp_path / "cartesian"))


@pytest.fixture
def copy_kitti(turning_kitti: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(turning_kitti / "cartesian", tmp_path / "cartesian"))


def found(result: ValidationResult, severity: str = "error") -> dict[str, str]:
    """The text of the findings of a severity, by check."""
    return {
        f.check: "\n".join(map(str, g))
        for (s, _), g in result.grouped().items()
        if s == severity
        for f in g
    }


def change_poses(folder: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    path = folder / layout.POSES
    path.write_bytes(layout.encode_poses(change(layout.decode_poses(path.read_bytes(), ""))))


def change_files(
    folder: Path, dtype: str, change: Callable[[np.ndarray], np.ndarray], suffix: str = ".bin"
) -> None:
    for path in folder.glob(f"*{suffix}"):
        path.write_bytes(change(np.frombuffer(path.read_bytes(), dtype)).tobytes())


def transpose_rotations(poses: np.ndarray) -> np.ndarray:
    changed = poses.copy()
    changed[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    return changed


# Sound data: no error, no warning.


def test_the_golden_sequence_is_sound(golden_capture: Path) -> None:
    result = validate(golden_capture / "cartesian")
    assert (result.ok, result.findings) == (True, ())
    assert result.sequences[0].voxel_share["evaluation"] > 0.9
    assert result.sequences[0].pose_share > 0.7


@pytest.mark.parametrize("grid", ["cylindrical", "cartesian_fine", "cartesian_step0.5"])
def test_a_sequence_of_grids_alone_is_sound(golden_capture: Path, grid: str) -> None:
    assert found(validate(golden_capture / grid)) == {}
    assert found(validate(golden_capture / grid), "warning") == {}


@pytest.mark.slow
@pytest.mark.parametrize("fixture", ["turning", "turning_kitti"])
def test_a_drive_round_a_bend_is_sound_in_both_frames(
    fixture: str, request: pytest.FixtureRequest
) -> None:
    result = validate(request.getfixturevalue(fixture))
    assert (found(result), found(result, "warning")) == ({}, {})
    assert result.sequences[0].voxel_share["evaluation"] > 0.9


@pytest.mark.parametrize(
    "poses",
    [
        pytest.param(drive(10), id="straight"),
        pytest.param(drive(10, speed_m=0.0), id="standing"),
        pytest.param(drive(10, speed_m=0.02), id="creeping"),
        pytest.param(drive(10, speed_m=-0.5, turn_rad=0.03), id="backwards"),
        pytest.param(
            np.concatenate([np.repeat(drive(1), 5, axis=0), drive(8, turn_rad=0.04)]), id="starting"
        ),
        pytest.param(drive(2), id="two frames"),
        pytest.param(drive(1), id="one frame"),
    ],
)
@pytest.mark.parametrize(
    ("frame", "labelled"), [("carlasc", True), ("kitti", True), ("kitti", False)]
)
def test_scans_alone_raise_no_false_alarm(
    tmp_path: Path, poses: np.ndarray, labelled: bool, frame: str
) -> None:
    write_drive(tmp_path / "cartesian", poses, frame=frame, labelled=labelled, seed=3)
    result = validate(tmp_path)
    assert [finding.check for finding in result.findings] == ["no-grids"]
    assert result.verdict == "sound"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fine", "cylindrical"])
@pytest.mark.parametrize("labelled", [True, False])
def test_other_grids_raise_no_false_alarm(tmp_path: Path, name: str, labelled: bool) -> None:
    spec = GridSpec.published(name)
    write_drive(
        tmp_path / spec.coordinates, drive(4, turn_rad=0.05), spec=spec, labelled=labelled, seed=5
    )
    assert validate(tmp_path).findings == ()


def test_a_prediction_beside_the_data_is_judged_by_its_own_classes_and_not_as_truth(
    copy: Path,
) -> None:
    shutil.copytree(copy / "evaluation", copy / "completion")
    for path in (copy / "completion").glob("*.bin"):
        path.unlink()
    params = json.loads((copy / "evaluation/params.json").read_text())
    record = {"classes": "carlasc11", "network": "lmscnet_ss"}
    (copy / "completion/params.json").write_text(
        json.dumps(params | {"num_channels": 11, "carlasc": record})
    )
    for path in (copy / "completion").glob("*.label"):
        path.write_bytes(
            np.where(np.fromfile(path, np.uint32) > 0, 9, 0).astype(np.uint32).tobytes()
        )
    assert not validate(copy).findings
    path.write_bytes(np.full(128 * 128 * 8, 11, np.uint32).tobytes())
    assert "class ids of carlasc11" in found(validate(copy, every=1))["class-ids"]


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["zarr", "h5"])
def test_a_packed_store_is_as_sound_as_what_it_was_packed_from(
    turning: Path, tmp_path: Path, ending: str
) -> None:
    """Stores keep labels as uint8: all checks hold there too."""
    store = tmp_path / f"drive.{ending}"
    carlasc.pack(turning, store)
    assert validate(store).findings == validate(turning).findings


def test_a_zip_is_validated_in_place(turning: Path, tmp_path: Path) -> None:
    path = shutil.make_archive(str(tmp_path / "drive"), "zip", turning)
    result = validate(path)
    assert (result.findings, len(result.sequences)) == ((), 1)


# Geometry: one fault, named.


def test_mirrored_points_are_told_from_the_grid_and_from_the_poses(copy: Path) -> None:
    change_files(copy / "velodyne", "<f4", lambda a: a.reshape(-1, 4) * np.float32([1, -1, 1, 1]))
    errors = found(validate(copy))
    assert "the likely cause is points with y mirrored" in errors["scan-in-voxels"]
    assert "y mirrored against the scans" in errors["poses-on-scans"]


def test_mirrored_points_are_told_in_a_converted_sequence(copy_kitti: Path) -> None:
    change_files(
        copy_kitti / "velodyne", "<f4", lambda a: a.reshape(-1, 4) * np.float32([1, -1, 1, 1])
    )
    errors = found(validate(copy_kitti))
    assert "the likely cause is points with y mirrored" in errors["scan-in-voxels"]
    assert "y mirrored against the scans" in errors["poses-on-scans"]


FAULTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "poses with y mirrored": lambda p: MIRROR @ p @ MIRROR,
    "transposed rotations": transpose_rotations,
    "inverted transforms": invert,
}


@pytest.mark.parametrize("fixture", ["copy", "copy_kitti"])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_poses_is_named_and_nothing_else_is(
    fault: str, fixture: str, request: pytest.FixtureRequest
) -> None:
    folder = request.getfixturevalue(fixture)
    change_poses(folder, FAULTS[fault])
    errors = found(validate(folder))
    assert list(errors) == ["poses-on-scans"]
    assert f"likely cause is {fault}" in errors["poses-on-scans"]


def test_camera_frame_poses_of_a_converted_sequence_are_named_with_the_remedy(
    copy_kitti: Path,
) -> None:
    change_poses(copy_kitti, camera_poses)
    errors = found(validate(copy_kitti))
    assert (
        "likely cause is camera-frame poses (x right, y down, z forward)"
        in errors["poses-on-scans"]
    )
    assert "inv(Tr) @ P @ Tr" in errors["poses-on-scans"]


@pytest.mark.parametrize("mirrored", [True, False])
def test_camera_frame_poses_are_named_in_a_mirrored_sequence_too(
    copy: Path, mirrored: bool
) -> None:
    # the converter mirrored the scans, and took the camera's poses as they were, or mirrored them
    # too
    def change(poses: np.ndarray) -> np.ndarray:
        camera = camera_poses(MIRROR @ poses @ MIRROR)
        return MIRROR @ camera @ MIRROR if mirrored else camera

    change_poses(copy, change)
    assert "camera-frame poses" in found(validate(copy))["poses-on-scans"]


def test_camera_frame_poses_show_on_a_straight_drive_where_a_mirrored_y_cannot(
    tmp_path: Path,
) -> None:
    folder = write_drive(tmp_path / "cartesian", drive(12), frame="kitti", seed=3)
    change_poses(folder, lambda p: MIRROR @ p @ MIRROR)
    assert validate(folder).ok
    change_poses(folder, lambda p: camera_poses(MIRROR @ p @ MIRROR))
    assert "camera-frame poses" in found(validate(folder))["poses-on-scans"]


def test_poses_that_stand_while_the_sensor_moves_are_told_with_the_offset(copy: Path) -> None:
    change_poses(copy, lambda p: np.tile(np.eye(4), (len(p), 1, 1)))
    assert "m away from their poses" in found(validate(copy))["poses-on-scans"]


def test_scans_that_are_in_one_common_frame_are_told(copy: Path) -> None:
    poses = layout.decode_poses((copy / layout.POSES).read_bytes(), "")
    for frame, pose in enumerate(poses):
        path = copy / "velodyne" / f"{frame:06d}.bin"
        points = np.frombuffer(path.read_bytes(), "<f4").reshape(-1, 4).copy()
        points[:, :3] = points[:, :3] @ pose[:3, :3].T + pose[:3, 3]
        path.write_bytes(points.tobytes())
    assert "scans that are all in one frame" in found(validate(copy))["poses-on-scans"]


@pytest.mark.slow
@pytest.mark.parametrize("shift", [(1, 0, 0), (0, -1, 0), (-1, 1, 0), (0, 0, 1)])
def test_a_grid_shifted_by_a_cell_is_named_with_its_direction(
    copy: Path, shift: tuple[int, int, int]
) -> None:
    def roll(values: np.ndarray) -> np.ndarray:
        return np.roll(values.reshape(COARSE.size), shift, (0, 1, 2))

    change_files(copy / "evaluation", "<f4", roll)
    change_files(copy / "evaluation", "<u4", roll, ".label")
    errors = found(validate(copy))
    assert list(errors) == ["scan-in-voxels"]
    assert "a grid shifted by" in errors["scan-in-voxels"]
    for name, step in zip("xyz", shift, strict=True):
        assert (
            f"one cell towards {'+' if step > 0 else '-'}{name}" in errors["scan-in-voxels"]
        ) == bool(step)


def test_grids_of_other_frames_are_told_from_those_of_other_classes(copy: Path) -> None:
    def rename(labels: np.ndarray) -> np.ndarray:
        return np.where(labels == 0, 0, labels % 22 + 1).astype(np.uint32)

    change_files(copy / "evaluation", "<u4", rename, ".label")
    assert "labels of another class table" in found(validate(copy))["scan-in-voxels"]


# Files: each fault is a finding, and the rest is looked at.


def test_a_truncated_grid_is_named_with_its_size_and_the_rest_is_still_read(copy: Path) -> None:
    path = copy / "evaluation" / "000003.label"
    path.write_bytes(path.read_bytes()[:-4])
    result = validate(copy)
    errors = found(result)
    assert list(errors) == ["file-size"]
    assert "000003.label: expected 524288 bytes" in errors["file-size"]
    assert "found 524284" in errors["file-size"]
    assert result.sequences[0].voxel_share["evaluation"] > 0.9


def test_a_scan_of_odd_size_and_labels_of_another_length_are_named(copy: Path) -> None:
    scan, labels = copy / "velodyne" / "000001.bin", copy / "labels" / "000002.label"
    scan.write_bytes(scan.read_bytes()[:-3])
    labels.write_bytes(labels.read_bytes()[:-40])
    errors = found(validate(copy))
    assert "000001.bin: expected a multiple of 16 bytes" in errors["file-size"]
    assert "000002.label" in errors["point-counts"]


def test_params_of_another_size_are_found_in_every_file(copy: Path) -> None:
    path = copy / "evaluation" / "params.json"
    params = json.loads(path.read_text()) | {"grid_size": [128.0, 128.0, 16.0]}
    path.write_text(json.dumps(params))
    result = validate(copy)
    assert len(result.grouped()["error", "file-size"]) == 24


@pytest.mark.parametrize("text", ["{", "[]", '{"grid_size": [1, 2]}'])
def test_a_broken_params_file_is_one_finding_and_scans_are_still_checked(
    copy: Path, text: str
) -> None:
    (copy / "evaluation" / "params.json").write_text(text)
    change_poses(copy, transpose_rotations)
    errors = found(validate(copy))
    assert set(errors) == {"params", "poses-on-scans"}


def test_a_grid_folder_without_params_is_not_passed_over(copy: Path) -> None:
    (copy / "evaluation" / "params.json").unlink()
    assert (
        "params.json: expected the grid's geometry, found no file"
        in found(validate(copy))["params"]
    )


def test_a_label_without_votes_and_votes_that_are_no_numbers_are_counted(copy: Path) -> None:
    path = copy / "evaluation" / "000000.bin"
    counts = np.frombuffer(path.read_bytes(), "<f4").copy()
    labels = np.frombuffer((copy / "evaluation" / "000000.label").read_bytes(), "<u4")
    counts[np.flatnonzero(labels)[:7]] = 0
    counts[np.flatnonzero(labels == 0)[:2]] = [np.nan, -1]
    path.write_bytes(counts.tobytes())
    errors = found(validate(copy))
    assert "7 voxels with a label but no vote" in errors["counts"]
    assert "whole numbers of votes" in errors["counts"]


def test_unknown_classes_are_named_with_their_number(copy: Path) -> None:
    path = copy / "labels" / "000004.label"
    labels = np.frombuffer(path.read_bytes(), "<u4").copy()
    labels[:3], labels[3] = 99, 24
    path.write_bytes(labels.tobytes())
    assert "24 (1 times), 99 (3 times)" in found(validate(copy))["class-ids"]


def test_nan_points_and_impossible_flow_are_found(copy: Path) -> None:
    scan, flow = copy / "velodyne" / "000000.bin", copy / "predictions" / "000001.bin"
    points = np.frombuffer(scan.read_bytes(), "<f4").copy()
    points[17 * 4] = np.nan
    scan.write_bytes(points.tobytes())
    velocities = np.frombuffer(flow.read_bytes(), "<f4").copy()
    velocities[0] = 400
    flow.write_bytes(velocities.tobytes())
    result = validate(copy)
    assert "1 rows, first in row 17" in found(result)["not-finite"]
    assert "400 m/s" in found(result, "warning")["flow"]


def test_what_is_only_in_a_frame_between_the_samples_is_found_by_a_full_look(copy: Path) -> None:
    path = copy / "labels" / "000005.label"
    path.write_bytes((np.frombuffer(path.read_bytes(), "<u4") + 100).astype("<u4").tobytes())
    assert validate(copy, every=2).ok
    assert not validate(copy, every=1).ok


def test_missing_frames_are_a_warning_and_missing_labels_an_error(copy: Path) -> None:
    for name in ("velodyne/000006.bin", "labels/000006.label", "predictions/000006.bin"):
        (copy / name).unlink()
    (copy / "labels" / "000009.label").unlink()
    result = validate(copy)
    assert "1 gaps" not in found(result)
    assert "none for 000009" in found(result)["frame-counts"]
    # the grid of a scan that is gone
    assert "1 more: 000006" in found(result, "warning")["frame-counts"]


def test_a_gap_in_all_fields_is_a_lesser_finding(copy: Path) -> None:
    for path in copy.glob("*/00000[67].*"):
        path.unlink()
    result = validate(copy)
    assert result.ok
    assert (
        "1 gaps, 2 frames missing; the first gap is between 5 and 8"
        in found(result, "warning")["frame-gaps"]
    )


def test_grids_on_some_frames_only_are_a_note(copy: Path) -> None:
    for path in copy.glob("evaluation/00000[1-9].*"):
        path.unlink()
    result = validate(copy)
    assert result.ok
    assert (
        "evaluation/labels for each of the 12 frames of points"
        in found(result, "note")["frame-counts"]
    )


def test_counts_missing_for_a_frame_are_an_error(copy: Path) -> None:
    (copy / "evaluation" / "000002.bin").unlink()
    assert "evaluation/counts for each of the 12" in found(validate(copy))["frame-counts"]


# Poses and times.


def test_missing_poses_are_an_error_where_there_are_scans(copy: Path) -> None:
    (copy / layout.POSES).unlink()
    assert "found no file" in found(validate(copy))["poses"]


@pytest.mark.slow
def test_poses_shorter_than_the_scans_are_an_error_and_longer_ones_a_warning(copy: Path) -> None:
    lines = (copy / layout.POSES).read_text().splitlines(keepends=True)
    (copy / layout.POSES).write_text("".join(lines[:-1]))
    assert "12 lines, up to frame 11, found 11 lines" in found(validate(copy))["poses"]
    (copy / layout.POSES).write_text("".join([*lines, lines[-1]]))
    result = validate(copy)
    assert result.ok
    assert "found 13 lines" in found(result, "warning")["poses"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: p * np.array([1, 1, 1, 1])[:, None] * 1.01, "scaled"),
        (lambda p: MIRROR @ p, "reflection"),
        (lambda p: p * np.where(np.arange(len(p)) == 5, np.nan, 1)[:, None, None], "line 6.*NaN"),
    ],
)
def test_poses_that_are_not_rigid_are_named(
    copy: Path, change: Callable[[np.ndarray], np.ndarray], message: str
) -> None:
    change_poses(copy, change)
    text = found(validate(copy))["poses"]
    assert all(part in text for part in message.split(".*"))


def test_a_jump_is_named_with_its_frames(copy: Path) -> None:
    def jump(poses: np.ndarray) -> np.ndarray:
        poses[7:, :3, 3] += (3.0, 0.0, 0.0)
        return poses

    change_poses(copy, jump)
    assert "from frame 6 to 7" in found(validate(copy))["pose-jump"]


def test_a_line_that_is_no_pose_is_named(copy: Path) -> None:
    lines = (copy / layout.POSES).read_text().splitlines(keepends=True)
    (copy / layout.POSES).write_text("".join([*lines[:4], "1 2 3\n", *lines[5:]]))
    assert "12 numbers per line, found 3 in line 5" in found(validate(copy))["poses"]


@pytest.mark.slow
def test_times_that_do_not_rise_are_named(copy: Path) -> None:
    times = np.arange(12) * 0.1
    times[4] = 0.1
    (copy / layout.TIMES).write_bytes(layout.encode_times(times))
    assert "0.1 s in line 5 after 0.3 s" in found(validate(copy))["times"]


def test_missing_times_are_a_warning(copy: Path) -> None:
    (copy / layout.TIMES).unlink()
    result = validate(copy)
    assert result.ok
    assert "times" in found(result, "warning")


# The whole and its parts.


def test_a_sequence_without_anything_is_an_error_and_the_others_are_still_checked(
    turning: Path, tmp_path: Path
) -> None:
    shutil.copytree(turning / "cartesian", tmp_path / "Val" / "A" / "cartesian")
    (tmp_path / "Val" / "B" / "cartesian" / "velodyne").mkdir(parents=True)
    result = validate(tmp_path)
    assert [finding.sequence for finding in result.findings] == ["Val/B/cartesian"]
    assert "expected scans or grids, found none" in found(result)["empty"]
    assert [report.frames for report in result.sequences] == [12, 0]


@pytest.mark.slow
def test_the_level_above_a_sequence_is_understood(turning: Path, tmp_path: Path) -> None:
    (tmp_path / "Val" / "A").mkdir(parents=True)
    (tmp_path / "Val" / "A" / "cartesian").symlink_to(turning / "cartesian")
    assert [report.path for report in validate(tmp_path / "Val", every=6).sequences] == [
        "A/cartesian"
    ]


def test_a_level_too_low_and_an_empty_folder_are_told(turning: Path, tmp_path: Path) -> None:
    with pytest.raises(MissingDataError) as caught:
        validate(turning / "cartesian" / "velodyne")
    assert "give the folder above" in caught.value.advice
    with pytest.raises(MissingDataError) as caught:
        validate(tmp_path)
    assert caught.value.expected.startswith("a data set, a split, a sequence")


@pytest.mark.slow
def test_progress_reaches_its_total_and_a_source_serves_as_well_as_a_path(turning: Path) -> None:
    seen: list[tuple[int, int]] = []
    validate(
        FolderSource(turning), run=Run(1, progress=lambda done, total: seen.append((done, total)))
    )
    assert seen[-1][0] == seen[-1][1] == 12 + 12 + 1
    assert [done for done, _ in seen] == list(range(1, 26))


def test_a_senseless_stride_is_an_argument_error(turning: Path) -> None:
    with pytest.raises(ArgumentError) as caught:
        validate(turning, every=0)
    assert caught.value.where == "every"


def test_the_result_turns_into_json(copy: Path) -> None:
    (copy / layout.POSES).unlink()
    values = json.loads(json.dumps(validate(copy).to_dict()))
    assert values["ok"] is False
    assert values["counts"]["error"] == 1
    assert values["findings"][0]["check"] == "poses"


def test_a_grid_of_unknown_classes_is_one_finding_and_the_rest_is_still_checked(copy: Path) -> None:
    path = copy / "evaluation/params.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"carlasc": {"classes": "lab"}}))
    result = found(validate(copy))
    assert "params.json" in result["params"] and "found 'lab'" in result["params"]
    assert "class-ids" not in result
