"""KITTI-360: what is read of a simulated drive in its format, and what is said of wrong files."""

import pickle
import re
import shutil

import numpy as np
import pytest
from carlasc_converters import kitti360_labels
from carlasc_converters.kitti360 import Kitti360
from carlasc_converters.kitti360_classes import KITTI360, KITTI360_TO_CARLA
from carlasc_converters.kitti360_labels import window_at, windows_of
from converters.formats.kitti360 import (
    CLASS_OF,
    CLASSES,
    DRIVE,
    DYNAMIC,
    STATIC,
    instances_of,
    write_kitti360,
    write_ply,
)
from converters.formats.kitti_drive import small_drive

from carlasc.core.tables import CARLA
from carlasc.errors import FormatError, MissingDataError
from carlasc.testing.drives import KINDS

TRUTH = small_drive(8)
WINDOWS = ((0, 4), (3, 8))
LABELS = f"data_3d_semantics/train/{DRIVE}"


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("kitti360")
    write_kitti360(folder, TRUTH, windows=WINDOWS)
    return folder


@pytest.fixture
def copy(root, tmp_path):
    """A data set that a test may damage."""
    forget()
    yield shutil.copytree(root, tmp_path / "copy")
    forget()


def forget():
    """Forget the files that this process keeps."""
    kitti360_labels._standing.cache_clear()
    kitti360_labels._by_time.cache_clear()


def recording_of(folder):
    (recording,) = Kitti360(folder).sequences()
    return recording


def test_points_are_kept_and_their_times_are_those_of_the_sweep(root):
    recording = recording_of(root)
    assert [frame.number for frame in recording.frames] == list(range(TRUTH.frames))
    for frame in recording.frames:
        (cloud,) = frame.read()
        assert cloud.points.tobytes() == TRUTH.scan(frame.number).points.tobytes()
        assert np.abs(cloud.seconds - TRUTH.scan(frame.number).seconds).max() < 1e-6
    assert not recording.sensors[0].deskewed


def test_labels_and_instances_are_those_of_the_clouds(root):
    recording = recording_of(root)
    assert recording.has_labels and recording.has_instances
    # beyond the first and the last pose, the motion is a guess
    for frame in recording.frames[1:-1]:
        (cloud,) = frame.read()
        scan = TRUTH.scan(frame.number)
        assert np.array_equal(cloud.labels, CLASS_OF[scan.kinds])
        assert np.array_equal(cloud.instances, instances_of(scan))
        assert {CLASSES["car"], CLASSES["road"], CLASSES["building"]} <= set(cloud.labels.tolist())


def test_labels_become_carlas(root):
    (cloud,) = recording_of(root).frames[2].read()
    expected = {
        "road": "Road",
        "building": "Building",
        "vegetation": "Vegetation",
        "pole": "Pole",
        "car": "Vehicle",
    }
    expected |= {"van": "Vehicle", "pedestrian": "Pedestrian", "cyclist": "Pedestrian"}
    truth = np.array([CARLA.id_of(expected[kind]) if kind in expected else 0 for kind in KINDS])
    assert np.array_equal(KITTI360_TO_CARLA(cloud.labels), truth[TRUTH.scan(2).kinds])


def test_what_moves_is_labelled_in_its_own_frame_only(root, copy):
    """A car drives over road that other frames saw: without time stamps, the road there would be
    part of the car.
    """
    path = copy / LABELS / "dynamic/0000000000_0000000004.ply"
    recording = recording_of(copy)
    (before,) = recording.frames[1].read()
    cars = before.labels == CLASSES["car"]
    assert cars.any()
    data = path.read_bytes()
    header, _, body = data.partition(b"end_header\n")
    rows = np.frombuffer(body, DYNAMIC).copy()
    rows["timestamp"] = 4
    path.write_bytes(header + b"end_header\n" + rows.tobytes())
    forget()
    (after,) = recording_of(copy).frames[1].read()
    moving = np.isin(before.instances, np.unique(rows["instance"]))
    assert moving.any() and not np.isin(after.instances[moving], np.unique(rows["instance"])).any()
    assert np.array_equal(after.labels[~moving], before.labels[~moving])


def test_points_far_from_all_labels_are_unlabelled(copy):
    static = copy / LABELS / "static"
    for path in static.iterdir():
        rows = np.frombuffer(path.read_bytes().partition(b"end_header\n")[2], STATIC).copy()
        write_ply(path, rows[rows["semantic"] != CLASSES["building"]])
    (cloud,) = recording_of(copy).frames[2].read()
    houses = CLASS_OF[TRUTH.scan(2).kinds] == CLASSES["building"]
    assert houses.any()
    assert (cloud.labels[houses] == 0).mean() > 0.95
    assert np.array_equal(cloud.labels[~houses], CLASS_OF[TRUTH.scan(2).kinds][~houses])


