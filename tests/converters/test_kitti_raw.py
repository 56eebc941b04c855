"""KITTI's raw data: what is read of a simulated drive in its format, and what is said of wrong
files.
"""

import pickle
import re

import numpy as np
import pytest
from carlasc_converters.kitti_boxes import KITTI, KITTI_TO_CARLA
from carlasc_converters.kitti_raw import KittiRaw
from carlasc_converters.tracklets import read_tracklets
from converters.formats.kitti_drive import small_drive, write_packets, write_stamps
from converters.formats.kitti_raw import DRIVE, tracklets_of, write_raw

from carlasc.errors import CarlascError, FormatError, MissingDataError

LABELS = {
    kind: KITTI.id_of(name)
    for kind, name in (("car", "Car"), ("van", "Van"), ("pedestrian", "Pedestrian"))
}
LABELS |= {"cyclist": KITTI.id_of("Cyclist")}
TRUTH = small_drive()


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("raw")
    write_raw(folder, TRUTH, LABELS, oxts_late_s=0.004)
    return folder


@pytest.fixture
def copy(tmp_path):
    """A drive that a test may damage."""
    return write_raw(tmp_path, TRUTH, LABELS)


def recording_of(folder):
    (recording,) = KittiRaw(folder).sequences()
    return recording


def test_points_are_kept_and_their_times_are_those_of_the_sweep(root):
    recording = recording_of(root)
    assert [frame.number for frame in recording.frames] == list(range(TRUTH.frames))
    for frame in recording.frames:
        (cloud,) = frame.read()
        scan = TRUTH.scan(frame.number)
        assert cloud.points.tobytes() == scan.points.tobytes()
        assert np.abs(cloud.seconds - scan.seconds).max() < 1e-6
        assert cloud.labels is None and cloud.instances is None
    assert not recording.sensors[0].deskewed
    assert not recording.has_labels


def test_points_put_in_place_by_their_times_are_those_of_the_instant(root):
    recording = recording_of(root)
    trajectory, times = recording.poses(), recording.times()
    for frame in recording.frames[1:-1]:
        (cloud,) = frame.read()
        now = trajectory.at(times[frame.number : frame.number + 1])[0]
        then = np.linalg.inv(now) @ trajectory.at(times[frame.number] + cloud.seconds)
        placed = np.einsum("nij,nj->ni", then[:, :3, :3], cloud.points[:, :3]) + then[:, :3, 3]
        assert np.abs(placed - TRUTH.scan(frame.number).deskewed[:, :3]).max() < 2e-3
        assert np.abs(cloud.points[:, :3] - TRUTH.scan(frame.number).deskewed[:, :3]).max() > 0.2


def test_poses_are_those_of_the_lidar_at_the_times_of_the_packets(root):
    trajectory = recording_of(root).poses()
    assert np.abs(trajectory.seconds - (TRUTH.times + 0.004)).max() < 1e-8
    truth = TRUTH.world_T_lidar(trajectory.seconds)
    assert (
        np.abs(
            np.linalg.inv(trajectory.world_T_vehicle[0]) @ trajectory.world_T_vehicle
            - np.linalg.inv(truth[0]) @ truth
        ).max()
        < 1e-6
    )


def test_times_are_seconds_after_the_first_frame(root):
    assert np.abs(recording_of(root).times() - TRUTH.times).max() < 1e-8


def test_boxes_are_in_the_frame_of_the_lidar_with_their_tracks(root):
    boxes = recording_of(root).boxes()
    assert sorted(boxes) == list(range(TRUTH.frames))
    for frame, found in boxes.items():
        truth = TRUTH.boxes(frame, LABELS)
        assert len(truth) >= 3
        assert found.tracks.tolist() == truth.tracks.tolist()
        assert found.labels.tolist() == truth.labels.tolist()
        assert np.abs(found.sensor_T_box - truth.sensor_T_box).max() < 1e-6
        assert np.abs(found.sizes - truth.sizes).max() < 1e-9
        assert found.annotated.all()


def test_points_of_an_object_are_in_its_box(root):
    recording = recording_of(root)
    (cloud,) = recording.frames[2].read()
    owners = recording.boxes()[2].owners(TRUTH.scan(2).deskewed[:, :3], 0.05)
    truth = TRUTH.scan(2).instances
    front = cloud.points[:, 0] > 3
    assert (truth[front] > 0).sum() > 10
    assert np.array_equal(owners[front] >= 0, truth[front] > 0)


def test_boxes_that_were_filled_in_are_not_annotated(tmp_path):
    boxes = [TRUTH.boxes(frame, LABELS) for frame in range(3)]
    types = {
        LABELS["car"]: "Car",
        LABELS["van"]: "Van",
        LABELS["pedestrian"]: "Person (sitting)",
        LABELS["cyclist"]: "Misc",
    }
    path = tmp_path / "tracklet_labels.xml"
    path.write_text(tracklets_of(boxes, types, interpolated=1))
    found = read_tracklets(path, [0, 1, 2])
    assert found[0].annotated.all() and found[2].annotated.all()
    assert not found[1].annotated.any() and len(found[1])
    names = {KITTI.names[int(label)] for label in found[0].labels}
    assert {"Person_sitting", "Misc"} <= names
    assert sorted(read_tracklets(path, [0, 2])) == [0, 2]


