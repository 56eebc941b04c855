"""Small simulated recordings of carriers other than a car: indoors, on foot, in the air, and with
LiDARs that are mounted otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from carlasc.converting.protocol import Sensor
from carlasc.core.arrays import FloatArray
from carlasc.core.geometry import poses_from, quaternions_of, relative_to
from carlasc.testing.drives import SimulatedDrive, Thing, world_T_sensor

_START_S = 1_700_000_000.0  # time of the first scan, since 1970
_WALL_M = 0.2
_STEP_M, _RISE_M, _STEPS = 0.28, 0.17, 10  # of a flight of stairs


def _poses(x: ArrayLike, y: ArrayLike, z: ArrayLike, angles_rad: Sequence[ArrayLike]) -> FloatArray:
    """Return (..., 4, 4) poses at positions in metres, with the angles roll, pitch (nose down) and
    yaw.
    """
    x, y, z, *angles = np.broadcast_arrays(x, y, z, *angles_rad)
    half = np.stack(angles).reshape(3, -1) / 2
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    quaternions = [
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ]
    places = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    return poses_from(np.stack(quaternions, axis=1), places).reshape(*x.shape, 4, 4)


def _in_room(at: FloatArray) -> FloatArray:
    """A cart on a curve at 0.5 m/s."""
    turn = 0.35 * at
    return _poses(-2.0 + np.sin(turn) / 0.7, 0.8 - np.cos(turn) / 0.7, 0.0, (0, 0, turn))


def _along_corridor(at: FloatArray) -> FloatArray:
    """A cart at 0.8 m/s."""
    return _poses(-6.0 + 0.8 * at, 0.1 * np.sin(0.8 * at), 0.0, (0, 0, 0.1 * np.cos(0.8 * at)))


def _upstairs(at: FloatArray) -> FloatArray:
    """A person who climbs the stairs, and turns on the landing."""
    x = -0.6 + 0.6 * at
    climb = np.clip(x, 0.0, _STEP_M * _STEPS) * _RISE_M / _STEP_M
    sway = 0.02 * np.sin(2 * np.pi * 1.6 * at)
    return _poses(x, sway, climb + sway / 2, (sway, 0.05 + sway, 0.3 * np.sin(0.7 * at)))


def _on_legs(at: FloatArray) -> FloatArray:
    """A robot that walks at about 1 m/s."""
    gait = np.sin(2 * np.pi * 1.5 * at)
    x = 1.0 * at + 0.15 * np.sin(1.1 * at)
    yaw = 0.12 * np.sin(0.8 * at)
    return _poses(x, 0.2 * np.sin(0.6 * at), 0.01 * gait, (0.015 * gait, 0.02 * gait, yaw))


def _in_the_air(at: FloatArray) -> FloatArray:
    """A drone at 15 m above the ground and 4 m/s."""
    z = 15.0 + 0.3 * np.sin(0.5 * at)
    roll, pitch = 0.03 * np.sin(1.3 * at), 0.06 + 0.02 * np.sin(at)
    return _poses(4.0 * at - 8.0, np.sin(0.4 * at), z, (roll, pitch, 0.1 * np.sin(0.5 * at)))


def _hall(x_m: float, y_m: float, z_m: float) -> tuple[Thing, ...]:
    """Return walls and a ceiling about the origin, of a hall of this size."""
    x, y, wall = x_m / 2 + _WALL_M / 2, y_m / 2 + _WALL_M / 2, _WALL_M
    return (
        *(Thing("building", (side * x, 0.0, z_m / 2), (wall, y_m, z_m)) for side in (-1, 1)),
        *(Thing("building", (0.0, side * y, z_m / 2), (x_m, wall, z_m)) for side in (-1, 1)),
        Thing("building", (0.0, 0.0, z_m + wall / 2), (x_m + wall, y_m + wall, wall)),
    )


_ROOM = (
    *_hall(8.0, 5.0, 2.6),
    Thing("building", (2.2, 1.2, 0.72), (1.6, 0.8, 0.06)),  # a table, and its legs
    *(
        Thing("building", (2.2 + x, 1.2 + y, 0.35), (0.08, 0.08, 0.7))
        for x in (-0.7, 0.7)
        for y in (-0.3, 0.3)
    ),
    Thing("building", (-3.6, -1.5, 1.0), (0.6, 1.2, 2.0)),  # cupboards
    Thing("building", (3.5, -2.1, 0.6), (0.8, 0.5, 1.2), 0.3),
    Thing("building", (-1.0, 2.2, 0.45), (0.5, 0.5, 0.9), 0.5),
)
_STAIRS = (
    *(
        Thing(
            "building",
            ((n + 0.5) * _STEP_M, 0.0, (n + 1) * _RISE_M / 2),
            (_STEP_M, 1.3, (n + 1) * _RISE_M),
        )
        for n in range(_STEPS)
    ),
    Thing("building", (3.5, 0.7, 0.85), (1.4, 2.7, 1.7)),  # the landing
    *(
        Thing(
            "building",
            ((n + 0.5) * _STEP_M, 1.4, 1.7 + (_STEPS - n) * _RISE_M - 0.1),
            (_STEP_M, 1.3, 0.2),
        )
        for n in range(_STEPS)
    ),
    Thing("building", (1.4, 0.7, 2.2), (2.6, 0.06, 1.8)),  # between the flights
    Thing("building", (1.3, -0.75, 2.5), (6.0, _WALL_M, 5.0)),
    Thing("building", (1.3, 2.15, 2.5), (6.0, _WALL_M, 5.0)),
    Thing("building", (-1.7, 0.7, 2.5), (_WALL_M, 2.9, 5.0)),
    Thing("building", (4.3, 0.7, 2.5), (_WALL_M, 2.9, 5.0)),
    Thing("building", (1.3, 0.7, 5.1), (6.2, 3.1, _WALL_M)),
)
_SQUARE = (
    Thing("building", (24.0, 2.0, 4.0), (6.0, 18.0, 8.0), 0.1),
    Thing("building", (2.0, 15.0, 4.0), (14.0, 6.0, 8.0), -0.1),
    Thing("building", (0.0, -13.0, 3.0), (20.0, 5.0, 6.0), 0.05),
    Thing("building", (-16.0, 0.0, 3.0), (4.0, 12.0, 6.0), 0.2),
    *(
        Thing("vegetation", (x, 6.0 - 0.3 * x, 2.0), (0.4, 0.4, 4.0))
        for x in (-6.0, 0.0, 6.0, 12.0)
    ),
    *(Thing("building", (x, -4.0, 0.25), (1.6, 0.5, 0.5), 0.2) for x in (-3.0, 5.0, 11.0)),
    Thing("pole", (8.0, 3.0, 2.0), (0.15, 0.15, 4.0)),
    Thing("pedestrian", (0.6, 1.4, 0.88), (0.5, 0.5, 1.75), 0.0, 1.05),  # beside the robot
    Thing("pedestrian", (-2.0, -1.3, 0.85), (0.5, 0.5, 1.7), 0.05, 1.3),  # overtakes it
    Thing("pedestrian", (14.0, 1.8, 0.85), (0.5, 0.5, 1.7), np.pi, 1.2),  # comes towards it
)
_FIELD = (
    *(Thing("vegetation", (x, (7.0 * x) % 31.0 - 15.0, 2.0), (1.5, 1.5, 4.0), 0.1 * x)
      for x in range(-24, 40, 5)),
    Thing("building", (6.0, 7.0, 2.5), (9.0, 6.0, 5.0), 0.3),
    Thing("building", (-9.0, -8.0, 2.0), (7.0, 5.0, 4.0), -0.2),
    Thing("car", (12.0, -5.0, 0.75), (4.4, 1.8, 1.5), 0.4),
)  # fmt: skip
_CART = tuple(Thing("car", (-0.35, side * 0.25, 0.6), (0.1, 0.1, 1.2)) for side in (-1, 1))
_ROBOT = (
    Thing("car", (-0.35, 0.0, 0.36), (0.5, 0.3, 0.16)),
    Thing("car", (-0.5, 0.0, 0.55), (0.1, 0.2, 0.3)),
)
_PERSON = (Thing("car", (-0.4, 0.0, 0.7), (0.3, 0.5, 1.5)),)


def _scene(
    things: tuple[Thing, ...],
    way: Callable[[FloatArray], FloatArray] | None,
    height_m: float,
    body: tuple[Thing, ...] = (),
    *,
    turned_rad: tuple[float, float] = (0.0, 0.0),
    elevation_deg: tuple[float, float] = (-22.5, 22.5),
    range_m: float = 60.0,
) -> SimulatedDrive:
    """Return a drive with one LiDAR, turned by roll and pitch."""
    return SimulatedDrive(
        frames=40,
        sensors=(Sensor("lidar", _poses(0.0, 0.0, height_m, (*turned_rad, 0.0))),),
        rolling=True,
        clockwise=True,
        things=things,
        channels=32,
        columns=360,
        elevation_deg=elevation_deg,
        range_m=range_m,
        noise_m=0.01,
        body=body,
        way=way,
    )


_DRIVE = SimulatedDrive()
SCENES: Final = {
    "room": _scene(_ROOM, _in_room, 1.0, _CART),
    "corridor": _scene(_hall(90.0, 2.0, 2.6), _along_corridor, 1.0, _CART, range_m=20.0),
    "stairwell": _scene(_STAIRS, _upstairs, 1.5, _PERSON),
    "walking-robot": _scene(_SQUARE, _on_legs, 0.5, _ROBOT),
    "drone": _scene(_FIELD, _in_the_air, 0.0, elevation_deg=(-88.0, -40.0)),
    "upside-down": _scene(_DRIVE.things, None, 1.8, turned_rad=(np.pi, 0.0)),
    "pitched": _scene(_DRIVE.things, None, 1.8, turned_rad=(0.0, np.deg2rad(20.0))),
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
    lines = []
    for frame, seconds in enumerate(drive.times + _START_S):
        scan = drive.scan(frame)
        order = np.argsort(scan.seconds, kind="stable")
        table = np.column_stack([scan.points, scan.seconds])[order].astype(np.float32)
        rows = table.view([(name, "<f4") for name in ("x", "y", "z", "intensity", "t")])
        np.save(folder / "scans" / f"{seconds:.9f}.npy", rows[:, 0])
        w, *xyz = quaternions_of(poses[frame : frame + 1, :3, :3])[0]
        numbers = seconds, *poses[frame, :3, 3], *xyz, w
        lines.append(" ".join(f"{number:.9f}" for number in numbers))
    (folder / "poses.txt").write_text("\n".join(lines) + "\n", "utf-8")
    return relative_to(poses[0], poses)
