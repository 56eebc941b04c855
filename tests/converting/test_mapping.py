"""`carlasc map` of recordings: they are converted into a hidden folder, and mapped from there."""

import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from helpers.converters.bags import START_NS, Messages, drive_messages, write_bag
from helpers.errors import raises

import carlasc
from carlasc import RecordingOptions, Run
from carlasc.converting import mapping
from carlasc.errors import (
    ArgumentError,
    CompleteError,
    ConflictError,
    DependencyError,
    FormatError,
    MissingDataError,
)
from carlasc.motion import MotionOptions, PoseOptions
from carlasc.testing import SCENES, SimulatedDrive
from carlasc.testing.scenes import write_scans

DRIVE = replace(SCENES["walking-robot"], frames=5, channels=8, columns=90)
GIVEN = {
    "cell_m": 0.2,
    "motion": MotionOptions("none"),
    "poses": PoseOptions("file", "never", force=True),  # so few points hardly overlap
    "run": Run(workers=1),
}


pytest.importorskip("rosbags", reason="needs carlasc[bags]")


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording")
    write_scans(DRIVE, folder)
    return folder


def make(recording, out, **options):
    of_scans = {"options": {"pose_file": str(recording / "poses.txt")}, "converter": "scans"}
    read = RecordingOptions(**of_scans, **options)
    return carlasc.map(recording / "scans", out, recording=read, **GIVEN)


def test_the_map_of_a_recording_is_that_of_the_converted_one(recording, tmp_path):
    result = make(recording, tmp_path / "a.ply")
    kept = make(recording, tmp_path / "b.ply", keep=tmp_path / "kept")
    again = carlasc.map(tmp_path / "kept", tmp_path / "c.ply", **GIVEN)
    a, b, c = ((tmp_path / f"{name}.ply").read_bytes() for name in "abc")
    assert a == b == c
    assert result.frames == kept.frames == again.frames == DRIVE.frames
    assert result.points == again.points > 100 and result.failures == ()
    assert [path.name for path in (tmp_path / ".carlasc").iterdir() if path.is_dir()] == []
    assert not any(".carlasc" in note for note in result.notes)
    with pytest.raises(CompleteError):
        make(recording, tmp_path / "a.ply")


