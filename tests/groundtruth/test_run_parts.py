"""A run in parts: each makes its own frames, whatever order they run in, and the last one writes
the report.
"""

import json
import subprocess
import sys
from itertools import permutations

import pytest
from helpers.datasets.captures import read_tree, write_capture

from carlasc import Run
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, ConflictError
from carlasc.groundtruth import FromScans, Voting, regrid
from carlasc.motion import PoseOptions
from carlasc.running import Part

SPEC = GridSpec.published().with_size((16, 16, 4))
FRAMES = 7


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A folder with two captures, and what one process makes of them."""
    root = tmp_path_factory.mktemp("parts")
    for name in ("A", "B"):
        write_capture(root / "source" / name, frames=FRAMES, points=200)
    result = regrid(root / "source", SPEC, root / "whole", run=Run(workers=1))
    assert result.made == 2 * FRAMES
    return root / "source", read_tree(root / "whole")


@pytest.mark.parametrize("order", [(1, 2, 3), (3, 1, 2), (2, 3, 1)])
def test_parts_in_any_order_make_what_one_run_makes(source, tmp_path, order):
    folder, whole = source
    for number in order[:-1]:
        regrid(folder, SPEC, tmp_path, run=Run(part=Part(number, 3), workers=1))
    assert set(whole) - set(read_tree(tmp_path))  # something is missing until the last part
    result = regrid(folder, SPEC, tmp_path, run=Run(part=Part(order[-1], 3), workers=1))
    assert result.made > 0
    assert read_tree(tmp_path) == whole


def test_frames_are_dealt_out_evenly_whatever_exists_already(source, tmp_path):
    made = [
        regrid(source[0], SPEC, tmp_path / "a", run=Run(part=Part(n, 4), workers=1)).made
        for n in range(1, 5)
    ]
    assert made == [3, 4, 3, 4]
    assert regrid(source[0], SPEC, tmp_path / "a", run=Run(part=Part(2, 4), workers=1)).made == 0
    (tmp_path / "a/A/cartesian/evaluation_16x16x4/000005.label").unlink()
    made = [
        regrid(source[0], SPEC, tmp_path / "a", run=Run(part=Part(n, 4), workers=1)).made
        for n in (1, 3, 4, 2)
    ]
    assert made == [0, 0, 0, 1]


def test_more_parts_than_frames_leave_some_without_work(source, tmp_path):
    results = [
        regrid(source[0], SPEC, tmp_path, run=Run(part=Part(n, 20), workers=1))
        for n in range(1, 21)
    ]
    assert sorted({result.made for result in results}) == [0, 1]
    assert read_tree(tmp_path) == source[1]


def test_the_report_waits_for_a_frame_that_failed(tmp_path):
    broken = tmp_path / "source"
    write_capture(broken, frames=3, points=200)
    labels = broken / "raw/labels0/102.npy"
    good = labels.read_bytes()
    labels.write_bytes(good[:-4])
    assert (
        len(regrid(broken, SPEC, tmp_path / "out", run=Run(part=Part(2, 2), workers=1)).failures)
        == 1
    )
    assert not regrid(broken, SPEC, tmp_path / "out", run=Run(part=Part(1, 2), workers=1)).failures
    report = tmp_path / "out/cartesian/evaluation_16x16x4/carlasc-report.json"
    assert not report.exists()
    labels.write_bytes(good)
    assert regrid(broken, SPEC, tmp_path / "out", run=Run(part=Part(2, 2), workers=1)).made == 1
    assert json.loads(report.read_bytes())["frames"] == [[0, 3]]


@pytest.mark.slow
def test_scans_are_merged_over_the_borders_of_parts(source, tmp_path):
    regrid(source[0], SPEC, tmp_path / "scans", run=Run(workers=1))
    options = {
        "observe": FromScans(window=(-2, 2), poses=PoseOptions(force=True)),
        "name": "merged",
    }
    for out in ("one", "parts"):
        for number in (1,) if out == "one" else (2, 1):
            part = Part(number, 1 if out == "one" else 2)
            regrid(
                tmp_path / "scans", SPEC, tmp_path / out, run=Run(part=part, workers=1), **options
            )
    assert read_tree(tmp_path / "one") == read_tree(tmp_path / "parts")


@pytest.mark.parametrize("same", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_commands_that_start_at_once_lose_nothing(source, tmp_path, same):
    """Four processes: the four parts of a run, or four times the whole run."""
    parts = [[] if same else ["--part", f"{n}/4"] for n in range(1, 5)]
    options = ["--size", "16,16,4", "--workers", "1", "-o", str(tmp_path)]
    command = [
        sys.executable,
        "-c",
        "from carlasc.cli import main; main()",
        "regrid",
        str(source[0]),
        *options,
    ]
    running = [
        subprocess.Popen([*command, *part], stderr=subprocess.PIPE, text=True) for part in parts
    ]
    said = [process.communicate(timeout=120)[1] for process in running]
    assert [process.returncode for process in running] == [0, 0, 0, 0], said
    assert read_tree(tmp_path) == source[1]


def test_a_run_with_other_settings_that_was_a_little_faster_is_found(source, tmp_path, monkeypatch):
    from carlasc.groundtruth import run

    begin = run._begin

    def slowly(job):
        monkeypatch.setattr(run, "_begin", begin)
        regrid(
            source[0] / "A",
            SPEC,
            tmp_path,
            voting=Voting(free_step_m=0.7),
            name="g",
            run=Run(workers=1),
        )
        begin(job)

    monkeypatch.setattr(run, "_begin", slowly)
    with pytest.raises(ConflictError, match="free_step_m"):
        regrid(source[0] / "A", SPEC, tmp_path, name="g", run=Run(workers=1))


def test_parts_do_not_replace_a_grid(source, tmp_path):
    with pytest.raises(ArgumentError, match="remove the existing output first"):
        regrid(source[0], SPEC, tmp_path, run=Run(part=Part(1, 2)), overwrite=True)
    assert not list(tmp_path.iterdir())


def test_every_order_of_four_parts_ends_with_a_report(tmp_path):
    write_capture(tmp_path, frames=4, points=50)
    for order in list(permutations(range(1, 5)))[::5]:
        out = tmp_path / "".join(map(str, order))
        for number in order:
            assert not (out / "cartesian/evaluation_16x16x4/carlasc-report.json").exists()
            regrid(tmp_path / "raw", SPEC, out, run=Run(part=Part(number, 4), workers=1))
        assert (out / "cartesian/evaluation_16x16x4/carlasc-report.json").exists()
