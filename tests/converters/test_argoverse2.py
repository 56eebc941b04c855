import tarfile
from pathlib import Path

import numpy as np
import pytest
from carlasc_converters.argoverse2 import Argoverse2
from carlasc_converters.argoverse2_classes import ARGOVERSE2, CATEGORIES, TO_CARLA
from converters.formats import argoverse2 as av2
from converters.formats.argoverse2 import (
    CITY_T_WORLD,
    LOG,
    START_NS,
    read_table,
    write_argoverse2,
    write_table,
)

import carlasc
from carlasc.converting import LayoutOptions, convert
from carlasc.core.tables import CARLA
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.running import Run
from carlasc.testing import ConverterContract
from carlasc.testing.drives import KINDS

pytestmark = pytest.mark.needs("pyarrow")
DRIVE = av2.drive()


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("av2")
    write_argoverse2(folder / "sensor" / "val", DRIVE)
    return folder


@pytest.fixture
def log(tmp_path):
    return write_argoverse2(tmp_path / "val", DRIVE)


def recording(folder):
    (found,) = Argoverse2(folder).sequences()
    return found


def sweeps(folder):
    return sorted((folder / "sensors" / "lidar").iterdir())


class TestContract(ConverterContract):
    converter = "argoverse2"
    ids = {kind: CATEGORIES[category] for kind, category in av2.CATEGORIES.items()}  # noqa: RUF012
    drive = av2.drive(8)
    keeps = frozenset({"boxes", "poses", "times", "seconds"})

    def write(self, folder):
        write_argoverse2(folder, self.drive)


def test_the_root_a_split_and_a_log_hold_the_same_log(root):
    for folder in (root, root / "sensor", root / "sensor" / "val", root / "sensor" / "val" / LOG):
        found = recording(folder)
        assert (found.name, found.split) == (f"AV2_{LOG}", "Val")
        assert [frame.number for frame in found.frames] == [0, 1, 2, 3]


def test_the_folder_of_a_log_says_its_split_and_logs_are_sorted(tmp_path):
    for split, name in (("test", "b"), ("train", "a"), ("elsewhere", "c")):
        write_argoverse2(tmp_path / split, av2.drive(1), log=name)
    assert [(log.name, log.split) for log in Argoverse2(tmp_path).sequences()] == [
        ("AV2_a", "Train"),
        ("AV2_b", "Test"),
        ("AV2_c", "Train"),
    ]


def test_points_of_each_lidar_are_those_of_the_file_in_its_order(root):
    found = recording(root)
    assert [sensor.name for sensor in found.sensors] == ["up_lidar", "down_lidar"]
    for frame in found.frames:
        points, offsets, lasers = av2.sweep(DRIVE, frame.number)
        clouds = frame.read()
        assert [cloud.sensor for cloud in clouds] == [0, 1]
        for cloud, own in zip(clouds, (lasers < 32, lasers >= 32), strict=True):
            np.testing.assert_array_equal(cloud.points[:, :3], points[own, :3])
            np.testing.assert_allclose(cloud.points[:, 3], points[own, 3] / 255, rtol=1e-6)
            np.testing.assert_allclose(cloud.seconds, offsets[own] * 1e-9, atol=1e-12)
            assert cloud.points.dtype == np.float32
            assert cloud.labels is None
            assert cloud.instances is None


def test_points_of_half_precision_are_read_as_they_are(tmp_path):
    folder = write_argoverse2(tmp_path, av2.drive(1), half=True)
    points, _, lasers = av2.sweep(av2.drive(1), 0)
    upper = recording(folder).frames[0].read()[0]
    np.testing.assert_array_equal(
        upper.points[:, :3], points[lasers < 32, :3].astype(np.float16).astype(np.float32)
    )


