"""Mistakes in poses are named on simulated drives, and correct drives raise no alarm."""

from __future__ import annotations

import tarfile

import numpy as np
import pytest

from carlasc.core.geometry import invert
from carlasc.core.tables import CARLA
from carlasc.inspection.alignment import diagnose_poses, known_corrections, structure_of
from carlasc.testing.drives import SimulatedDrive

MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
CAMERA = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def transposed(poses):
    poses = poses.copy()
    poses[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    return poses


MISTAKES = {
    "y mirrored": lambda poses: MIRROR @ poses @ MIRROR,
    "transposed rotations": transposed,
    "inverted transforms": invert,
    "camera-frame": lambda poses: CAMERA @ poses @ CAMERA.T,
}


class Swaying(SimulatedDrive):
    """A nearly straight drive: the vehicle pitches, rolls and turns by some tenths of a degree."""

    sway_rad = 0.01

    def world_T_vehicle(self, seconds):
        at = np.asarray(seconds, np.float64)
        yaw, pitch, roll = (
            self.sway_rad * np.sin(rate * at + start)
            for rate, start in ((1.1, 0), (2.3, 1), (1.7, 2))
        )
        poses = np.tile(np.eye(4), (*at.shape, 1, 1))
        poses[..., 0, 1], poses[..., 1, 0] = -yaw, yaw
        poses[..., 0, 2], poses[..., 2, 0] = pitch, -pitch
        poses[..., 1, 2], poses[..., 2, 1] = -roll, roll
        u, _, v = np.linalg.svd(poses[..., :3, :3])
        poses[..., :3, :3] = u @ v
        poses[..., 0, 3] = self.speed * at
        return poses


def structures(drive, *, deskewed=True):
    found = []
    for frame in range(drive.frames):
        scan = drive.scan(frame)
        points = (scan.deskewed if deskewed else scan.points)[:, :3].astype(np.float64)
        found.append(structure_of(points, None, None, CARLA))
    return found


def poses_of(drive):
    poses = drive.world_T_vehicle(drive.times) @ drive.sensors[0].vehicle_T_sensor
    return invert(poses[0]) @ poses


@pytest.fixture(scope="module")
def swaying():
    drive = Swaying(frames=24, channels=32, columns=360)
    return structures(drive), poses_of(drive)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named_on_a_nearly_straight_drive(swaying, mistake):
    scans, poses = swaying
    correction = diagnose_poses(scans.__getitem__, MISTAKES[mistake](poses)).correction
    assert correction is not None
    assert mistake in correction.name


def test_mirrored_points_are_named_as_mirrored_poses_are(swaying):
    scans, poses = swaying
    correction = diagnose_poses(lambda index: scans[index] * [1, -1, 1], poses).correction
    assert correction is not None
    assert "y mirrored" in correction.name


@pytest.mark.slow
@pytest.mark.parametrize("rolling", [False, True])
@pytest.mark.parametrize("speed", [0.0, 12.0])
def test_correct_poses_raise_no_alarm(speed, rolling):
    drive = SimulatedDrive(frames=20, speed=speed, rolling=rolling, channels=24, columns=240)
    scans = structures(drive, deskewed=False)
    result = diagnose_poses(scans.__getitem__, poses_of(drive))
    assert (result.correction, result.offset_m) == (None, None)


@pytest.mark.slow
def test_vehicles_that_keep_pace_are_not_taken_for_scans_in_one_frame():
    rng = np.random.default_rng(3)
    fixed, convoy = (
        rng.uniform((-40, -25, 0), (60, 25, 3), (2500, 3)),
        rng.uniform((-20, -6, 0), (20, 6, 2), (1500, 3)),
    )
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[:, 0, 3] = np.arange(20)
    scans = [np.concatenate([fixed - pose[:3, 3], convoy]) for pose in poses]
    result = diagnose_poses(scans.__getitem__, poses)
    assert (result.correction, result.offset_m) == (None, None)
    in_one_frame = diagnose_poses(lambda _: fixed, poses)
    assert in_one_frame.correction is not None
    assert "all in one frame" in in_one_frame.correction.name


def test_a_rare_choice_of_axes_is_named_only_if_no_common_one_explains_as_much(swaying):
    scans, poses = swaying
    upside_down = np.diag([1.0, -1.0, -1.0, 1.0])
    correction = diagnose_poses(scans.__getitem__, upside_down @ poses @ upside_down).correction
    assert correction is not None
    assert not correction.rare  # z hardly matters on this drive
    rare = next(c for c in known_corrections() if c.name.endswith("(x, y, z are y, x, z)"))
    swapped = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    correction = diagnose_poses(scans.__getitem__, swapped @ poses @ swapped).correction
    assert correction is not None
    assert correction.name == rare.name


@pytest.mark.slow
def test_mistakes_are_named_on_a_real_drive(real):
    pytest.importorskip("kiss_icp")
    from carlasc.motion.odometry import estimate_poses

    with tarfile.open(real / "kitti_tracking_0000.tar.xz") as archive:
        read = {
            member.name: np.frombuffer(archive.extractfile(member).read(), np.float32).reshape(
                -1, 4
            )[:, :3]
            for member in archive
            if member.name.endswith(".bin") and int(member.name[-10:-4]) < 45
        }
    scans = [read[name] for name in sorted(read)]
    poses = estimate_poses(scans, min_range_m=2.5, max_range_m=50.0)
    structure = [structure_of(scan, None, None, CARLA) for scan in scans]
    assert diagnose_poses(structure.__getitem__, poses).correction is None
    for mistake, make in MISTAKES.items():
        correction = diagnose_poses(structure.__getitem__, make(poses)).correction
        assert correction is not None
        assert mistake in correction.name
