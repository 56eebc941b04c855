"""`carlasc convert` and `carlasc export`."""

import json

import numpy as np
import pytest
from helpers.datasets.tiny_kitti import write_labels, write_tiny_kitti
from typer.testing import CliRunner

from carlasc.cli import app

runner = CliRunner()


@pytest.fixture
def source(tmp_path):
    write_tiny_kitti(tmp_path / "in", voxels=True)
    return tmp_path / "in"


def run(*arguments):
    return runner.invoke(app, [*map(str, arguments), "--workers", "1"])


def test_the_list_names_the_converters():
    result = runner.invoke(app, ["convert", "--list"])
    assert result.exit_code == 0
    assert "kitti: SemanticKITTI" in result.output
    assert "poss: SemanticPOSS" in result.output


def test_there_and_back_by_two_commands(source, tmp_path):
    options = (
        "--classes",
        "semantickitti",
        "--axes",
        "right",
        "--grids",
        "voxels",
        "--flow",
        "none",
    )
    result = run("convert", "kitti", source, tmp_path / "middle", *options)
    assert result.exit_code == 0, result.output
    assert "3 frames converted" in result.output
    result = run("export", "kitti", tmp_path / "middle", tmp_path / "out")
    assert result.exit_code == 0, result.output
    for name in ("velodyne/000001.bin", "voxels/000002.invalid"):
        before, after = (
            folder / "sequences" / "00" / name for folder in (source, tmp_path / "out")
        )
        assert before.read_bytes() == after.read_bytes()


def test_grids_are_made_by_default_and_figures_are_json(source, tmp_path):
    result = run(
        "convert",
        "kitti",
        source,
        tmp_path / "out",
        "--window",
        "-1:1",
        "--dynamic",
        "drop",
        "--json",
    )
    assert result.exit_code == 0, result.output
    values = json.loads(result.stdout)
    assert values["made"] == 3
    assert values["grids"] == [str(tmp_path / "out/Train/KITTI_00/cartesian/evaluation")]
    params = json.loads(
        (tmp_path / "out/Train/KITTI_00/cartesian/evaluation/params.json").read_text()
    )
    assert params["carlasc"]["window"] == "-1:1"
    assert params["carlasc"]["dynamic"] == "drop"
    assert params["carlasc"]["min_range_m"] == 2.5


def test_failed_frames_are_listed_and_the_exit_code_is_1(source, tmp_path):
    write_labels(source / "sequences" / "00", 1, np.zeros(3, np.uint32))
    result = run("convert", "kitti", source, tmp_path / "out", "--grids", "none")
    assert result.exit_code == 1
    assert "labels/000001.label: expected a label for each of 60 points, found 3" in result.stderr
    assert "frame 2 waits for frame 1" in result.stderr  # its motion
    assert "1 of 3 frames failed, and 2 wait for them" in result.stderr
    result = run("convert", "kitti", source, tmp_path / "out", "--grids", "none", "--allow-gaps")
    assert result.exit_code == 1
    assert "1 of 3 frames failed" in result.stderr


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (
            ("--res", "0.2", "--grids", "none"),
            2,
            "--grids: expected scans, because options of the grid are given, found none",
        ),
        (("--classes", "poss"), 2, "--classes: expected one of auto, carla, semantickitti"),
        (("--sequences", "05"), 1, "expected the sequences 05, found only 00"),
        (("--color", "red"), 2, "no such option: --color"),
        (("--preset", "coarse", "--res", "0.2"), 2, "expected one of --res, --size and --preset"),
    ],
)
def test_mistakes_are_one_line_and_the_right_exit_code(source, tmp_path, options, code, message):
    result = run("convert", "kitti", source, tmp_path / "out", *options)
    assert result.exit_code == code
    assert message in result.stderr
    assert "Traceback" not in result.output
    assert len(result.stderr.strip().splitlines()) == 1


def test_an_unknown_converter_is_wrong_usage(source, tmp_path):
    result = run("convert", "waymo", source, tmp_path / "out")
    assert result.exit_code == 2
    assert "expected one of argoverse2, " in result.stderr
