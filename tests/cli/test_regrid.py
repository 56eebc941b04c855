import json
import math
import re

import numpy as np
import pytest
from helpers.datasets.captures import read_tree, write_capture
from helpers.scenes import passing_car
from typer.testing import CliRunner

from carlasc.cli import app, common
from carlasc.cli.grid_flags import GridFlags
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError


@pytest.fixture
def capture(tmp_path, monkeypatch):
    write_capture(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def _regrid(*options):
    return CliRunner().invoke(app, ["regrid", "--workers", "1", *map(str, options)])


def test_inside_a_sequences_folder_res_is_all_it_needs(capture):
    result = _regrid("--res", 0.2)
    assert result.exit_code == 0, result.stderr
    assert result.stdout.splitlines()[0] == "cartesian/evaluation_256x256x15"
    assert "cartesian 256 x 256 x 15: 3 frames made in" in result.stdout
    assert result.stderr == ""  # no bar where there is no terminal
    assert (
        capture / "cartesian/evaluation_256x256x15/000002.bin"
    ).stat().st_size == 256 * 256 * 15 * 4
    assert "0 frames made (3 existed)" in _regrid("--res", 0.2).stdout


def test_where_there_is_no_terminal_long_work_prints_a_line_now_and_then(capture, monkeypatch):
    monkeypatch.setattr(common, "_LINE_S", 0)
    result = _regrid("--res", 0.8)
    lines = result.stderr.splitlines()[-3:]
    assert [re.fullmatch(r"regrid: (\d) of 3 frames, \d+ s", line)[1] for line in lines] == [
        "1",
        "2",
        "3",
    ]
    assert result.stdout.splitlines()[0] == "cartesian/evaluation_64x64x4"


def test_the_published_cartesian_grid_is_called_evaluation_and_another_of_its_size_is_not(capture):
    assert _regrid("--preset", "coarse", "-o", "out").exit_code == 0
    assert _regrid("--res", 0.4, "-o", "out").exit_code == 0
    grids = {path.parent.name for path in (capture / "out/cartesian").glob("*/params.json")}
    assert grids == {"evaluation", "evaluation_128x128x8"}


def test_every_option_reaches_the_run(capture):
    options = [
        "--size",
        "16,12,4",
        "--bounds",
        "-8,8,-6,6,-2,1",
        "--free-step-m",
        0.5,
        "--voting",
        "sample",
    ]
    result = _regrid(
        capture,
        "-o",
        "out",
        *options,
        "--frames",
        "101:",
        "--keep-votes",
        "--name",
        "mine",
        "--json",
    )
    assert result.exit_code == 0, result.stderr
    printed = json.loads(result.stdout)
    assert (printed["made"], printed["skipped"], printed["failures"]) == (2, 0, [])
    assert printed["grids"] == ["out/cartesian/mine"]
    params = json.loads((capture / "out/cartesian/mine/params.json").read_bytes())
    record = params.pop("carlasc")
    assert params == GridSpec("cartesian", (16, 12, 4), (-8, -6, -2), (8, 6, 1)).to_params()
    assert (record["free_step_m"], record["voting"], record["frames"]) == (0.5, "sample", "101:")
    assert sorted(name.split("/")[-1] for name in read_tree(capture / "out/cartesian/mine")) == [
        *(
            "000000.bin",
            "000000.label",
            "000000.votes.npz",
            "000001.bin",
            "000001.label",
            "000001.votes.npz",
        ),
        "carlasc-report.json",
        "params.json",
    ]


def test_other_settings_need_overwrite_or_another_name(capture):
    assert _regrid("--preset", "coarse").exit_code == 0
    refused = _regrid("--preset", "coarse", "--free-step-m", 1)
    assert refused.exit_code == 1
    (line,) = refused.stderr.splitlines()
    assert "free_step_m 1.5 where this run has 1.0" in line and "--overwrite" in line
    assert _regrid("--preset", "coarse", "--free-step-m", 1, "--name", "other").exit_code == 0
    assert _regrid("--preset", "coarse", "--free-step-m", 1, "--overwrite").exit_code == 0


def test_bad_frames_are_listed_at_the_end_and_the_exit_code_tells(capture):
    np.save(capture / "raw/velodyne1/101.npy", np.zeros((300, 3)))
    result = _regrid("--preset", "coarse")
    assert result.exit_code == 1
    assert "2 frames made" in result.stdout
    first, last = result.stderr.splitlines()
    assert "velodyne1/101.npy: expected float32 values, found float64" in first
    assert "1 of 3 frames failed" in last


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "expected one of --res, --size and --preset, found none of them"),
        (["--res", 0.2, "--preset", "fine"], "found --res and --preset"),
        (["--res", 0], "expected one or three positive numbers, found 0.0"),
        (["--res", -0.2], "expected one or three positive numbers, found -0.2"),
        (["--res", "nan"], "expected one or three positive numbers, found nan"),
        (["--res", "0.2,0.2"], "--res: expected 1 or 3 numbers"),
        (["--res", "fine"], "--res: expected 1 or 3 numbers"),
        (["--res", 1e-4], "expected fewer than 2^31 cells"),
        (["--size", "0,10,10"], "expected at least one cell per axis"),
        (["--size", "1.5,10,10"], "--size: expected 3 whole numbers"),
        (["--res", 0.2, "--bounds", "1,-1,0,1,0,1"], "expected lower < upper on every axis"),
        (["--res", 0.2, "--bounds", "1,2,3"], "--bounds: expected 6 numbers"),
        (
            ["--preset", "coarse", "--bounds", "0,1,0,1,0,1"],
            "--bounds: expected none, because --preset has bounds",
        ),
        (
            ["--preset", "cylindrical", "--coordinates", "cartesian"],
            "--coordinates: expected cylindrical with --preset cylindrical",
        ),
        (["--preset", "huge"], "'huge'"),
        (["--preset", "coarse", "--voting", "twice"], "'twice'"),
        (["--preset", "coarse", "--free-step-m", 0], "--free-step-m: expected a positive number"),
        (
            ["--preset", "coarse", "--frames", "9:3"],
            "--frames: expected a range that holds a frame",
        ),
        (["--preset", "coarse", "--window", "2:9"], "--window: expected a range that contains 0"),
        (["--preset", "coarse", "--window", "all"], "--window: expected A:B"),
        (["--preset", "coarse", "--stride", 0], "--stride: expected at least 1"),
        (
            ["--preset", "coarse", "--min-range-m", 5, "--max-range-m", 2],
            "--min-range-m: expected 0 <= minimum < maximum",
        ),
        (
            ["--preset", "coarse", "--observe", "capture", "--stride", 2],
            "--observe: expected scans, because options for scans",
        ),
        (
            ["--preset", "coarse", "--observe", "capture", "--from-grid", "x"],
            "--observe: expected grid, because --from-grid",
        ),
        (
            ["--preset", "coarse", "--from-grid", "x", "--keep-votes"],
            "--keep-votes: expected False for resampled grids",
        ),
        (["--preset", "coarse", "--name", "a/b"], "--name: expected letters"),
    ],
)
def test_wrong_usage_is_one_line_and_2(capture, options, message):
    result = _regrid(*options)
    assert result.exit_code == 2
    assert message in " ".join(result.stderr.split())
    assert not (capture / "cartesian").exists()


