"""Grids that are written to a packed store: the same as in a folder, whoever writes them."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from helpers.datasets.captures import read_tree, write_capture

import carlasc
from carlasc import Run
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, ConflictError, FormatError, MissingDataError, StorageError
from carlasc.groundtruth import FromScans, Voting, regrid
from carlasc.motion import PoseOptions
from carlasc.running import Part

pytest.importorskip("numcodecs")

SPEC = GridSpec.published().with_size((16, 16, 4))
FRAMES = 36  # three blocks of 16, the last one short


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A capture, and the files and the store that one process makes of it."""
    root = tmp_path_factory.mktemp("stores")
    write_capture(root / "source", frames=FRAMES, points=100)
    regrid(root / "source", SPEC, root / "files", run=Run(workers=1))
    regrid(root / "source", SPEC, root / "one.zarr", run=Run(workers=1))
    return root / "source", read_tree(root / "files"), read_tree(root / "one.zarr")


def test_a_store_unpacks_to_the_files_of_a_folder(source, tmp_path):
    regrid(source[0], SPEC, tmp_path / "x.zarr", run=Run(workers=1))
    carlasc.unpack(tmp_path / "x.zarr", tmp_path / "x", run=Run(workers=1))
    assert read_tree(tmp_path / "x") == source[1]


@pytest.mark.slow
def test_two_processes_and_any_order_of_parts_make_the_same_store(source, tmp_path):
    regrid(source[0], SPEC, tmp_path / "two.zarr", run=Run(workers=2))
    assert read_tree(tmp_path / "two.zarr") == source[2]
    for number in (3, 1, 4, 2):
        regrid(source[0], SPEC, tmp_path / "parts.zarr", run=Run(part=Part(number, 4), workers=1))
        if number == 3:
            with pytest.raises(FormatError, match="`carlasc finish`"):
                carlasc.open(tmp_path / "parts.zarr")
    assert read_tree(tmp_path / "parts.zarr") == source[2]


def test_a_run_on_a_finished_store_finds_that_everything_exists(source, tmp_path):
    regrid(source[0], SPEC, tmp_path / "x.zarr", run=Run(workers=1))
    again = regrid(source[0], SPEC, tmp_path / "x.zarr", run=Run(workers=1))
    assert (again.made, again.skipped) == (0, FRAMES)
    assert read_tree(tmp_path / "x.zarr") == source[2]
    with pytest.raises(ConflictError, match="free_step_m"):
        regrid(
            source[0], SPEC, tmp_path / "x.zarr", voting=Voting(free_step_m=0.5), run=Run(workers=1)
        )


@pytest.mark.slow
def test_a_grid_is_added_to_a_store_that_can_be_read_meanwhile(source, tmp_path):
    regrid(source[0], SPEC, tmp_path / "x.zarr", run=Run(workers=1))
    before = carlasc.open(tmp_path / "x.zarr").sequences()["cartesian"]
    observe = FromScans(window=(0, 0), poses=PoseOptions(force=True))
    regrid(
        tmp_path / "x.zarr",
        SPEC,
        tmp_path / "x.zarr",
        observe=observe,
        name="own",
        run=Run(workers=1),
    )
    assert before.grid("evaluation_16x16x4", 3).labels.shape == (16, 16, 4)
    after = carlasc.open(tmp_path / "x.zarr").sequences()["cartesian"]
    assert {"own/labels", "evaluation_16x16x4/labels"} <= after.fields()
    assert len(after.frames("own/labels")) == FRAMES