def test_frames_outside_of_all_windows_are_unlabelled_and_that_is_said(copy):
    for kind in ("static", "dynamic"):
        (copy / LABELS / kind / "0000000003_0000000008.ply").unlink()
    recording = recording_of(copy)
    (cloud,) = recording.frames[5].read()
    assert not cloud.labels.any() and not cloud.instances.any()
    assert "3 frames are in no labelled window: their points are unlabelled" in recording.notes()


def test_the_window_in_which_a_frame_is_farthest_from_the_ends_is_taken(root):
    windows = windows_of(root / LABELS / "static")
    assert list(windows.values()) == list(WINDOWS)
    first, second = windows
    assert [window_at(windows, frame) for frame in (0, 2, 3, 4, 8, 9)] == [
        first,
        first,
        first,
        second,
        second,
        None,
    ]
    assert window_at({}, 3) is None
    assert windows_of(root / "nothing") == {}


def test_a_window_without_dynamic_points_is_read(copy):
    shutil.rmtree(copy / LABELS / "dynamic")
    (cloud,) = recording_of(copy).frames[2].read()
    truth = CLASS_OF[TRUTH.scan(2).kinds]
    moves = np.isin(truth, [CLASSES["car"], CLASSES["pedestrian"], CLASSES["cyclist"]])
    assert moves.any() and np.array_equal(cloud.labels[~moves], truth[~moves])
    assert not (cloud.labels == truth)[moves].any()


def test_one_window_at_a_time_is_kept(root):
    forget()
    for frame in recording_of(root).frames:
        frame.read()
    info = kitti360_labels._standing.cache_info()
    assert (info.misses, info.currsize) == (len(WINDOWS), 1)


def test_poses_are_those_of_the_lidar(root):
    recording = recording_of(root)
    trajectory = recording.poses()
    assert np.abs(trajectory.at(recording.times()) - TRUTH.world_T_lidar(TRUTH.times)).max() < 1e-6
    assert np.abs(recording.times() - TRUTH.times).max() < 1e-8


def test_frames_without_a_pose_are_between_their_neighbours(tmp_path):
    write_kitti360(tmp_path, TRUTH, without_pose=(3, 4))
    trajectory = recording_of(tmp_path).poses()
    assert np.abs(trajectory.seconds - np.delete(TRUTH.times, (3, 4))).max() < 1e-8
    assert (
        np.abs(
            trajectory.at(TRUTH.times)[:, :3, 3] - TRUTH.world_T_lidar(TRUTH.times)[:, :3, 3]
        ).max()
        < 0.01
    )


def test_the_car_stands_before_the_first_pose_and_after_the_last(tmp_path):
    write_kitti360(tmp_path, TRUTH, without_pose=(0, 1, 2, 6, 7))
    recording = recording_of(tmp_path)
    poses = recording.poses().at(recording.times())
    truth = TRUTH.world_T_lidar(TRUTH.times)
    assert np.abs(poses[:3] - truth[3]).max() < 1e-6
    assert np.abs(poses[6:] - truth[5]).max() < 1e-6


def test_without_labels_scans_have_none(tmp_path):
    write_kitti360(tmp_path, TRUTH)
    recording = recording_of(tmp_path)
    (cloud,) = recording.frames[0].read()
    assert cloud.labels is None and cloud.instances is None
    assert not recording.has_labels and recording.notes() == []


def test_labels_without_poses_are_not_given_and_that_is_said(copy):
    shutil.rmtree(copy / "data_poses")
    recording = recording_of(copy)
    assert recording.poses() is None and not recording.has_labels
    assert recording.frames[0].read()[0].labels is None
    assert "labels cannot be given to scans without" in recording.notes()[0]


def test_names_splits_and_sources(tmp_path):
    for name in (DRIVE, "2013_05_28_drive_0008_sync"):
        scans = write_kitti360(tmp_path, small_drive(2), name=name)
    found = [(recording.name, recording.split) for recording in Kitti360(tmp_path).sequences()]
    assert found == [("KITTI360_0003", "Train"), ("KITTI360_0008", "Test")]
    one = recording_of(scans.parent)
    assert one.name == "KITTI360_0008"
    assert one.poses() is not None


def test_a_missing_scan_is_absent_and_the_others_keep_their_times(copy):
    (copy / f"data_3d_raw/{DRIVE}/velodyne_points/data/0000000002.bin").unlink()
    recording = recording_of(copy)
    assert [frame.number for frame in recording.frames] == [0, 1, 3, 4, 5, 6, 7]
    assert np.abs(recording.times() - TRUTH.times).max() < 1e-8


def test_handles_are_light_and_can_be_sent_to_workers(root):
    frame = recording_of(root).frames[0]
    assert len(pickle.dumps(frame)) < 600
    assert pickle.loads(pickle.dumps(frame)) == frame


