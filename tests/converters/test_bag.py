"""Bags as recordings: the points, times, extrinsics and poses of a simulated drive in each kind,
and whole conversions.
"""

import shutil
import subprocess
import sys

import numpy as np
import pytest
from carlasc_converters.bag import Bag
from helpers.converters.bags import (
    BASE,
    KINDS,
    LIDAR,
    START_NS,
    WORLD,
    Messages,
    drive_messages,
    file_of,
    velodyne,
    write_bag,
)
from helpers.errors import raises
from helpers.processes.peak import PRINT_PEAK

import carlasc
from carlasc.converting import Sensor, convert
from carlasc.core.geometry import rotation_z, translation
from carlasc.core.grids import GridSpec
from carlasc.errors import FormatError, MissingDataError
from carlasc.groundtruth import GridOptions
from carlasc.running import Run
from carlasc.testing import ConverterContract, SimulatedDrive

pytestmark = pytest.mark.needs("rosbags")
TWO = (
    Sensor("front", translation((1.0, 0.0, 1.7)) @ rotation_z(0.1)),
    Sensor("rear", translation((-1.0, 0.2, 1.6)) @ rotation_z(3.0)),
)
DRIVE = SimulatedDrive(4, rolling=True, channels=8, columns=60)
TWIN_DRIVE = SimulatedDrive(6, sensors=TWO, rolling=True, channels=10, columns=90)
POINTS = np.random.default_rng(0).uniform(1, 50, (50, 4)).astype(np.float32)


def write(folder, kind, drive=DRIVE, poses="odometry"):
    store = Messages(kind)
    return write_bag(folder, kind, drive_messages(store, drive, poses), store=store)


def recording_of(folder, kind, messages, **options):
    store = Messages(kind)
    (recording,) = Bag(write_bag(folder, kind, messages(store), store=store), **options).sequences()
    return recording


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("poses", ["odometry", "pose", "covariance", "path", "tf"])
def test_points_times_and_poses_come_back(tmp_path, kind, poses):
    bag = write(tmp_path, kind, poses=poses)
    for source in {bag, file_of(bag), tmp_path}:
        (recording,) = Bag(source).sequences()
        assert recording.name == "drive"
        assert [frame.number for frame in recording.frames] == list(range(DRIVE.frames))
        for frame in recording.frames:
            (cloud,) = frame.read()
            scan = DRIVE.scan(frame.number)
            assert cloud.points.tobytes() == scan.points.tobytes()
            assert np.abs(cloud.seconds - scan.seconds).max() < 1e-6
        np.testing.assert_allclose(recording.times(), DRIVE.times, atol=1e-9)
        found = recording.poses().at(recording.times())
        np.testing.assert_allclose(found, DRIVE.world_T_vehicle(DRIVE.times), atol=1e-9)
        (sensor,) = recording.sensors
        np.testing.assert_allclose(
            sensor.vehicle_T_sensor, DRIVE.sensors[0].vehicle_T_sensor, atol=1e-12
        )
        assert sensor.calibrated and not sensor.deskewed
        units, said, *_ = recording.notes()
        assert units == "/lidar/points: the times of points are in s"
        assert "the poses are those of base_link" in said
        assert said.endswith(", which is assumed: the messages do not name it") == (
            poses in ("pose", "covariance", "path")
        )


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_without_poses_has_none(tmp_path, kind):
    (recording,) = Bag(write(tmp_path, kind, poses="none")).sequences()
    assert recording.poses() is None


def test_several_topics_are_several_lidars_with_their_places(tmp_path):
    (recording,) = Bag(
        write(tmp_path, "bag", TWIN_DRIVE), topics="/rear/points, /front/points"
    ).sequences()
    for sensor, expected in zip(recording.sensors, TWO[::-1], strict=True):
        assert sensor.name == f"/{expected.name}/points"
        np.testing.assert_allclose(sensor.vehicle_T_sensor, expected.vehicle_T_sensor, atol=1e-9)
    for frame in recording.frames:
        for index, cloud in enumerate(frame.read()):
            assert cloud.sensor == index
            assert (
                cloud.points.tobytes() == TWIN_DRIVE.scan(frame.number, 1 - index).points.tobytes()
            )


def test_the_message_nearest_in_time_belongs_to_a_frame_and_its_points_keep_their_times(tmp_path):
    late_ns = 30_000_000

    def messages(store):
        for child in ("one", "two"):
            yield store.transform("/tf_static", START_NS, BASE, child, np.eye(4))
        for frame in range(5):
            stamp = START_NS + frame * 100_000_000
            yield store.cloud(
                "/one", stamp, velodyne(POINTS, np.linspace(0, 0.09, len(POINTS))), "one"
            )
            if frame != 2:
                yield store.cloud(
                    "/two", stamp + late_ns, velodyne(POINTS + frame)[["x", "y", "z"]].copy(), "two"
                )

    recording = recording_of(tmp_path, "mcap", messages, topics="/one,/two")
    frames = [frame.read() for frame in recording.frames]
    assert [len(clouds) for clouds in frames] == [2, 2, 2, 2, 2]
    # that of frame 1 is 70 ms before
    assert frames[2][1].points[0, 0] == np.float32(POINTS[0, 0] + 1)
    np.testing.assert_allclose(frames[2][1].seconds, -0.07, atol=1e-9)
    np.testing.assert_allclose(frames[3][1].seconds, 0.03, atol=1e-9)