@pytest.mark.parametrize("below", ["", "2011_09_26", DRIVE])
def test_the_root_a_date_and_a_drive_are_sources(root, below):
    recording = recording_of(root / below)
    assert (recording.name, recording.split, len(recording.frames)) == (
        "KITTI_2011_09_26_0005",
        "Train",
        TRUTH.frames,
    )


def test_drives_of_several_dates_are_found(tmp_path):
    for name in (DRIVE, "2011_09_29/2011_09_29_drive_0026_sync"):
        write_raw(tmp_path, small_drive(2), LABELS, name)
    names = [recording.name for recording in KittiRaw(tmp_path).sequences()]
    assert names == ["KITTI_2011_09_26_0005", "KITTI_2011_09_29_0026"]


def test_a_drive_without_oxts_and_tracklets_has_neither_poses_nor_boxes(copy):
    for path in (copy / "oxts/data").iterdir():
        path.unlink()
    (copy / "tracklet_labels.xml").unlink()
    recording = recording_of(copy)
    assert recording.poses() is None
    assert recording.boxes() is None
    assert recording.notes() == []


def test_a_missing_scan_is_absent_and_the_others_keep_their_times(copy):
    (copy / "velodyne_points/data/0000000002.bin").unlink()
    recording = recording_of(copy)
    assert [frame.number for frame in recording.frames] == [0, 1, 3, 4, 5]
    assert np.abs(recording.times() - TRUTH.times).max() < 1e-8
    assert 2 not in recording.boxes()
    assert recording.problems() == []


def test_a_missing_scan_may_have_no_time_and_one_line_per_scan_goes_by_their_order(copy):
    (copy / "velodyne_points/data/0000000002.bin").unlink()
    path = copy / "velodyne_points/timestamps.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:2], "", *lines[3:]]) + "\n")
    assert np.abs(recording_of(copy).times() - TRUTH.times).max() < 1e-8
    path.write_text("\n".join([*lines[:2], *lines[3:]]) + "\n")
    assert np.abs(recording_of(copy).times() - TRUTH.times).max() < 1e-8


def test_a_missing_packet_is_said_and_its_pose_interpolated(copy):
    (copy / "oxts/data/0000000003.txt").unlink()
    recording = recording_of(copy)
    assert any("1 frames have no packet in oxts/ (first 3)" in note for note in recording.notes())
    trajectory = recording.poses()
    assert len(trajectory.world_T_vehicle) == TRUTH.frames - 1
    found = np.linalg.inv(trajectory.world_T_vehicle[0]) @ trajectory.at(TRUTH.times)
    truth = np.linalg.inv(TRUTH.world_T_lidar(0.0)) @ TRUTH.world_T_lidar(TRUTH.times)
    assert np.abs(found - truth).max() < 0.01


def test_packets_whose_time_does_not_increase_are_left_out(copy):
    times = TRUTH.times.copy()
    times[3] = times[2]
    write_stamps(copy / "oxts/timestamps.txt", times)
    assert np.abs(recording_of(copy).poses().seconds - np.delete(TRUTH.times, 3)).max() < 1e-8


def test_handles_are_light_and_can_be_sent_to_workers(root):
    frame = recording_of(root).frames[0]
    assert len(pickle.dumps(frame)) < 400
    assert pickle.loads(pickle.dumps(frame)) == frame


def test_every_class_has_a_target():
    assert set(KITTI_TO_CARLA.mapping) == set(KITTI.names)
    assert KITTI.geometry_id == KITTI.id_of("geometry")


def fails(folder, read, error=FormatError):
    with pytest.raises(error) as raised:
        read(recording_of(folder))
    assert "\n" not in str(raised.value)
    return str(raised.value)


def test_a_scan_that_is_cut_short_or_empty_is_named(copy):
    path = copy / "velodyne_points/data/0000000001.bin"
    path.write_bytes(path.read_bytes()[:-7])
    assert "0000000001.bin: expected a multiple of 16 bytes" in fails(
        copy, lambda r: r.frames[1].read()
    )
    path.write_bytes(b"")
    assert "0000000001.bin: expected points, found an empty file" in fails(
        copy, lambda r: r.frames[1].read()
    )


