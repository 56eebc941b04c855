"""The protocol: a second converter, one of a third party, and what all of them share."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.datasets.tiny_kitti import write_labels, write_tiny_kitti
from typer.testing import CliRunner

import carlasc
from carlasc.cli import app
from carlasc.converting import (
    Converter,
    LayoutOptions,
    OptionDeclaration,
    convert,
    converter_names,
    load_converter,
    option_declarations,
    read_options,
)
from carlasc.errors import ArgumentError, DependencyError, MissingDataError
from carlasc.motion import PoseOptions
from carlasc.running import Run
from carlasc.storage import Sink
from carlasc.storage.protocol import SequenceWriter

PLAIN = {"grids": None, "layout": LayoutOptions(flow="none"), "run": Run(workers=1)}

THIRD_PARTY = """
from typing import Annotated, Literal
import numpy as np
from carlasc.errors import FormatError
from carlasc.converting import Cloud, Converter, FrameHandle, Recording, Trajectory
from carlasc.core.classes import Remap
from carlasc.core.tables import CARLA

class Handle(FrameHandle):
    def __init__(self, number):
        self.number, self.location = number, f"lab {number}"
    def read(self):
        points = np.full((5, 4), self.number + 1, np.float32)
        return [Cloud(points, np.full(5, 7, np.uint8), np.zeros(5, np.uint32))]

class Rec(Recording):
    name, split, location, has_labels, has_instances = "LAB_a", "Test", "lab", True, True
    frames = [Handle(0), Handle(1)]
    def poses(self, *, force=False):
        return Trajectory(np.tile(np.eye(4), (2, 1, 1)))

class Lab(Converter):
    title, classes, to_carla = "our laboratory", CARLA, Remap("lab", CARLA, CARLA, {i: i for i in CARLA.names})
    def sequences(self):
        return [Rec()]

class Torn(Handle):
    def read(self):
        raise FormatError(self.location, expected="a scan", found="half of one")

class Faulty(Handle):
    def read(self):
        return {}["points"]

class Failing(Lab):
    def __init__(self, source, *, how: Annotated[Literal["torn", "faulty"], "What is wrong."] = "torn", posed: bool = True):
        super().__init__(source)
        self.how, self.posed = how, posed
    def sequences(self):
        recording = Rec()
        recording.frames = [{"torn": Torn, "faulty": Faulty}[self.how](number) for number in range(2)]
        if not self.posed:
            recording.poses = lambda *, force=False: None
        return [recording]
"""


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Install a distribution of a third party, as pip would leave it: a module and its metadata."""
    site = tmp_path / "site"
    (site / "lab-1.0.dist-info").mkdir(parents=True)
    (site / "lab_converter.py").write_text(THIRD_PARTY)
    (site / "lab-1.0.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: lab\nVersion: 1.0\n"
    )
    (site / "lab-1.0.dist-info" / "entry_points.txt").write_text(
        "[carlasc.converters]\nlab = lab_converter:Lab\nbroken = lab_converter:Nothing\nwrong = "
        "lab_converter:Handle\n"
        "failing = lab_converter:Failing\n"
    )
    monkeypatch.syspath_prepend(str(site))
    yield site
    sys.modules.pop("lab_converter", None)


def test_kitti_and_poss_are_there():
    assert {"kitti", "poss"} <= set(converter_names())


def test_a_third_partys_converter_is_found_and_used(installed, tmp_path):
    assert "lab" in converter_names()
    result = convert("lab", installed, tmp_path / "out", poses=PoseOptions(force=True), **PLAIN)
    assert (result.made, result.failures) == (2, ())
    sequence = carlasc.open(tmp_path / "out").sequences()["Test/LAB_a/cartesian"]
    assert sequence.read("points", 1)[0].tolist() == [2, -2, 2, 2]
    assert sequence.read("labels", 1).tolist() == [7] * 5
    assert sequence.times.tolist() == [0, 0.1]


