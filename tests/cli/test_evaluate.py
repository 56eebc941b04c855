from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from carlasc import GridSpec
from carlasc.cli import app
from carlasc.storage import FolderSink, layout

SPEC = GridSpec("cartesian", (4, 4, 2), (-2.0, -2.0, -1.0), (2.0, 2.0, 1.0))
PATH = "Test/Town10_Heavy/cartesian"


def run(*arguments):
    return CliRunner().invoke(app, ["evaluate", *map(str, arguments)])


@pytest.fixture
def data(tmp_path):
    rng = np.random.default_rng(0)
    for name in ("pred", "truth"):
        writer = FolderSink(tmp_path / name).sequence(PATH)
        writer.write_document(
            layout.params_file("evaluation"), json.dumps(SPEC.to_params()).encode()
        )
        for frame in range(2):
            writer.write(
                "evaluation/labels", frame, rng.integers(0, 23, SPEC.size).astype(np.uint32)
            )
            writer.write("evaluation/counts", frame, np.ones(SPEC.size, np.float32))
    return tmp_path / "pred", tmp_path / "truth"


def test_both_tables_are_printed(data):
    result = run(*data, "--name", "Mine")
    assert result.exit_code == 0, result.output
    assert "mIoU w/o free" in result.output
    assert "Precision" in result.output
    assert result.output.count("Mine") == 2


def test_json_csv_and_latex_hold_the_same_figures(data):
    figures = json.loads(run(*data, "--json").output)
    assert figures["frames"] == 2
    assert f",{100 * figures['accuracy']:.2f}\n" in run(*data, "--csv").output
    assert f"& {100 * figures['accuracy']:.2f} \\\\" in run(*data, "--latex").output


def test_bands_and_views_leave_voxels_out(data):
    whole = json.loads(run(*data, "--json").output)["scored_voxels"]
    near = json.loads(run(*data, "--json", "--far", "1").output)["scored_voxels"]
    ahead = json.loads(run(*data, "--json", "--fov", "90").output)["scored_voxels"]
    assert (whole, near, ahead) == (64, 16, 24)


def test_a_missing_prediction_is_named_and_exits_1_after_the_tables(data):
    (data[0] / PATH / "evaluation" / "000001.label").unlink()
    result = run(*data)
    assert result.exit_code == 1
    assert "prediction for frame 1" in result.output
    assert "mIoU" in result.output
    assert run(*data, "--frames", "0:1").exit_code == 0


def test_mistakes_are_one_line(data):
    result = run(data[0], data[1] / "nothing")
    assert (result.exit_code, result.output.count("\n")) == (1, 1)
    result = run(*data, "--convention", "nonsense")
    assert (result.exit_code, result.output.count("\n")) == (2, 1)
    assert run(*data, "--far", "0").exit_code == 2


def test_all_conventions_are_printed_a_row_each_with_the_reason_where_there_is_none(data):
    result = run(*data, "--all-conventions")
    assert result.exit_code == 0, result.output
    for name in ("carlasc", "semantickitti", "sscbench", "occ3d-lidar", "openoccupancy"):
        assert name in result.output
    assert "no score: occ3d-camera" in result.output
    assert "cameras and the field" in result.output
    figures = json.loads(run(*data, "--all-conventions", "--json").output)
    assert "impossible" in figures["occ3d-camera"]
    assert figures["sscbench"]["miou"] != figures["carlasc"]["miou"]


def test_frames_are_written_drawn_and_broken_down(data, tmp_path):
    pytest.importorskip("matplotlib")
    csv, plot = tmp_path / "frames.csv", tmp_path / "frames.png"
    result = run(
        *data, "--per-frame", csv, "--plot", plot, "--by", "distance", "--by", "visibility"
    )
    assert result.exit_code == 0, result.output
    assert csv.read_text().startswith("sequence,frame,miou")
    assert len(csv.read_text().splitlines()) == 3
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert "visible" in result.output and "0-10 m" in result.output
    assert run(*data, "--plot", tmp_path / "frames.txt").exit_code == 2


def test_too_few_sequences_to_compare_are_said_in_one_line(data):
    result = run(*data, "--compare", data[0])
    assert (result.exit_code, result.output.count("\n")) == (2, 1)
    assert "at least 5" in result.output


def test_files_of_semantickitti_are_scored_by_its_rules(tmp_path):
    size = (256, 256, 32)
    truth = np.zeros(size, "<u2")
    truth[10:20, 120:130, 2] = 40
    prediction = truth.copy()
    prediction[10:15, 120:130, 2] = 10
    for name, labels in (("voxels", truth), ("predictions", prediction)):
        folder = tmp_path / "sequences" / "08" / name
        folder.mkdir(parents=True)
        labels.tofile(folder / "000000.label")
    mask = tmp_path / "sequences" / "08" / "voxels" / "000000.invalid"
    mask.write_bytes(np.packbits(np.zeros(size, bool)).tobytes())
    # the occupancy of a scan, no counts
    mask.with_suffix(".bin").write_bytes(np.packbits(truth > 0).tobytes())
    values = json.loads(run(tmp_path, tmp_path, "--json").stdout)
    assert (values["convention"], values["frames"]) == ("semantickitti", 1)
    assert values["class_iou"]["road"] == pytest.approx(0.5)
    assert values["iou"] == 1.0
    near = json.loads(run(tmp_path, tmp_path, "--json", "--far", "2.9").stdout)
    # the first half of the road, from 2 to 3 m, is called a car
    assert near["class_iou"]["road"] == pytest.approx(0.0)
    assert near["scored_voxels"] < values["scored_voxels"] == 256 * 256 * 32


def test_the_class_tables_and_absent_classes_are_printed(data):
    result = run(*data, "--sequences", "Town10_Heavy")
    assert (
        "classes: predictions carla (assumed: no file names one); ground truth carla"
        in result.output
    )
    assert run(*data, "--markdown").output.startswith("Semantic scene completion")
    assert "| Network |" in run(*data, "--markdown").output
    figures = json.loads(run(*data, "--json", "--allow-unknown").output)
    assert figures["source_classes"] == [{"table": "carla", "found": "assumed"}]
    assert run(*data, "--sequences", "Town99").exit_code == 1
