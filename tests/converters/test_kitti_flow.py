"""Flow of a simulated drive, whose actors' true velocities are known."""

import numpy as np
import pytest
from carlasc_recorders import TownDrive
from helpers.datasets.kitti import write_kitti

import carlasc
from carlasc.converting import LayoutOptions, convert
from carlasc.motion import PoseOptions
from carlasc.running import Run

SEQUENCE = "Train/KITTI_00/cartesian"
MIRROR = np.array([1, -1, 1], np.float32)


@pytest.mark.slow
def test_flow_of_moving_vehicles_is_right_and_that_of_everything_static_exactly_zero(tmp_path):
    truth = write_kitti(tmp_path / "in", TownDrive(7, "heavy"), range(240, 262), voxels_every=0)
    result = convert("kitti", tmp_path / "in", tmp_path / "out", grids=None, run=Run(workers=2))
    assert not result.failures
    sequence = carlasc.open(tmp_path / "out").sequences()[SEQUENCE]
    errors = []
    for frame in truth.frames:
        scan, flow = sequence.scan(frame), truth.flow[frame] * MIRROR
        classes = np.fromfile(truth.folder / "labels" / f"{frame:06d}.label", "<u4") & 0xFFFF
        assert not scan.flow[classes < 252].any()
        for actor in np.unique(scan.instances[classes == 252]):
            own = np.flatnonzero(scan.instances == actor)
            assert (scan.flow[own] == scan.flow[own[0]]).all()
            if len(own) >= 100 and 5 <= np.linalg.norm(flow[own[0]]) <= 12:
                errors.append(np.linalg.norm(scan.flow[own[0]] - flow[own[0]]))
    assert len(errors) > 30
    assert np.median(errors) < 0.15


def test_flow_is_in_the_sensors_frame_with_ego_motion_removed(tmp_path):
    """A car ahead at constant distance drives as fast as the ego vehicle; both turn."""
    from helpers.datasets.kitti import write_poses
    from helpers.datasets.tiny_kitti import write_labels, write_tiny_kitti

    from carlasc.core.geometry import invert, rotation_z, transform_points, translation

    folder = write_tiny_kitti(tmp_path / "in", frames=30, points=300)
    rng = np.random.default_rng(0)
    poses, world_T_car = [np.eye(4)], [translation((10, 0, 0))]
    for _ in range(29):
        poses.append(poses[-1] @ translation((0.6, 0, 0)) @ rotation_z(0.02))
        world_T_car.append(world_T_car[-1] @ translation((0.9, 0, 0)) @ rotation_z(0.02))
    car = rng.uniform(-0.5, 0.5, (300, 3)) * (4.4, 1.8, 1.5)
    for frame in range(30):
        points = transform_points(invert(poses[frame]) @ world_T_car[frame], car)
        np.column_stack([points, np.zeros(300)]).astype("<f4").tofile(
            folder / "velodyne" / f"{frame:06d}.bin"
        )
        write_labels(folder, frame, np.full(300, 252 | 9 << 16))
    write_poses(folder / "poses.txt", np.stack(poses))
    convert(
        "kitti",
        tmp_path / "in",
        tmp_path / "out",
        layout=LayoutOptions(axes="right"),
        poses=PoseOptions(force=True),
        grids=None,
        run=Run(workers=1),
    )
    sequence = carlasc.open(tmp_path / "out").sequences()[SEQUENCE]
    for frame in (8, 15, 22):
        car_in_sensor = (invert(poses[frame]) @ world_T_car[frame])[:3, :3]
        expected = car_in_sensor @ (9.0, 0, 0)
        assert np.abs(sequence.read("flow", frame)[0] - expected).max() < 0.4


def test_without_instances_moving_points_have_no_known_flow_and_that_is_said(tmp_path):
    from helpers.datasets.tiny_kitti import write_labels, write_tiny_kitti

    folder = write_tiny_kitti(tmp_path / "in", points=10)
    for frame in range(3):
        write_labels(folder, frame, np.full(10, 252))
    result = convert("kitti", tmp_path / "in", tmp_path / "out", grids=None, run=Run(workers=1))
    assert "30 moving points belong to no numbered actor" in result.notes[0]
    assert not carlasc.open(tmp_path / "out").sequences()[SEQUENCE].read("flow", 0).any()
