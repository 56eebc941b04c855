"""What all exporters share: how they are found, their options, and an exporter of a third party."""

import json
import re
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from helpers.datasets.exported import PATH, files_and_bytes, scene_grid, write_scene
from typer.testing import CliRunner

from carlasc.cli import app
from carlasc.converting import export, exporter_names, load_exporter, option_declarations
from carlasc.errors import (
    ArgumentError,
    ConflictError,
    DependencyError,
    FormatError,
    MissingDataError,
)
from carlasc.running import Run

PAGE = Path(__file__).parents[2] / "docs" / "howto" / "exporter.md"
OURS = ("kitti", "occ3d", "openoccupancy", "opensceneflow", "sscbench")

runner = CliRunner()


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Install the exporter of the documentation, as pip would leave it: a module and its metadata."""
    site = tmp_path / "site"
    (site / "lab-1.0.dist-info").mkdir(parents=True)
    (code,) = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    (entry,) = re.findall(r"^```toml\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    (site / "lab_exporter.py").write_text(code)
    (site / "lab-1.0.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: lab\nVersion: 1.0\n"
    )
    declared = tomllib.loads(entry)["project"]["entry-points"]["carlasc.exporters"]
    declared |= {"broken": "lab_exporter:Nothing", "wrong": "lab_exporter:np"}
    lines = "".join(f"{name} = {value}\n" for name, value in declared.items())
    (site / "lab-1.0.dist-info" / "entry_points.txt").write_text(f"[carlasc.exporters]\n{lines}")
    monkeypatch.syspath_prepend(str(site))
    yield write_scene(tmp_path / "in", frames=3, grid="evaluation")
    sys.modules.pop("lab_exporter", None)


def run(*arguments):
    return runner.invoke(app, ["export", *map(str, arguments)])


def test_ours_are_there_and_have_titles_and_options():
    assert set(OURS) <= set(exporter_names())
    result = run("--list")
    assert result.exit_code == 0
    for name in OURS:
        assert f"{name}: {load_exporter(name).title}" in result.output
    assert "(options: grid, predictions, every)" in result.output
    assert tuple(option.name for option in option_declarations(load_exporter("occ3d"))) == (
        "grid",
        "predictions",
        "height_m",
    )


def test_the_exporter_of_the_documentation_works(installed, tmp_path):
    assert "topviews" in exporter_names()
    result = export("topviews", installed, tmp_path / "out", run=Run(workers=1))
    assert (result.made, result.failures) == (3, ())
    assert result.notes == ("unknown voxels are shown as free",)
    assert sorted(files_and_bytes(tmp_path / "out")) == [
        "carlasc-export.json",
        "index.json",
        *(
            f"town07_light/{name}"
            for name in ("000000.npy", "000001.npy", "000002.npy", "frames.txt")
        ),
    ]
    for frame in range(3):
        labels, _ = scene_grid(shift_m=0.4 * frame)
        columns = labels[:, ::-1].reshape(-1, labels.shape[2])
        top = [column[column > 0][-1] if column.any() else 0 for column in columns]
        assert (
            np.load(tmp_path / "out" / "town07_light" / f"{frame:06d}.npy").reshape(-1).tolist()
            == top
        )
    assert json.loads((tmp_path / "out" / "index.json").read_text()) == ["town07_light"]


def test_options_of_the_command_line_are_those_of_the_constructor(installed, tmp_path):
    result = run("topviews", installed, tmp_path / "out", "--above-m=-1.0", "--workers", "1")
    assert result.exit_code == 0, result.output
    assert "note: unknown voxels are shown as free" in result.output
    assert f"{PATH} -> {tmp_path / 'out' / 'town07_light'}" in result.output
    assert "3 frames written in" in result.output
    assert 7 not in np.load(tmp_path / "out" / "town07_light" / "000000.npy")  # the road is below
    result = run("topviews", installed, tmp_path / "out", "--above-m=-2.0", "--workers", "1")
    assert result.exit_code == 1
    assert "expected frames that were exported with grid=evaluation, above_m=-2.0" in result.stderr
    assert "`--overwrite`" in result.stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--above-m",), "option '--above-m' requires an argument"),
        (("--above-m", "high"), "invalid value for '--above-m'"),
        (("--below-m", "1"), "no such option: --below-m"),
        (("--predictions",), "no such option: --predictions"),
    ],
)
def test_wrong_options_are_named_and_the_exit_code_is_2(installed, tmp_path, options, message):
    result = run("topviews", installed, tmp_path / "out", *options)
    assert result.exit_code == 2
    assert message in result.stderr
    assert not (tmp_path / "out").exists()


def test_an_exporter_that_does_not_load_is_named(installed, tmp_path):
    with pytest.raises(
        DependencyError, match=r"exporter broken \(lab_exporter:Nothing\): cannot be loaded"
    ):
        load_exporter("broken")
    with pytest.raises(
        DependencyError, match=r"expected a class that inherits carlasc.converting.Exporter"
    ):
        load_exporter("wrong")
    with pytest.raises(ArgumentError, match="name: expected one of .*topviews.*, found 'other'"):
        load_exporter("other")
    with pytest.raises(MissingDataError, match="expected the grid fine, found evaluation"):
        export("topviews", installed, tmp_path / "out", options={"grid": "fine"})


def test_truth_values_are_read_from_text(installed, tmp_path):
    for text in ("true", "Yes", "1"):
        export(
            "kitti", installed, tmp_path / text, options={"predictions": text}, run=Run(workers=1)
        )
        assert (tmp_path / text / "sequences" / "00" / "predictions" / "000000.label").is_file()
    with pytest.raises(ArgumentError, match="predictions: expected true or false, found 'perhaps'"):
        export(
            "kitti",
            installed,
            tmp_path / "out",
            options={"predictions": "perhaps"},
            run=Run(workers=1),
        )


def test_frames_that_fail_are_listed_and_the_exit_code_is_1(installed, tmp_path):
    (installed / PATH / "evaluation" / "000001.label").write_bytes(b"short")
    result = run("topviews", installed, tmp_path / "out", "--workers", "1")
    assert result.exit_code == 1
    assert "000001.label" in result.stderr
    assert "1 of 3 frames failed; the others are done" in result.stderr
    assert (tmp_path / "out" / "town07_light" / "000002.npy").is_file()


@pytest.mark.slow
def test_workers_write_the_same_files(installed, tmp_path):
    for place, workers in (("one", 1), ("two", 2)):
        export("kitti", installed, tmp_path / place, run=Run(workers=workers))
    assert files_and_bytes(tmp_path / "one") == files_and_bytes(tmp_path / "two")


def test_figures_are_json(installed, tmp_path):
    result = run("topviews", installed, tmp_path / "out", "--json", "--workers", "1")
    values = json.loads(result.stdout)
    assert (values["made"], values["sequences"]) == (3, {PATH: "town07_light"})


def test_a_damaged_record_is_named(installed, tmp_path):
    export("topviews", installed, tmp_path / "out", run=Run(workers=1))
    (tmp_path / "out" / "carlasc-export.json").write_text("{")
    with pytest.raises(ValueError, match=r"carlasc-export.json: expected JSON"):
        export("topviews", installed, tmp_path / "out", run=Run(workers=1))


def test_exporters_of_different_data_sets_do_not_share_a_record(installed, tmp_path):
    export("topviews", installed, tmp_path / "out", run=Run(workers=1))
    assert export("kitti", installed, tmp_path / "out", run=Run(workers=1)).made == 3
    with pytest.raises(ConflictError):
        export(
            "kitti", installed, tmp_path / "out", options={"grid": "evaluation"}, run=Run(workers=1)
        )


def test_two_sequences_of_one_name_are_not_written_to_one_place(installed, tmp_path):
    write_scene(installed, frames=1, grid="evaluation", path="Train/Town07_Light/cartesian")
    message = "expected sequences of different names, found Train/Town07_Light/cartesian and Val/Town07_Light/cartesian"
    with pytest.raises(FormatError, match=message):
        export("topviews", installed, tmp_path / "out", run=Run(workers=1))
