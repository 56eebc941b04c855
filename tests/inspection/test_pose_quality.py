"""Poses of another point of the vehicle, and late poses, are told from correct ones on a drive that
turns.
"""

from __future__ import annotations

import numpy as np
import pytest
from helpers.scenes.winding import Straight, Winding, record

from carlasc.core.geometry import invert, rotation_z, slerp, translation
from carlasc.inspection.pose_quality import describe_mounting, measure_poses
from carlasc.motion.mounting import Mounting
from carlasc.testing import wrong_poses


@pytest.fixture(scope="module")
def winding():
    return record()


def mounting_of(scans, poses):
    found = measure_poses(scans.__getitem__, poses)
    assert found.mounting is not None
    return found.mounting


@pytest.mark.parametrize("jitter_m", [0.0, 0.03])
def test_correct_poses_need_no_explanation(winding, jitter_m):
    scans, poses = winding
    mounting = mounting_of(
        scans, wrong_poses(poses, jitter_m=jitter_m, jitter_rad=0.002 * bool(jitter_m))
    )
    assert not mounting.wrong.any()
    assert mounting.determined.tolist() == [True, True, False, True, True, True, True]
    assert (np.abs(mounting.values) < 4 * mounting.errors + 1e-3)[mounting.determined].all()
    assert describe_mounting(mounting) is None


@pytest.mark.slow
def test_scans_that_are_not_corrected_for_motion_raise_no_alarm():
    assert not mounting_of(*record(rolling=True)).wrong[:6].any()


@pytest.mark.parametrize("jitter_m", [0.0, 0.03])
@pytest.mark.parametrize(
    ("arm_m", "yaw_deg"),
    [((0.81, -0.32, -0.8), 0.0), ((-0.6, 0.0, 0.0), 0.0), ((1.0, 0.3, 0.0), 3.0)],
)
def test_poses_of_another_point_are_told_where_the_sensor_is(winding, arm_m, yaw_deg, jitter_m):
    scans, poses = winding
    stored = wrong_poses(
        poses @ invert(translation(arm_m) @ rotation_z(np.deg2rad(yaw_deg))), jitter_m=jitter_m
    )
    mounting = mounting_of(scans, stored)
    assert mounting.values[:2] == pytest.approx(arm_m[:2], abs=0.02 if jitter_m == 0 else 0.12)
    assert np.rad2deg(mounting.values[5]) == pytest.approx(yaw_deg, abs=0.4)
    assert not mounting.determined[2]
    assert mounting.wrong[[0, 1, 5]].tolist() == [True, bool(arm_m[1]), bool(yaw_deg)]
    corrected = mounting.correct(stored, 0.1 * np.arange(len(stored)))
    turned = poses @ invert(rotation_z(np.deg2rad(yaw_deg)))  # rotations are reported, not changed
    off = (invert(corrected[:-10]) @ corrected[10:] - invert(turned[:-10]) @ turned[10:])[:, :2, 3]
    assert np.abs(off).max() < (0.03 if jitter_m == 0 else 0.25)


@pytest.mark.slow
@pytest.mark.parametrize("late", [-1.0, 0.5, 2.0])
@pytest.mark.parametrize("kind", [Winding, Straight])
def test_late_poses_are_told_by_how_much(winding, kind, late):
    scans, poses = winding if kind is Winding else record(kind)
    numbers = np.arange(len(poses), dtype=np.float64)
    mounting = mounting_of(scans, slerp(poses, numbers, numbers - late))
    assert mounting.values[6] == pytest.approx(0.1 * late, abs=0.01)
    assert mounting.wrong.tolist() == [False] * 6 + [True]


@pytest.mark.slow
def test_a_straight_drive_shows_no_lever_arm():
    scans, poses = record(Straight)
    mounting = mounting_of(scans, poses @ translation((0.8, -0.3, 0.8)))
    assert not mounting.determined[:3].any() and not mounting.wrong.any()
    assert mounting.describe()["x"] == "undetermined"


def test_a_few_scans_tell_nothing(winding):
    scans, poses = winding
    assert measure_poses(scans.__getitem__, poses[:2]).mounting is None
    assert measure_poses(lambda row: np.empty((0, 3)), poses).disagreement_m is None


def test_the_messages_say_what_to_do():
    def described(**values):
        names = ("x", "y", "z", "roll", "pitch", "yaw", "late")
        errors = np.array([0.02, 0.02, 9.0, 0.001, 0.001, 0.001, 0.005])
        return describe_mounting(
            Mounting(np.array([values.get(name, 0.0) for name in names]), errors)
        )

    late, fix_late = described(late=0.2)
    assert (
        late == "poses that are 0.20 ± 0.01 s late (2.0 frames)"
        and "compare the time stamps" in fix_late
    )
    assert "0.10 ± 0.01 s early" in described(late=-0.1)[0]
    arm, fix_arm = described(x=0.8, y=-0.3, yaw=np.deg2rad(2.0))
    assert (
        "at about x = 0.80 ± 0.02 m, y = -0.30 ± 0.02 m, z = undetermined and poses in whose frame "
        "the sensor is turned by yaw 2.00 ± 0.06 degrees" in arm
    )
    assert "inv(T) @ P @ T" in fix_arm and "carlasc refine" in fix_arm
