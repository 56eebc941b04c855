import json

import numpy as np
import pytest
from helpers.films import Image, read_mp4
from typer.testing import CliRunner

from carlasc.cli import app

pytest.importorskip("embreex")


def call(*options):
    return CliRunner().invoke(app, ["render", *map(str, options)])


@pytest.mark.parametrize("grid", ["cartesian", "cartesian_fine", "cylindrical"])
def test_a_picture_of_the_golden_grids(golden_capture, tmp_path, grid):
    result = call(golden_capture / grid, "-o", tmp_path / "a.png", "--size", "640x360")
    assert result.exit_code == 0, result.stderr
    assert result.stdout.startswith(f"{tmp_path}/a.png: grid of ")
    assert result.stderr == ""
    shown = np.asarray(Image.open(tmp_path / "a.png").convert("RGB"))
    assert shown.shape == (360, 640, 3)
    assert len(np.unique(shown.reshape(-1, 3), axis=0)) > 500


@pytest.mark.slow
def test_frames_become_a_film_and_figures_are_json(golden_capture, tmp_path):
    result = call(
        golden_capture / "cartesian", "--frames", "0:2", "-o", tmp_path / "drive.mp4", "--size", "321x180",
        "--workers", 1, "--json", "--view", "bev", "--viewpoint", "azimuth=20",
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    figures = json.loads(result.stdout)
    assert (figures["frames"], figures["pictures"], figures["size"]) == ([0, 1], 2, [322, 180])
    assert len(read_mp4(tmp_path / "drive.mp4")[1]) == 2


@pytest.mark.parametrize(
    ("options", "code", "word"),
    [
        (["--frames", 9], 1, "expected frames 9:10"),
        (["-o", "a.bmp"], 2, "--out: expected a file name that ends in .png or .gif or .mp4, found a.bmp"),
        (["--size", "big"], 2, "--size"),
        (["--viewpoint", "zoom=3"], 2, "--viewpoint: expected"),
        (["--what", "errors"], 2, "give it with `--truth`"),
        (["--frames", "3:1"], 2, "--frames"),
        (["--grid", "fine"], 1, "fine"),
        (["--classes", "mine"], 2, "--classes: expected"),
        (["--source-classes", "mine"], 2, "--source-classes: expected"),
        (["--orbit", "-o", "a.png"], 2, "--orbit: expected a film"),
    ],
)
def test_a_mistake_is_one_line_and_the_right_exit_code(golden_capture, tmp_path, monkeypatch, options, code, word):
    monkeypatch.chdir(tmp_path)
    result = call(golden_capture / "cartesian", *options)
    assert result.exit_code == code
    assert word in result.stderr and result.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
