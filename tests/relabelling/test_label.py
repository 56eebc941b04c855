"""A labelled data set: the source as it was, its files linked, the labels of a network, and a word
of who predicted them.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from typer.testing import CliRunner

import carlasc
from carlasc import Run
from carlasc.cli import app
from carlasc.core.tables import remap_named
from carlasc.errors import (
    ArgumentError,
    CompleteError,
    ConflictError,
    FormatError,
    MissingDataError,
    StorageError,
)
from carlasc.inspection import card, report, validate
from carlasc.storage import open as open_store
from carlasc.testing import write_dataset
from carlasc.testing.data import SCANS, WHOLE

ALONE = Run(workers=1)
SEQUENCES = (SCANS, WHOLE)
OTHER = carlasc.ClassTable("mine", {0: "free", 1: "wall"}, {0: (0, 0, 0), 1: (9, 9, 9)})


def files_of(folder):
    """Return the bytes of all files of a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and ".carlasc" not in path.parts
    }


def predict(data, folder, classes=23, seed=0):
    """Write random probabilities for the scans of a data set, and return them by (path, frame)."""
    rng, found = np.random.default_rng(seed), {}
    for path in SEQUENCES:
        sequence = open_store(data).sequences()[path]
        (folder / path).mkdir(parents=True)
        for frame in sequence.frames("points").tolist():
            shares = rng.dirichlet(
                np.full(classes, 0.3), len(sequence.read("points", frame))
            ).astype(np.float32)
            np.save(folder / path / f"{frame:06d}.npy", shares)
            found[path, frame] = shares
    return found


@pytest.fixture
def data(tmp_path):
    return write_dataset(tmp_path / "data")


@pytest.fixture
def predictions(data, tmp_path):
    return predict(data, tmp_path / "net")


def test_labels_are_those_of_the_network_and_everything_else_is_the_same_file(
    data, predictions, tmp_path
):
    before = files_of(data)
    result = carlasc.label(data, tmp_path / "out", tmp_path / "net", run=ALONE)
    assert files_of(data) == before
    source, made = open_store(data).sequences(), open_store(tmp_path / "out").sequences()
    assert list(made) == result.sequences == sorted(SEQUENCES)
    for path in SEQUENCES:
        kept = {name for name in source[path].fields() if "/" not in name} - {
            "labels",
            "probabilities",
        }
        assert made[path].fields() == kept | {"labels", "probabilities"}
        assert not made[path].grids
        for name in kept:
            for file in (data / path / made[path]._entry(name).folder).iterdir():
                assert file.samefile(tmp_path / "out" / file.relative_to(data))
        for frame in source[path].frames("points").tolist():
            wanted = predictions[path, frame]
            assert_array_equal(made[path].read("labels", frame), wanted.argmax(axis=1))
            pairs = made[path].read("probabilities", frame)
            assert_array_equal(pairs[:, 0], wanted.argmax(axis=1))
            assert np.abs(pairs[:, 1] / 65535 - wanted.max(axis=1, initial=0)).max(initial=0) < 1e-5
    assert (data / WHOLE / "poses.txt").samefile(tmp_path / "out" / WHOLE / "poses.txt")
    assert result.frames == 7 and result.linked > 20 and result.files == 14 and result.kept == 0
    assert result.classes == "carla" and result.left_out == ["evaluation/", "evaluation_8x4x3/"]
    assert not (tmp_path / "out.part").exists() and not (tmp_path / "out.part.json").exists()


def test_carlasc_json_keeps_what_it_said_and_names_who_predicted(data, predictions, tmp_path):
    carlasc.label(data, tmp_path / "out", tmp_path / "net", run=ALONE)
    carlasc.label(data, tmp_path / "named", tmp_path / "net", by="SPVCNN, 2 epochs", run=ALONE)
    found = json.loads((tmp_path / "out" / WHOLE / "carlasc.json").read_text())
    assert found == {
        "format": 2,
        "axes": "right",
        "classes": "carla",
        "sensor": "a",
        "labels": "predicted by net",
    }
    made = open_store(tmp_path / "named").sequences()
    assert {one.metadata.predicted for one in made.values()} == {"predicted by SPVCNN, 2 epochs"}


