import pickle
from pathlib import Path

import numpy as np
import pytest
from helpers.datasets.captures import make_recording, write_capture
from helpers.errors import raises
from hypothesis import given, settings
from hypothesis import strategies as st

from carlasc.captures.raw import Capture, SensorRecording, find_captures
from carlasc.captures.writing import CaptureWriter, TimesLog
from carlasc.core.scans import Scan
from carlasc.errors import FormatError, MissingDataError, StorageError


def _npy(capture, folder, frame=100):
    return Path(capture.location) / folder / f"{frame}.npy"


def test_the_golden_capture_is_read_as_the_format_says(golden_capture):
    capture = Capture(golden_capture)
    assert capture.sensors == (0, 1, 2, 3, 4)
    assert capture.frames.tolist() == [100, 101, 102]
    recording = capture.read(0, 100)
    assert recording.scan.points.shape == (8215, 3)
    assert recording.scan.points.flags.c_contiguous  # the files are in Fortran order
    assert recording.velocities.shape == (5, 4)
    assert capture.read(1, 100).velocities.shape == (0, 4)
    assert capture.read_time(101) == 101 * 0.1
    assert capture.read_bev(100) == (golden_capture / "cartesian/bev/000000.jpg").read_bytes()


def test_arrays_in_fortran_order_are_read(tmp_path):
    capture = write_capture(tmp_path, frames=1)
    points = capture.read(0, 100).scan.points
    np.save(_npy(capture, "velodyne0"), np.asfortranarray(points))
    assert np.array_equal(capture.read(0, 100).scan.points, points)


def test_raw_itself_is_taken_as_well_as_the_folder_that_holds_it(tmp_path):
    write_capture(tmp_path, frames=1)
    assert Capture(tmp_path).location == Capture(tmp_path / "raw").location == str(tmp_path / "raw")


@given(st.integers(0, 50), st.integers(0, 4), st.integers(0, 99))
@settings(max_examples=20, deadline=None)
def test_what_is_written_comes_back(tmp_path_factory, points, actors, seed):
    root = tmp_path_factory.mktemp("capture")
    written = make_recording(points, actors, seed)
    writer = CaptureWriter(root)
    writer.write(3, 7, written)
    writer.write(0, 7, written)
    assert writer.has(3, 7) and not writer.has(3, 8)
    read = Capture(root).read(3, 7)
    for array, other in (
        (read.scan.points, written.scan.points),
        (read.scan.labels, written.scan.labels),
        (read.scan.instances, written.scan.instances),
        (read.velocities, written.velocities),
        (read.world_T_sensor, written.world_T_sensor),
    ):
        assert array.dtype == other.dtype
        assert np.array_equal(array, other)


def test_an_empty_list_of_actors_is_written_without_columns(tmp_path):
    CaptureWriter(tmp_path).write(0, 1, make_recording(actors=0))
    assert np.load(tmp_path / "raw/velocities0/1.npy").shape == (0,)


def test_a_frame_exists_only_with_all_its_files(tmp_path):
    capture = write_capture(tmp_path, frames=1)
    writer = CaptureWriter(tmp_path)
    assert writer.has(1, 100)
    _npy(capture, "pose1").unlink()
    assert not writer.has(1, 100)


def test_the_last_line_of_a_frame_in_a_times_file_is_valid(tmp_path):
    write_capture(tmp_path, frames=1)
    with (tmp_path / "raw/times0.txt").open("a") as file:
        file.write("100, Timestamp(frame=100,elapsed_seconds=77.5)\n")
    assert Capture(tmp_path).read_time(100) == 77.5
    with raises(MissingDataError, where="times0.txt", expected="a line for frame 4"):
        Capture(tmp_path).read_time(4)
    (tmp_path / "raw/times0.txt").write_text("100 10.0\n")
    with raises(FormatError, where="times0.txt", found="'100 10.0' in line 1"):
        Capture(tmp_path).read_time(100)


def test_times_are_written_as_in_the_golden_capture(tmp_path, golden_capture):
    for frame in (102, 100, 101):
        CaptureWriter(tmp_path).write_times({frame: [frame * 0.1]})
    assert (tmp_path / "raw/times0.txt").read_bytes() == (
        golden_capture / "raw/times0.txt"
    ).read_bytes()


def test_a_capture_without_pictures_has_none(tmp_path):
    capture = write_capture(tmp_path, frames=1)
    assert capture.has_bev(100) and not capture.has_bev(101)
    assert capture.read_bev(101) is None


def test_flow_is_the_velocity_of_each_points_actor_and_zero_elsewhere():
    scan = Scan(np.zeros((5, 3), np.float32), None, None, np.array([9, 0, 4, 7, 9], np.uint32))
    velocities = np.array([[9, 1, 2, 3], [4, -1, 0, 0], [0, 5, 5, 5]], np.float64)
    flow = SensorRecording(scan, np.eye(4), velocities).flow()
    assert flow.dtype == np.float32
    assert flow.tolist() == [[1, 2, 3], [0, 0, 0], [-1, 0, 0], [0, 0, 0], [1, 2, 3]]
    assert not SensorRecording(scan, np.eye(4), np.empty((0, 4))).flow().any()