@pytest.mark.parametrize(
    ("stamps", "expected"), [([0, 0, 0], [0, 0.2, 0.4]), ([0, 10**8, 2 * 10**8], [0, 0.1, 0.2])]
)
def test_times_of_a_simulator_begin_at_0_and_those_that_nobody_filled_are_when_it_was_recorded(
    tmp_path, stamps, expected
):
    def messages(store):
        for frame, stamp in enumerate(stamps):
            topic, kind, _, message = store.cloud("/points", stamp, velodyne(POINTS))
            yield topic, kind, START_NS + frame * 200_000_000, message

    recording = recording_of(tmp_path, "db3", messages)
    np.testing.assert_allclose(recording.times(), expected, atol=1e-9)


def test_several_lidars_without_transforms_between_them_are_refused(tmp_path):
    def messages(store):
        for stamp in range(START_NS, START_NS + 300_000_000, 100_000_000):
            for name in ("one", "two"):
                yield store.cloud(f"/{name}", stamp, velodyne(POINTS), name)

    with raises(MissingDataError, expected="transforms from two to one", found="only no frames"):
        _ = recording_of(tmp_path, "db3", messages, topics="/one,/two").sensors


def clouds_and(*others):
    def messages(store):
        for frame in range(3):
            stamp = START_NS + frame * 100_000_000
            yield store.cloud("/points", stamp, velodyne(POINTS), LIDAR)
            for make in others:
                yield make(store, stamp, translation((frame, 0, 0)))

    return messages


@pytest.mark.parametrize("kind", KINDS)
def test_transforms_without_a_path_from_the_lidar_are_refused_with_the_frames_that_exist(
    tmp_path, kind
):
    unrelated = clouds_and(
        lambda store, stamp, pose: store.transform("/tf", stamp, WORLD, "camera", pose)
    )
    recording = recording_of(tmp_path, kind, unrelated, pose_topic="/tf")
    with pytest.raises(MissingDataError) as raised:
        recording.poses()
    assert "expected transforms from lidar to odom, found only odom > camera" in str(raised.value)


def test_poses_of_a_frame_that_the_lidar_has_no_path_to_are_refused_or_forced(tmp_path):
    recording = recording_of(
        tmp_path,
        "bag",
        clouds_and(lambda store, stamp, pose: store.odometry("/odom", stamp, pose, "imu")),
    )
    with raises(MissingDataError, expected="transforms from lidar to imu", found="only no frames"):
        recording.poses()
    np.testing.assert_array_equal(recording.sensors[0].vehicle_T_sensor, np.eye(4))
    assert recording.poses(force=True).world_T_vehicle[2, 0, 3] == 2
    assert any(
        "from lidar to imu: both are taken as the same frame" in note for note in recording.notes()
    )
    (recording,) = Bag(tmp_path / "drive.bag", pose_frame="lidar").sequences()
    assert recording.poses().world_T_vehicle[2, 0, 3] == 2


def test_poses_of_another_time_are_refused_with_both_spans(tmp_path):
    late = clouds_and(
        lambda store, stamp, pose: store.odometry("/odom", stamp + 10**12, pose, LIDAR)
    )
    recording = recording_of(tmp_path, "db3", late)
    with pytest.raises(
        FormatError,
        match=r"poses between 1700000000.123 and 1700000000.323 s.*found 1700001000.123 to",
    ):
        recording.poses()


def test_a_quaternion_that_is_no_rotation_is_named(tmp_path):
    def zero(store, stamp, pose):
        message = store.odometry("/odom", stamp, pose, LIDAR)
        message[3].pose.pose.orientation.w = 0.0
        return message

    with raises(
        FormatError, where="/odom", expected="a rotation: a quaternion w, x, y, z of length 1"
    ):
        recording_of(tmp_path, "mcap", clouds_and(zero)).poses()


def test_poses_of_the_tree_are_in_odom_unless_another_frame_is_asked_for(tmp_path):
    chain = clouds_and(
        lambda store, stamp, pose: store.transform("/tf", stamp, "map", WORLD, pose),
        lambda store, stamp, pose: store.transform("/tf", stamp + 1, WORLD, BASE, pose),
        lambda store, stamp, pose: store.transform(
            "/tf_static", stamp, BASE, LIDAR, translation((0, 0, 1.5))
        ),
    )
    (tmp_path / "one").mkdir()
    recording = recording_of(tmp_path / "one", "bag", chain)
    np.testing.assert_allclose(recording.poses().world_T_vehicle[:, 0, 3], [0, 1, 2])
    (recording,) = Bag(tmp_path / "one", world_frame="map").sequences()
    np.testing.assert_allclose(
        recording.poses().at(recording.times())[:, 0, 3], [0, 2, 4], atol=1e-6
    )
    (recording,) = Bag(tmp_path / "one", world_frame="utm").sequences()
    with raises(MissingDataError, expected="transforms from lidar to utm", found="only"):
        recording.poses()


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_with_one_message_of_points_is_one_frame(tmp_path, kind):
    drive = SimulatedDrive(1, rolling=True)
    result = convert(
        "bag", write(tmp_path, kind, drive), tmp_path / "out", grids=None, run=Run(workers=1)
    )
    assert result.failures == ()
    (sequence,) = carlasc.open(tmp_path / "out").sequences().values()
    assert sequence.frames("points").tolist() == [0]


