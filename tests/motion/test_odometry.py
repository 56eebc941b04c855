import numpy as np
import pytest

from carlasc.core.geometry import invert, rotation_z, transform_points, translation
from carlasc.errors import ArgumentError
from carlasc.motion.odometry import estimate_poses

pytest.importorskip("kiss_icp")


def street_scans(poses, seed=0):
    """Scans of the same random blocks from each pose: no plane without a corner."""
    rng = np.random.default_rng(seed)
    walls = []
    for _ in range(60):
        x, y = rng.uniform(-60, 60, 2)
        side = rng.uniform(0, 1, (400, 3)) * (rng.uniform(1, 6), 0, 4) + (x, y, -1.8)
        other = rng.uniform(0, 1, (400, 3)) * (0, rng.uniform(1, 6), 4) + (x, y, -1.8)
        walls += [side, other]
    ground = np.column_stack([rng.uniform(-60, 60, (20000, 2)), np.full(20000, -1.8)])
    world = np.concatenate([*walls, ground])
    for pose in poses:
        points = transform_points(invert(pose), world)
        points = points[np.linalg.norm(points, axis=1) < 45]
        yield (points[rng.random(len(points)) < 0.5] + rng.uniform(-0.02, 0.02, 3)).astype(np.float32)


def test_kiss_icp_finds_a_known_trajectory_that_starts_at_rest():
    poses, pose = [], np.eye(4)
    for frame in range(30):
        pose = pose @ translation((min(frame * 0.05, 0.8), 0, 0)) @ rotation_z(0.01)
        poses.append(pose)
    poses = np.linalg.inv(poses[0]) @ np.stack(poses)
    seen = []
    estimated = estimate_poses(street_scans(poses), max_range_m=50.0, total=30, progress=lambda *a: seen.append(a))
    driven = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()
    assert np.linalg.norm(estimated[-1, :3, 3] - poses[-1, :3, 3]) < 0.02 * driven
    assert np.allclose(estimated[0], np.eye(4))
    assert seen[-1] == (30, 30)


def test_an_empty_scan_is_named():
    with pytest.raises(ArgumentError, match="found 3 in scan 0"):
        estimate_poses([np.zeros((3, 3))] * 2)


def test_no_scans_have_no_poses():
    assert estimate_poses([]).shape == (0, 4, 4)


def test_a_scan_alone_is_where_it_is_however_few_its_points():
    assert np.array_equal(estimate_poses([np.zeros((5, 3))]), np.eye(4)[None])