def test_sensors_are_where_the_calibration_says_and_points_are_in_the_frame_of_the_vehicle(root):
    for sensor, truth in zip(recording(root).sensors, DRIVE.sensors, strict=True):
        np.testing.assert_allclose(sensor.vehicle_T_sensor, truth.vehicle_T_sensor, atol=1e-12)
        np.testing.assert_allclose(sensor.origin, truth.vehicle_T_sensor[:3, 3], atol=1e-12)
        assert sensor.points_in == "vehicle"
        assert sensor.deskewed
        assert sensor.calibrated
        assert sensor.height_m == pytest.approx(truth.vehicle_T_sensor[2, 3] + 0.33, abs=0.01)


def test_poses_and_times_are_those_of_the_simulation(root):
    found = recording(root)
    trajectory, times = found.poses(), found.times()
    np.testing.assert_allclose(times, DRIVE.times, atol=1e-9)
    np.testing.assert_allclose(
        trajectory.at(times), CITY_T_WORLD @ DRIVE.world_T_vehicle(DRIVE.times), atol=1e-6
    )
    np.testing.assert_allclose(
        trajectory.world_T_vehicle,
        CITY_T_WORLD @ DRIVE.world_T_vehicle(trajectory.seconds),
        atol=1e-6,
    )
    assert trajectory.seconds[0] == pytest.approx(-0.05)
    assert len(trajectory.seconds) > 4 * len(times)


def test_boxes_keep_pose_size_class_and_their_track_throughout(root):
    found = recording(root).boxes()
    names = {}
    for frame in range(DRIVE.frames):
        truth, boxes = DRIVE.boxes(frame), found[frame]
        assert len(boxes) == len(truth)
        nearest = np.linalg.norm(boxes.centers[:, None] - truth.centers, axis=2).argmin(axis=0)
        boxes = boxes.select(nearest)
        np.testing.assert_allclose(boxes.sensor_T_box, truth.sensor_T_box, atol=1e-9)
        np.testing.assert_allclose(boxes.sizes, truth.sizes)
        assert [ARGOVERSE2.names[label] for label in boxes.labels] == [
            av2.CATEGORIES[KINDS[k]] for k in truth.labels
        ]
        assert boxes.annotated.all()
        for track, number in zip(truth.tracks.tolist(), boxes.tracks.tolist(), strict=True):
            assert names.setdefault(track, number) == number
    order = sorted(names, key=av2.track_uuid)
    assert {track: names[track] for track in order} == {
        track: number for number, track in enumerate(order, 1)
    }


def test_each_category_has_a_class_and_a_class_of_carla():
    assert len(CATEGORIES) == 30
    assert CATEGORIES["REGULAR_VEHICLE"] == 19  # as in the data set's labels of scene flow
    assert list(CATEGORIES.values()) == list(range(1, 31))
    assert list(CATEGORIES) == sorted(CATEGORIES)
    carla = {
        name: CARLA.names[TO_CARLA.mapping[ARGOVERSE2.id_of(name)]]
        for name in ARGOVERSE2.names.values()
    }
    assert carla["BICYCLIST"] == carla["STROLLER"] == "Pedestrian"
    assert carla["TRUCK_CAB"] == "Vehicle"
    assert carla["GROUND"] == "Ground"
    assert carla["BACKGROUND"] == "Other"
    assert CARLA.movable >= {
        TO_CARLA.mapping[CATEGORIES[name]] for name in ("BUS", "PEDESTRIAN", "WHEELED_RIDER")
    }
    assert not ARGOVERSE2.movable & {
        CATEGORIES["BOLLARD"],
        CATEGORIES["STOP_SIGN"],
        *ARGOVERSE2.ground,
    }


def test_without_calibration_there_is_one_sensor_at_an_assumed_place(log):
    (log / "calibration" / "egovehicle_SE3_sensor.feather").unlink()
    found = recording(log)
    (sensor,) = found.sensors
    assert not sensor.calibrated
    assert all(np.linalg.norm(sensor.origin - truth.origin) < 0.1 for truth in DRIVE.sensors)
    (cloud,) = found.frames[0].read()
    np.testing.assert_array_equal(cloud.points[:, :3], av2.sweep(DRIVE, 0)[0][:, :3])
    (note,) = found.notes()
    assert "egovehicle_SE3_sensor.feather does not exist: both LiDARs count as one" in note
    assert "(1.35, 0.00, 1.58) m" in note