class BagContract(ConverterContract):
    ids = {}  # noqa: RUF012 (a bag has no classes)
    drive = TWIN_DRIVE
    points_m = 5e-3  # corrected for motion by poses that are interpolated
    keeps = frozenset({"poses", "times", "seconds"})
    options = {"topics": "/front/points,/rear/points"}  # noqa: RUF012
    converter = "bag"
    kind: str

    def write(self, folder):
        write(folder, self.kind, self.drive, "tf")


class TestRos1Bag(BagContract):
    kind = "bag"


class TestSqliteBag(BagContract):
    kind = "db3"


class TestMcapBag(BagContract):
    kind = "mcap"


def test_every_kind_of_bag_gives_the_same_grids_byte_for_byte(tmp_path):
    drive, spec = (
        SimulatedDrive(5, rolling=True, channels=12, columns=120),
        GridSpec.published().with_size((32, 32, 4)),
    )
    grids = []
    for kind in KINDS:
        (tmp_path / kind).mkdir()
        bag = write(tmp_path / kind, kind, drive)
        result = convert(
            "bag", bag, tmp_path / f"{kind}.out", grids=GridOptions(spec), run=Run(workers=1)
        )
        assert result.failures == ()
        files = sorted((tmp_path / f"{kind}.out").glob("**/evaluation*/0*"))
        grids.append({file.name: file.read_bytes() for file in files})
    assert len(grids[0]) >= 2 * drive.frames and any(any(data) for data in grids[0].values())
    assert grids[0] == grids[1] == grids[2]


def write_large(folder, kind, count, size):
    """Write a bag of a vehicle that stands still, with `count` scans of `size` points: 32 bytes
    each.
    """
    store, random = Messages(kind), np.random.default_rng(0)
    angles, down = random.uniform(0, 2 * np.pi, size), random.uniform(0.02, 0.4, size)
    reach = np.minimum(1.7 / np.sin(down), 40)
    rays = np.stack(
        [np.cos(down) * np.cos(angles), np.cos(down) * np.sin(angles), -np.sin(down)], axis=1
    )
    points = np.column_stack([rays * reach[:, None], angles]).astype(np.float32)

    def messages():
        for stamp in range(START_NS, START_NS + count * 100_000_000, 100_000_000):
            yield store.cloud("/points", stamp, velodyne(points, angles / 70), LIDAR)
            yield store.odometry("/odom", stamp, np.eye(4), LIDAR)

    return write_bag(folder, kind, messages(), store=store)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_memory_does_not_grow_with_the_bag(tmp_path, kind):
    peaks = []
    for count in (25, 100):  # 80 and 320 MB
        (tmp_path / str(count)).mkdir()
        bag = write_large(tmp_path / str(count), kind, count, 100_000)
        code = (
            "from carlasc.converting import convert; from carlasc.running import Run\n"
            f"result = convert('bag', {str(bag)!r}, {str(tmp_path / f'out{count}')!r}, "
            f"grids=None, run=Run(workers=1))\n"
            f"assert len(result.failures) == 0\n{PRINT_PEAK}"
        )
        run = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        )
        peaks.append(int(run.stdout) / 1024)
        shutil.rmtree(bag.parent)
    assert peaks[1] < 500, peaks
    assert peaks[1] - peaks[0] < 60, peaks


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_a_bag_that_was_written_again_is_read_again(tmp_path, kind):
    for poses in ("odometry", "pose"):
        bag = write(tmp_path, kind, poses=poses)
        (recording,) = Bag(bag).sequences()
        assert [len(frame.read()[0].points) > 0 for frame in recording.frames] == [
            True
        ] * DRIVE.frames
        shutil.rmtree(bag) if bag.is_dir() else bag.unlink()
    with raises(MissingDataError, expected="a bag: .bag, .db3, .mcap", found="nothing"):
        recording.frames[0].read()


def test_transforms_that_move_something_else_are_noted(tmp_path):
    def messages(store):
        found = drive_messages(store, DRIVE, "tf")
        return [message for message in found if message[0] != "/tf_static"]

    recording = recording_of(tmp_path, "mcap", messages)
    assert recording.poses() is None
    note = recording.notes()[0]
    assert note.endswith(f"transforms do not say how lidar moves, only {WORLD} > {BASE}")
