"""Which topics of a bag are used, which files belong together, and what is said where that is not
clear.
"""

import numpy as np
import pytest
from carlasc_converters.bag import Bag
from carlasc_converters.bag_topics import find_bags
from helpers.converters.bags import (
    KINDS,
    START_NS,
    Messages,
    file_of,
    velodyne,
    write_bag,
    write_one_message,
)

from carlasc.errors import ArgumentError, CarlascError, FormatError, MissingDataError

pytestmark = pytest.mark.needs("rosbags")
POINTS = np.random.default_rng(0).uniform(1, 50, (50, 4)).astype(np.float32)


def bag_of(folder, kind, *topics, frames=3, period_ns=100_000_000, start_ns=START_NS):
    """Write a bag of topics: of points, or of poses if the name ends in "odom"."""
    store = Messages(kind)
    messages = []
    for stamp in range(start_ns, start_ns + frames * period_ns, period_ns):
        for topic in topics:
            if topic.endswith("odom"):
                messages.append(store.odometry(topic, stamp, np.eye(4)))
            elif topic == "/chatter":
                messages.append(store.imu(topic, stamp))
            else:
                messages.append(store.cloud(topic, stamp, velodyne(POINTS)))
    return write_bag(folder, kind, messages, store=store)


def refused(error, call):
    with pytest.raises(error) as raised:
        call()
    assert "\n" not in str(raised.value)
    return str(raised.value)


@pytest.mark.parametrize("kind", KINDS)
def test_several_topics_of_points_are_listed_with_counts_and_rates(tmp_path, kind):
    bag = bag_of(tmp_path, kind, "/front", "/rear", "/odom")
    message = refused(ArgumentError, lambda: Bag(bag).sequences())
    assert (
        "topics: expected one or several of /front (PointCloud2, 3 messages, 10 Hz), /rear "
        "(PointCloud2" in message
    )
    (recording,) = Bag(bag, topics="/rear").sequences()
    assert [sensor.name for sensor in recording.sensors] == ["/rear"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_without_points_is_named_with_what_it_has(tmp_path, kind):
    bag = bag_of(tmp_path, kind, "/chatter", "/odom")
    message = refused(MissingDataError, lambda: Bag(bag).sequences())
    assert "found /chatter (String, 3 messages, 10 Hz), /odom (Odometry" in message
    assert "replay them with its driver" in message


def test_a_topic_that_does_not_exist_or_has_another_type_is_named(tmp_path):
    bag = bag_of(tmp_path, "bag", "/points", "/chatter", "/odom")
    message = refused(ArgumentError, lambda: Bag(bag, topics="/lidar").sequences())
    assert (
        "topics: expected one of /points (PointCloud2, 3 messages, 10 Hz) in" in message
        and "'/lidar'" in message
    )
    message = refused(ArgumentError, lambda: Bag(bag, topics="/chatter").sequences())
    assert "found /chatter (String, 3 messages, 10 Hz), which is not read" in message
    (recording,) = Bag(bag, pose_topic="/chatter").sequences()
    message = refused(ArgumentError, recording.poses)
    assert "pose_topic: expected one of /odom (Odometry, 3 messages, 10 Hz) in" in message


def test_points_in_an_encoding_that_is_not_read_are_named(tmp_path):
    pytest.importorskip("mcap.writer")
    write_one_message(tmp_path / "drive.mcap", "flatbuffer", b"")
    for options in ({}, {"topics": "/points"}):
        message = refused(
            CarlascError,
            lambda options=options: Bag(tmp_path / "drive.mcap", **options).sequences(),
        )
        assert "found /points (foxglove.PointCloud as flatbuffer, 1 messages)" in message


def test_several_topics_of_poses_are_listed(tmp_path):
    bag = bag_of(tmp_path, "db3", "/points", "/wheel_odom", "/visual_odom")
    (recording,) = Bag(bag).sequences()
    message = refused(ArgumentError, recording.poses)
    assert (
        "pose_topic: expected one of /visual_odom (Odometry, 3 messages, 10 Hz), /wheel_odom"
        in message
    )
    (recording,) = Bag(bag, pose_topic="/wheel_odom", pose_frame="lidar").sequences()
    assert recording.poses().where.endswith("/wheel_odom")


@pytest.mark.parametrize("kind", KINDS)
def test_messages_of_a_packet_each_are_refused_with_what_to_do(tmp_path, kind):
    bag = bag_of(tmp_path, kind, "/packets", frames=20, period_ns=1_327_000)
    message = refused(FormatError, lambda: Bag(bag).sequences())
    assert (
        "/packets: expected a message for each turn of the LiDAR, found 20 messages, 754 per second"
        in message
    )
    assert "set the driver to publish full turns" in message


@pytest.mark.parametrize("kind", KINDS)
def test_parts_of_a_recording_are_one_and_other_bags_are_others(tmp_path, kind):
    ending = f".{kind}"
    for number, name in enumerate(("drive_0", "drive_1", "drive_2", "other", "run_4", "run_5")):
        (tmp_path / name).mkdir()
        file = file_of(
            bag_of(tmp_path / name, kind, "/points", start_ns=START_NS + number * 300_000_000)
        )
        file.rename(tmp_path / f"{name}{ending}")
    found = [[path.name.removesuffix(ending) for path in paths] for paths in find_bags(tmp_path)]
    assert found == [["drive_0", "drive_1", "drive_2"], ["other"], ["run_4"], ["run_5"]]
    recording = Bag(tmp_path).sequences()[0]
    assert recording.name == "drive" and len(recording.frames) == 9
    np.testing.assert_allclose(recording.times(), np.arange(9) * 0.1, atol=1e-9)
    assert recording.frames[8].read()[0].points.tobytes() == POINTS.tobytes()
    assert any("3 files are parts of one recording" in note for note in recording.notes())


def test_a_folder_without_bags_a_packed_bag_and_another_file_are_named(tmp_path):
    assert "expected a bag: .bag, .db3, .mcap, found none" in refused(
        MissingDataError, lambda: Bag(tmp_path).sequences()
    )
    packed = tmp_path / "drive_0.db3.zstd"
    packed.write_bytes(b"\x28\xb5\x2f\xfd")
    for source in (tmp_path, packed):
        message = refused(
            (MissingDataError, FormatError), lambda source=source: Bag(source).sequences()
        )
        assert "unpack it with `zstd -d drive_0.db3.zstd`" in message
    (tmp_path / "drive.bag").write_text("#ROSBAG V1.2\n")
    message = refused(FormatError, lambda: Bag(tmp_path / "drive.bag").sequences())
    assert "drive.bag: expected a bag: .bag, .db3, .mcap, found another kind of file" in message
