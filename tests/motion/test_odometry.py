from collections import deque
from dataclasses import replace

import numpy as np
import pytest

from carlasc.converting import Sensor
from carlasc.core.geometry import invert, rotation_z, transform_points, translation
from carlasc.errors import ArgumentError
from carlasc.motion.odometry import estimate_poses, follow_scans, usable_points
from carlasc.testing import SCENES
from carlasc.testing.drives import SimulatedDrive, Thing, world_T_sensor

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
        yield (points[rng.random(len(points)) < 0.5] + rng.uniform(-0.02, 0.02, 3)).astype(
            np.float32
        )


def test_kiss_icp_finds_a_known_trajectory_that_starts_at_rest():
    poses, pose = [], np.eye(4)
    for frame in range(30):
        pose = pose @ translation((min(frame * 0.05, 0.8), 0, 0)) @ rotation_z(0.01)
        poses.append(pose)
    poses = np.linalg.inv(poses[0]) @ np.stack(poses)
    seen = []
    estimated = estimate_poses(
        street_scans(poses), max_range_m=50.0, total=30, progress=lambda *a: seen.append(a)
    )
    driven = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()
    assert np.linalg.norm(estimated[-1, :3, 3] - poses[-1, :3, 3]) < 0.02 * driven
    assert np.allclose(estimated[0], np.eye(4))
    assert seen[-1] == (30, 30)


def test_an_empty_scan_is_named():
    with pytest.raises(ArgumentError) as error:
        estimate_poses([np.zeros((3, 3))] * 2)
    assert error.value.found == "3 in scan 0"


def test_no_scans_have_no_poses():
    assert estimate_poses([]).shape == (0, 4, 4)


def test_a_scan_alone_is_where_it_is_however_few_its_points():
    assert np.array_equal(estimate_poses([np.zeros((5, 3))]), np.eye(4)[None])


class Bend(SimulatedDrive):
    """A drive in a circle with a radius of 12 m, from its first scan on at full speed."""

    def world_T_vehicle(self, seconds):
        way = self.speed * np.asarray(seconds)
        cos, sin = np.cos(way / 12.0), np.sin(way / 12.0)
        poses = np.tile(np.eye(4), (*way.shape, 1, 1))
        poses[..., 0, 0], poses[..., 0, 1], poses[..., 1, 0], poses[..., 1, 1] = cos, -sin, sin, cos
        poses[..., 0, 3], poses[..., 1, 3] = 12.0 * sin, 12.0 * (1 - cos)
        return poses


def houses_about(x, y, seed=1):
    rng = np.random.default_rng(seed)
    for angle in np.linspace(0, 2 * np.pi, 26, endpoint=False):
        middle = rng.uniform(20, 32) * np.array([np.cos(angle), np.sin(angle)]) + (x, y)
        yield Thing("building", (*middle, 4.0), (*rng.uniform(2, 6, 2), 8.0), rng.uniform(0, 3))


@pytest.fixture(scope="module")
def bend():
    """Return the drive, its scans, and first_T_sensor at the times of its frames."""
    things = tuple(houses_about(0.0, 12.0))
    drive = Bend(frames=20, rolling=True, speed=8.0, channels=32, columns=540, things=things)
    world_T_sensor = drive.world_T_vehicle(drive.times) @ drive.sensors[0].vehicle_T_sensor
    return (
        drive,
        [drive.scan(frame) for frame in range(20)],
        invert(world_T_sensor[0]) @ world_T_sensor,
    )


def step_errors(estimated, true):
    steps = [invert(poses[:-1]) @ poses[1:] for poses in (estimated, true)]
    return np.linalg.norm(steps[0][:, :3, 3] - steps[1][:, :3, 3], axis=1)


@pytest.mark.slow
def test_a_drive_may_start_at_any_speed(bend):
    _, scans, true = bend
    estimated = estimate_poses([scan.deskewed[:, :3] for scan in scans], max_range_m=50.0)
    assert step_errors(estimated, true).max() < 0.06  # of 0.8 m; registered forwards only, 0.4 m


@pytest.mark.parametrize("height_m", [1.0, pytest.param(2.5, marks=pytest.mark.slow)])
def test_the_sensor_may_be_at_any_height(height_m):
    sensors = (Sensor("lidar", translation((0.0, 0.0, height_m))),)
    drive = SimulatedDrive(frames=20, speed=10.0, channels=32, columns=540, sensors=sensors)
    true = invert(drive.world_T_vehicle(0.0)) @ drive.world_T_vehicle(drive.times)
    estimated = estimate_poses(
        [drive.scan(frame).points[:, :3] for frame in range(20)], max_range_m=50.0
    )
    assert np.linalg.norm((estimated - true)[-1, :2, 3]) < 0.15
    assert step_errors(estimated, true).max() < 0.06


@pytest.mark.slow
def test_poses_of_rolling_scans_are_those_at_the_times_of_the_frames(bend):
    drive, scans, true = bend
    points, seconds = [scan.points[:, :3] for scan in scans], [scan.seconds for scan in scans]
    estimated = estimate_poses(points, seconds=seconds, times=drive.times, max_range_m=50.0)
    raw = estimate_poses(points, max_range_m=50.0)
    assert np.linalg.norm((estimated - true)[-1, :2, 3]) < 0.1
    assert np.linalg.norm((raw - true)[-1, :2, 3]) > 0.2
    assert step_errors(estimated, true).max() < 0.06


