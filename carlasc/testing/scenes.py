"""Small simulated recordings of carriers other than a car: indoors, on foot, in the air, and with
LiDARs that are mounted otherwise.

`scenes.json` holds them. Each has the `mount` of the LiDAR (height in metres, roll and pitch in
degrees) and may have `things` and parts of the `body` (kind, center, size, heading, speed: see
`Thing`), and the `way` of the carrier: x, y, z in metres and roll, pitch, yaw in radians, each as a
value at the start, its change per second, and the amplitude, the radians per second and the phase
of a sine.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np

from carlasc.converting.protocol import Sensor
from carlasc.core.arrays import FloatArray
from carlasc.core.geometry import poses_from, quaternions_of, relative_to
from carlasc.testing.drives import SimulatedDrive, read_things, world_T_sensor

_START_S = 1_700_000_000.0  # time of the first scan, since 1970


def _poses(values: FloatArray) -> FloatArray:
    """Return (..., 4, 4) poses of (..., 6) x, y, z in metres, and roll, pitch (nose down) and yaw
    in radians.
    """
    half = np.moveaxis(values[..., 3:], -1, 0).reshape(3, -1) / 2
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    quaternions = [
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ]
    poses = poses_from(np.stack(quaternions, axis=1), values[..., :3].reshape(-1, 3))
    return poses.reshape(*values.shape[:-1], 4, 4)


def _along(way: Mapping[str, Sequence[float]], at: FloatArray) -> FloatArray:
    """Return the (..., 4, 4) poses on a way at some times."""
    rows = [way.get(name, [0.0] * 5) for name in ("x", "y", "z", "roll", "pitch", "yaw")]
    start, speed, amplitude, rate, phase = np.array(rows).T
    line = start + speed * at[..., None]
    line[..., 2] = line[..., 2].clip(0.0)  # stairs begin on the ground
    return _poses(line + amplitude * np.sin(rate * at[..., None] + phase))


def _scene(told: Mapping[str, Any]) -> SimulatedDrive:
    """Return a drive with one LiDAR; without things, along the street."""
    height_m, roll, pitch = told["mount"]
    mount = _poses(np.array([0.0, 0.0, height_m, *np.deg2rad([roll, pitch, 0.0])]))
    return SimulatedDrive(
        frames=40,
        sensors=(Sensor("lidar", mount),),
        rolling=True,
        clockwise=True,
        things=read_things(told["things"]) if "things" in told else SimulatedDrive().things,
        channels=32,
        columns=360,
        elevation_deg=tuple(told.get("elevation_deg", (-22.5, 22.5))),
        range_m=told.get("range_m", 60.0),
        noise_m=0.01,
        body=read_things(told.get("body", ())),
        way=partial(_along, told["way"]) if "way" in told else None,
    )


SCENES: Final = {
    name: _scene(told)
    for name, told in json.loads(
        files(__package__).joinpath("scenes.json").read_text("utf-8")
    ).items()
}
"""Recordings of 4 s with one LiDAR, by name.

In the room of 8 x 5 m, the stairwell and on the square, all directions are determined. Along the
corridor, no surface within range determines the position. `dataclasses.replace(scene, things=())`
leaves the ground alone.
"""


def write_scans(drive: SimulatedDrive, folder: Path) -> FloatArray:
    """Write a drive as `carlasc convert scans` reads it.

    `folder/scans` gets a .npy file for each scan, named after its time, with x, y, z, intensity and
    the time t of each point; `folder/poses.txt` the true poses of the sensor in the format of TUM.

    Returns:
        (F, 4, 4) first_T_sensor, the true poses.
    """
    (folder / "scans").mkdir(parents=True)
    poses = np.stack([world_T_sensor(drive, frame) for frame in range(drive.frames)])
    times = drive.times + _START_S
    for frame, seconds in enumerate(times):
        scan = drive.scan(frame)
        order = np.argsort(scan.seconds, kind="stable")
        table = np.column_stack([scan.points, scan.seconds])[order].astype(np.float32)
        rows = table.view([(name, "<f4") for name in ("x", "y", "z", "intensity", "t")])
        np.save(folder / "scans" / f"{seconds:.9f}.npy", rows[:, 0])
    turns = quaternions_of(poses[:, :3, :3])[:, [1, 2, 3, 0]]
    np.savetxt(folder / "poses.txt", np.column_stack([times, poses[:, :3, 3], turns]), fmt="%.9f")
    return relative_to(poses[0], poses)
