import json

import numpy as np
import pytest
from helpers.readers.pictures import Image, read_mp4
from typer.testing import CliRunner

from carlasc.cli import app

pytest.importorskip("embreex")


def call(*options):
    return CliRunner().invoke(app, ["render", *map(str, options)])


@pytest.mark.slow
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
        (
            ["-o", "a.bmp"],
            2,
            "--out: expected a file name that ends in .png or .gif or .mp4 or .webp, found a.bmp",
        ),
        (["--size", "big"], 2, "--size"),
        (["--viewpoint", "zoom=3"], 2, "--viewpoint: expected"),
        (["--what", "errors"], 2, "give it with `--truth`"),
        (["--frames", "3:1"], 2, "--frames"),
        (["--grid", "fine"], 1, "fine"),
        (["--classes", "mine"], 2, "--classes: expected"),
        (["--source-classes", "mine"], 2, "--source-classes: expected"),
        (["--orbit", "-o", "a.png"], 2, "--orbit: expected a film"),
        (["elsewhere"], 2, "SOURCE: expected one, found 2: draw several with --grid-of"),
        (["--caption", "one"], 2, "--caption: expected several sources or frames in one picture"),
        (
            ["--grid-of", "--caption", "one", "--caption", "two"],
            2,
            "--caption: expected one for each of the 1 panels",
        ),
        (["--color", "views"], 1, "make the grid again with `carlasc regrid --keep-evidence`"),
        (
            ["--color", "votes", "--what", "scan"],
            2,
            "--color: expected class where no grid is shown",
        ),
        (["--style", "paper", "-o", "a.gif"], 2, "--style: expected screen for a film"),
        (["--boxes", "--no-ego"], 1, "expected the field boxes, or points with instances"),
        (["--dpi", 1], 2, "--dpi: expected 30 to 2400"),
    ],
)
def test_a_mistake_is_one_line_and_the_right_exit_code(
    golden_capture, tmp_path, monkeypatch, options, code, word
):
    monkeypatch.chdir(tmp_path)
    result = call(golden_capture / "cartesian", *options)
    assert result.exit_code == code
    assert word in result.stderr and result.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_two_grids_on_paper_and_their_legend(golden_capture, tmp_path):
    sources = [golden_capture / name for name in ("cartesian", "cylindrical")]
    options = ["--style", "paper", "--size", "6cmx3cm", "--dpi", 200, "--color", "votes"]
    result = call(
        "--grid-of",
        *sources,
        "-o",
        tmp_path / "a.png",
        "--caption",
        "boxes",
        "--caption",
        "wedges",
        *options,
    )
    assert result.exit_code == 0, result.stderr
    assert f"{tmp_path}/a.legend.png: the legend" in result.stdout.splitlines()
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.size == (472, 236)
        assert picture.info["dpi"] == pytest.approx((200, 200), abs=0.02)
