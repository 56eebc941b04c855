"""Recorders are found by their entry points, also those of a third party."""

import json
import re
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from carlasc_recorders import SimulatedCapture
from helpers.errors import raises
from typer.testing import CliRunner

import carlasc
from carlasc.captures import (
    Capture,
    LidarEffects,
    Simulator,
    load_recorder,
    recorder_names,
    simulate,
)
from carlasc.cli import app
from carlasc.core import CARLA
from carlasc.errors import ArgumentError, ConflictError, DependencyError
from carlasc.running import Run

PAGE = Path(__file__).parents[2] / "docs" / "howto" / "simulator.md"
ONE = Run(workers=1)


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Install the simulator of the documentation, as pip would leave it."""
    site = tmp_path / "site"
    (site / "lab-1.0.dist-info").mkdir(parents=True)
    (code,) = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    (entry,) = re.findall(r"^```toml\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    (site / "lab_simulator.py").write_text(code)
    (site / "lab-1.0.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: lab\nVersion: 1.0\n"
    )
    declared = tomllib.loads(entry)["project"]["entry-points"]["carlasc.recorders"]
    declared |= {"broken": "lab_simulator:Nothing", "wrong": "lab_simulator:np"}
    lines = "".join(f"{name} = {value}\n" for name, value in declared.items())
    (site / "lab-1.0.dist-info" / "entry_points.txt").write_text(f"[carlasc.recorders]\n{lines}")
    monkeypatch.syspath_prepend(str(site))
    yield
    sys.modules.pop("lab_simulator", None)


def test_the_town_and_the_carla_server_are_there():
    assert {"carla", "town"} <= set(recorder_names())
    assert load_recorder("town", Simulator) is SimulatedCapture
    assert load_recorder("carla") is carlasc.record


def test_a_third_partys_simulator_writes_a_capture_and_goes_on(installed, tmp_path):
    out = tmp_path / "drive"
    assert simulate(out, simulator="straight", count=2, sensors=2, run=ONE).written == 2
    second = simulate(out, simulator="straight", count=3, sensors=2, run=ONE)
    assert (second.count, second.written, second.points) == (3, 1, 1400)
    assert second.classes == {"Road": 1000, "Vehicle": 400}
    capture, drive = Capture(out), load_recorder("straight")(count=3, sensors=2)
    assert capture.frames.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(capture.read(1, 2).scan.points, drive.read(1, 2).scan.points)
    assert capture.read_time(2, 1) == pytest.approx(0.2)
    settings = json.loads((out / "raw" / "simulation.json").read_text())
    assert settings["simulator"] == "straight"
    with pytest.raises(ConflictError) as error:
        simulate(out, count=3, sensors=2, run=ONE)
    assert "simulator 'straight'" in error.value.found


def test_a_simulator_whose_scans_are_ideal_takes_no_effects(installed):
    load_recorder("straight")(count=1, sensors=2, effects=LidarEffects())
    with raises(ArgumentError, where="effects", found="rain=0.1"):
        load_recorder("straight")(count=1, sensors=2, effects=LidarEffects(rain=0.1))


def test_the_command_takes_its_name_for_a_capture_and_for_ground_truth(
    installed, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    options = ["--simulator", "straight", "--count", "2", "--sensors", "2", "--workers", "1"]
    run = CliRunner().invoke(app, ["simulate", "drive", *options])
    assert run.exit_code == 0, run.output
    run = CliRunner().invoke(app, ["simulate", "grids", *options, "--size", "32,32,8"])
    assert run.exit_code == 0, run.output
    (sequence,) = carlasc.open("grids").sequences().values()
    labels = sequence.grid("evaluation_32x32x8", 1).labels
    assert np.count_nonzero(labels == CARLA.id_of("Vehicle")) > 0


def test_what_cannot_be_loaded_or_is_no_simulator_is_refused(installed, tmp_path):
    for name, kind in (
        ("none", ArgumentError),
        ("broken", DependencyError),
        ("wrong", DependencyError),
        ("carla", DependencyError),
    ):
        with pytest.raises(kind) as error:
            simulate(tmp_path / "out", simulator=name)
        if kind is DependencyError:
            assert error.value.where.startswith(f"recorder {name} (")
    with pytest.raises(ArgumentError) as error:
        simulate(tmp_path / "out", simulator="straight", cameras=["front"])
    assert error.value.where == "cameras"
    assert not (tmp_path / "out").exists()


def test_an_unknown_simulator_is_named_as_its_argument(tmp_path):
    with pytest.raises(ArgumentError) as error:
        simulate(tmp_path / "out", simulator="twon")
    assert error.value.where == "simulator" and "town" in error.value.expected
