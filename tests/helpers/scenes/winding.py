"""A drive that turns left and right, faster and slower, between houses: it shows where the sensor
is, and whether poses are late.
"""

from __future__ import annotations

import numpy as np

from carlasc.core.geometry import invert
from carlasc.testing.drives import SimulatedDrive, Thing


class Winding(SimulatedDrive):
    """A drive that turns left and right, faster and slower, with a curvature of at most 1/15 m."""

    bends = True

    def world_T_vehicle(self, seconds):
        at = np.asarray(seconds, np.float64)
        fine = np.linspace(-1.0, 5.0, 6001)
        speed = self.speed * (1 + 0.4 * np.sin(2.0 * fine))
        yaw = np.cumsum(speed * np.sin(1.5 * fine)) * 0.001 / 15.0 * self.bends
        x, y = np.cumsum(speed * np.cos(yaw)) * 0.001, np.cumsum(speed * np.sin(yaw)) * 0.001
        now = np.interp(at, fine, yaw)
        poses = np.tile(np.eye(4), (*at.shape, 1, 1))
        poses[..., 0, 0], poses[..., 0, 1] = np.cos(now), -np.sin(now)
        poses[..., 1, 0], poses[..., 1, 1] = np.sin(now), np.cos(now)
        poses[..., 0, 3], poses[..., 1, 3] = np.interp(at, fine, x), np.interp(at, fine, y)
        return poses


def houses(seed=2):
    rng = np.random.default_rng(seed)
    for x in range(-15, 60, 7):
        for side in (-1, 1):
            middle = (x + rng.uniform(-2, 2), side * rng.uniform(14, 22), 3.0)
            yield Thing("building", middle, (*rng.uniform(2, 6, 2), 6.0), rng.uniform(0, 3))


def record(kind=None, *, rolling=False, frames=40):
    """Return the points of each scan, and first_T_sensor."""
    things = tuple(houses())
    drive = (kind or Winding)(
        frames=frames, speed=8.0, channels=32, columns=400, things=things, rolling=rolling
    )
    poses = drive.world_T_vehicle(drive.times) @ drive.sensors[0].vehicle_T_sensor
    rng, scans = np.random.default_rng(0), []
    for frame in range(drive.frames):
        points = drive.scan(frame).points[:, :3]
        away = np.linalg.norm(points, axis=1, keepdims=True)
        scans.append(points * (1 + rng.normal(0, 0.02, away.shape) / away))
    return scans, invert(poses[0]) @ poses


class Straight(Winding):
    """The same on a straight road."""

    bends = False