def test_a_complete_log_has_neither_notes_nor_problems(root):
    assert recording(root).notes() == []
    assert recording(root).problems() == []


def test_a_sweep_that_is_missing_between_others_is_named_and_other_frames_keep_their_numbers(log):
    sweeps(log)[2].unlink()
    found = recording(log)
    assert [frame.number for frame in found.frames] == [0, 1, 3]
    np.testing.assert_allclose(found.times(), DRIVE.times, atol=1e-9)
    ((number, message),) = found.problems()
    assert number == 2
    assert (
        f"{START_NS + 200_000_000}.feather: expected an annotated sweep, found no such file"
        in message
    )
    assert 2 in found.boxes()


def test_a_log_that_was_cut_keeps_its_numbers_and_says_so(log):
    for path in (sweeps(log)[0], sweeps(log)[3]):
        path.unlink()
    found = recording(log)
    assert [frame.number for frame in found.frames] == [1, 2]
    assert found.problems() == []
    assert sorted(found.boxes()) == [0, 1, 2, 3]
    (note,) = found.notes()
    assert "2 annotated sweeps before the first and after the last file do not exist" in note


def test_a_log_without_annotations_or_poses_has_none(log):
    (log / "annotations.feather").unlink()
    (log / "city_SE3_egovehicle.feather").unlink()
    found = recording(log)
    assert found.boxes() is None
    assert found.poses() is None
    assert [frame.number for frame in found.frames] == [0, 1, 2, 3]


def test_a_sweep_without_boxes_was_not_annotated(log):
    table = read_table(log / "annotations.feather")
    keep = table["timestamp_ns"] != START_NS
    write_table(log / "annotations.feather", {name: column[keep] for name, column in table.items()})
    assert sorted(recording(log).boxes()) == [1, 2, 3]


def change(path, **columns):
    write_table(path, read_table(path) | columns)


def test_an_unknown_category_is_named(log):
    path = log / "annotations.feather"
    categories = read_table(path)["category"]
    categories[0] = "HOVERCRAFT"
    change(path, category=categories)
    with pytest.raises(
        FormatError,
        match=r"annotations.feather: expected the 30 categories.*found HOVERCRAFT: .*version",
    ):
        recording(log).boxes()


def test_a_track_with_two_boxes_in_a_sweep_is_named(log):
    table = read_table(log / "annotations.feather")
    write_table(
        log / "annotations.feather",
        {name: np.append(column, column[:1]) for name, column in table.items()},
    )
    with pytest.raises(
        FormatError,
        match=r"annotations.feather: timestamp \d+: boxes: tracks: expected one box per track",
    ):
        recording(log).boxes()


def test_a_truncated_sweep_is_named(log):
    path = sweeps(log)[1]
    path.write_bytes(path.read_bytes()[:-200])
    frames = recording(log).frames
    with pytest.raises(
        FormatError,
        match=rf"{path.name}: expected a Feather file, found something else .*copy it again",
    ):
        frames[1].read()
    assert len(frames[0].read()) == 2


def test_a_sweep_that_vanishes_is_named(log):
    frames = recording(log).frames
    sweeps(log)[1].unlink()
    with pytest.raises(
        MissingDataError,
        match=r"feather: expected a Feather file, found nothing: download it again",
    ):
        frames[1].read()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"laser_number": None},
            "expected the columns laser_number, found x, y, z, intensity, offset_ns",
        ),
        ({"x": lambda x: x.astype(str)}, "expected numbers in the column x, found"),
        (
            {"laser_number": lambda lasers: lasers + np.uint8(64)},
            r"expected laser numbers 0\.\.63, found 127",
        ),
    ],
)
def test_a_sweep_of_another_kind_is_named(log, changes, message):
    path = sweeps(log)[0]
    table = read_table(path)
    for name, new in changes.items():
        column = table.pop(name)
        table |= {} if new is None else {name: new(column)}
    write_table(path, table)
    with pytest.raises(FormatError, match=rf"{path.name}: {message}"):
        recording(log).frames[0].read()