def test_an_interrupted_map_goes_on_from_what_was_converted(recording, tmp_path, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(mapping, "write_map", stop)
        with pytest.raises(KeyboardInterrupt):
            make(recording, tmp_path / "a.ply")
    assert not (tmp_path / "a.ply").exists()
    made = []
    convert = mapping.convert
    monkeypatch.setattr(
        mapping,
        "convert",
        lambda *args, **options: made.append(convert(*args, **options)) or made[-1],
    )
    make(recording, tmp_path / "a.ply")
    assert (made[0].made, made[0].skipped) == (0, DRIVE.frames)
    make(recording, tmp_path / "b.ply")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_a_bad_scan_is_named_and_the_others_are_mapped(recording, tmp_path):
    copy = tmp_path / "scans"
    copy.mkdir()
    for place, path in enumerate(sorted((recording / "scans").iterdir())):
        data = path.read_bytes()
        (copy / path.name).write_bytes(data[:200] if place == 3 else data)
    read = RecordingOptions("scans", options={"pose_file": str(recording / "poses.txt")})
    result = carlasc.map(copy, tmp_path / "a.pcd", recording=read, **GIVEN)
    assert result.frames == DRIVE.frames - 1
    assert [failure.frame for failure in result.failures] == [3]


def test_the_reader_of_a_recording_is_found(recording, tmp_path):
    poses = PoseOptions("file", "never")
    with pytest.raises(MissingDataError) as error:  # bare scans, and poses are asked for
        carlasc.map(recording / "scans", tmp_path / "a.ply", poses=poses, run=Run(workers=1))
    assert "poses" in str(error.value)


@pytest.mark.parametrize("kind", ["empty", "file", "missing"])
def test_places_that_nothing_can_read_are_refused(tmp_path, kind):
    place = tmp_path / "place"
    if kind == "empty":
        place.mkdir()
    elif kind == "file":
        place.write_text("no bag")
    with pytest.raises((MissingDataError, FormatError, DependencyError)) as error:
        carlasc.map(place, tmp_path / "a.ply", **GIVEN)
    assert str(place) in str(error.value)
    assert not (tmp_path / ".carlasc").exists()


def test_bags_without_one_lidar_say_so_although_they_are_folders(tmp_path):
    store = Messages("mcap")
    for name, count in (("none", 0), ("two", 2)):
        (tmp_path / name).mkdir()
        points = np.zeros(9, [(axis, np.float32) for axis in "xyz"])
        clouds = [store.cloud(f"/{number}", START_NS, points) for number in range(count)]
        write_bag(tmp_path / name, "mcap", clouds or [store.imu("/imu", START_NS)], store=store)
    with raises(MissingDataError, where="drive.mcap", found="/imu"):
        carlasc.map(tmp_path / "none" / "drive", tmp_path / "a.ply", **GIVEN)
    with raises(ArgumentError, where="topics", advice='`converter="bag"`'):
        carlasc.map(tmp_path / "two" / "drive", tmp_path / "a.ply", **GIVEN)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["none", "two"]


def test_scans_without_points_or_without_overlap_are_one_line_that_names_them(recording, tmp_path):
    (tmp_path / "empty").mkdir()
    for number in range(DRIVE.frames):
        np.save(tmp_path / "empty" / f"{number}.npy", np.full((50, 3), np.nan, np.float32))
    given = RecordingOptions("scans", options={"pose_file": str(recording / "poses.txt")})
    with raises(MissingDataError, where=str(tmp_path / "empty"), found="none of 5"):
        carlasc.map(tmp_path / "empty", tmp_path / "a.ply", recording=given, **GIVEN)
    assert not list(tmp_path.glob(".carlasc/recording*"))
    poses = np.loadtxt(recording / "poses.txt")
    poses[:, 1] += 100 * np.arange(len(poses))
    np.savetxt(tmp_path / "other.txt", poses)
    read = RecordingOptions("scans", options={"pose_file": str(tmp_path / "other.txt")})
    checked = GIVEN | {"poses": PoseOptions("file", "never")}
    with raises(FormatError, where=str(recording / "scans")):
        carlasc.map(recording / "scans", tmp_path / "a.ply", recording=read, **checked)
    assert not (tmp_path / "a.ply").exists()


def test_what_would_be_read_again_is_refused(recording, tmp_path):
    with pytest.raises(ConflictError):
        make(recording, recording / "scans" / "clean.pcd")
    store = Messages("mcap")
    for name in "ab":
        (tmp_path / "two" / name).mkdir(parents=True)
        messages = drive_messages(store, SimulatedDrive(2, channels=4, columns=20), "odometry")
        write_bag(tmp_path / "two" / name, "mcap", messages, store=store)
    with raises(ArgumentError, where="source", found="2 "):
        carlasc.map(tmp_path / "two", tmp_path / "a.ply", **GIVEN)
    make(recording, tmp_path / "b.ply", keep=tmp_path / "kept")
    with raises(ArgumentError, where="keep"):
        other = RecordingOptions(keep=tmp_path / "other")
        carlasc.map(tmp_path / "kept", tmp_path / "a.ply", recording=other, **GIVEN)


ENDS_ITSELF = """
import fnmatch, os, signal, sys
from carlasc.cli import main
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored below a shell's job
pattern, number, ending, *sys.argv[1:] = sys.argv[1:]
left = int(number)

def look(event, args):
    global left
    name = {"os.rename": 1, "os.mkdir": 0}.get(event)
    if name is not None and fnmatch.fnmatch(os.fspath(args[name]), pattern):
        left -= 1
        if not left:
            os.kill(os.getpid(), int(ending))

sys.addaudithook(look)
main()
"""
"""Runs `carlasc`, which ends itself when it names or makes a file of a pattern the n-th time."""


@pytest.mark.slow
@pytest.mark.parametrize("is_recording", [True, False])
def test_a_map_that_is_killed_goes_on_from_what_it_kept(recording, tmp_path, is_recording):
    """The moments are those at which files appear: the third scan, the actors when poses are kept,
    and the map when both are.
    """
    call = ["map", str(recording / "scans"), "--converter", "scans", "--force", "--workers", "1"]
    call += ["--pose-file", str(recording / "poses.txt")]
    if not is_recording:
        make(recording, tmp_path / "other.ply", keep=tmp_path / "kept")
        call = ["map", str(tmp_path / "kept"), "--force", "--workers", "1"]
    kept, found = tmp_path / ".carlasc" / "recording-a.ply", dict[str, int]()
    for pattern, number, ending, names in (
        *((("*/recording-a.ply/*.bin", "3", signal.SIGINT, []),) if is_recording else ()),
        ("*/tracks-*.npz", "1", signal.SIGKILL, ["poses"]),
        ("*a.ply", "1", signal.SIGKILL, ["poses", "tracks"]),
    ):
        began = [sys.executable, "-c", ENDS_ITSELF, pattern, number, str(int(ending)), *call]
        run = subprocess.run([*began, "a.ply"], cwd=tmp_path, capture_output=True, check=False)
        said = run.stderr.decode()
        assert run.returncode == (130 if ending == signal.SIGINT else -ending), said
        assert not (tmp_path / "a.ply").exists() and any(kept.rglob("*.bin")) == is_recording
        assert ending != signal.SIGINT or "same command" in said, said
        now = {path.name: path.stat().st_ino for path in kept.rglob(".carlasc/*.npz")}
        assert sorted(name.partition("-")[0] for name in now) == names
        assert found.items() <= now.items()  # what was kept was not made again
        found = now
    call = [sys.executable, "-m", "carlasc", *call]
    for name in ("a.ply", "b.ply"):
        subprocess.run([*call, name], cwd=tmp_path, check=True)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert [path.name for path in tmp_path.glob(".*")] == [".carlasc"]
    assert not [path for path in (tmp_path / ".carlasc").iterdir() if path.is_dir()]