def test_the_table_has_the_ids_of_kitti_360():
    expected = {
        0: "unlabeled",
        7: "road",
        11: "building",
        21: "vegetation",
        24: "person",
        26: "car",
        33: "bicycle",
    }
    assert expected.items() <= KITTI360.names.items()
    assert (len(KITTI360.names), KITTI360.names[44]) == (45, "unknown object")
    assert set(KITTI360_TO_CARLA.mapping) == set(KITTI360.names)
    for role in ("movable", "deformable", "ground"):
        for index in getattr(KITTI360, role):
            assert KITTI360_TO_CARLA.mapping[index] in getattr(CARLA, role), KITTI360.names[index]


def fails(folder, read, error=FormatError):
    with pytest.raises(error) as raised:
        read(recording_of(folder))
    assert "\n" not in str(raised.value)
    return str(raised.value)


def test_a_scan_that_is_cut_short_is_named(copy):
    path = copy / f"data_3d_raw/{DRIVE}/velodyne_points/data/0000000001.bin"
    path.write_bytes(path.read_bytes()[:-4])
    assert "0000000001.bin: expected a multiple of 16 bytes" in fails(
        copy, lambda r: r.frames[1].read()
    )


@pytest.mark.parametrize("kind", ["static", "dynamic"])
def test_a_damaged_cloud_is_named(copy, kind):
    path = copy / LABELS / kind / "0000000000_0000000004.ply"
    data = path.read_bytes()
    path.write_bytes(data[:-50])
    assert f"{kind}/0000000000_0000000004.ply: expected" in fails(
        copy, lambda r: r.frames[1].read()
    )
    path.write_bytes(data.replace(b"semantic", b"semantik"))
    assert "expected vertices with semantic" in fails(copy, lambda r: r.frames[1].read())


@pytest.mark.parametrize(("written", "named"), [(77, 77), (65536 + CLASSES["road"], 65535)])
def test_unknown_ids_are_named_by_the_remap(copy, written, named):
    for path in (copy / LABELS / "static").iterdir():
        rows = np.frombuffer(path.read_bytes().partition(b"end_header\n")[2], STATIC).copy()
        rows["semantic"][rows["semantic"] == CLASSES["road"]] = written
        write_ply(path, rows)
    (cloud,) = recording_of(copy).frames[1].read()
    with pytest.raises(FormatError, match=rf"found {named} \(\d+ times\)"):
        KITTI360_TO_CARLA(cloud.labels)


@pytest.mark.parametrize("name", ["calib_cam_to_pose.txt", "calib_cam_to_velo.txt"])
def test_a_missing_calibration_is_named_and_force_does_without(copy, name):
    (copy / "calibration" / name).unlink()
    message = fails(copy, lambda r: r.poses(), MissingDataError)
    assert f"{name}: expected the place of the LiDAR on the car" in message
    assert len(recording_of(copy).poses(force=True).world_T_vehicle) == TRUTH.frames


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (
            "calib_cam_to_pose.txt",
            "image_01: 1 0 0 0 0 1 0 0 0 0 1 0\n",
            "expected image_00, found only image_01",
        ),
        (
            "calib_cam_to_velo.txt",
            "hello\n",
            "calib_cam_to_velo.txt: expected a line of 12 numbers, found only",
        ),
        (
            "calib_cam_to_velo.txt",
            "1 0 0 0\n",
            "calib_cam_to_velo.txt: expected 12 numbers in a line, found 4",
        ),
        ("calib_cam_to_velo.txt", "2 0 0 0 0 1 0 0 0 0 1 0\n", "calib_cam_to_velo.txt: "),
    ],
)
def test_a_wrong_calibration_is_named(copy, name, text, message):
    (copy / "calibration" / name).write_text(text)
    assert message in fails(copy, lambda r: r.poses())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 1 0 0\n", "expected a frame number and 12 numbers per line, found 4 numbers in line 1"),
        ("0.5 1 0 0 0 0 1 0 0 0 0 1 0\n", "found 0.5 in line 1"),
        ("zero\n", "expected 13 numbers per line, found something else"),
        ("", "expected increasing frames 0..7, which have a time, found no lines"),
        ("99 1 0 0 0 0 1 0 0 0 0 1 0\n", "found 99 as the last"),
        ("0 2 0 0 0 0 1 0 0 0 0 1 0\n", "poses.txt"),
    ],
)
def test_wrong_poses_are_named(copy, text, message):
    path = copy / f"data_poses/{DRIVE}/poses.txt"
    path.write_text(text)
    found = fails(copy, lambda r: r.poses())
    assert "poses.txt" in found and re.search(re.escape(message), found)


def test_missing_time_stamps_are_named(copy):
    (copy / f"data_3d_raw/{DRIVE}/velodyne_points/timestamps.txt").unlink()
    assert "timestamps.txt: expected a time per frame" in fails(
        copy, lambda r: r.frames, MissingDataError
    )


def test_a_folder_without_drives_is_named(tmp_path):
    with pytest.raises(
        MissingDataError,
        match="expected data_3d_raw/2013_05_28_drive_0000_sync/velodyne_points/data/",
    ):
        Kitti360(tmp_path).sequences()