@pytest.mark.slow
@pytest.mark.parametrize("ending", [".zarr", ".h5", ".parquet"])
def test_probabilities_go_through_every_store_and_packed_sources_are_unpacked(
    data, predictions, tmp_path, ending
):
    carlasc.label(data, tmp_path / "out", tmp_path / "net", run=ALONE)
    carlasc.pack(tmp_path / "out", tmp_path / f"out{ending}", run=ALONE)
    carlasc.unpack(tmp_path / f"out{ending}", tmp_path / "again", run=ALONE)
    assert files_of(tmp_path / "again") == files_of(tmp_path / "out")
    carlasc.pack(data, tmp_path / f"data{ending}", run=ALONE)
    result = carlasc.label(
        tmp_path / f"data{ending}", tmp_path / "unpacked", tmp_path / "net", run=ALONE
    )
    assert result.linked == 0
    assert files_of(tmp_path / "unpacked") == files_of(tmp_path / "out")


def test_labels_without_probabilities_have_no_such_field(data, predictions, tmp_path):
    for path, frame in predictions:
        labels = predictions[path, frame].argmax(axis=1).astype(np.uint32)
        labels.tofile(tmp_path / "net" / path / f"{frame:06d}.label")
        (tmp_path / "net" / path / f"{frame:06d}.npy").unlink()
    carlasc.label(data, tmp_path / "out", tmp_path / "net", run=ALONE)
    made = open_store(tmp_path / "out").sequences()[WHOLE]
    assert "probabilities" not in made.fields()
    assert_array_equal(made.read("labels", 5), predictions[WHOLE, 5].argmax(axis=1))


def test_files_some_of_which_have_probabilities_are_refused(data, predictions, tmp_path):
    np.save(tmp_path / "net" / WHOLE / "000002.npy", np.zeros(777, np.uint8))
    with pytest.raises(FormatError) as error:
        carlasc.label(data, tmp_path / "out", tmp_path / "net", run=ALONE)
    assert error.value.where.endswith("000002.npy") and error.value.found == "labels only"
    assert not (tmp_path / "out").exists()


def test_labels_of_another_table_are_converted_where_that_is_known(data, tmp_path):
    ids = np.array(sorted(remap_named("semantickitti_to_carla").mapping), np.uint32)
    for path in SEQUENCES:
        (tmp_path / "net" / path).mkdir(parents=True)
        sequence = open_store(data).sequences()[path]
        for frame in sequence.frames("points").tolist():
            given = np.resize(ids, len(sequence.read("points", frame)))
            given.tofile(tmp_path / "net" / path / f"{frame:06d}.label")
    result = carlasc.label(
        data, tmp_path / "out", tmp_path / "net", classes="semantickitti", run=ALONE
    )
    made = open_store(tmp_path / "out").sequences()[WHOLE]
    assert result.classes == made.metadata.classes.name == "carla" and "boxes" in made.fields()
    wanted = remap_named("semantickitti_to_carla")(np.resize(ids, 1001))
    assert_array_equal(made.read("labels", 5), wanted)


@pytest.mark.parametrize("table", [OTHER, "own.json"])
def test_a_table_that_cannot_be_converted_becomes_that_of_the_result(data, tmp_path, table):
    predict(data, tmp_path / "net", classes=2)
    (tmp_path / "own.json").write_text(json.dumps(OTHER.to_dict()))
    given = table if table is OTHER else tmp_path / table
    result = carlasc.label(data, tmp_path / "out", tmp_path / "net", classes=given, run=ALONE)
    made = open_store(tmp_path / "out").sequences()[WHOLE]
    assert made.metadata.classes == OTHER and result.classes == "mine"
    # their classes are those of the other table
    assert "boxes" not in made.fields() and "boxes" in result.left_out
    findings = [
        one for one in validate(tmp_path / "out", run=ALONE).findings if one.check == "class-ids"
    ]
    assert not findings


def test_frames_that_a_range_leaves_out_are_copied_without_labels(data, predictions, tmp_path):
    (tmp_path / "net" / WHOLE / "000005.npy").unlink()
    with pytest.raises(MissingDataError) as error:
        carlasc.label(data, tmp_path / "out", tmp_path / "net", run=ALONE)
    assert error.value.found.startswith("none for 1 of 4 frames") and error.value.found.endswith(
        "(000005)"
    )
    carlasc.label(data, tmp_path / "out", tmp_path / "net", frames=(1, 3), run=ALONE)
    made = open_store(tmp_path / "out").sequences()[WHOLE]
    assert made.frames("labels").tolist() == [1, 2] == made.frames("probabilities").tolist()
    assert made.frames("points").tolist() == [0, 1, 2, 5]