@pytest.mark.parametrize("posed", [True, False])
@pytest.mark.parametrize(
    ("how", "cause"),
    [
        ("torn", "lab 0: expected a scan, found half of one"),
        (
            "faulty",
            "lab 0: the converter failed: KeyError: 'points': check the file, or report the error",
        ),
    ],
)
def test_where_every_frame_fails_the_first_cause_is_the_message(
    installed, tmp_path, how, cause, posed
):
    result = convert(
        "failing",
        installed,
        tmp_path / "out",
        options={"how": how, "posed": posed},
        run=Run(workers=1),
    )
    assert [failure.frame for failure in result.failures] == [0, 1]
    assert result.failures[0].message == cause
    assert (result.made, result.grids) == (0, ())
    options = ["--how", how, "--posed" if posed else "--no-posed", "--workers", "1"]
    ran = CliRunner().invoke(
        app, ["convert", "failing", str(installed), str(tmp_path / "cli"), *options]
    )
    assert ran.exit_code == 1
    assert cause in ran.stderr.splitlines()[0]
    assert "velodyne" not in ran.output


def test_a_converter_declares_its_options(installed):
    kind = load_converter("failing")
    assert option_declarations(kind) == (
        OptionDeclaration("how", str, "torn", "What is wrong.", ("torn", "faulty")),
        OptionDeclaration("posed", bool, True),
    )
    assert read_options(kind, {"how": "faulty", "posed": "no"}) == {"how": "faulty", "posed": False}
    for options, message in (
        ({"how": "broken"}, "how: expected one of torn, faulty, found 'broken'"),
        ({"posed": "perhaps"}, "posed: expected true or false, found 'perhaps'"),
        ({"color": "red"}, "options: expected one of how, posed, found color"),
    ):
        with pytest.raises(ArgumentError) as error:
            read_options(kind, options)
        assert str(error.value) == message


def test_options_that_are_declared_badly_are_named():
    class NoDefault(Converter):
        def __init__(self, source, *, count: int):
            super().__init__(source)

    class NoType(Converter):
        def __init__(self, source, *, names: list[str] = ()):
            super().__init__(source)

    with pytest.raises(DependencyError, match="NoDefault: count: expected a default, found none"):
        option_declarations(NoDefault)
    with pytest.raises(
        DependencyError, match="NoType: names: expected an option of the type str, int, float, bool"
    ):
        option_declarations(NoType)


def test_a_converter_that_does_not_load_is_named(installed):
    with pytest.raises(
        DependencyError, match=r"converter broken \(lab_converter:Nothing\): cannot be loaded"
    ):
        load_converter("broken")
    with pytest.raises(
        DependencyError, match=r"expected a class that inherits carlasc.converting.Converter"
    ):
        load_converter("wrong")


def test_what_a_converter_lacks_is_an_argument_error(installed, tmp_path):
    with pytest.raises(MissingDataError, match="lab: expected voxel grids, found none"):
        convert("lab", installed, tmp_path / "out", poses=PoseOptions(force=True), grids="voxels")
    with pytest.raises(
        ArgumentError, match="options: expected no options for this data set, found color"
    ):
        convert("lab", installed, tmp_path / "out", options={"color": "red"})


def test_a_source_that_does_not_exist_is_named(tmp_path):
    for name in ("synthcity", "kitti-raw"):
        with pytest.raises(
            MissingDataError, match="typo: expected a folder, found nothing: check the path"
        ):
            convert(name, tmp_path / "typo", tmp_path / "out")


def test_semanticposs_has_its_own_classes_and_poses_of_the_lidar(tmp_path):
    folder = write_tiny_kitti(tmp_path / "in", "02", frames=2, points=5)
    for frame in range(2):
        write_labels(folder, frame, np.array([4, 7 | 3 << 16, 22, 15, 0], np.uint32))
    (folder / "calib.txt").unlink()
    np.savetxt(folder / "poses.txt", np.stack([np.eye(4), np.eye(4)])[:, :3].reshape(2, 12))
    result = convert("poss", tmp_path / "in", tmp_path / "out", **PLAIN)
    assert result.made == 2
    sequence = carlasc.open(tmp_path / "out").sequences()["Val/POSS_02/cartesian"]
    assert sequence.read("labels", 0).tolist() == [4, 10, 14, 1, 0]
    assert sequence.read("instances", 0).tolist() == [0, 7 << 16 | 3, 0, 0, 0]
    assert "40 channels" in sequence.metadata.sensor


