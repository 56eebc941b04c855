"""The converter of the documentation keeps what the contract says, with the test that the
documentation gives.
"""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import carlasc
from carlasc.converting import convert
from carlasc.motion import PoseOptions
from carlasc.running import Run

PAGE = (Path(__file__).parents[2] / "docs" / "howto" / "converter.md").read_text()
NAMES = ("lab_converter", "test_lab_converter")


def code_of(name):
    found = re.search(rf'```python title="{name}\.py"\n(.*?)```', PAGE, re.DOTALL)
    assert found, name
    return found[1]


@pytest.fixture(scope="module")
def modules(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lab")
    for name in NAMES:
        (folder / f"{name}.py").write_text(code_of(name))
    sys.path.insert(0, str(folder))
    yield folder
    sys.path.remove(str(folder))
    for name in NAMES:
        sys.modules.pop(name, None)


@pytest.mark.slow
def test_its_own_test_passes(modules):
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "test_lab_converter.py",
    ]
    done = subprocess.run(
        command, cwd=modules, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"\b[5-9]\d* passed|\b1\d passed", done.stdout)


@pytest.fixture(scope="module")
def source(modules, tmp_path_factory):
    import test_lab_converter

    folder = tmp_path_factory.mktemp("drives")
    test_lab_converter.TestLab().write(folder)
    return folder


def test_it_converts_with_everything(modules, source, tmp_path):
    import lab_converter

    result = convert(lab_converter.Lab, source, tmp_path / "out", grids=None, run=Run(workers=1))
    assert result.failures == ()
    assert any("persons are blurred" in note for note in result.notes)
    (sequence,) = carlasc.open(tmp_path / "out").sequences().values()
    assert sequence.fields() == {
        "points",
        "labels",
        "instances",
        "boxes",
        "flow",
        "seconds",
        "sensor",
        "origins",
    }
    sensors = sequence.metadata.extra["sensors"]
    assert [(sensor["name"], round(sensor["height_m"], 2)) for sensor in sensors] == [
        ("upper", 1.9),
        ("lower", 0.9),
    ]
    assert np.abs(sequence.read("flow", 4)).max() > 5


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (lambda path: path.unlink(), "lower/000003.npz: expected a scan, found nothing"),
        (
            lambda path: path.write_bytes(b"PK"),
            "lower/000003.npz: expected points, labels and seconds",
        ),
    ],
)
def test_a_damaged_scan_is_reported_and_the_others_are_converted(
    modules, tmp_path, damage, problem
):
    import lab_converter
    import test_lab_converter

    source = tmp_path / "drives"
    source.mkdir()
    test_lab_converter.TestLab().write(source)
    damage(source / "drive_0" / "lower" / "000003.npz")
    result = convert(
        lab_converter.Lab,
        source,
        tmp_path / "out",
        poses=PoseOptions(force=True),
        grids=None,
        run=Run(workers=1),
    )
    assert [failure.frame for failure in result.failures] == [3]
    assert problem in result.failures[0].message
    assert result.made == 7