def test_an_empty_sweep_is_named(log):
    path = sweeps(log)[0]
    write_table(path, {name: column[:0] for name, column in read_table(path).items()})
    with pytest.raises(FormatError, match="expected points, found an empty table"):
        recording(log).frames[0].read()


def test_a_missing_value_is_named(log):
    path = log / "city_SE3_egovehicle.feather"
    change(path, tx_m=[None, *read_table(path)["tx_m"][1:].tolist()])
    with pytest.raises(
        FormatError,
        match=r"city_SE3_egovehicle.feather: expected numbers in the column tx_m, found 1 missing",
    ):
        recording(log).poses()


def test_a_calibration_without_a_lidar_is_named(log):
    path = log / "calibration" / "egovehicle_SE3_sensor.feather"
    change(path, sensor_name=["ring_front_center", "stereo_front_left", "up_lidar"])
    with pytest.raises(
        FormatError,
        match=r"expected a row for each of up_lidar, down_lidar, found no down_lidar in ring_",
    ):
        list(recording(log).sensors)


def test_poses_that_are_none_and_times_that_stand_still_are_named(log):
    path = log / "city_SE3_egovehicle.feather"
    table = read_table(path)
    change(
        path,
        timestamp_ns=np.where(
            table["timestamp_ns"] == START_NS, START_NS - 10_000_000, table["timestamp_ns"]
        ),
    )
    with pytest.raises(
        FormatError,
        match=r"city_SE3_egovehicle.feather: expected times that increase, found none at",
    ):
        recording(log).poses()
    change(path, **(table | {"qw": table["qw"] * 2}))
    with pytest.raises(
        FormatError,
        match=r"city_SE3_egovehicle.feather: expected a rotation: a quaternion .* in row 0",
    ):
        recording(log).poses()


def test_a_folder_without_logs_and_an_unknown_option_are_refused(tmp_path):
    with pytest.raises(
        MissingDataError,
        match=r"expected logs: folders with sensors/lidar/ in them, found none: give",
    ):
        Argoverse2(tmp_path).sequences()
    with pytest.raises(MissingDataError, match="found no such folder"):
        Argoverse2(tmp_path / "typo").sequences()
    with pytest.raises(ArgumentError, match="expected no options for this data set, found flow"):
        convert("argoverse2", tmp_path, tmp_path / "out", options={"flow": "yes"})


@pytest.fixture(scope="module")
def sample(real, tmp_path_factory):
    """The real sample: two sweeps of a log with calibration, and one of a log without."""
    path = real / "av2.tar.xz"
    if not path.is_file():
        pytest.skip(f"{path} is not there")
    folder = tmp_path_factory.mktemp("real")
    with tarfile.open(path) as archive:
        archive.extractall(folder, filter="data")
    return folder / "av2"


def test_the_real_sample_is_read(sample):
    with_calibration, without = Argoverse2(sample).sequences()
    assert [sensor.name for sensor in with_calibration.sensors] == ["up_lidar", "down_lidar"]
    assert [sensor.calibrated for sensor in without.sensors] == [False]
    assert with_calibration.split == without.split == "Val"
    assert [frame.number for frame in with_calibration.frames] == [116, 117]
    assert [frame.number for frame in without.frames] == [0]
    np.testing.assert_allclose(np.diff(with_calibration.times()[[116, 117]]), 0.100196, atol=1e-9)
    upper, lower = with_calibration.frames[0].read()
    assert (len(upper.points), len(lower.points)) == (51785, 47444)
    assert len(without.frames[0].read()[0].points) == 100660


def test_lasers_of_the_real_sample_belong_to_the_sensors_that_they_are_given_to(sample):
    found = Argoverse2(sample).sequences()[0]
    for k, cloud in enumerate(found.frames[0].read()):
        own, other = (_disorder(cloud.points, found.sensors[i].origin) for i in (k, 1 - k))
        assert own < other