def test_a_missing_calibration_is_named_and_force_does_without(copy):
    path = copy.parent / "calib_imu_to_velo.txt"
    path.unlink()
    message = fails(copy, lambda r: r.poses(), MissingDataError)
    assert "calib_imu_to_velo.txt: expected R and T" in message
    assert len(recording_of(copy).poses(force=True).world_T_vehicle) == TRUTH.frames


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("R: 1 0 0 0 1 0 0 0 1\n", r"calib_imu_to_velo.txt: expected T, found only R"),
        ("R: 1 0 0\nT: 0 0 0\n", r"calib_imu_to_velo.txt: expected 9 numbers after R:, found 3"),
        ("R: 2 0 0 0 1 0 0 0 1\nT: 0 0 0\n", r"calib_imu_to_velo.txt: R, T: "),
    ],
)
def test_a_wrong_calibration_is_named(copy, text, message):
    (copy.parent / "calib_imu_to_velo.txt").write_text(text)
    assert re.search(message, fails(copy, lambda r: r.poses()))


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        (
            "velodyne_points",
            lambda lines: lines[:-1],
            "expected a time for each frame up to 5, found none for frame 5",
        ),
        ("velodyne_points", lambda lines: ["", *lines[1:]], "found none for frame 0"),
        (
            "velodyne_points",
            lambda lines: [lines[1], lines[0], *lines[2:]],
            "expected times that increase, found none at frame 1",
        ),
        ("velodyne_points", lambda lines: ["yesterday", *lines[1:]], "found 'yesterday' in line 1"),
        (
            "oxts",
            lambda lines: lines[:3],
            "oxts/timestamps.txt: expected a time for each packet up to 5, found 3 lines",
        ),
    ],
)
def test_wrong_time_stamps_are_named(copy, name, change, message):
    path = copy / name / "timestamps.txt"
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")
    assert message in fails(copy, lambda r: r.poses())


def test_missing_time_stamps_are_named(copy):
    (copy / "velodyne_points/timestamps.txt").unlink()
    assert "timestamps.txt: expected a time per frame" in fails(
        copy, lambda r: r.frames, MissingDataError
    )


@pytest.mark.parametrize(
    ("packet", "message"),
    [
        ("49.0 8.4 112\n", "expected 30 numbers per line, found 3 numbers in line 1"),
        ("49.0 north\n", "expected 30 numbers per line, found could not convert"),
        (" ".join(["nan"] * 30) + "\n", "found a place that is not finite in line 1"),
        ("", "expected one line, found 0"),
    ],
)
def test_a_wrong_packet_is_named(copy, packet, message):
    (copy / "oxts/data/0000000002.txt").write_text(packet)
    found = fails(copy, lambda r: r.poses())
    assert "0000000002.txt" in found and message in found


def test_packets_may_have_the_numbers_of_doubles(tmp_path):
    from carlasc_converters.oxts import read_packets

    packets = np.arange(60, dtype=np.float64).reshape(2, 30) / 7
    write_packets(tmp_path / "oxts.txt", packets)
    assert np.array_equal(read_packets(tmp_path / "oxts.txt"), packets)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("</tracklets>", "", "tracklet_labels.xml: expected XML, found damage"),
        (
            "<objectType>Car",
            "<objectType>Horse",
            r"tracklet 1: expected a type of object: one of Car, .*found 'Horse'",
        ),
        ("<objectType>Car</objectType>", "", "tracklet 1: expected objectType, found none"),
        ("<tz>", "<tz>deep", "expected a number for tz, found 'deep"),
        ("<count>5</count>", "<count>7</count>", "expected 7 tracklets, found 5"),
        (
            "tracklets",
            "labels",
            "expected tracklets in boost_serialization, found <boost_serialization> without them",
        ),
        ("<poses>", "<nothing>", "expected XML, found damage"),
        ("<w>1.8</w>", "<w>0</w>", "tracklet_labels.xml: frame 0: boxes: sizes: expected positive"),
        (
            "<!DOCTYPE boost_serialization>",
            '<!DOCTYPE a [<!ENTITY b "c">]>',
            "expected XML in UTF-8 without entities, found an entity",
        ),
        (
            "<first_frame>0",
            "<first_frame>inf",
            "expected a frame number for first_frame, found 'inf'",
        ),
    ],
)
def test_wrong_tracklets_are_named(copy, old, new, message):
    path = copy / "tracklet_labels.xml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    assert re.search(message, fails(copy, lambda r: r.boxes()))


def test_tracklets_in_another_encoding_are_refused(copy):
    path = copy / "tracklet_labels.xml"
    path.write_text(path.read_text().replace("UTF-8", "UTF-16"), "utf-16")
    assert "expected XML in UTF-8 without entities, found another encoding" in fails(
        copy, lambda r: r.boxes()
    )


def test_a_file_of_tracklets_that_is_too_large_is_not_read(copy, monkeypatch):
    monkeypatch.setattr("carlasc_converters.tracklets.MAX_BYTES", 100)
    assert "expected at most 100 bytes" in fails(copy, lambda r: r.boxes())


def test_a_folder_without_drives_is_named(tmp_path):
    for folder in (tmp_path, tmp_path / "nothing"):
        with pytest.raises(
            CarlascError,
            match="expected 2011_09_26/2011_09_26_drive_0001_sync/velodyne_points/data/",
        ):
            KittiRaw(folder).sequences()
