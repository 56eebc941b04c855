"""Scenes of carriers other than a car: what is written is what `carlasc convert scans` reads, and is
exact.
"""

from dataclasses import replace

import numpy as np
import pytest
from carlasc_converters.scans import Scans

from carlasc.core.geometry import transform_points
from carlasc.testing import KINDS, SCENES, write_scans


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_is_read_as_it_was_simulated(name, tmp_path):
    drive = replace(SCENES[name], frames=3)
    poses = write_scans(drive, tmp_path)
    (recording,) = Scans(tmp_path / "scans", pose_file=str(tmp_path / "poses.txt")).sequences()
    assert len(recording.frames) == 3
    times = recording.times()
    assert np.allclose(np.diff(times), drive.period_s)
    (first,) = recording.frames[1].read()
    assert len(first.points) == len(drive.scan(1).points)
    given = recording.poses(force=False).world_T_vehicle
    assert np.allclose(np.linalg.inv(given[0]) @ given, poses, atol=1e-6)


def test_parts_of_the_carrier_stay_where_they_are_in_its_frame_and_walls_do_not():
    drive = replace(SCENES["room"], noise_m=0.0)
    own, walls = [], []
    for frame in (0, 30):
        scan = drive.scan(frame)
        world = np.einsum("nij,nj->ni", scan.world_T_sensor[:, :3, :3], scan.points[:, :3])
        world += scan.world_T_sensor[:, :3, 3]
        inside = (np.abs(world[:, :2]) < np.array([4.01, 2.51])).all(axis=1)
        assert inside.all()  # of a room of 8 x 5 m
        own.append(scan.points[scan.kinds == KINDS.index("car"), :3])
        walls.append(scan.points[scan.kinds == KINDS.index("building"), :3])
    assert np.abs(own[0] - own[1]).max() < 1e-5
    assert len(walls[0]) != len(walls[1])
    assert transform_points(np.eye(4), own[0])[:, 0].max() < 0
