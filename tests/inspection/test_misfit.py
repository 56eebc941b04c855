"""Poses of another point of the vehicle, and poses of other frames, are told from correct ones on a drive that turns."""

from __future__ import annotations

import numpy as np
import pytest

from carlasc.core.geometry import invert, rotation_z, slerp, transform_points, translation
from carlasc.inspection.alignment import diagnose_poses
from carlasc.inspection.misfit import LeverArm, Misfit, add_squares, describe_misfit, flat_cells, match, residual
from carlasc.inspection.structure import upright
from carlasc.testing.drives import SimulatedDrive, Thing

POINTS = np.random.default_rng(0).uniform(-9, 9, (3000, 3)) * (1, 1, 0.2)


@pytest.mark.parametrize("cell_m", [1.0, 0.7])
def test_cells_and_their_distributions_are_those_of_numpy(cell_m):
    lower = np.floor(POINTS.min(axis=0) / cell_m) - 1
    size = (np.floor(POINTS.max(axis=0) / cell_m) - lower + 2).astype(np.int64)
    flat = flat_cells(POINTS, cell_m, lower, size)
    cells = (np.floor(POINTS / cell_m) - lower).astype(np.int64)
    assert np.array_equal(flat, np.ravel_multi_index(tuple(cells.T), tuple(size)))

    _, row, expected = np.unique(flat, return_inverse=True, return_counts=True)
    mean = np.stack([np.bincount(row, POINTS[:, axis]) for axis in range(3)], axis=1) / expected[:, None]
    off = POINTS - mean[row]
    squares = np.zeros((len(expected), 3, 3))
    add_squares(POINTS, row, mean, squares)
    for i in range(3):
        for j in range(i, 3):
            assert np.array_equal(squares[:, i, j], np.bincount(row, off[:, i] * off[:, j]))


def test_the_motion_between_two_views_of_walls_is_measured():
    rng = np.random.default_rng(1)
    wall = rng.uniform(-8, 8, (6000, 3)) * (1, 0, 0.2)
    walls = np.concatenate([wall + (0, 7, 1), wall[:, [1, 0, 2]] + (6, 0, 1), wall + (0, -6, 1)])
    floor = rng.uniform(-8, 8, (3000, 3)) * (1, 1, 0)
    scene = np.concatenate([walls, floor]) + rng.normal(0, 0.01, (21_000, 3))
    motion = translation((0.3, -0.2, 0.05)) @ rotation_z(0.02)
    later = transform_points(np.linalg.inv(motion), scene)
    assert np.allclose(match(scene, later, np.eye(4)).motion, motion, atol=0.03)


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


def record(kind=None, *, rolling=False):
    """Return the structure of each scan, and first_T_sensor."""
    drive = (kind or Winding)(frames=26, speed=8.0, channels=32, columns=400, things=tuple(houses()), rolling=rolling)
    poses = drive.world_T_vehicle(drive.times) @ drive.sensors[0].vehicle_T_sensor
    scans = [upright(drive.scan(frame).points[:, :3]) for frame in range(drive.frames)]
    return scans, invert(poses[0]) @ poses


@pytest.fixture(scope="module")
def winding():
    return record()


def diagnose(scans, poses):
    result = diagnose_poses(scans.__getitem__, poses)
    assert (result.correction, result.offset_m) == (None, None)
    return result.misfit


@pytest.mark.parametrize("rolling", [False, True])
def test_correct_poses_need_no_explanation(rolling):
    assert diagnose(*record(rolling=rolling)) is None


def test_the_motion_between_two_scans_is_measured(winding):
    scans, poses = winding
    true = invert(poses[10]) @ poses[13]
    measured = match(scans[10], scans[13], true @ translation((0.3, -0.2, 0.0)) @ rotation_z(0.02))
    error = np.abs(residual(measured.motion, true))
    assert error[:2].max() < 0.02
    assert error[5] < 0.002


@pytest.mark.parametrize(
    ("arm_m", "yaw_deg"), [((0.8, -0.3, 0.8), 0.0), ((-0.6, 0.0, 0.0), 0.0), ((1.0, 0.3, 0.0), 3.0)]
)
def test_poses_of_another_point_are_told_where_the_sensor_is(winding, arm_m, yaw_deg):
    scans, poses = winding
    stored = poses @ invert(translation(arm_m) @ rotation_z(np.deg2rad(yaw_deg)))
    misfit = diagnose(scans, stored)
    assert misfit is not None
    assert misfit.arm is not None
    assert misfit.arm.arm_m == pytest.approx(arm_m[:2], abs=0.12)
    assert np.rad2deg(misfit.arm.yaw_rad) == pytest.approx(yaw_deg, abs=0.4)


@pytest.mark.parametrize("late", [-1, 2])
def test_poses_of_other_frames_are_told(winding, late):
    scans, poses = winding
    numbers = np.arange(len(poses), dtype=np.float64)
    misfit = diagnose(scans, slerp(poses, numbers, numbers - late))
    assert misfit == Misfit(late_frames=late)


@pytest.mark.slow
def test_a_straight_drive_shows_no_lever_arm():
    class Straight(Winding):
        bends = False

    scans, poses = record(Straight)
    stored = poses @ translation((0.8, -0.3, 0.8))
    assert diagnose(scans, stored) is None


def test_the_messages_say_what_to_do():
    late, fix_late = describe_misfit(Misfit(late_frames=2))
    assert late == "poses that are 2 frames late"
    assert "2 frames later in the file" in fix_late
    assert describe_misfit(Misfit(late_frames=-1))[0] == "poses that are 1 frame early"
    arm, fix_arm = describe_misfit(Misfit(LeverArm((0.8, -0.3), np.deg2rad(2.0))))
    assert "at about x = 0.8 m, y = -0.3 m, turned by 2.0 degrees" in arm
    assert "inv(T) @ P @ T" in fix_arm