def test_a_folder_without_a_capture_is_1(tmp_path):
    result = _regrid(tmp_path, "--res", 0.2)
    assert result.exit_code == 1
    assert "expected a capture" in result.stderr
    assert (
        "nowhere: expected a folder, a zip or a packed store, found nothing"
        in _regrid(tmp_path / "nowhere", "--res", 0.2).stderr
    )


def test_advice_names_options_where_the_library_names_arguments(tmp_path, capture):
    street = passing_car.write_sequence(tmp_path / "street", (), frames=2, poses=False)
    assert "`--poses kiss-icp`" in _regrid(street, "--res", 0.4, "--poses", "file").stderr
    assert _regrid("--preset", "coarse").exit_code == 0
    advice = _regrid("--preset", "coarse", "--voting", "sample").stderr
    assert "choose another `--name`, or replace the grid with `--overwrite`" in advice
    assert (
        "`--out`"
        in _regrid(
            "--preset", "coarse", "--name", "velodyne2", "-o", street, "--frames", "100"
        ).stderr
    )


@pytest.mark.slow
def test_options_for_scans_and_grids_say_what_observes_the_scene(capture):
    runs = {"capture": [], "scans": ["--stride", 2, "--force"], "grid": ["--from-grid", "capture"]}
    for kind, options in runs.items():
        result = _regrid("--size", "16,16,4", "--name", kind, *options)
        assert result.exit_code == 0, result.stderr
        record = json.loads((capture / "cartesian" / kind / "params.json").read_bytes())["carlasc"]
        assert record["observe"] == kind


def test_presets_are_the_published_grids_in_the_coordinates_asked_for():
    published = GridSpec.published
    assert GridFlags(preset="coarse").spec() == published("cartesian")
    assert GridFlags(preset="fine").spec() == published("fine")
    assert GridFlags(preset="cylindrical").spec() == published("cylindrical")
    assert GridFlags(preset="coarse", coordinates="cylindrical").spec() == published("cylindrical")


def test_degrees_end_at_the_command_line():
    spec = GridFlags("0.5,3,0.5", coordinates="cylindrical", bounds="0,20,-90,90,-2,1").spec()
    assert spec.size == (40, 60, 6)
    assert spec.lower[1] == np.float32(-math.pi / 2) and spec.upper[1] == np.float32(math.pi / 2)
    whole = GridFlags(size="8,8,4", coordinates="cylindrical", bounds="0,20,-180,180,-2,1").spec()
    assert whole.lower[1] == GridSpec.published("cylindrical").lower[1]
    with pytest.raises(ArgumentError) as error:
        GridFlags(size="8,8,4", coordinates="cylindrical", bounds="0,20,-190,180,-2,1").spec()
    assert "2 pi" in error.value.expected