def test_a_capture_pickles_into_a_worker(tmp_path):
    capture = write_capture(tmp_path, frames=1)
    again = pickle.loads(pickle.dumps(capture))
    assert np.array_equal(again.read(0, 100).scan.points, capture.read(0, 100).scan.points)


def test_captures_are_found_with_their_paths(tmp_path):
    for path in ("Train/Town01_Light", "Val/Town07_Heavy"):
        write_capture(tmp_path / path, frames=1)
    assert list(find_captures(tmp_path)) == ["Train/Town01_Light", "Val/Town07_Heavy"]
    assert list(find_captures(tmp_path / "Val")) == ["Town07_Heavy"]
    assert list(find_captures(tmp_path / "Val/Town07_Heavy")) == [""]
    assert list(find_captures(tmp_path / "Val/Town07_Heavy/raw")) == [""]
    with raises(MissingDataError, expected="a capture ", found="none"):
        find_captures(tmp_path / "Val/Town07_Heavy/raw/bev")


def test_a_missing_folder_sensor_or_frame_is_named(tmp_path):
    with raises(MissingDataError, where="nowhere", expected="a folder", found="nothing"):
        Capture(tmp_path / "nowhere")
    (tmp_path / "raw").mkdir()
    with raises(
        MissingDataError,
        where="raw",
        expected="the folder velodyne0 of the ego sensor",
        found="no sensor",
    ):
        _ = Capture(tmp_path).sensors
    (tmp_path / "raw/velodyne2").mkdir()
    with raises(MissingDataError, found=r"only the sensors \[2\]"):
        _ = Capture(tmp_path).sensors
    (tmp_path / "raw/velodyne0").mkdir()
    with raises(
        MissingDataError, where="raw", expected="frames such as velodyne0/100.npy", found="none"
    ):
        _ = Capture(tmp_path).frames


def test_a_missing_file_is_named(tmp_path):
    capture = write_capture(tmp_path, frames=1)
    _npy(capture, "labels1").unlink()
    with raises(MissingDataError, where="labels1/100.npy", expected="a file", found="nothing"):
        capture.read(1, 100)


def test_a_sensor_without_points_is_listed_all_the_same(tmp_path):
    capture = write_capture(tmp_path, frames=1)
    _npy(capture, "velodyne1").unlink()
    (tmp_path / "raw/velodyne1").rmdir()
    assert Capture(tmp_path).sensors == (0, 1)


INVALID = {  # folder -> (array that is written over it, what is expected and found)
    "wrong type": ("velodyne0", np.zeros((300, 3)), "float32 values", "float64"),
    "wrong shape": (
        "velodyne0",
        np.zeros((300, 4), np.float32),
        "an array of N x 3 values",
        "300 x 4",
    ),
    "too flat": (
        "velodyne0",
        np.zeros(900, np.float32),
        "an array of N x 3 values",
        "900",
    ),
    "NaN": (
        "velodyne0",
        np.full((300, 3), np.nan, np.float32),
        "finite coordinates",
        ".*nan.* at point 0",
    ),
    "infinite": (
        "velodyne0",
        np.full((300, 3), np.inf, np.float32),
        "finite coordinates",
        ".*inf.*",
    ),
    "beyond the table": (
        "labels0",
        np.full(300, 25, np.uint32),
        "class ids of carla",
        r"25 \(300 times\) of 300",
    ),
    "short labels": (
        "labels0",
        np.zeros(299, np.uint32),
        "300 values, one per point .*",
        "299",
    ),
    "long instances": (
        "instances0",
        np.zeros(301, np.uint32),
        "300 values, one per point .*",
        "301",
    ),
    "signed labels": ("labels0", np.zeros(300, np.int32), "uint32 values", "int32"),
    "NaN velocity": ("velocities0", np.full((1, 4), np.nan), "finite", ""),
    "scaled pose": ("pose0", 2 * np.eye(4), "a rigid transform", ""),
    "mirrored pose": ("pose0", np.diag([1.0, -1, 1, 1]), "a rotation", "a reflection"),
    "NaN pose": ("pose0", np.full((4, 4), np.nan), "finite numbers", ""),
    "three rows": ("pose0", np.eye(4)[:3], "an array of 4 x 4 values", "3 x 4"),
    "objects": ("pose0", np.array([{}], object), "float64 values", "object"),
}


