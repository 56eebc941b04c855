"""Poses from the scans alone."""

import json

import numpy as np
import pytest
from carlasc_recorders import TownDrive
from helpers.datasets.kitti import write_kitti
from helpers.datasets.tiny_kitti import write_tiny_kitti

import carlasc
from carlasc.captures import Lidar
from carlasc.converting import LayoutOptions, convert
from carlasc.running import Run
from carlasc.storage import layout

pytest.importorskip("kiss_icp")
SEQUENCE = "Train/KITTI_00/cartesian"


@pytest.mark.slow
def test_kiss_icp_drifts_less_than_1_percent_over_100_m_of_a_drive_from_rest(tmp_path):
    """A town with cross streets and trees, no deskewing; every other scan, which is harder and
    takes half the time.
    """
    truth = write_kitti(
        tmp_path / "in",
        TownDrive(3, "light", Lidar(channels=32, points=20_000)),
        range(0, 190, 2),
        voxels_every=0,
    )
    (truth.folder / "poses.txt").unlink()
    seen = []
    options = {"grids": None, "layout": LayoutOptions(axes="right", flow="none")}
    convert(
        "kitti",
        tmp_path / "in",
        tmp_path / "out",
        run=Run(1, progress=lambda *step: seen.append(step)),
        **options,
    )
    folder = tmp_path / "out" / SEQUENCE
    poses = layout.decode_poses((folder / "poses.txt").read_bytes(), "poses")
    steps = np.linalg.norm(np.diff(truth.poses[:, :3, 3], axis=0), axis=1)
    assert steps[0] < 0.1
    assert steps.sum() > 100
    assert np.linalg.norm(poses[-1, :3, 3] - truth.poses[-1, :3, 3]) < 0.01 * steps.sum()
    assert json.loads((folder / "carlasc.json").read_text())["poses"] == "kiss-icp"
    assert seen[-1] == (95, 95)  # poses are estimated while scans are read


def test_estimated_poses_are_estimated_once(tmp_path):
    folder = write_tiny_kitti(tmp_path / "in", points=200)
    (folder / "poses.txt").unlink()
    # cannot be read: it gets the pose of the one before
    (folder / "velodyne" / "000001.bin").write_bytes(b"")
    options = {"grids": None, "layout": LayoutOptions(flow="none")}
    first = convert("kitti", tmp_path / "in", tmp_path / "out", run=Run(1), **options)
    assert [failure.frame for failure in first.failures] == [1]
    poses = carlasc.open(tmp_path / "out").sequences()[SEQUENCE].poses
    assert len(poses) == 3
    assert np.array_equal(poses[0], poses[1])
    steps = []
    convert(
        "kitti",
        tmp_path / "in",
        tmp_path / "out",
        run=Run(1, progress=lambda *step: steps.append(step)),
        **options,
    )
    assert steps[-1] == (3, 3)  # no odometry this time
