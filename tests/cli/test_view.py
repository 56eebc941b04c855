import json
import sys

import pytest
from helpers.scenes.road_blocks import write_blocks
from typer.testing import CliRunner

from carlasc.cli import app


def call(*options):
    return CliRunner().invoke(app, ["view", *map(str, options)])


def test_a_page_is_written_and_named(golden_capture, tmp_path):
    result = call(golden_capture / "cartesian", "-o", tmp_path / "scene.html")
    assert result.exit_code == 0, result.stderr
    assert result.stdout.startswith(f"{tmp_path}/scene.html: ") and "3 frames" in result.stdout
    assert (tmp_path / "scene.html").read_text().startswith("<!doctype html>")


def test_figures_are_json(golden_capture, tmp_path):
    result = call(
        golden_capture / "cylindrical",
        "-o",
        tmp_path / "a.html",
        "--frames",
        "1:3",
        "--every",
        2,
        "--json",
    )
    figures = json.loads(result.stdout)
    assert (
        figures["frames"] == [1] and figures["size_bytes"] == (tmp_path / "a.html").stat().st_size
    )


@pytest.mark.needs("rerun", "foxglove")
@pytest.mark.parametrize(("ending", "word"), [("rrd", "with `rerun`"), ("mcap", "in Foxglove")])
def test_a_recording_is_written_and_its_size_said_before_all_points_are_kept(
    golden_capture, tmp_path, ending, word
):
    out = tmp_path / f"scene.{ending}"
    result = call(golden_capture / "cartesian", "--to", out, "--frames", "0:2", "--full-points")
    assert result.exit_code == 0, result.stderr
    before, after = result.stdout.splitlines()
    assert before.startswith(f"{out}: about ") and before.endswith(
        " MB: 2 frames with all of their points"
    )
    assert (
        after.startswith(f"{out}: ") and "2 frames" in after and after.endswith(f"open it {word}")
    )
    figures = json.loads(
        call(golden_capture / "cartesian", "-o", out, "--overwrite", "--json").stdout
    )
    assert figures["frames"] == [0, 1, 2] and figures["size_bytes"] == out.stat().st_size


@pytest.mark.parametrize(
    ("options", "code", "word"),
    [
        (["-o", "a.txt"], 2, ".html"),
        (["-o", "a.html", "--frames", "9:12"], 1, "choose others with `--frames`"),
        (["-o", "a.html", "--grid", "fine"], 1, "fine"),
        (["-o", "a.html", "--thin", "0"], 2, "--thin"),
        (["-o", "a.html", "--classes", "mine"], 2, "--classes: expected"),
        (["-o", "a.html", "--frames", "x"], 2, "--frames: expected"),
        (["--json"], 2, "--out"),
        (["--beside", "other"], 2, "--beside: a window shows only one run"),
        (["-o", "a.mcap", "--beside", "other"], 2, "--beside: expected a page"),
        (["-o", "a.html", "--full-points"], 2, "--full-points: expected a recording"),
        (["--to", "a.rrd", "--grid", "fine"], 1, "fine"),
        (["--to", "a.rdd"], 2, "ends in .html, .rrd, .mcap, or without"),
    ],
)
def test_a_mistake_is_one_line_and_the_right_exit_code(
    golden_capture, tmp_path, monkeypatch, options, code, word
):
    monkeypatch.chdir(tmp_path)
    result = call(golden_capture / "cartesian", *options)
    assert result.exit_code == code, result.stderr
    assert word in result.stderr and result.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_an_existing_page_is_replaced_only_with_overwrite(tmp_path):
    data = write_blocks(tmp_path / "data" / "cartesian", frames=1)
    (tmp_path / "a.html").write_text("mine")
    assert call(data, "-o", tmp_path / "a.html").exit_code == 1
    assert (tmp_path / "a.html").read_text() == "mine"
    assert call(data, "-o", tmp_path / "a.html", "--overwrite").exit_code == 0
    assert (tmp_path / "a.html").read_text() != "mine"


def test_two_runs_and_a_folder(tmp_path):
    first, second = (
        write_blocks(tmp_path / name / "Town01" / "cartesian", shift=shift, points=False)
        for name, shift in (("tube", 0.0), ("align", 2.0))
    )
    result = call(first, "--beside", second, "-o", tmp_path / "page", "--json")
    figures = json.loads(result.stdout)
    assert (
        figures["panels"] == ["tube", "align"] and (tmp_path / "page/frames/000002.bin").is_file()
    )
    result = call(first, "-o", f"{tmp_path}/page/", "--overwrite")
    assert result.exit_code == 0, result.stderr
    assert result.stdout.endswith("serve it with `python -m http.server`\n")
    again = call(first, "-o", tmp_path / "page")
    assert (
        again.exit_code == 1 and "`--overwrite`" in again.stderr and again.stderr.count("\n") == 1
    )


@pytest.mark.slow
def test_without_a_screen_the_window_says_what_to_do(tmp_path, monkeypatch):
    pytest.importorskip("open3d", exc_type=ImportError)
    if sys.platform != "linux":
        pytest.skip("screens are named by DISPLAY on Linux only")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    result = call(write_blocks(tmp_path / "data" / "cartesian", frames=1))
    assert result.exit_code == 1
    assert (
        "DISPLAY" in result.stderr
        and "`--out page.html`" in result.stderr
        and result.stderr.count("\n") == 1
    )


def test_without_open3d_the_window_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    result = call(write_blocks(tmp_path / "data" / "cartesian", frames=1))
    assert result.exit_code == 1 and "[view]'" in result.stderr
