"""Nothing is called sound that was not tested: recordings of many carriers, and their faults."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.errors import raises

import carlasc
from carlasc.core.geometry import relative_to, transform_points
from carlasc.errors import ArgumentError
from carlasc.storage import FolderSink, Metadata, layout
from carlasc.testing import SCENES
from carlasc.testing.drives import world_T_sensor

GRID_CHECKS = ("range", "ground", "poses-on-scans")


def write(folder, scans, poses, **extra):
    with FolderSink(folder).sequence("cartesian") as writer:
        writer.write_document(layout.POSES, layout.encode_poses(relative_to(poses[0], poses)))
        writer.write_document(layout.TIMES, layout.encode_times(0.1 * np.arange(len(poses))))
        writer.write_document(layout.METADATA, Metadata("right", extra=extra).to_json())
        for frame, points in enumerate(scans):
            table = np.column_stack([points[:, :3], np.zeros(len(points))])
            writer.write("points", frame, table.astype(np.float32))
    return folder


def film(name, every=2, **changes):
    drive = replace(SCENES[name], **changes)
    frames = range(0, drive.frames, every)
    return (
        [drive.scan(frame).deskewed[:, :3].copy() for frame in frames],
        np.stack([world_T_sensor(drive, frame) for frame in frames]),
    )


def checks_of(folder, **options):
    result = carlasc.validate(folder, **options)
    return result.verdict, dict(result.sequences[0].checks)


def standing(poses):
    return np.tile(np.eye(4), (len(poses), 1, 1))


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_a_scene_is_sound_only_if_its_ground_and_motion_were_tested(name, tmp_path):
    verdict, checks = checks_of(write(tmp_path, *film(name)))
    expected = {
        "corridor": ("undetermined", {"poses-on-scans": "untested"}),
        "upside-down": ("not sound", {"ground": "wrong"}),
        "pitched": ("not sound", {"ground": "wrong"}),
    }.get(name, ("sound", {}))
    assert (verdict, checks) == (expected[0], dict.fromkeys(GRID_CHECKS, "right") | expected[1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "share"),
    [(name, share) for name in SCENES for share in (0.0, 0.5)],
)
def test_a_motion_that_is_missing_in_the_poses_is_never_sound(name, share, tmp_path):
    scans, poses = film(name)
    short = relative_to(poses[0], poses)
    short[:, :3, 3] *= share
    short[:, :3, :3] = short[:, :3, :3] if share else np.eye(3)
    assert checks_of(write(tmp_path, scans, short))[0] != "sound"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["stairwell", "room"])
@pytest.mark.parametrize(
    "error",
    [np.linspace(0, 0.3, 20), np.where(np.arange(20) % 2, 0.06, -0.06) * (np.arange(20) > 9)],
)
def test_poses_whose_height_drifts_are_never_sound(name, error, tmp_path):
    scans, poses = film(name)
    poses[:, 2, 3] += error
    assert checks_of(write(tmp_path, scans, poses))[1]["poses-on-scans"] == "wrong"


@pytest.mark.slow
def test_few_beams_on_steep_stairs_do_not_determine_the_height(tmp_path):
    scans, poses = film("stairwell", channels=16, elevation_deg=(-8.0, 8.0))
    assert checks_of(write(tmp_path, scans, poses))[1]["poses-on-scans"] != "right"


@pytest.mark.slow
@pytest.mark.parametrize("beams", [(16, 900), (64, 1024)])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_no_motion_along_a_tunnel_is_called_tested(beams, share, tmp_path):
    channels, columns = beams
    things = SCENES["corridor"].things[:2]  # the walls across it
    walls = [replace(SCENES["corridor"].things[2], center=(0, side * 4, 2.5), size=(180, 0.2, 5))
             for side in (-1, 1)]  # fmt: skip
    scans, poses = film(
        "corridor", every=8, things=(*things, *walls), channels=channels, columns=columns
    )
    short = relative_to(poses[0], poses)
    short[:, :3, 3] *= share
    verdict, checks = checks_of(write(tmp_path, scans, short))
    assert (verdict, checks["poses-on-scans"]) == ("undetermined", "untested")


def test_a_corridor_is_undetermined_and_the_record_says_so_if_that_is_accepted(tmp_path):
    scans, poses = film("corridor", every=5)
    folder = write(tmp_path, scans, standing(poses))  # floor and walls overlap all the same
    assert checks_of(folder)[0] == "undetermined"
    accepted = checks_of(folder, accept=["poses-on-scans"])
    assert accepted == ("sound", dict.fromkeys(GRID_CHECKS, "right") | {GRID_CHECKS[2]: "accepted"})
    assert checks_of(folder) == accepted
    (entry,) = json.loads((folder / "cartesian/carlasc.json").read_text())["findings"]
    assert (entry["check"], entry["verdict"]) == ("poses-on-scans", "accepted")
    with raises(ArgumentError, where="accept", found="tunnel"):
        carlasc.validate(folder, accept=["tunnel"])


@pytest.mark.parametrize("name", ["upside-down", "pitched"])
def test_a_sensor_that_is_not_upright_is_told(name, tmp_path):
    result = carlasc.validate(write(tmp_path, *film(name, every=8)))
    (finding,) = [one for one in result.findings if one.check == "ground"]
    assert ("upside down" in finding.found, "20 degrees" in finding.found) == (
        name == "upside-down",
        name == "pitched",
    )
    assert not result.ok


def test_points_far_away_are_told(tmp_path):
    scans, poses = film("walking-robot", every=8)
    far = [np.concatenate([points, [[5200.0, 0, 0]] * 200]) for points in scans]
    assert checks_of(write(tmp_path / "far", far, poses))[1]["range"] == "wrong"


@pytest.mark.parametrize(
    "name",
    [
        "room",
        *(pytest.param(name, marks=pytest.mark.slow) for name in SCENES if name != "room"),
    ],
)
def test_scans_in_the_frame_of_the_world_are_told(name, tmp_path):
    scans, poses = film(name, every=5)
    moved = [
        transform_points(pose, points.astype(np.float64))
        for pose, points in zip(relative_to(poses[0], poses), scans, strict=True)
    ]
    result = carlasc.validate(write(tmp_path, moved, standing(poses)))
    assert (result.verdict, result.sequences[0].checks["range"]) == ("not sound", "wrong")
    assert any("while the poses stand" in finding.found for finding in result.findings)


def test_warnings_of_the_converter_keep_data_from_being_sound_until_they_are_accepted(tmp_path):
    entry = {"check": "mount", "verdict": "warning", "message": "tilted by 6 degrees"}
    folder = write(tmp_path, *film("walking-robot", every=8), findings=[entry])
    assert checks_of(folder)[0] == "not sound"
    assert checks_of(folder, accept=["mount"])[1]["mount"] == "accepted"
    assert checks_of(folder)[0] == "sound"
