"""Points as the common drivers publish them: Velodyne, Ouster, Hesai and Livox, with the times of
points in their units.
"""

import numpy as np
import pytest
from carlasc_converters.bag import Bag
from helpers.converters.bags import KINDS, START_NS, Messages, velodyne, write_bag
from helpers.errors import raises

from carlasc.errors import FormatError

pytestmark = pytest.mark.needs("rosbags")
FRAMES, COUNT, PERIOD_NS = 3, 200, 100_000_000
SECONDS = np.linspace(0, 0.0995, COUNT)
OUSTER = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "t", "reflectivity", "ring", "ambient", "range"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u4", "<u2", "<u1", "<u2", "<u4"],
        "offsets": [0, 4, 8, 16, 20, 24, 26, 28, 32],
        "itemsize": 48,
    }
)
HESAI = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "timestamp", "ring"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<f8", "<u2"],
        "offsets": [0, 4, 8, 16, 24, 32],
        "itemsize": 48,
    }
)
LIVOX = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "tag", "line", "timestamp"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "u1", "u1", "<f8"],
        "offsets": [0, 4, 8, 12, 16, 17, 18],
        "itemsize": 26,
    }
)


def xyz_of(frame):
    return np.random.default_rng(frame).uniform(1, 50, (COUNT, 4)).astype(np.float32)


def packed(layout, frame, name, times):
    points = np.zeros(COUNT, layout)
    for column, axis in enumerate(("x", "y", "z", "intensity")):
        points[axis] = xyz_of(frame)[:, column]
    points[name] = times
    return points


def clouds(store, driver):
    """Yield the messages of a driver: frame 1 begins PERIOD_NS after frame 0, and so on."""
    for frame in range(FRAMES):
        stamp = START_NS + frame * PERIOD_NS
        if driver == "velodyne":
            yield store.cloud("/velodyne_points", stamp, velodyne(xyz_of(frame), SECONDS))
        elif driver == "ouster":
            yield store.cloud("/points", stamp, packed(OUSTER, frame, "t", np.round(SECONDS * 1e9)))
        elif driver == "hesai":
            yield store.cloud(
                "/points", stamp, packed(HESAI, frame, "timestamp", stamp * 1e-9 + SECONDS)
            )
        elif driver == "livox":
            yield store.cloud(
                "/points", stamp, packed(LIVOX, frame, "timestamp", stamp + SECONDS * 1e9)
            )
        else:
            points, offsets = xyz_of(frame), np.round(SECONDS * 1e9).astype(int).tolist()
            rows = [
                (at, *row[:3], int(row[3]), 16, 2)
                for at, row in zip(offsets, points.tolist(), strict=True)
            ]
            yield store.livox("/livox/lidar", stamp, rows, driver)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "driver", ["velodyne", "ouster", "hesai", "livox", "livox_ros_driver", "livox_ros_driver2"]
)
def test_points_and_their_times_are_those_of_the_driver(kind, driver, tmp_path):
    store = Messages(kind)
    (recording,) = Bag(write_bag(tmp_path, kind, clouds(store, driver), store=store)).sequences()
    np.testing.assert_allclose(recording.times(), np.arange(FRAMES) * 0.1, atol=1e-9)
    for frame in recording.frames:
        (cloud,) = frame.read()
        expected = xyz_of(frame.number)
        expected[:, 3] = (
            expected[:, 3].astype(int) if driver.startswith("livox_") else expected[:, 3]
        )
        assert cloud.points.tobytes() == expected.tobytes()
        assert np.abs(cloud.seconds - SECONDS).max() < 1e-6


def test_times_of_another_clock_count_from_the_first_point(tmp_path):
    store = Messages("db3")
    since_boot = store.cloud(
        "/points", START_NS, packed(LIVOX, 0, "timestamp", 5e15 + SECONDS * 1e9)
    )
    (recording,) = Bag(write_bag(tmp_path, "db3", [since_boot], store=store)).sequences()
    (cloud,) = recording.frames[0].read()
    assert np.abs(cloud.seconds - SECONDS).max() < 1e-6


def test_an_mcap_of_ros_1_is_read(tmp_path):
    writer_of = pytest.importorskip("mcap.writer")
    store = Messages("bag")
    with (tmp_path / "drive.mcap").open("wb") as file:
        writer = writer_of.Writer(file)
        writer.start("ros1")
        schema = writer.register_schema("sensor_msgs/PointCloud2", "ros1msg", b"")
        channel = writer.register_channel("/velodyne_points", "ros1", schema)
        for _, kind, stamp, message in clouds(store, "velodyne"):
            writer.add_message(
                channel, stamp, bytes(store.store.serialize_ros1(message, kind)), stamp
            )
        writer.finish()
    (recording,) = Bag(tmp_path / "drive.mcap").sequences()
    assert [frame.read()[0].points.tobytes() for frame in recording.frames] == [
        xyz_of(frame).tobytes() for frame in range(FRAMES)
    ]
    np.testing.assert_allclose(recording.times(), np.arange(FRAMES) * 0.1, atol=1e-9)


def test_times_in_no_known_unit_are_named_until_the_unit_is_given(tmp_path):
    store = Messages("db3")
    cloud = store.cloud("/points", START_NS, packed(OUSTER, 0, "t", np.arange(COUNT) * 10))
    bag = write_bag(tmp_path, "db3", [cloud], store=store)
    with raises(FormatError, advice="give their unit with `time_unit`"):
        _ = Bag(bag).sequences()[0].frames
    (cloud,) = Bag(bag, time_unit="us").sequences()[0].frames[0].read()
    np.testing.assert_allclose(cloud.seconds, np.arange(COUNT) * 1e-5)


def test_points_without_a_return_are_left_out(tmp_path):
    store = Messages("mcap")
    points = velodyne(xyz_of(0), SECONDS)
    points["x"][3], points["y"][5] = np.nan, np.inf
    for axis in "xyz":
        points[axis][7] = 0
    (recording,) = Bag(
        write_bag(tmp_path, "mcap", [store.cloud("/points", START_NS, points)], store=store)
    ).sequences()
    (cloud,) = recording.frames[0].read()
    kept = np.delete(np.arange(COUNT), [3, 5, 7])
    assert cloud.points.tobytes() == xyz_of(0)[kept].tobytes()
    assert np.abs(cloud.seconds - SECONDS[kept]).max() < 1e-6


def test_a_message_without_points_is_named(tmp_path):
    store = Messages("mcap")
    empty = store.cloud("/points", START_NS, velodyne(np.zeros((5, 4), np.float32)))
    (recording,) = Bag(write_bag(tmp_path, "mcap", [empty], store=store)).sequences()
    with raises(FormatError, where="/points: message 0", expected="points", found="none"):
        recording.frames[0].read()