def test_what_was_read_before_a_store_grew_is_read_again(tmp_path):
    """Frames are added to a block whose index is known already."""
    write_capture(tmp_path / "source", frames=20, points=100)
    damaged = tmp_path / "source/raw/labels0/103.npy"
    good = damaged.read_bytes()
    damaged.write_bytes(good[:-4])
    regrid(tmp_path / "source", SPEC, tmp_path / "x.zarr", run=Run(workers=1))
    sequence = carlasc.open(tmp_path / "x.zarr").sequences()["cartesian"]
    before = [sequence.read("points", frame).copy() for frame in (2, 9)]
    damaged.write_bytes(good)
    regrid(tmp_path / "source", SPEC, tmp_path / "x.zarr", run=Run(workers=1))
    for one, other in zip(before, sequence.read_many("points", [2, 9]), strict=True):
        assert np.array_equal(one, other)
    assert len(sequence.read("points", 3)) == 100


def test_frames_that_fail_are_left_out_and_added_when_they_are_corrected(tmp_path):
    write_capture(tmp_path / "source", frames=20, points=100)
    damaged = tmp_path / "source/raw/labels0/105.npy"
    good = damaged.read_bytes()
    damaged.write_bytes(good[:-4])
    result = regrid(tmp_path / "source", SPEC, tmp_path / "x.zarr", run=Run(workers=1))
    assert [failure.frame for failure in result.failures] == [105]
    grid = "evaluation_16x16x4/labels"
    assert len(carlasc.open(tmp_path / "x.zarr").sequences()["cartesian"].frames(grid)) == 19
    damaged.write_bytes(good)
    assert regrid(tmp_path / "source", SPEC, tmp_path / "x.zarr", run=Run(workers=1)).made == 1
    regrid(tmp_path / "source", SPEC, tmp_path / "files", run=Run(workers=1))
    carlasc.unpack(tmp_path / "x.zarr", tmp_path / "x", run=Run(workers=1))
    assert read_tree(tmp_path / "x") == read_tree(tmp_path / "files")


def _command(source, out, *options):
    arguments = [
        "regrid",
        str(source),
        "-o",
        str(out),
        "--size",
        "16,16,4",
        "--workers",
        "1",
        *options,
    ]
    return [sys.executable, "-c", "from carlasc.cli import main; main()", *arguments]


@pytest.mark.slow
@pytest.mark.parametrize("same", [True, False])
def test_commands_that_start_at_once_lose_nothing(source, tmp_path, same):
    out = tmp_path / "x.zarr"
    parts = [[] if same else ["--part", f"{n}/3"] for n in range(1, 4)]
    running = [
        subprocess.Popen(_command(source[0], out, *p), stderr=subprocess.PIPE, text=True)
        for p in parts
    ]
    said = [process.communicate(timeout=120)[1] for process in running]
    assert [process.returncode for process in running] == [0, 0, 0], said
    assert read_tree(out) == source[2]


@pytest.mark.slow
@pytest.mark.parametrize("delay_s", [0.0, 0.05, 0.1, 0.2, 0.4])
def test_a_command_that_is_killed_is_finished_by_the_next_one(source, tmp_path, delay_s):
    out = tmp_path / "x.zarr"
    with subprocess.Popen(_command(source[0], out), stderr=subprocess.DEVNULL) as process:
        for _ in range(600):
            if out.exists():
                break
            time.sleep(0.05)
        time.sleep(delay_s)
        os.kill(process.pid, signal.SIGKILL)
    regrid(source[0], SPEC, out, run=Run(workers=1))
    assert read_tree(out) == source[2]


def test_the_clocks_of_machines_do_not_matter(source, tmp_path):
    """Files of another machine may be from tomorrow, or from 1970."""
    out = tmp_path / "x.zarr"
    regrid(source[0], SPEC, out, run=Run(part=Part(2, 3), workers=1))
    for number, path in enumerate(sorted(path for path in out.rglob("*") if path.is_file())):
        moment = time.time() + 86_400 if number % 2 else 0
        os.utime(path, (moment, moment))
    for number in (1, 3):
        regrid(source[0], SPEC, out, run=Run(part=Part(number, 3), workers=1))
    assert read_tree(out) == source[2]


