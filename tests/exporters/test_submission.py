"""Folders of predictions, checked and packed as SemanticKITTI's benchmark takes them."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from carlasc.cli import app
from carlasc.converting import export
from carlasc.errors import ArgumentError, FormatError, MissingDataError

VOXELS, POINTS = 64, 5
FIRST = "sequences/11/predictions/000000.label"


@pytest.fixture(params=["completion", "segmentation"])
def case(request, tmp_path):
    """Return the task, the benchmark's data with two inputs in each test sequence, and a right
    folder of predictions.
    """
    task, kind = request.param, "<u2" if request.param == "completion" else "<u4"
    for number in range(11, 22):
        inputs = (
            tmp_path
            / f"data/sequences/{number}"
            / ("voxels" if task == "completion" else "velodyne")
        )
        predictions = tmp_path / f"out/sequences/{number}/predictions"
        inputs.mkdir(parents=True)
        predictions.mkdir(parents=True)
        for frame in (0, 5):
            size = VOXELS // 8 if task == "completion" else POINTS * 16
            (inputs / f"{frame:06d}.bin").write_bytes(bytes(size))
            labels = np.full(VOXELS if task == "completion" else POINTS, 40, kind)
            labels[1] = 10 if task == "completion" else 10 | 7 << 16  # a car, which is the actor 7
            (predictions / f"{frame:06d}.label").write_bytes(labels.tobytes())
    return task, tmp_path / "data", tmp_path / "out"


def check(case, **options):
    task, data, out = case
    return export("kitti", data, out, options={"check": task, **options})


def test_a_right_folder_passes_and_is_packed_whole(case, tmp_path):
    (case[2] / "carlasc-export.json").write_text("{}")
    (case[2] / "description.txt").write_text("a network")
    before = sorted(case[2].rglob("*"))
    result = check(case, zip=str(tmp_path / "new" / "ours.zip"))
    assert (result.made, result.skipped, result.failures) == (0, 22, ())
    assert sorted(case[2].rglob("*")) == before
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["ours.zip"]
    with zipfile.ZipFile(tmp_path / "new" / "ours.zip") as archive:
        names = archive.namelist()
        assert archive.read(FIRST) == (case[2] / FIRST).read_bytes()
    files = [
        f"sequences/{n}/predictions/{frame:06d}.label" for n in range(11, 22) for frame in (0, 5)
    ]
    folders = [
        "sequences/",
        *(f"sequences/{n}/{part}" for n in range(11, 22) for part in ("", "predictions/")),
    ]
    assert sorted(names) == sorted([*files, *folders, "description.txt"])


def test_a_missing_file_and_a_missing_folder_are_named(case, tmp_path):
    (case[2] / "sequences/14/predictions/000005.label").unlink()
    expected = "14/predictions: expected 2 files of predictions, found 1, without 000005.label"
    with pytest.raises(MissingDataError, match=expected):
        check(case, zip=str(tmp_path / "ours.zip"))
    assert not (tmp_path / "ours.zip").exists()
    (case[2] / "sequences/14/predictions").rename(case[2] / "sequences/14/labels")
    with pytest.raises(
        MissingDataError, match="expected a prediction for each of 2 inputs, found none"
    ):
        check(case)


def test_a_file_of_another_size_is_named(case):
    path = case[2] / FIRST
    path.write_bytes(path.read_bytes()[:-2])
    expected = "128 bytes: 64 voxels, 2" if case[0] == "completion" else "20 bytes: 5 points, 4"
    with pytest.raises(
        FormatError, match=f"{FIRST}: expected {expected} bytes each, found (126|18) bytes"
    ):
        check(case)


@pytest.mark.parametrize("bad", [52, 300])
def test_an_id_that_the_evaluator_does_not_take_is_named(case, bad):
    path = case[2] / FIRST
    labels = np.frombuffer(path.read_bytes(), "<u2" if case[0] == "completion" else "<u4").copy()
    labels[:2] = bad
    path.write_bytes(labels.tobytes())
    # other-structure: the evaluator of points maps it to unlabeled
    if case[0] == "segmentation" and bad == 52:
        assert check(case).skipped == 22
        return
    with pytest.raises(
        FormatError, match=rf"{FIRST}: expected class ids .*, found {bad} \(2 times\)"
    ):
        check(case)


def test_files_that_are_not_needed_are_an_error_in_completion_and_are_not_packed(case, tmp_path):
    more = case[2] / "sequences/11/predictions/000001.label"
    more.write_bytes((case[2] / FIRST).read_bytes())
    if case[0] == "segmentation":
        check(case, zip=str(tmp_path / "ours.zip"))
        assert (
            "sequences/11/predictions/000001.label"
            not in zipfile.ZipFile(tmp_path / "ours.zip").namelist()
        )
        return
    with pytest.raises(
        FormatError, match="expected no more than 2 files, found 1 more: 000001.label"
    ):
        check(case)
    more.unlink()
    (case[2] / "sequences/08").mkdir()
    with pytest.raises(FormatError, match="expected the sequences 11 to 21, found also 08"):
        check(case)


def test_data_without_the_test_sequences_are_named(case):
    with pytest.raises(MissingDataError, match="expected the inputs of a test sequence"):
        export("kitti", case[1] / "sequences", case[2], options={"check": case[0]})


def test_the_zip_is_checked_before_anything_is_read(tmp_path):
    with pytest.raises(
        ArgumentError, match="zip: expected a name that ends in .zip, found 'ours.tar'"
    ):
        export("kitti", tmp_path, tmp_path, options={"check": "completion", "zip": "ours.tar"})
    with pytest.raises(ArgumentError, match="zip: expected `check` too"):
        export("kitti", tmp_path, tmp_path, options={"zip": "ours.zip"})


def test_the_command_says_it_in_one_line(case):
    task, data, out = case
    given = ["export", "kitti", str(data), str(out), "--check", task]
    result = CliRunner().invoke(app, given)
    assert result.exit_code == 0, result.output
    assert f"benchmark for {task}: 22 files" in " ".join(result.output.split())
    Path(out / FIRST).write_bytes(b"")
    result = CliRunner().invoke(app, given)
    assert result.exit_code != 0
