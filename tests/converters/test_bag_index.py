"""Bags that are compressed, cut short or damaged: what is whole is read, and what is lost is said."""

import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from carlasc_converters.bag import Bag
from carlasc_converters.bag_messages import decompressed
from carlasc_converters.bag_topics import BagFiles
from helpers.converters.bags import KINDS, Messages, drive_messages, file_of, write_bag
from helpers.errors import raises

from carlasc.errors import CarlascError, DependencyError, FormatError, MissingDataError
from carlasc.testing import SimulatedDrive

pytestmark = pytest.mark.needs("rosbags")


class RandomDrive(SimulatedDrive):
    """A drive whose scans are random points: 0.4 MB each, of which some are in a chunk."""

    def scan(self, frame, sensor=0):
        points = np.random.default_rng(frame).uniform(1, 50, (12_000, 4)).astype(np.float32)
        return SimpleNamespace(points=points, seconds=np.linspace(0, 0.1, len(points)))


DRIVE = RandomDrive(24, rolling=True)
CODECS = [
    ("bag", "bz2"),
    ("bag", "lz4"),
    ("db3", "message"),
    ("mcap", "message"),
    ("mcap", "storage"),
]


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """The file of each kind, by kind and codec."""
    found = {}
    for kind, codec in [(kind, "") for kind in KINDS] + CODECS:
        store = Messages(kind)
        folder = tmp_path_factory.mktemp(f"{kind}{codec}")
        found[kind, codec] = file_of(
            write_bag(
                folder, kind, drive_messages(store, DRIVE, "tf"), store=store, compressed=codec
            )
        )
    return found


def cut(path, share, folder):
    """Write the first part of a file's bytes into a folder."""
    whole = path.read_bytes()
    copy = folder / path.name
    copy.write_bytes(whole[: int(len(whole) * share)])
    return copy


def lost_of(recording):
    """Return what the recording says of its file."""
    return [note for note in recording.notes() if re.match(r".*: (it|its) ", note)]


def check_frames(recording):
    """Compare every point that is read with that of the drive."""
    for frame in recording.frames:
        (cloud,) = frame.read()
        assert cloud.points.tobytes() == DRIVE.scan(frame.number).points.tobytes()


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "codec"), CODECS)
def test_compressed_bags_hold_the_same_points(bags, kind, codec):
    (recording,) = Bag(bags[kind, codec]).sequences()
    assert len(recording.frames) == DRIVE.frames and lost_of(recording) == []
    check_frames(recording)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("share", "least"), [(0.3, 3), (0.7, 12), (0.99, 19)])
def test_a_bag_that_is_cut_short_gives_what_is_whole(bags, kind, share, least, tmp_path):
    path = cut(bags[kind, ""], share, tmp_path)
    (recording,) = Bag(path).sequences()
    assert least <= len(recording.frames) <= DRIVE.frames
    check_frames(recording)
    (note,) = lost_of(recording)
    assert note.startswith(f"{path}: ") and str(path.stat().st_size) in note
    truth = DRIVE.world_T_vehicle(recording.times())
    assert np.abs(recording.poses().at(recording.times()) - truth)[:least].max() < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "codec"), CODECS)
@pytest.mark.parametrize("share", [0.3, 0.7, 0.99])
def test_a_compressed_bag_that_is_cut_short_gives_what_is_whole_or_says_why_not(
    bags, kind, codec, share, tmp_path
):
    path = cut(bags[kind, codec], share, tmp_path)
    try:
        (recording,) = Bag(path).sequences()
    except CarlascError as error:
        assert share == 0.3 and str(path.stat().st_size) in str(error) and "\n" not in str(error)
        return
    assert recording.frames
    check_frames(recording)
    assert len(lost_of(recording)) == 1


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [0, 5, 20, 100, 4096 + 20, 20000])
def test_a_bag_of_which_little_is_left_is_named_in_one_line(bags, kind, size, tmp_path):
    path = tmp_path / bags[kind, ""].name
    path.write_bytes(bags[kind, ""].read_bytes()[:size])
    with pytest.raises((FormatError, MissingDataError)) as raised:
        Bag(path).sequences()
    assert str(path) in str(raised.value) and "\n" not in str(raised.value)


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_a_bag_whose_end_is_missing_loses_nothing_else(bags, kind, tmp_path):
    path = tmp_path / bags[kind, ""].name
    path.write_bytes(bags[kind, ""].read_bytes()[:-4])
    (recording,) = Bag(path).sequences()
    assert len(recording.frames) == DRIVE.frames
    assert len(lost_of(recording)) == 1


