"""`carlasc report`: what it prints, the page that it writes, and its exit codes."""

import json
import shutil

import pytest
from helpers.scenes import passing_car
from typer.testing import CliRunner

from carlasc import GridSpec, Run
from carlasc.cli import app
from carlasc.groundtruth import FromScans, regrid
from carlasc.storage import layout

SPEC = GridSpec.published().with_resolution(0.8)
GRID = layout.grid_folder(SPEC)


def run(*arguments):
    return CliRunner().invoke(app, ["report", *map(str, arguments)])


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = passing_car.write_sequence(tmp_path_factory.mktemp("street"), frames=6)
    regrid(folder, SPEC, observe=FromScans(window=(-2, 2)), run=Run(workers=1))
    return folder


def test_a_report_is_printed_with_its_actors(made):
    result = run(made)
    assert result.exit_code == 0, result.output
    lines = result.output.splitlines()
    assert lines[0] == f"cartesian/{GRID}"
    for text in (
        "known ",
        "convergence ",
        "1 moving (1 Vehicle)",
        "window -2:2",
        "Static m",
        "0..5",
    ):
        assert text in result.output
    assert "held-out rays" not in result.output


def test_a_report_is_printed_as_json(made):
    values = json.loads(run(made, "--json", "--grid", GRID).stdout)
    assert values["reports"][f"cartesian/{GRID}"]["coverage"]["known_share"] > 0.1


def test_a_page_is_written(made, tmp_path):
    result = run(made, "--html", tmp_path / "page.html")
    assert result.exit_code == 0
    assert f"page: {tmp_path / 'page.html'}" in result.output
    assert (tmp_path / "page.html").read_text().startswith("<!doctype html>")


def test_held_out_rays_are_added_and_saved(made, tmp_path):
    folder = shutil.copytree(made, tmp_path / "Street")
    assert "held-out rays" in run(folder, "--holdout", "--save", "--workers", "1").output
    assert "held-out rays" in run(folder).output
    next(folder.rglob(layout.REPORT)).unlink()
    assert "held-out rays" not in run(folder, "--remake", "--workers", "1").output


def test_a_frame_that_cannot_be_read_is_listed_and_exits_1(made, tmp_path):
    folder = shutil.copytree(made, tmp_path / "Street")
    next(folder.rglob(f"{GRID}/000002.label")).write_bytes(b"odd")
    result = run(folder, "--remake", "--workers", "1")
    assert result.exit_code == 1
    assert "000002.label" in result.stderr
    assert "1 of 6 frames failed" in result.stderr
    assert "known " in result.output


@pytest.mark.parametrize("grid", [(), ("--grid", "other")])
def test_a_place_without_grids_is_one_line_and_exit_1(tmp_path, grid):
    folder = passing_car.write_sequence(tmp_path, frames=2)
    result = run(folder, *grid)
    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1
    assert "grid" in result.stderr


def test_a_damaged_report_is_one_line_that_says_what_to_do(made, tmp_path):
    folder = shutil.copytree(made, tmp_path / "Street")
    next(folder.rglob(layout.REPORT)).write_text('{"format": 0}')
    result = run(folder)
    assert result.exit_code == 1
    assert "make it again with `--remake`" in result.stderr


def test_published_data_are_not_written_to(golden_capture, tmp_path):
    folder = shutil.copytree(golden_capture / "cartesian", tmp_path / "cartesian")
    result = run(folder, "--save")
    assert result.exit_code == 1
    assert "leave out `--save`" in result.stderr
