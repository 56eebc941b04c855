"""`carlasc info`, `stats` and `validate`: what they print, and the exit codes that scripts rely on."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from carlasc.cli import app
from carlasc.storage import layout


def run(*arguments: object) -> Any:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture
def sequence(golden_capture: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(golden_capture / "cartesian", tmp_path / "cartesian"))


def test_validate_of_sound_data_exits_0_and_says_so(sequence: Path) -> None:
    result = run("validate", sequence)
    assert result.exit_code == 0, result.output
    assert "sound (0 errors, 0 warnings, 0 notes)" in result.output
    assert "of points in voxels of their class (evaluation)" in result.output
    assert "tested and right: occupied, range, ground, poses-on-scans" in result.output


def test_validate_of_broken_data_groups_what_it_found_and_exits_1(sequence: Path) -> None:
    for path in (sequence / "labels").iterdir():
        path.write_bytes(path.read_bytes()[:-4])
    (sequence / layout.TIMES).unlink()
    result = run("validate", sequence)
    assert result.exit_code == 1
    assert "error: point-counts (3)" in result.output
    assert "warning: times (1)" in result.output
    assert "not sound (3 errors, 1 warning," in result.output


def test_validate_prints_a_few_of_a_kind_and_all_on_request(sequence: Path) -> None:
    path = sequence / "evaluation" / "params.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"grid_size": [64.0, 64.0, 8.0]}))
    assert "... and 3 more (--all prints them)" in run("validate", sequence).output
    assert "more (--all" not in run("validate", sequence, "--all").output


def test_a_warning_of_the_record_exits_1_until_it_is_accepted(sequence: Path) -> None:
    path = sequence / layout.METADATA
    entry = {"check": "mount", "verdict": "warning", "message": "tilted"}
    known = json.loads(path.read_text()) if path.exists() else {}
    path.write_text(json.dumps(known | {"findings": [entry]}))
    assert run("validate", sequence).exit_code == 1
    assert "accepted: mount" in run("validate", sequence, "--accept", "mount").output
    result = run("validate", sequence, "--json", "--full")
    assert (result.exit_code, json.loads(result.stdout)["verdict"]) == (0, "sound")
    assert run("validate", sequence, "--accept", "grund").exit_code == 2


def test_validate_prints_json_with_its_exit_code(sequence: Path) -> None:
    (sequence / layout.POSES).unlink()
    result = run("validate", sequence, "--json", "--full")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["findings"][0]["check"] == "poses"


@pytest.mark.parametrize("arguments", [("--every", "0"), ("--every", "2", "--full")])
def test_validate_of_senseless_strides_exits_2(sequence: Path, arguments: tuple[str, ...]) -> None:
    assert run("validate", sequence, *arguments).exit_code == 2


@pytest.mark.parametrize("command", ["validate", "stats", "info"])
def test_a_place_without_data_is_one_line_and_exit_1(command: str, tmp_path: Path) -> None:
    result = run(command, tmp_path)
    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1
    assert str(tmp_path) in result.stderr


def test_info_prints_sequences_grids_and_json(sequence: Path) -> None:
    result = run("info", sequence)
    assert result.exit_code == 0
    assert "128 x 128 x 8" in result.output
    assert json.loads(run("info", sequence, "--json").stdout)["sequences"][0]["frames"] == 3


def test_info_of_a_capture_tells_its_sensors(golden_capture: Path) -> None:
    assert "5 sensors, 3 frames (100..102)" in run("info", golden_capture / "raw").output


@pytest.mark.needs("matplotlib")
def test_stats_prints_both_tables_and_draws_the_plot(sequence: Path, tmp_path: Path) -> None:
    plot = tmp_path / "classes.png"
    result = run("stats", sequence, "--plot", plot)
    assert result.exit_code == 0, result.output
    assert "Classes of carlasc11" in result.output
    assert "Barrier" in result.output
    assert "% of voxels known (3 grids)" in result.output
    assert plot.stat().st_size > 10_000


@pytest.mark.parametrize(("plot", "missing", "code"), [("a.png", True, 1), ("a.doc", False, 2)])
def test_stats_refuses_a_plot_that_it_cannot_draw_before_it_counts(
    sequence: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    plot: str,
    missing: bool,
    code: int,
) -> None:
    # reading a frame would fail
    monkeypatch.delattr("carlasc.storage.published.PublishedSequence.read")
    if missing:
        for module in ("matplotlib", "matplotlib.figure"):
            monkeypatch.setitem(sys.modules, module, None)
    result = run("stats", sequence, "--plot", tmp_path / plot)
    assert result.exit_code == code
    assert result.output.count("\n") == 1
    assert ("[plots]'" if missing else "--plot: expected a file that ends in .png") in result.output
    assert not (tmp_path / plot).exists()


def test_stats_by_sequence_has_a_row_a_sequence(sequence: Path) -> None:
    assert "voxels, % by sequence" in run("stats", sequence.parent, "--by", "sequence").output


def test_stats_prints_json(sequence: Path) -> None:
    values = json.loads(run("stats", sequence, "--json", "--remap", "none").stdout)
    assert values["remap"] is None
    assert values["total"]["points"]["Road"] == 8413


def test_stats_goes_on_past_a_bad_file_and_exits_1(sequence: Path) -> None:
    (sequence / "labels" / "000001.label").write_bytes(b"odd")
    result = run("stats", sequence)
    assert result.exit_code == 1
    assert "Classes of carla" in result.stdout
    assert "000001.label" in result.stderr
    assert "1 of 6 files failed" in result.stderr


def test_stats_of_an_unknown_remap_exits_2(sequence: Path) -> None:
    assert run("stats", sequence, "--remap", "nonsense").exit_code == 2