def test_a_disk_that_is_full_ends_the_command_and_the_next_one_finishes(
    source, tmp_path, monkeypatch
):
    from carlasc.storage.transport import trees

    write, left = trees.write_atomic, [6]

    def full(path, content, **options):
        left[0] -= 1
        if left[0] < 0:
            raise StorageError(path, problem="cannot be written: No space left on device")
        return write(path, content, **options)

    monkeypatch.setattr(trees, "write_atomic", full)
    with pytest.raises(StorageError, match="No space left"):
        regrid(source[0], SPEC, tmp_path / "x.zarr", run=Run(workers=1))
    monkeypatch.setattr(trees, "write_atomic", write)
    regrid(source[0], SPEC, tmp_path / "x.zarr", run=Run(workers=1))
    assert read_tree(tmp_path / "x.zarr") == source[2]


@pytest.mark.needs("h5py", "hdf5plugin", "pyarrow")
@pytest.mark.parametrize("kind", ["h5", "parquet"])
@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_stores_of_one_writer_take_what_workers_make(source, tmp_path, kind, workers):
    result = regrid(source[0], SPEC, tmp_path / f"x.{kind}", run=Run(workers=workers))
    assert result.grids == (f"{tmp_path}/x.{kind}/cartesian/evaluation_16x16x4",)
    carlasc.unpack(tmp_path / f"x.{kind}", tmp_path / "x", run=Run(workers=1))
    assert read_tree(tmp_path / "x") == source[1]


@pytest.mark.parametrize("kind", ["h5", "parquet"])
def test_stores_of_one_writer_refuse_parts(source, tmp_path, kind):
    with pytest.raises(ArgumentError) as error:
        regrid(source[0], SPEC, tmp_path / f"x.{kind}", run=Run(part=Part(1, 2)))
    assert error.value.where == "part"
    assert not list(tmp_path.iterdir())


def test_a_run_that_cannot_begin_leaves_no_store(tmp_path):
    with pytest.raises(MissingDataError):
        regrid(tmp_path / "nothing", SPEC, tmp_path / "x.zarr", run=Run(workers=1))
    assert not list(tmp_path.iterdir())


def test_memory_is_of_one_process(source, tmp_path):
    for place in ("memory://run/x.zarr", "memory://run/folder"):
        with pytest.raises(ArgumentError) as error:
            regrid(source[0], SPEC, place, run=Run(workers=2))
        assert error.value.where == "workers"
        regrid(source[0], SPEC, place, run=Run(workers=1))
    carlasc.unpack("memory://run/x.zarr", tmp_path / "x", run=Run(workers=1))
    assert read_tree(tmp_path / "x") == source[1]
    with pytest.raises(ArgumentError) as error:
        carlasc.pack("memory://run/folder", tmp_path / "x.zarr", run=Run(workers=2))
    assert error.value.where == "workers"


def test_a_store_without_its_last_part_is_finished_by_hand(source, tmp_path):
    from typer.testing import CliRunner

    from carlasc.cli import app

    out = tmp_path / "x.zarr"
    regrid(source[0], SPEC, out, run=Run(part=Part(1, 3), workers=1))
    ran = CliRunner().invoke(app, ["finish", str(out)])
    assert ran.exit_code == 1
    assert ran.stderr.startswith(
        f"carlasc: {out}: expected all frames that the run announced, found 20 of "
    )
    assert ran.stderr.count("\n") == 1 and "give `--incomplete`" in ran.stderr
    ran = CliRunner().invoke(app, ["finish", str(out), "--incomplete", "--json"])
    assert ran.exit_code == 0
    assert json.loads(ran.stdout)["sequences"]["cartesian"]["points"] == 16
    assert len(carlasc.open(out).sequences()["cartesian"].frames("points")) == 16
    ran = CliRunner().invoke(app, ["finish", str(tmp_path)])
    assert ran.exit_code == 1 and "expected a zarr store" in ran.stderr