def test_actors_of_semanticposs_that_go_nowhere_have_no_flow(tmp_path):
    """Its classes do not say what moves: every numbered actor is followed."""
    folder = write_tiny_kitti(tmp_path / "in", frames=20, points=400)
    rng = np.random.default_rng(0)
    box = rng.uniform(0, 1, (200, 3)) * (4, 1.8, 1.5)
    for frame in range(20):
        walls = np.concatenate([box + (10 + 0.8 * frame, 3, -1.7), box + (10, -6, -1.7)])
        walls = walls + rng.uniform(-0.02, 0.02, walls.shape)
        np.column_stack([walls, np.zeros(400)]).astype("<f4").tofile(
            folder / "velodyne" / f"{frame:06d}.bin"
        )
        write_labels(folder, frame, np.repeat([7 | 1 << 16, 7 | 2 << 16], 200))
    np.savetxt(folder / "poses.txt", np.tile(np.eye(4)[:3].ravel(), (20, 1)))
    (folder / "calib.txt").unlink()
    convert(
        "poss",
        tmp_path / "in",
        tmp_path / "out",
        poses=PoseOptions(force=True),
        grids=None,
        run=Run(workers=1),
    )
    flow = carlasc.open(tmp_path / "out").sequences()["Train/POSS_00/cartesian"].read("flow", 10)
    assert np.abs(flow[:200] - [8, 0, 0]).max() < 0.3
    assert not flow[200:].any()


class Kept(SequenceWriter):
    """A store that cannot be written to from workers."""

    location = "memory"

    def __init__(self):
        self.fields, self.texts = {}, {}

    def has(self, field, frame):
        return (field, frame) in self.fields

    def write(self, field, frame, array):
        self.fields[field, frame] = array

    def write_document(self, name, data):
        self.texts[name] = data

    def read_document(self, name):
        return self.texts.get(name)


class Memory(Sink):
    location = "memory"

    def __init__(self):
        self.writers = {}

    def sequence(self, path):
        return self.writers.setdefault(path, Kept())


def test_any_sink_will_do(tmp_path):
    write_tiny_kitti(tmp_path / "in")
    sink = Memory()
    convert("kitti", tmp_path / "in", sink, grids=None, run=Run(workers=2))
    kept = sink.writers["Train/KITTI_00/cartesian"]
    assert {(name, frame) for name, frame in kept.fields} == {
        (name, frame) for name in ("points", "labels", "flow", "instances") for frame in range(3)
    }
    texts = {"poses.txt", "times.txt", "carlasc.json", "cameras.json", ".carlasc/conversion.json"}
    assert set(kept.texts) == texts
    with pytest.raises(ArgumentError, match="convert to a folder or a .zarr store"):
        convert("kitti", tmp_path / "in", sink)


def files_of(root):
    return {
        path.relative_to(root): path.read_bytes()
        for path in sorted(Path(root).rglob("*"))
        if path.is_file()
    }


@pytest.mark.parametrize("name", ["SIGINT", "SIGKILL"])
def test_an_interrupted_run_leaves_whole_files_and_the_next_one_goes_on(tmp_path, name):
    write_tiny_kitti(tmp_path / "in", frames=60)
    convert("kitti", tmp_path / "in", tmp_path / "whole", grids=None, run=Run(workers=1))
    arguments = [
        "kitti",
        str(tmp_path / "in"),
        str(tmp_path / "out"),
        "--grids",
        "none",
        "--workers",
        "1",
    ]
    helper = Path(__file__).parents[1] / "helpers" / "processes" / "interrupted.py"
    done = subprocess.run(
        [sys.executable, helper, name, "100", "convert", *arguments],
        start_new_session=True,
        capture_output=True,
        timeout=120,
        check=False,
        env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"},
    )
    assert done.returncode == (130 if name == "SIGINT" else -signal.SIGKILL)
    there = files_of(tmp_path / "out")
    expected = files_of(tmp_path / "whole")
    assert 0 < len(there) < len(expected)
    assert all(expected[path] == data for path, data in there.items() if path.suffix != ".part")
    result = convert("kitti", tmp_path / "in", tmp_path / "out", grids=None, run=Run(workers=1))
    assert result.skipped > 0
    assert files_of(tmp_path / "out") == expected