def test_frames_may_be_at_any_rate(bend):
    drive, scans, true = bend
    every_other = [(scan.points[:, :3], scan.seconds) for scan in scans[::2]]
    points, seconds = zip(*every_other, strict=True)
    estimated = estimate_poses(points, seconds=seconds, times=drive.times[::2], max_range_m=50.0)
    assert np.linalg.norm((estimated - true[::2])[-1, :2, 3]) < 0.1


def long_street(speed):
    """A street of houses, poles and trees, and cars that drive along with the vehicle at its speed."""
    rng = np.random.default_rng(3)
    for side in (-1, 1):
        x = -70.0
        while x < 160.0:
            length, away = rng.uniform(8, 20), rng.uniform(13, 20)
            yield Thing("building", (x + length / 2, side * away, 4.0), (length, 8.0, 8.0))
            yield Thing("pole", (x, side * rng.uniform(7, 9), 3.5), (0.25, 0.25, 7.0))
            yield Thing(
                "vegetation", (x + length / 2, side * rng.uniform(7, 9), 3.5), (2.0, 2.0, 4.0)
            )
            x += length + rng.uniform(1, 12)
    for ahead in (-24.0, -12.0, 12.0, 24.0, 36.0):
        yield Thing("car", (ahead, rng.choice([0.0, 3.5, -3.5]), 0.8), (4.4, 1.8, 1.5), speed=speed)


@pytest.mark.slow
def test_a_drive_may_start_fast_at_a_low_rate():
    things = tuple(long_street(11.0))
    drive = SimulatedDrive(
        frames=12, period_s=0.5, speed=11.0, channels=32, columns=540, things=things
    )
    true = invert(drive.world_T_vehicle(0.0)) @ drive.world_T_vehicle(drive.times)
    scans = [drive.scan(frame).points[:, :3] for frame in range(12)]
    estimated = estimate_poses(scans, times=drive.times, max_range_m=60.0)
    assert step_errors(estimated, true).max() < 0.3  # by KISS-ICP alone, the vehicle stands: 5.5 m
    turned = rotation_z(2.0)  # the sensor may be mounted in any direction
    estimated = estimate_poses(
        [transform_points(turned, scan) for scan in scans], times=drive.times, max_range_m=60.0
    )
    assert step_errors(invert(turned) @ estimated @ turned, true).max() < 0.3


def test_seconds_must_be_those_of_the_points():
    scans = [np.zeros((200, 3))] * 2
    for seconds, found in (
        ([np.zeros(200), np.zeros(199)], "199"),
        ([np.zeros(200)], "0"),
    ):
        with pytest.raises(ArgumentError) as error:
            estimate_poses(scans, seconds=seconds)
        assert "200 of scan 1" in error.value.expected and error.value.found == found


def scene_errors(drive):
    """Return the greatest error of the position as a share of the way, and what was chosen."""
    frames, said = drive.frames, []
    scans = [drive.scan(frame) for frame in range(frames)]
    chosen = [usable_points(scan.points) for scan in scans]
    usable = [(s.points[u, :3], s.seconds[u]) for s, u in zip(scans, chosen, strict=True)]
    estimated = np.stack(list(follow_scans(usable, times=drive.times, note=said.append)))
    true = np.stack([world_T_sensor(drive, frame) for frame in range(frames)])
    true = invert(true[0]) @ true
    way = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum()
    return np.linalg.norm((estimated - true)[:, :3, 3], axis=1).max() / way, said


@pytest.mark.parametrize(
    "name",
    [
        "room",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("stairwell", "walking-robot", "drone", "pitched")
        ),
    ],
)
def test_carriers_other_than_cars_are_followed_within_two_percent(name):
    error, said = scene_errors(replace(SCENES[name], frames=12 if name == "room" else 40))
    assert error < 0.02
    (line,) = said
    assert line.startswith("odometry by planes: points within ")


def stairwell(steps, **lidar):
    """Return the stairwell with steps of another depth and height."""
    scene = SCENES["stairwell"]
    scale = np.array([steps[0] / 0.28, 1.0, steps[1] / 0.17])

    def way(at):
        poses = scene.way(at)
        poses[..., 2, 3] *= scale[2] / scale[0]
        return poses

    things = tuple(
        replace(thing, center=tuple(scale * thing.center), size=tuple(scale * thing.size))
        for thing in scene.things
    )
    return replace(scene, things=things, way=way, **lidar)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("steps", "lidar"),
    [
        ((0.31, 0.15), {"channels": 64, "elevation_deg": (-25.0, 15.0)}),
        ((0.26, 0.18), {"channels": 40, "elevation_deg": (-30.0, 30.0), "columns": 500}),
    ],
)
def test_stairs_of_other_sizes_are_followed_within_two_percent(steps, lidar):
    assert scene_errors(stairwell(steps, **lidar))[0] < 0.02


def test_a_street_needs_no_note():
    drive = SimulatedDrive(frames=2, channels=32, columns=360)
    said = []
    deque(follow_scans([(drive.scan(f).points[:, :3], None) for f in (0, 1)], note=said.append))
    assert said == []
