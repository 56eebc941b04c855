"""The contract of converters, on drives in memory: what the toolkit does itself for any data set."""

import numpy as np
from helpers.converters.drive_converter import IDS, DriveConverter

from carlasc.converting import Sensor
from carlasc.core import rotation_z
from carlasc.testing import ConverterContract, SimulatedDrive


def mounted(x, z, yaw):
    pose = rotation_z(yaw)
    pose[:3, 3] = x, 0, z
    return pose


class InMemory(ConverterContract):
    ids = IDS
    poses_m = 1e-5  # poses are interpolated

    def write(self, folder):
        """Nothing is written: the converter has the drive."""


class TestNumberedActors(InMemory):
    converter = DriveConverter
    keeps = frozenset({"labels", "instances", "poses", "times"})


class Boxed(DriveConverter):
    gives = frozenset({"boxes", "poses", "times"})


class TestTrackedBoxes(InMemory):
    converter = Boxed
    keeps = Boxed.gives


class BoxedSometimes(DriveConverter):
    drive = SimulatedDrive(frames=16)
    gives = frozenset({"boxes", "poses", "times"})
    annotated = 5


class TestBoxesOfSomeFrames(InMemory):
    converter = BoxedSometimes
    drive = BoxedSometimes.drive
    keeps = BoxedSometimes.gives


class Rolling(DriveConverter):
    drive = SimulatedDrive(
        sensors=(
            Sensor("upper", mounted(1.0, 1.7, 0.3), deskewed=False),
            Sensor("lower", mounted(-0.6, 1.2, -2.0), deskewed=False),
        ),
        rolling=True,
        speed=10.0,
    )


class TestTwoSensorsThatTurn(InMemory):
    converter = Rolling
    drive = Rolling.drive
    keeps = frozenset({"labels", "instances", "poses", "times", "seconds"})
    points_m = 2e-3  # at 50 m, of interpolated rotations

    def test_points_know_their_sensor_their_time_and_where_their_rays_began(self, sequence):
        scans = [self.drive.scan(3, sensor) for sensor in range(2)]
        sensor, seconds = sequence.read("sensor", 3), sequence.read("seconds", 3)
        assert sensor.tolist() == [0] * len(scans[0].points) + [1] * len(scans[1].points)
        np.testing.assert_allclose(
            seconds, np.concatenate([scan.seconds for scan in scans]), atol=1e-6
        )
        origins = sequence.read("origins", 3)
        upper, lower = origins[sensor == 0], origins[sensor == 1]
        # 10 m/s: half a metre before and after the time of the frame, in steps
        np.testing.assert_allclose(upper[:, 0], 10 * scans[0].seconds, atol=0.13)
        np.testing.assert_allclose(lower[:, 0], -1.6 + 10 * scans[1].seconds, atol=0.13)
        np.testing.assert_allclose(lower[:, 2], -0.5, atol=1e-3)


class Unposed(DriveConverter):
    gives = frozenset({"labels", "instances", "times"})


class TestEstimatedPoses(InMemory):
    converter = Unposed
    keeps = Unposed.gives