@pytest.mark.parametrize("invalid", INVALID)
def test_an_invalid_file_is_named_with_what_was_expected_and_found(tmp_path, invalid):
    folder, array, expected, found = INVALID[invalid]
    capture = write_capture(tmp_path, frames=1)
    np.save(_npy(capture, folder), array)
    with raises(FormatError, where=f"{folder}/100.npy", expected=expected, found=found) as caught:
        capture.read(0, 100)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "expected", "found", "advice"),
    [
        (lambda data: data[:-5], r"3728 bytes \(300 x 3 float32\)", "3723", "cut short"),
        (lambda data: data + b"more", "3728 bytes", "3732", "cut short, or something was added"),
        (lambda data: data[:60], "a .npy array", "something else", ""),
        (lambda data: b"", "a .npy array", "something else", ""),
        (lambda data: b"x" * 4000, "a .npy array", "something else", ""),
    ],
)
def test_a_file_of_another_size_is_named(tmp_path, change, expected, found, advice):
    capture = write_capture(tmp_path, frames=1)
    path = _npy(capture, "velodyne0")
    path.write_bytes(change(path.read_bytes()))
    with raises(
        FormatError,
        where="velodyne0/100.npy",
        expected=expected,
        found=found,
        advice=advice,
    ):
        capture.read(0, 100)


def test_a_recording_without_labels_is_not_written(tmp_path):
    scan = Scan(np.zeros((1, 3), np.float32))
    with raises(
        FormatError, where="sensor 0, frame 5", expected="a scan with labels and instances"
    ):
        CaptureWriter(tmp_path).write(0, 5, SensorRecording(scan, np.eye(4), np.empty((0, 4))))


def test_a_folder_that_cannot_be_written_to_is_named(tmp_path):
    (tmp_path / "raw").write_text("a file in the way")
    for write in (
        lambda w: w.write(0, 1, make_recording()),
        lambda w: w.write_settings("simulation.json", {}),
        lambda w: w.write_bev(1, b""),
    ):
        with raises(StorageError, where="raw/", problem="cannot be written"):
            write(CaptureWriter(tmp_path))


def test_captures_are_found_up_to_three_levels_down_and_not_in_hidden_folders(tmp_path):
    write_capture(tmp_path / "data/Train/Town01_Light", frames=1)
    write_capture(tmp_path / "deeper/data/Train/Town01_Light", frames=1)
    write_capture(tmp_path / ".trash/Town01_Light", frames=1)
    assert list(find_captures(tmp_path)) == ["data/Train/Town01_Light"]


def test_a_frame_exists_with_all_sensors_and_its_picture(tmp_path):
    write_capture(tmp_path, frames=1)
    writer = CaptureWriter(tmp_path)
    assert writer.has_frame(100, sensors=2, bev=True) and not writer.has_frame(
        100, sensors=3, bev=False
    )
    (tmp_path / "raw/bev/100.jpg").unlink()
    assert writer.has_frame(100, sensors=2, bev=False) and not writer.has_frame(
        100, sensors=2, bev=True
    )


def test_a_frame_is_timed_when_all_its_sensors_are(tmp_path):
    writer = CaptureWriter(tmp_path)
    assert writer.timed_frames(2) == frozenset()
    writer.write_times({100: [10.0]})
    assert writer.timed_frames(2) == frozenset()
    writer.write_times({100: [10.0, 10.0]})
    assert writer.timed_frames(2) == {100}


def test_times_of_each_sensor_are_its_own(tmp_path):
    writer = CaptureWriter(tmp_path)
    writer.write(0, 1, make_recording())
    writer.write_times({1: [0.1, 0.3]})
    assert (Capture(tmp_path).read_time(1), Capture(tmp_path).read_time(1, 1)) == (0.1, 0.3)
    with raises(MissingDataError, where=r"times2\.txt", expected="a file", found="nothing"):
        Capture(tmp_path).read_time(1, 2)


def test_times_files_are_in_the_order_of_frames_and_keep_the_lines_that_they_have(tmp_path):
    (tmp_path / "raw").mkdir()
    line = "7, Timestamp(frame=7,elapsed_seconds=0.7,delta_seconds=0.1,platform_timestamp=1e9)"
    (tmp_path / "raw/times0.txt").write_text(f"{line}\n")
    with pytest.raises(KeyboardInterrupt), TimesLog(CaptureWriter(tmp_path), every=3) as log:
        for frame in (9, 8, 3):
            log.add(frame, [frame / 10])
        assert list(Capture(tmp_path / "raw").read_times()) == [3, 7, 8, 9]
        log.add(4, [0.4])
        raise KeyboardInterrupt
    lines = (tmp_path / "raw/times0.txt").read_text().splitlines()
    assert [int(text.partition(",")[0]) for text in lines] == [3, 4, 7, 8, 9]
    assert lines[2] == line


def test_a_pose_that_is_not_rigid_is_not_written(tmp_path):
    recording = make_recording()
    with raises(FormatError, where="sensor 0, frame 5", expected="a rigid transform"):
        CaptureWriter(tmp_path).write(
            0, 5, SensorRecording(recording.scan, 2 * np.eye(4), recording.velocities)
        )