def _disorder(points, origin):
    """Return the entropy of elevations: the beams of a laser have one elevation, but only about the
    place of their own sensor.
    """
    rays = points[:, :3] - origin
    distances = np.linalg.norm(rays, axis=1)
    near = (distances > 4) & (distances < 15)
    counts = np.histogram(
        np.degrees(np.arcsin(rays[near, 2] / distances[near])), np.arange(-26, 16, 0.05)
    )[0]
    shares = counts[counts > 0] / counts.sum()
    return float(-(shares * np.log(shares)).sum())


def test_boxes_of_the_real_sample_hold_the_points_that_the_annotators_counted(sample):
    for found in Argoverse2(sample).sequences():
        frame = found.frames[0]
        boxes = found.boxes()[frame.number]
        points = np.concatenate([cloud.points[:, :3] for cloud in frame.read()])
        counted = read_table(found.folder / "annotations.feather")
        own = counted["timestamp_ns"] == int(Path(frame.location).stem)
        inside = boxes.contains(points).sum(axis=1)
        differences = np.abs(inside - counted["num_interior_pts"][own])
        assert np.median(differences / np.maximum(counted["num_interior_pts"][own], 1)) < 0.05
        assert len(boxes) > 40


@pytest.mark.slow
def test_the_road_of_the_real_sample_is_in_the_grid_and_each_lidar_casts_its_own_rays(
    sample, tmp_path
):
    result = convert(
        "argoverse2",
        sample,
        tmp_path / "out",
        layout=LayoutOptions(axes="right"),
        run=Run(workers=1),
    )
    assert result.failures == () and result.made == 3
    assert sum("both LiDARs count as one" in note for note in result.notes) == 1
    for sequence in carlasc.open(tmp_path / "out").sequences().values():
        (name,) = sequence.grids
        spec = sequence.grids[name]
        frame = int(sequence.frames("points")[-1])
        points, labels = sequence.read("points", frame)[:, :3], sequence.read("labels", frame)
        ground = points[(labels == CARLA.ground_id) & (np.abs(points[:, :2]) < 25).all(axis=1)]
        assert len(ground) > 5000
        assert (ground[:, 2] < spec.lower[2]).mean() < 0.05
        assert (ground[:, 2] < -2.0).mean() > 0.2  # they are below the published grid
        assert (sequence.grid(name, frame).labels == CARLA.ground_id).sum() > 1000
        calibrated = len(sequence.metadata.extra["sensors"]) == 2
        assert ("origins" in sequence.fields()) == calibrated


def test_points_of_the_real_sample_are_in_view_of_as_many_cameras_as_a_plain_projection_says(
    sample,
):
    from carlasc_converters.feather import read_columns

    from carlasc.core.geometry import invert, transform_points

    recording, without = Argoverse2(sample).sequences()
    names = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3", "width_px", "height_px")
    table = read_columns(
        recording.folder / "calibration/intrinsics.feather", names, ("sensor_name",)
    )
    points = np.concatenate([cloud.points[:, :3] for cloud in recording.frames[0].read()]).astype(
        np.float64
    )
    cameras = recording.cameras()
    assert len(cameras) == 9 and not without.cameras()
    for row, camera in enumerate(cameras):
        fx, fy, cx, cy, k1, k2, k3, width, height = (float(table[name][row]) for name in names)
        x, y, z = transform_points(invert(camera.sensor_T_camera), points).T
        x, y, ahead = x / z, y / z, z > 0
        squared = x * x + y * y
        factor = 1 + k1 * squared + k2 * squared**2 + k3 * squared**3
        u, v = fx * x * factor + cx, fy * y * factor + cy
        inside = ahead & (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)
        found = camera.contains(
            camera.project(transform_points(invert(camera.sensor_T_camera), points))
        )
        assert camera.name == table["sensor_name"][row] and inside.sum() == found.sum() > 10_000
