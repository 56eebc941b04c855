"""What a conversion would do, before it does it."""

import json

import numpy as np
import pytest
from helpers.converters.scan_writers import write_scan
from typer.testing import CliRunner

from carlasc.cli import app
from carlasc.converting import preview
from carlasc.errors import FormatError
from carlasc.motion import PoseOptions
from carlasc.testing import SimulatedDrive

DRIVE = SimulatedDrive(3, channels=16, columns=120)


def write(folder, order="xyz"):
    for frame in range(DRIVE.frames):
        points = DRIVE.scan(frame).points
        write_scan(
            folder / f"{frame}.npy",
            {name: points[:, "xyz".index(axis)] for name, axis in zip("xyz", order, strict=True)},
        )


def test_frames_bounds_height_and_poses_are_found(tmp_path):
    write(tmp_path / "in")
    np.savetxt(tmp_path / "times.txt", DRIVE.times)
    (found,) = preview("scans", tmp_path / "in", options={"time_file": str(tmp_path / "times.txt")})
    points = DRIVE.scan(0).points
    assert (found.frames, found.rate_hz, found.points, found.poses) == (
        3,
        10.0,
        len(points),
        "kiss-icp",
    )
    np.testing.assert_allclose(found.lower, points[:, :3].min(axis=0), atol=0.01)
    assert found.up == "+z"
    assert abs(found.height_m - DRIVE.sensors[0].vehicle_T_sensor[2, 3] - DRIVE.axle_m) < 0.1


def test_axes_with_y_up_are_noticed(tmp_path):
    write(tmp_path / "in", "yzx")
    assert preview("scans", tmp_path / "in")[0].up == "+y"


def test_poses_are_those_that_a_conversion_would_take(tmp_path):
    write(tmp_path / "in")
    np.save(tmp_path / "poses.npy", np.tile(np.eye(4), (2, 1, 1)))
    options = {"pose_file": str(tmp_path / "poses.npy")}
    with pytest.raises(FormatError, match="expected a pose for each of 3 scans, found 2 poses"):
        preview("scans", tmp_path / "in", options=options)
    assert (
        preview("scans", tmp_path / "in", poses=PoseOptions("kiss-icp"), options=options)[0].poses
        == "kiss-icp"
    )
    np.save(tmp_path / "poses.npy", np.tile(np.eye(4), (3, 1, 1)))
    assert preview("scans", tmp_path / "in", options=options)[0].poses == "file"


def test_the_command_writes_nothing(tmp_path):
    write(tmp_path / "in")
    done = CliRunner().invoke(
        app, ["convert", "scans", str(tmp_path / "in"), str(tmp_path / "out"), "--dry-run"]
    )
    assert done.exit_code == 0
    assert "3 scans, no times, of lidar" in done.stdout
    assert done.stdout.rstrip().endswith("nothing was written")
    as_json = CliRunner().invoke(
        app,
        ["convert", "scans", str(tmp_path / "in"), str(tmp_path / "out"), "--dry-run", "--json"],
    )
    assert json.loads(as_json.stdout)[0]["frames"] == 3
    assert not (tmp_path / "out").exists()
