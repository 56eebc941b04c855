"""What a scan, a mount, poses and a motion can be: wrong recordings are corrected, refused, or get
a warning that their record keeps.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from carlasc_converters.calibration_file import axes_named
from helpers.converters.drive_converter import DriveConverter
from helpers.errors import raises
from typer.testing import CliRunner

import carlasc
from carlasc.cli import app
from carlasc.converting import Cloud, LayoutOptions, Trajectory, convert, preview
from carlasc.converting.plausibility import (
    are_posed,
    check_mount,
    check_scan,
    check_standing,
    find_mount,
)
from carlasc.core import translation
from carlasc.core.geometry import invert, transform_points
from carlasc.core.scans import ScanCentres
from carlasc.errors import ArgumentError, FormatError
from carlasc.motion import PoseOptions
from carlasc.running import Run
from carlasc.testing import SCENES, SimulatedDrive

ALONE = Run(workers=1)
DRIVE = SimulatedDrive(8, channels=24, columns=180)
MOUNT = DRIVE.sensors[0].vehicle_T_sensor


def turned(roll=0.0, pitch=0.0):
    (cr, cp), (sr, sp) = (f(np.deg2rad([roll, pitch])) for f in (np.cos, np.sin))
    turn = np.eye(4)
    turn[:3, :3] = [[cp, sr * sp, cr * sp], [0, cr, -sr], [-sp, sr * cp, cr * cp]]
    return turn


def scans(turn=None, drive=DRIVE):
    points = [drive.scan(frame).points[:, :3] for frame in (0, 3, 7)]
    return points if turn is None else [transform_points(invert(turn), own) for own in points]


@pytest.mark.parametrize(
    ("roll", "pitch", "up", "severity"),
    [
        (0, 0, "+z", None), (2, 3, "+z", None), (0, 8, "+z", "warning"), (-10, 0, "+z", "warning"),
        (0, 20, "+z", "error"), (-25, 0, "+z", "error"), (180, 0, "-z", "error"),
        (180, 20, "-z", "error"), (5, 180, "-z", "error"),
    ],
)  # fmt: skip
def test_the_mount_is_found_from_the_ground(roll, pitch, up, severity):
    turn = turned(roll, pitch)
    mount = find_mount(scans(turn))
    found = [one.severity for one in check_mount(mount, "drive", force=False)]
    assert (mount.up, found) == (up, [severity] if severity else [])
    assert abs(mount.height_m - MOUNT[2, 3]) < 0.1
    level = (mount.level_T_scan @ invert(turn))[2, :3]  # z of the drive
    np.testing.assert_allclose(level, [0, 0, 1], atol=0.02 if severity else 0.1)
    accepted = [one.severity for one in check_mount(mount, "drive", force=True)]
    assert accepted == (["warning"] if severity else [])


@pytest.mark.parametrize("axes", ["flu", "frd", "rdf", "rub", "ulb", "dlf"])
def test_axes_are_proposed(axes):
    mount = find_mount(scans(axes_named(axes)))
    assert mount.axes == axes
    np.testing.assert_allclose(mount.level_T_scan, axes_named(axes), atol=0.02)


QUICK = ("room", "upside-down")


@pytest.mark.parametrize(
    "name",
    [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in SCENES if name not in QUICK)],
)
def test_only_lidars_that_are_not_upright_are_called_so(name):
    drive = SCENES[name]
    mount = find_mount([drive.scan(frame).points for frame in (0, 10, 20, 29, 39)])
    wrong = [one.severity for one in check_mount(mount, name, force=False)]
    assert wrong == (["error"] if name in ("upside-down", "pitched") else [])


@pytest.mark.parametrize("offset", [(5e5, 5.4e6, 0), (900, 0, 0), (0, 0, 3000)])
def test_points_that_no_sensor_sees_are_refused(offset):
    points = DRIVE.scan(0).points.copy()
    check_scan(points, DRIVE.scan(0).seconds, "scan")
    points[:, :3] += offset
    with raises(FormatError, where="scan", expected="frame of the sensor", advice="world frame"):
        check_scan(points, None, "scan")


@pytest.mark.parametrize("seconds", [(0, 5), (-4, -3.9), (0, 1.7e9)])
def test_points_are_taken_during_their_scan(seconds):
    with raises(FormatError, where="scan: times", expected="within 3 s"):
        check_scan(DRIVE.scan(0).points, np.linspace(*seconds, len(DRIVE.scan(0).points)), "scan")


def test_scans_far_from_poses_and_in_their_gaps_have_none():
    poses = np.r_[np.arange(10, 20, 0.1), np.arange(25, 30, 0.1)]
    at = np.array([9.0, 9.8, 15.05, 20.5, 24.9, 30.1, 31.0])
    assert are_posed(at, poses).tolist() == [False, True, True, False, True, True, False]
    assert are_posed(np.array([3.0, 15.0]), np.arange(0.0, 20.0, 4.0)).all()  # they are seldom


@pytest.mark.parametrize(
    ("world", "speed", "moves"), [(True, 6.0, True), (False, 6.0, False), (False, 0.0, False)]
)
def test_a_sensor_that_stands_although_its_scans_move_is_refused(world, speed, moves):
    drive, centres = replace(DRIVE, speed=speed, frames=20, channels=8, columns=90), ScanCentres()
    for frame, seconds in enumerate(drive.times):
        points = drive.scan(frame).points[:, :3]
        centres.add(transform_points(drive.world_T_vehicle(seconds), points) if world else points)
    standing = np.tile(np.eye(4), (drive.frames, 1, 1))
    if moves:
        with raises(FormatError, where="drive", found="centres move", advice="force"):
            check_standing(centres, standing, "drive")
        check_standing(centres, drive.world_T_vehicle(drive.times), "drive")
    else:
        check_standing(centres, standing, "drive")


class Mounted(DriveConverter):
    """A LiDAR that hangs upside down, with the poses of the sensor, or of the vehicle."""

    turn, of = turned(180, 10), "sensor"
    drive = DRIVE
    gives = frozenset({"poses", "times"})

    def sequences(self):
        (recording,) = super().sequences()
        turn, own, identity = (
            self.turn,
            recording.poses(),
            [replace(sensor, vehicle_T_sensor=np.eye(4)) for sensor in recording.sensors],
        )
        frame_T_vehicle = invert(MOUNT @ turn) if self.of == "sensor" else invert(MOUNT)
        poses = own.world_T_vehicle @ invert(frame_T_vehicle)
        recording.sensors = identity
        recording.poses = lambda *, force=False: Trajectory(poses, own.seconds)
        for frame in recording.frames:
            frame.read = lambda frame=frame: [
                Cloud(
                    np.hstack([
                        transform_points(invert(turn), DRIVE.scan(frame.number).points[:, :3]),
                        DRIVE.scan(frame.number).points[:, 3:],
                    ]).astype(np.float32)
                )
            ]  # fmt: skip
        return [recording]


class OnVehicle(Mounted):
    of = "vehicle"


def converted(kind, tmp_path, **options):
    (tmp_path / "in").mkdir(exist_ok=True)
    options = {"grids": None, "run": ALONE} | options
    return convert(kind, tmp_path / "in", tmp_path / "out", **options)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Mounted, OnVehicle])
def test_scans_are_turned_upright_where_asked(kind, tmp_path):
    with raises(FormatError, expected="upright", found="up is -z", advice="level=True"):
        converted(kind, tmp_path)
    assert not (tmp_path / "out").exists()
    (tmp_path / "in").mkdir(exist_ok=True)
    (found,) = preview(kind, tmp_path / "in")
    assert (found.up, found.findings[0].severity) == ("-z", "error")
    converted(kind, tmp_path, layout=LayoutOptions(axes="right", level=True))
    (sequence,) = carlasc.open(tmp_path / "out").values()
    points = sequence.read("points", 3)[:, :3]
    np.testing.assert_allclose(points, DRIVE.scan(3).points[:, :3], atol=0.3)
    true = DRIVE.world_T_vehicle(DRIVE.times)
    np.testing.assert_allclose(
        sequence.read_pose(7)[:3, 3], (invert(true[0]) @ true[7])[:3, 3], atol=0.05
    )
    assert "findings" not in sequence.metadata.extra


def test_what_is_accepted_is_in_the_record(tmp_path):
    result = converted(Mounted, tmp_path, poses=PoseOptions(force=True))
    assert [(one.severity, one.check) for one in result.findings] == [("warning", "mount")]
    (sequence,) = carlasc.open(tmp_path / "out").values()
    (kept,) = sequence.metadata.extra["findings"]
    assert (kept["check"], kept["verdict"]) == ("mount", "warning")
    assert "up is -z" in kept["message"]


class Part(DriveConverter):
    """A drive with poses of its middle, one of which jumps."""

    drive = replace(DRIVE, frames=20)
    gives = frozenset({"poses", "times"})

    def sequences(self):
        (recording,) = super().sequences()
        seconds = np.arange(0.6, 1.4, 0.05)
        poses = self.drive.world_T_vehicle(seconds)
        poses[-3:] = translation((5, 0, 0)) @ poses[-3:]
        recording.poses = lambda *, force=False: Trajectory(poses, seconds, "odometry")
        return [recording]


@pytest.mark.slow
def test_scans_without_poses_are_left_out_and_jumps_are_warnings(tmp_path):
    result = converted(Part, tmp_path)
    (sequence,) = carlasc.open(tmp_path / "out").values()
    assert sequence.frames("points").tolist() == list(range(4, 17))
    assert any("7 of 20 scans have no pose" in note and "0 to 3, 17 to 19" in note
               for note in result.notes)  # fmt: skip
    assert [one.check for one in result.findings] == ["pose-jump"]
    assert sequence.metadata.extra["findings"][0]["check"] == "pose-jump"


def test_some_frames_are_converted_and_the_others_later(tmp_path):
    for frames, count in (("2:4", 2), (None, 8)):
        result = converted(Drive, tmp_path, frames=frames)
        (sequence,) = carlasc.open(tmp_path / "out").values()
        assert len(sequence.frames("points")) == count
    assert (result.made, result.skipped) == (6, 2)
    assert any("2 of 8 frames existed" in note for note in result.notes)
    with raises(ArgumentError, where="frames", expected="0 to 7", found="30:40"):
        converted(Drive, tmp_path, frames="30:40")


class Drive(DriveConverter):
    drive = DRIVE
    gives = frozenset({"poses", "times"})


@pytest.mark.slow
def test_the_option_that_is_printed_is_one_of_the_command(tmp_path):
    for frame in range(3):
        (tmp_path / "in").mkdir(exist_ok=True)
        np.save(tmp_path / "in" / f"{frame}.npy", DRIVE.scan(frame).points * [1, -1, -1, 1])
    poses = invert(MOUNT) @ DRIVE.world_T_vehicle(DRIVE.times[:3]) @ MOUNT @ turned(180)
    np.save(tmp_path / "poses.npy", poses)
    command = ["convert", "scans", str(tmp_path / "in"), str(tmp_path / "out"), "--grids", "none"]
    command += ["--pose-file", str(tmp_path / "poses.npy"), "--workers", "1"]
    said = set()
    for more in ([], ["--dry-run"]):
        done = CliRunner().invoke(app, [*command, *more])
        assert done.exit_code == 1
        said.add(next(line for line in done.stderr.splitlines() if "upright" in line))
    (line,) = said
    assert "`--level`" in line
    assert CliRunner().invoke(app, [*command, "--level", "--json"]).exit_code == 0
    as_json = CliRunner().invoke(app, [*command, "--level", "--json"]).stdout
    assert json.loads(as_json)["findings"] == []