def test_what_exists_is_not_replaced_unless_it_was_labelled_and_that_is_asked_for(
    data, predictions, tmp_path
):
    carlasc.label(data, tmp_path / "out", tmp_path / "net", run=ALONE)
    with pytest.raises(CompleteError):
        carlasc.label(data, tmp_path / "out", tmp_path / "net", run=ALONE)
    with pytest.raises(ConflictError) as error:
        carlasc.label(data, tmp_path / "out", tmp_path / "net", by="x", run=ALONE)
    assert error.value.expected == "a new path"
    carlasc.label(
        data, tmp_path / "out", tmp_path / "net", by="x", overwrite=True, frames=(0, 3), run=ALONE
    )
    made = open_store(tmp_path / "out").sequences()[WHOLE]
    assert made.metadata.predicted == "predicted by x" and made.frames("labels").tolist() == [
        0,
        1,
        2,
    ]
    assert not (tmp_path / "out.replaced").exists()
    before = shutil.copytree(data, tmp_path / "other")
    with pytest.raises(ConflictError) as error:
        carlasc.label(data, tmp_path / "other", tmp_path / "net", overwrite=True, run=ALONE)
    assert error.value.expected == "a data set with predicted labels to overwrite"
    assert files_of(before) == files_of(data)
    for place in (data, data / "inside", tmp_path):
        with pytest.raises(ConflictError):
            carlasc.label(data, place, tmp_path / "net", overwrite=True, run=ALONE)


def test_an_error_keeps_the_data_set_or_says_where_it_is(data, predictions, tmp_path, monkeypatch):
    carlasc.label(data, tmp_path / "out", tmp_path / "net", run=ALONE)
    (tmp_path / "out.part").mkdir()  # of another run, which lost its mark
    with pytest.raises(ConflictError):
        carlasc.label(data, tmp_path / "out", tmp_path / "net", overwrite=True, run=ALONE)
    assert open_store(tmp_path / "out").sequences()[WHOLE].metadata.predicted
    assert not (tmp_path / "out.replaced").exists()
    (tmp_path / "out.part").rmdir()

    def full(*_, **__):
        raise StorageError(tmp_path / "out.part", problem="the disk is full")

    monkeypatch.setattr("carlasc.storage.derived_copies.unpack", full)
    with pytest.raises(StorageError) as error:
        carlasc.label(data, tmp_path / "out", tmp_path / "net", overwrite=True, run=ALONE)
    assert error.value.advice.endswith(str(tmp_path / "out.replaced"))
    assert open_store(tmp_path / "out.replaced").sequences()[WHOLE].metadata.predicted


KILLED = """
import os, sys
from carlasc import Run, label
def progress(done, total):
    if done >= total - 5:
        os._exit(9)
label(sys.argv[1], sys.argv[2], sys.argv[3], run=Run(workers=1, progress=progress))
"""


def test_an_interrupted_run_is_continued_by_the_same_call_and_by_no_other(
    data, predictions, tmp_path
):
    out = tmp_path / "out"
    ran = subprocess.run([sys.executable, "-c", KILLED, data, out, tmp_path / "net"], check=False)
    assert ran.returncode == 9 and not out.exists() and (tmp_path / "out.part").is_dir()
    with pytest.raises(ConflictError) as error:
        carlasc.label(data, out, tmp_path / "net", by="another", run=ALONE)
    assert error.value.where.endswith("out.part") and error.value.found == "files of another run"
    changed = tmp_path / "net" / WHOLE / "000000.npy"
    times = changed.stat()
    os.utime(changed, (0, 0))
    with pytest.raises(ConflictError) as error:
        carlasc.label(data, out, tmp_path / "net", run=ALONE)
    assert error.value.where.endswith("out.part")
    os.utime(changed, ns=(times.st_atime_ns, times.st_mtime_ns))
    result = carlasc.label(data, out, tmp_path / "net", run=ALONE)
    assert result.kept > 0 and result.linked == 0
    carlasc.label(data, tmp_path / "whole", tmp_path / "net", run=ALONE)
    assert files_of(out) == files_of(tmp_path / "whole")
    assert not list(tmp_path.glob("out.part*"))