def test_a_bag_that_its_recorder_did_not_close_is_read(bags, tmp_path):
    data = bytearray(bags["bag", ""].read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    end = int.from_bytes(data[at : at + 8], "little")
    data[at : at + 8] = bytes(8)
    (tmp_path / "drive.bag.active").write_bytes(data[:end])
    (recording,) = Bag(tmp_path).sequences()
    assert recording.name == "drive" and len(recording.frames) == DRIVE.frames
    check_frames(recording)
    (note,) = lost_of(recording)
    assert "its recorder did not close it" in note


@pytest.mark.parametrize(("kind", "codec"), [("bag", "lz4"), ("mcap", "storage")])
@pytest.mark.parametrize("place", [0.1, 0.5])
def test_a_damaged_chunk_costs_its_frames_only(bags, kind, codec, place, tmp_path):
    data = bytearray(bags[kind, codec].read_bytes())
    chunks = np.unique(BagFiles([bags[kind, codec]]).topics["/lidar/points"].parts[0][2]["chunk"])
    begin = int(chunks[int(len(chunks) * place)]) + 200
    data[begin : begin + 300_000] = bytes(300_000)
    path = tmp_path / bags[kind, codec].name
    path.write_bytes(data)
    (recording,) = Bag(path).sequences()
    assert len(recording.frames) == DRIVE.frames
    failed = 0
    for frame in recording.frames:
        try:
            (cloud,) = frame.read()
        except FormatError as error:
            assert str(path) in str(error) and "\n" not in str(error)
            failed += 1
        else:
            assert cloud.points.tobytes() == DRIVE.scan(frame.number).points.tobytes()
    assert 1 <= failed <= DRIVE.frames // 4
    assert 0 < DRIVE.times[-1] - recording.times()[-1] + 1e-9 < 0.1 * failed + 1e-6
    # with the only message of /tf_static, so nobody knows where the LiDAR is on the vehicle
    if place < 0.2:
        assert recording.poses() is None
    else:
        truth = DRIVE.world_T_vehicle(recording.times())
        assert (
            np.abs(recording.poses().at(recording.times()) - truth)[: DRIVE.frames // 3].max()
            < 1e-9
        )
    assert any("messages are left out" in note for note in recording.notes())


def test_damage_between_chunks_loses_what_follows(bags, tmp_path):
    """The header of a record is overwritten, and with it the end of the chunk before."""
    data = bytearray(bags["bag", "lz4"].read_bytes())
    chunks = np.unique(BagFiles([bags["bag", "lz4"]]).topics["/lidar/points"].parts[0][2]["chunk"])
    begin = int(chunks[len(chunks) // 2])
    data[begin - 3000 : begin + 200] = bytes(3200)
    path = tmp_path / "drive.bag"
    path.write_bytes(data)
    (recording,) = Bag(path).sequences()
    assert DRIVE.frames // 4 < len(recording.frames) < DRIVE.frames
    check_frames(recording)
    (note,) = lost_of(recording)
    assert "cut short or damaged at byte" in note


def test_a_chunk_that_does_not_fit_its_checksum_is_named(tmp_path):
    writer_of = pytest.importorskip("mcap.writer")
    path = tmp_path / "drive.mcap"
    with path.open("wb") as file:
        writer = writer_of.Writer(file, compression=writer_of.CompressionType.NONE)
        writer.start()
        schema = writer.register_schema("foxglove.PointCloud", "protobuf", b"")
        writer.add_message(writer.register_channel("/points", "protobuf", schema), 1, b"points", 1)
        writer.finish()
    path.write_bytes(path.read_bytes().replace(b"points", b"damage"))
    with raises(FormatError, expected="checksum"):
        Bag(path).sequences()[0].frames[0].read()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "codec"), [("bag", ""), ("bag", "lz4"), ("db3", ""), ("mcap", ""), ("mcap", "storage")]
)
def test_damage_anywhere_is_an_error_of_one_line_or_harmless(kind, codec, tmp_path):
    store, random, drive = (
        Messages(kind),
        np.random.default_rng(7),
        SimulatedDrive(4, channels=6, columns=40),
    )
    path = file_of(
        write_bag(tmp_path, kind, drive_messages(store, drive, "tf"), store=store, compressed=codec)
    )
    whole = path.read_bytes()
    harmless = 0
    for _ in range(60):
        data = np.frombuffer(whole, np.uint8).copy()
        data[random.integers(0, min(len(data), 8000), 3)] = random.integers(0, 256, 3)
        path.write_bytes(data[: random.integers(len(data) // 2, 2 * len(data))].tobytes())
        try:
            (recording,) = Bag(path).sequences()
            assert recording.poses() is not None or recording.notes()
            assert all(len(frame.read()) == len(recording.sensors) for frame in recording.frames)
            harmless += 1
        except CarlascError as error:
            assert "\n" not in str(error)
    assert 0 < harmless < 60


def test_a_codec_that_nobody_knows_is_named():
    with raises(
        FormatError,
        where="drive.bag",
        expected="chunks that are not compressed, or",
        found="'snappy'",
    ):
        decompressed(b"", "snappy", "drive.bag")


def test_a_codec_that_is_not_installed_is_named_with_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "lz4.frame", None)
    with raises(DependencyError, advice=r"install it with `pip install .*\[bags\]'`"):
        decompressed(b"", "lz4", "drive.bag")
