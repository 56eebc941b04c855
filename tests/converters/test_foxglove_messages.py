"""Foxglove's own messages: what `view` writes comes back, and JSON says the same as protobuf."""

import base64
import json

import numpy as np
import pytest
from carlasc_converters.bag import Bag
from carlasc_converters.foxglove_messages import read_message
from helpers.converters.bags import write_one_message
from helpers.errors import raises
from helpers.scenes.road_blocks import write_blocks

from carlasc.core.geometry import quaternions_of, rotation_z, translation
from carlasc.errors import FormatError
from carlasc.storage import FolderSink, layout
from carlasc.viewing import Scene, view

FRAMES, POSES = (
    3,
    np.stack([translation((2.0 * i, 1.0 * i, 0.0)) @ rotation_z(0.1 * i) for i in range(3)]),
)


@pytest.mark.needs("foxglove")
def test_the_points_and_poses_of_a_recording_that_view_writes_come_back(tmp_path):
    folder = write_blocks(tmp_path / "Train" / "Town01_Light" / "cartesian")
    FolderSink(folder.parent).sequence(folder.name).write_document(
        layout.POSES, layout.encode_poses(POSES)
    )
    view(folder, tmp_path / "scene.mcap", full_points=True)
    (recording,) = Bag(tmp_path / "scene.mcap").sequences()
    assert recording.name == "scene" and len(recording.frames) == FRAMES
    poses = recording.poses()
    notes = recording.notes()
    assert any("not read: " in note for note in notes)
    assert not any("transforms that were not used" in note for note in notes)
    reader = Scene(folder).open().right_handed()
    for frame in recording.frames:
        (cloud,) = frame.read()
        assert (
            cloud.points[:, :3].tobytes()
            == np.ascontiguousarray(reader.read(frame.number).scan.points).tobytes()
        )
        assert cloud.seconds is None
    np.testing.assert_allclose(recording.times(), [0.0, 0.1, 0.2], atol=1e-9)
    expected = np.stack([reader.read(frame).pose for frame in range(FRAMES)])
    np.testing.assert_allclose(poses.at(recording.times()), expected, atol=1e-9)


def pose_json(pose):
    w, i, j, k = quaternions_of(pose[None, :3, :3])[0].tolist()
    x, y, z = pose[:3, 3].tolist()
    return {"position": {"x": x, "y": y, "z": z}, "orientation": {"x": i, "y": j, "z": k, "w": w}}


def write_json(path, poses_topic, points, cloud_pose, **options):
    """Write points and poses with the library of the format, as JSON."""
    writer_of = pytest.importorskip("mcap.writer")
    if "compression" in options:
        options["compression"] = writer_of.CompressionType[options["compression"]]
    if "index_types" in options:
        options["index_types"] = writer_of.IndexType[options["index_types"]]
    with path.open("wb") as file:
        writer = writer_of.Writer(file, **options)
        writer.start()
        channels = {}
        for topic, kind in (("/points", "PointCloud"), (poses_topic, "PoseInFrame")):
            schema = writer.register_schema(f"foxglove.{kind}", "jsonschema", b"{}")
            channels[topic] = writer.register_channel(topic, "json", schema)
        for frame, pose in enumerate(POSES):
            stamp = 5 * 10**9 + frame * 10**8
            head = {
                "timestamp": {"sec": stamp // 10**9, "nsec": stamp % 10**9},
                "frame_id": "lidar",
            }
            fields = [
                {"name": name, "offset": 4 * i, "type": 7}
                for i, name in enumerate(("x", "y", "z", "intensity"))
            ]
            data = base64.b64encode(points.tobytes()).decode()
            cloud = head | {"pose": cloud_pose, "point_stride": 16, "fields": fields, "data": data}
            for topic, message in (
                ("/points", cloud),
                (poses_topic, head | {"frame_id": "map", "pose": pose_json(pose)}),
            ):
                writer.add_message(channels[topic], stamp, json.dumps(message).encode(), stamp)
        writer.finish()


@pytest.mark.parametrize("moved", [np.eye(4), translation((1, 2, 3)) @ rotation_z(0.3)])
def test_json_is_read_and_the_pose_of_a_cloud_is_applied(tmp_path, moved):
    points = np.random.default_rng(0).uniform(-20, 20, (100, 4)).astype(np.float32)
    write_json(tmp_path / "drive.mcap", "/pose", points, pose_json(moved))
    (recording,) = Bag(tmp_path / "drive.mcap").sequences()
    for frame in recording.frames:
        (cloud,) = frame.read()
        expected = points[:, :3].astype(np.float64) @ moved[:3, :3].T + moved[:3, 3]
        np.testing.assert_allclose(cloud.points[:, :3], expected, atol=1e-5)
        assert cloud.points[:, 3].tobytes() == points[:, 3].tobytes()
    np.testing.assert_allclose(recording.poses().world_T_vehicle, POSES, atol=1e-12)
    assert any("which is assumed" in note for note in recording.notes())


@pytest.mark.parametrize(
    "options",
    [
        {"compression": "LZ4"},
        {"compression": "NONE"},
        {"use_chunking": False},
        {"index_types": "NONE"},
        {"chunk_size": 1},
    ],
)
def test_files_of_any_structure_hold_the_same(tmp_path, options):
    points = np.random.default_rng(0).uniform(-20, 20, (100, 4)).astype(np.float32)
    write_json(tmp_path / "drive.mcap", "/pose", points, pose_json(np.eye(4)), **options)
    (recording,) = Bag(tmp_path / "drive.mcap").sequences()
    assert [frame.read()[0].points.tobytes() for frame in recording.frames] == [
        points.tobytes()
    ] * FRAMES
    np.testing.assert_allclose(recording.poses().world_T_vehicle, POSES, atol=1e-12)
    assert not any("cut short" in note or "finished" in note for note in recording.notes())


def test_protobuf_that_is_cut_short_is_no_message():
    with pytest.raises(ValueError, match="cut short"):
        read_message(b"\x12\x08base", "foxglove.FrameTransform", "protobuf")
    with pytest.raises(ValueError, match="more than 64 bits"):
        read_message(b"\xff" * 12, "foxglove.FrameTransform", "protobuf")


def test_a_message_that_is_none_is_named(tmp_path):
    pytest.importorskip("mcap.writer")
    write_one_message(tmp_path / "drive.mcap", "protobuf", b"\x0a\xff")
    with raises(
        FormatError,
        where="/points",
        expected="a message of type foxglove.PointCloud",
        found="something else",
    ):
        _ = Bag(tmp_path / "drive.mcap").sequences()[0].frames