def test_several_processes_and_parts_make_the_same_files(data, predictions, tmp_path):
    carlasc.label(data, tmp_path / "alone", tmp_path / "net", run=ALONE)
    carlasc.label(data, tmp_path / "two", tmp_path / "net", run=Run(workers=2))
    for number in (1, 2):
        carlasc.label(
            data,
            tmp_path / "parts",
            tmp_path / "net",
            run=Run(1, part=carlasc.running.Part(number, 2)),
        )
    assert (
        files_of(tmp_path / "two") == files_of(tmp_path / "alone") == files_of(tmp_path / "parts")
    )


def test_files_are_copied_where_the_file_system_has_no_hard_links(data, predictions, tmp_path):
    apart = Path("/dev/shm")
    if not apart.is_dir() or apart.stat().st_dev == tmp_path.stat().st_dev:
        pytest.skip("needs two file systems")
    out = apart / f"carlasc-label-{os.getpid()}"
    try:
        result = carlasc.label(data, out, tmp_path / "net", run=ALONE)
        carlasc.label(data, tmp_path / "linked", tmp_path / "net", run=ALONE)
        assert result.linked == 0
        assert files_of(out) == files_of(tmp_path / "linked")
    finally:
        shutil.rmtree(out, ignore_errors=True)


def test_a_record_a_report_and_a_card_say_who_predicted(data, predictions, tmp_path):
    carlasc.label(data, tmp_path / "out", tmp_path / "net", by="SPVCNN", run=ALONE)
    sequence = tmp_path / "out" / WHOLE
    spec = carlasc.GridSpec(
        lower=(-4, -4, -2), upper=(4, 4, 2), size=(8, 8, 4), coordinates="cartesian"
    )
    carlasc.regrid(sequence, spec, observe=carlasc.FromScans(), name="mine", run=ALONE)
    record = open_store(sequence).sequences()[""].params("mine")["carlasc"]
    assert record["labels"] == "predicted by SPVCNN"
    made = report(tmp_path / "out", run=ALONE).reports[f"{WHOLE}/mine"]
    assert made.settings["carlasc"]["labels"] == "predicted by SPVCNN"
    shown = CliRunner().invoke(app, ["report", str(sequence)])
    assert "labels predicted by SPVCNN" in " ".join(shown.output.split())
    card(
        tmp_path / "out",
        tmp_path / "card",
        about=carlasc.CardDetails(license="cc-by-4.0"),
        pictures=False,
        draft=True,
        run=ALONE,
    )
    text = (tmp_path / "card/README.md").read_text()
    assert re.search(r"\| labels +\| predicted by SPVCNN +\|", text)
    assert "simulat" not in text


@pytest.mark.parametrize("by", ["", " ", "a\nb"])
def test_a_name_is_one_line(data, predictions, tmp_path, by):
    with pytest.raises(ArgumentError) as error:
        carlasc.label(data, tmp_path / "out", tmp_path / "net", by=by, run=ALONE)
    assert error.value.where == "by"


def test_the_command_prints_what_was_made_and_one_line_where_it_fails(data, predictions, tmp_path):
    arguments = [
        "label",
        str(data),
        "-o",
        str(tmp_path / "out"),
        "--from",
        str(tmp_path / "net"),
        "--workers",
        "1",
    ]
    done = CliRunner().invoke(app, [*arguments, "--by", "SPVCNN"])
    assert done.exit_code == 0
    assert "out: labels of 7 frames predicted by SPVCNN (carla); " in done.output
    assert (
        "note: evaluation/, evaluation_8x4x3/ left out, because of other labels or classes"
        in done.output
    )
    again = CliRunner().invoke(app, arguments)
    assert again.exit_code == 1 and "`--overwrite`" in again.output
    printed = CliRunner().invoke(app, [*arguments, "--overwrite", "--json"])
    assert json.loads(printed.output)["frames"] == 7
    np.save(tmp_path / "net" / WHOLE / "000005.npy", np.ones((1001, 23), np.float32))
    failed = CliRunner().invoke(app, [*arguments, "--overwrite"])
    assert (
        failed.exit_code == 1
        and "000005.npy" in failed.output
        and "give `--logits`" in failed.output
    )
    wrong = CliRunner().invoke(app, [*arguments, "--overwrite", "--classes", "kitti"])
    assert wrong.exit_code == 2 and "--classes: expected one of carla" in wrong.output
