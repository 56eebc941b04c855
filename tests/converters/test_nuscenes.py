import json
import shutil
import tracemalloc

import numpy as np
import pytest
from carlasc_converters.json_rows import read_rows
from carlasc_converters.nuscenes import NuScenes
from carlasc_converters.nuscenes_classes import CLASS_IDS, NUSCENES, TO_CARLA, VALIDATION
from carlasc_converters.nuscenes_frames import number_instances
from converters.formats import nuscenes as nusc
from converters.formats.nuscenes import (
    CATEGORIES,
    CLASS_OF_KIND,
    GLOBAL_T_WORLD,
    MOUNT,
    change_table,
    microseconds,
    rows_of,
    write_nuscenes,
    write_table,
)

from carlasc.converting import convert
from carlasc.core.boxes import Boxes
from carlasc.core.geometry import transform_points
from carlasc.core.tables import CARLA
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.testing import ConverterContract
from carlasc.testing.drives import KINDS

DRIVE = nusc.drive()
KEYS = (0, 3, 6)
SCENES = {"scene-0061": nusc.drive(4), "scene-0103": DRIVE}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("nuscenes")
    write_nuscenes(folder, SCENES)
    return folder


@pytest.fixture(scope="module")
def one_scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    write_nuscenes(folder, {"scene-0103": DRIVE})
    return folder


@pytest.fixture
def tables(one_scene, tmp_path):
    """The folder of the tables of one scene, which may be changed."""
    return shutil.copytree(one_scene, tmp_path / "copy") / "v1.0-mini"


def recording(folder, name="scene-0103", **options):
    return {found.name: found for found in NuScenes(folder, **options).sequences()}[f"NUSC_{name}"]


def scan_file(tables, frame):
    folder = "samples" if frame in KEYS else "sweeps"
    return (
        tables.parent / folder / "LIDAR_TOP" / f"scene-0103__{microseconds(DRIVE, frame)}.pcd.bin"
    )


class TestContract(ConverterContract):
    converter = "nuscenes"
    ids = {kind: CLASS_IDS[category] for kind, category in CATEGORIES.items()}  # noqa: RUF012
    drive = nusc.drive(channels=20, columns=180)

    def write(self, folder):
        write_nuscenes(folder, {"scene-0103": self.drive})

    def labelled(self, sequence):
        assert sequence.frames("labels").tolist() == list(range(7))
        return list(KEYS)

    def test_scans_between_key_frames_have_the_classes_that_key_frames_show(self, sequence):
        for frame in {*range(7)} - {*KEYS}:
            truth, labels = self.drive.scan(frame), sequence.read("labels", frame)
            static = truth.instances == 0
            assert (labels == CLASS_OF_KIND[truth.kinds])[static].mean() > 0.95
            assert (labels == CLASS_OF_KIND[truth.kinds])[~static].mean() > 0.9


def test_scenes_are_found_in_the_root_and_from_the_folder_of_the_tables(root):
    for folder in (root, root / "v1.0-mini"):
        found = NuScenes(folder).sequences()
        assert [(scene.name, scene.split) for scene in found] == [
            ("NUSC_scene-0061", "Train"),
            ("NUSC_scene-0103", "Val"),
        ]
        assert [frame.number for frame in found[1].frames] == list(range(7))


def test_scans_hold_the_points_in_the_frame_of_the_sensor(root):
    found = recording(root)
    (sensor,) = found.sensors
    np.testing.assert_allclose(sensor.vehicle_T_sensor, MOUNT, atol=1e-12)
    assert sensor.points_in == "sensor"
    assert sensor.deskewed
    assert sensor.height_m == pytest.approx(1.84)
    for frame in found.frames:
        (cloud,) = frame.read()
        truth = rows_of(DRIVE.scan(frame.number))
        np.testing.assert_array_equal(cloud.points[:, :3], truth[:, :3])
        np.testing.assert_allclose(cloud.points[:, 3], truth[:, 3] / 255, rtol=1e-6)
        assert cloud.points.flags.writeable


def test_a_point_ahead_of_the_vehicle_has_a_positive_y_in_the_file(root):
    """The axes of the LiDAR are not those of the vehicle, so that a reader that takes them as they
    are would fail.
    """
    vehicle = transform_points(
        recording(root).sensors[0].vehicle_T_sensor, np.array([[0.0, 10.0, 0.0], [2.0, 0.0, 0.0]])
    )
    np.testing.assert_allclose(vehicle, [[10.94, 0.0, 1.84], [0.94, -2.0, 1.84]], atol=1e-9)


def test_key_frames_have_labels_and_instances_and_scans_between_have_none(root):
    found = recording(root)
    assert found.has_labels
    assert found.has_instances
    for frame in found.frames:
        (cloud,) = frame.read()
        if frame.number not in KEYS:
            assert cloud.labels is None
            assert cloud.instances is None
            continue
        truth = DRIVE.scan(frame.number)
        np.testing.assert_array_equal(cloud.labels, CLASS_OF_KIND[truth.kinds])
        np.testing.assert_array_equal(cloud.instances > 0, truth.instances > 0)
        assert cloud.instances.dtype == np.uint32


def test_points_and_boxes_of_an_object_have_one_number_in_all_frames(root):
    found = recording(root)
    boxes, names = found.boxes(), {}
    for frame in found.frames:
        if frame.number in KEYS:
            truth, instances = DRIVE.scan(frame.number).instances, frame.read()[0].instances
            pairs = set(zip(truth[truth > 0].tolist(), instances[truth > 0].tolist(), strict=True))
            own, true = boxes[frame.number], DRIVE.boxes(frame.number)
            nearest = np.linalg.norm(own.centers[:, None] - true.centers, axis=2).argmin(axis=0)
            pairs |= set(zip(true.tracks.tolist(), own.tracks[nearest].tolist(), strict=True))
            for track, number in pairs:
                assert names.setdefault(track, number) == number
    assert len(set(names.values())) == len(names) == 5
    assert max(names.values()) == 5


def test_an_object_takes_the_box_of_its_class_with_most_of_its_points_and_keeps_its_own_number_without_one():
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, 0, 3] = poses[2, 0, 3] = 1.0
    sizes = np.array([[2.0, 2.0, 2.0], [4.0, 4.0, 4.0], [2.0, 2.0, 2.0]])
    boxes = Boxes.from_poses(
        np.array([7, 8, 9], np.uint32), np.array([2, 17, 2], np.uint32), poses, sizes
    )
    points = np.zeros((6, 4), np.float32)
    points[:, 0] = [-0.9, 0.5, -0.5, 1.9, 30.0, 30.0]
    panoptic = np.array([2001, 2001, 2001, 2005, 17003, 0], np.uint16)
    assert number_instances(panoptic, points, boxes).tolist() == [7, 7, 7, 9, 65536 + 17003, 0]
    assert number_instances(panoptic, points, None).tolist() == [
        65536 + value if value else 0 for value in panoptic.tolist()
    ]


def test_boxes_are_in_the_frame_of_the_vehicle_at_their_scan(root):
    found = recording(root).boxes()
    assert sorted(found) == list(KEYS)
    for frame, unordered in found.items():
        truth = DRIVE.boxes(frame)
        nearest = np.linalg.norm(unordered.centers[:, None] - truth.centers, axis=2).argmin(axis=0)
        boxes = unordered.select(nearest)
        np.testing.assert_allclose(boxes.sensor_T_box, truth.sensor_T_box, atol=1e-9)
        np.testing.assert_allclose(boxes.sizes, truth.sizes)
        assert [NUSCENES.names[label] for label in boxes.labels.tolist()] == [
            CATEGORIES[KINDS[kind]] for kind in truth.labels.tolist()
        ]


def test_cameras_have_the_image_nearest_to_each_scan(root):
    recording = next(one for one in NuScenes(root).sequences() if len(one.frames) > 1)
    (camera,) = recording.cameras()
    assert (camera.name, camera.width, camera.height, camera.model) == (
        "CAM_FRONT",
        1600,
        900,
        "pinhole",
    )
    assert np.allclose(camera.matrix, nusc.MATRIX) and np.allclose(
        camera.sensor_T_camera, nusc.VEHICLE_T_CAMERA
    )
    later = camera.times - recording.times()
    assert later == pytest.approx(np.full(len(later), nusc.IMAGE_LATER_US * 1e-6))
    assert all(
        name.endswith(".jpg") and f"{root}/samples/CAM_FRONT/" in name for name in camera.images
    )


def test_poses_and_times_are_those_of_the_simulation(root):
    found = recording(root)
    trajectory, times = found.poses(), found.times()
    np.testing.assert_allclose(times, DRIVE.times, atol=1e-9)
    np.testing.assert_allclose(trajectory.seconds, DRIVE.times, atol=1e-9)
    np.testing.assert_allclose(
        trajectory.at(times), GLOBAL_T_WORLD @ DRIVE.world_T_vehicle(DRIVE.times), atol=1e-6
    )


def test_only_key_frames_are_frames_if_sweeps_are_not_wanted(root):
    found = recording(root, sweeps=False)
    assert [frame.number for frame in found.frames] == [0, 1, 2]
    np.testing.assert_allclose(found.times(), DRIVE.times[list(KEYS)], atol=1e-9)
    assert sorted(found.boxes()) == [0, 1, 2]
    np.testing.assert_allclose(found.poses().seconds, DRIVE.times, atol=1e-9)
    np.testing.assert_array_equal(
        found.frames[2].read()[0].points[:, :3], rows_of(DRIVE.scan(6))[:, :3]
    )
    assert found.notes() == []
    with pytest.raises(ArgumentError, match="sweeps: expected true or false, found 'maybe'"):
        convert("nuscenes", root, root.parent / "out", options={"sweeps": "maybe"})


def test_without_files_between_key_frames_the_frames_are_the_key_frames(tables):
    for frame in {*range(7)} - {*KEYS}:
        scan_file(tables, frame).unlink()
    found = recording(tables)
    assert [frame.number for frame in found.frames] == [0, 1, 2]
    assert found.problems() == []
    (note,) = found.notes()
    assert "v1.0-mini: scene-0103: no scan between key frames exists in sweeps/" in note


def test_scenes_without_files_are_left_out(tmp_path):
    write_nuscenes(tmp_path, {"scene-0061": nusc.drive(1), "scene-0103": nusc.drive(1)})
    for path in (tmp_path / "samples" / "LIDAR_TOP").glob("scene-0061*"):
        path.unlink()
    assert [scene.name for scene in NuScenes(tmp_path).sequences()] == ["NUSC_scene-0103"]


def test_a_missing_scan_is_named_and_other_frames_keep_their_numbers(tables):
    scan_file(tables, 4).unlink()
    found = recording(tables)
    assert [frame.number for frame in found.frames] == [0, 1, 2, 3, 5, 6]
    np.testing.assert_allclose(found.times(), DRIVE.times, atol=1e-9)
    ((number, message),) = found.problems()
    assert number == 4
    assert (
        f"{scan_file(tables, 4).name}: expected a LiDAR scan that the tables list, found no such "
        f"file" in message
    )


def test_labels_come_from_panoptic_files_where_there_are_no_others(tmp_path):
    write_nuscenes(tmp_path, {"scene-0103": DRIVE}, lidarseg=False)
    found = recording(tmp_path)
    np.testing.assert_array_equal(
        found.frames[3].read()[0].labels, CLASS_OF_KIND[DRIVE.scan(3).kinds]
    )


def test_without_point_labels_there_are_boxes_only(tmp_path):
    write_nuscenes(tmp_path, {"scene-0103": DRIVE}, lidarseg=False, panoptic=False)
    found = recording(tmp_path)
    assert not found.has_labels
    assert not found.has_instances
    assert found.frames[0].read()[0].labels is None
    assert sorted(found.boxes()) == list(KEYS)


def test_the_test_set_has_neither_boxes_nor_labels(tmp_path):
    write_nuscenes(
        tmp_path,
        {"scene-0077": DRIVE},
        version="v1.0-test",
        lidarseg=False,
        panoptic=False,
        annotated=False,
    )
    found = recording(tmp_path, "scene-0077")
    assert found.split == "Test"
    assert found.boxes() is None
    assert len(found.frames) == 7


def test_a_key_frame_without_boxes_is_annotated_nevertheless(tables):
    path = tables / "sample_annotation.json"
    rows = json.loads(path.read_text())
    write_table(path, [row for row in rows if row["sample_token"] != "scene-0103-sample-1"])
    found = recording(tables)
    assert [len(boxes) for boxes in found.boxes().values()] == [5, 0, 5]
    instances = found.frames[3].read()[0].instances
    assert set(instances[instances > 0] > 1 << 16) == {True}


def test_the_version_is_chosen_where_there_are_several(tmp_path):
    write_nuscenes(tmp_path, {"scene-0553": nusc.drive(1)})
    write_nuscenes(
        tmp_path,
        {"scene-0553": nusc.drive(1), "scene-1110": nusc.drive(1)},
        version="v1.0-trainval",
    )
    with pytest.raises(
        ArgumentError, match=r"version: expected one of v1.0-mini, v1.0-trainval, found no choice"
    ):
        NuScenes(tmp_path).sequences()
    with pytest.raises(
        ArgumentError, match=r"version: expected one of v1.0-mini, v1.0-trainval, found 'v1.0-test'"
    ):
        NuScenes(tmp_path, version="v1.0-test").sequences()
    splits = {
        scene.name: scene.split for scene in NuScenes(tmp_path, version="v1.0-trainval").sequences()
    }
    assert splits == {"NUSC_scene-0553": "Val", "NUSC_scene-1110": "Train"}
    assert recording(tmp_path, "scene-0553", version="v1.0-mini").split == "Train"
    assert len(VALIDATION) == 150


def test_each_category_has_a_class_and_a_class_of_carla():
    assert len(CLASS_IDS) == 32
    carla = {name: CARLA.names[TO_CARLA.mapping[index]] for name, index in CLASS_IDS.items()}
    assert carla["vehicle.car"] == carla["vehicle.bicycle"] == "Vehicle"
    assert carla["human.pedestrian.child"] == "Pedestrian"
    assert carla["flat.driveable_surface"] == "Road"
    assert carla["noise"] == carla["vehicle.ego"] == "Free"
    assert {carla[NUSCENES.names[index]] for index in NUSCENES.ground} <= {
        CARLA.names[index] for index in CARLA.ground
    }
    assert (CLASS_IDS["static.other"], CLASS_IDS["static.vegetation"]) == (29, 30)
    assert NUSCENES.names[NUSCENES.geometry_id] == "static.other"
    assert NUSCENES.names[NUSCENES.ground_id] == "flat.other"


@pytest.mark.parametrize(
    ("values", "found"),
    [
        ({"name": "vehicle.tram"}, "'vehicle.tram'"),
        ({"index": 30}, "30 for vehicle.ego, which is 31"),
    ],
)
def test_tables_of_another_version_are_named(tables, values, found):
    change_table(tables / "category.json", **values)
    with pytest.raises(
        FormatError,
        match=rf"category.json: expected the 32 categories of nuScenes v1.0.*found {found}: use "
        rf"the tables of nuScenes",
    ):
        NuScenes(tables).sequences()


def test_an_object_of_an_unknown_category_is_named(tables):
    change_table(tables / "instance.json", category_token="nothing")
    with pytest.raises(
        FormatError,
        match=r"instance.json: expected a category_token of category.json, found nothing for",
    ):
        recording(tables).boxes()


@pytest.mark.parametrize(
    "table",
    [
        "scene",
        "sample",
        "sample_data",
        "ego_pose",
        "calibrated_sensor",
        "sensor",
        "category",
        "instance",
    ],
)
def test_a_table_that_is_missing_or_cut_short_or_lacks_a_key_is_named(tables, table):
    def read():
        found = NuScenes(tables.parent).sequences()[0]
        return found.sensors, found.poses(), found.boxes()

    path = tables / f"{table}.json"
    rows = json.loads(path.read_text())
    write_table(path, [*rows, {"other": 1}])
    with pytest.raises(
        FormatError,
        match=rf"{table}.json: expected the key '(token|name)'.* found other in row {len(rows)}: ",
    ):
        read()
    write_table(path, rows)
    path.write_bytes(path.read_bytes()[:-9])
    count = len(rows) - 1
    with pytest.raises(
        FormatError,
        match=rf"{table}.json: expected a JSON list.*ends or is damaged after {count} rows",
    ):
        read()
    path.unlink()
    found = "none" if table == "scene" else "nothing"
    with pytest.raises(
        MissingDataError, match=rf"{'scene' if table == 'scene' else table}.json.*found {found}"
    ):
        read()


def test_a_scan_of_an_unknown_sample_and_one_without_a_pose_are_named(tables):
    rows = json.loads((tables / "ego_pose.json").read_text())
    write_table(tables / "ego_pose.json", rows[:-1])
    with pytest.raises(
        FormatError,
        match=r"ego_pose.json: expected the pose scene-0103-scan-0-pose of a LiDAR scan, found no",
    ):
        recording(tables).poses()
    write_table(tables / "sample.json", json.loads((tables / "sample.json").read_text())[1:])
    with pytest.raises(
        FormatError,
        match=r"sample_data.json: expected a sample_token of sample.json, found scene-0103-sample-2",
    ):
        recording(tables)


def test_a_box_of_an_unknown_object_and_one_without_a_rotation_are_named(tables):
    path = tables / "sample_annotation.json"
    text = path.read_text()
    change_table(path, instance_token="nobody")
    with pytest.raises(
        FormatError,
        match=r"sample_annotation.json: expected a known sample and instance.*nobody in row 0",
    ):
        recording(tables).boxes()
    path.write_text(text)
    change_table(path, size=[1.0, 2.0])
    with pytest.raises(
        FormatError,
        match=r"sample_annotation.json: expected a list of 3 numbers under .size., found .* in row "
        r"0",
    ):
        recording(tables).boxes()
    path.write_text(text)
    change_table(path, rotation=[0, 0, 0, 0])
    with pytest.raises(
        FormatError, match=r"sample_annotation.json: samples/.*boxes: expected a rotation"
    ):
        recording(tables).boxes()


@pytest.mark.parametrize("table", ["ego_pose", "calibrated_sensor"])
def test_a_pose_of_too_few_numbers_is_named(tables, table):
    rows = json.loads((tables / f"{table}.json").read_text())
    write_table(tables / f"{table}.json", [row | {"rotation": [1.0, 0.0]} for row in rows])
    with pytest.raises(
        FormatError,
        match=rf"{table}.json: expected a list of 4 numbers under 'rotation', found .* in row 0",
    ):
        recording(tables).poses()


@pytest.mark.parametrize(
    ("table", "key", "value", "expected"),
    [
        ("sample_data", "timestamp", "soon", "a value of type int"),
        ("sample_data", "is_key_frame", 1, "a value of type bool"),
        ("sample_annotation", "translation", None, "a list of 3 numbers"),
        ("sample_annotation", "size", [1.0, "wide", 2.0], "a list of 3 numbers"),
        ("instance", "token", 7, "a value of type str"),
    ],
)
def test_a_value_of_another_type_is_named(tables, table, key, value, expected):
    rows = json.loads((tables / f"{table}.json").read_text())
    write_table(tables / f"{table}.json", [*rows[:-1], rows[-1] | {key: value}])
    with pytest.raises(
        FormatError,
        match=rf"{table}.json: expected {expected} under '{key}', found .* in row {len(rows) - 1}",
    ):
        recording(tables).boxes()


def test_poses_whose_times_stand_still_are_named(tables):
    rows = json.loads((tables / "ego_pose.json").read_text())
    write_table(tables / "ego_pose.json", [row | {"timestamp": nusc.START_US} for row in rows])
    with pytest.raises(
        FormatError, match=r"ego_pose.json: scene-0103: expected times that increase, found none at"
    ):
        recording(tables).poses()


def test_two_calibrations_in_a_scene_are_refused(tables):
    rows = json.loads((tables / "calibrated_sensor.json").read_text())
    moved = rows[0] | {"token": "moved", "translation": [0.0, 0.0, 0.0]}
    write_table(tables / "calibrated_sensor.json", [*rows, moved])
    data = json.loads((tables / "sample_data.json").read_text())
    write_table(
        tables / "sample_data.json", [*data[:-1], data[-1] | {"calibrated_sensor_token": "moved"}]
    )
    with pytest.raises(
        FormatError, match=r"scene-0103: expected one calibration of LIDAR_TOP in a scene, found 2"
    ):
        list(recording(tables).sensors)


def test_files_that_do_not_fit_are_named(tables):
    frame = recording(tables).frames[3]
    points = scan_file(tables, 3)
    data = points.read_bytes()
    labels = tables.parent / "lidarseg" / "v1.0-mini" / "scene-0103-scan-3_lidarseg.bin"
    panoptic = tables.parent / "panoptic" / "v1.0-mini" / "scene-0103-scan-3_panoptic.npz"
    for broken in (data[:-1], b""):
        points.write_bytes(broken)
        with pytest.raises(
            FormatError,
            match=rf"pcd.bin: expected a multiple of 20 bytes .*found {len(broken)}: .*incomplete",
        ):
            frame.read()
    points.write_bytes(data[:-20])
    with pytest.raises(
        FormatError,
        match=rf"scan-3_lidarseg.bin: expected a label for each of {len(data) // 20 - 1} points",
    ):
        frame.read()
    points.write_bytes(data)
    good = labels.read_bytes()
    labels.write_bytes(b"\xff" + good[1:])
    with pytest.raises(
        FormatError, match=r"lidarseg.bin: expected class ids of nuscenes, found 255 \(1 times\) of"
    ):
        frame.read()
    labels.unlink()
    with pytest.raises(
        MissingDataError, match=r"lidarseg.bin: expected a file that the tables list, found nothing"
    ):
        frame.read()
    labels.write_bytes(good)
    np.savez(panoptic, data=np.zeros(5, np.uint16))
    with pytest.raises(
        FormatError, match=r"panoptic.npz: expected a label for each of \d+ points, found 5"
    ):
        frame.read()
    np.savez(panoptic, other=np.zeros(5, np.uint16))
    with pytest.raises(FormatError, match=r"panoptic.npz: expected an array data, found other"):
        frame.read()
    np.savez(panoptic, data=np.array([{"a": 1}], object))
    with pytest.raises(
        FormatError,
        match=r"panoptic.npz: data: expected uint8 or uint16 or uint32 values, found object",
    ):
        frame.read()
    panoptic.write_bytes(b"PK\x03\x04")
    with pytest.raises(FormatError, match=r"panoptic.npz: expected an .npz file"):
        frame.read()
    panoptic.unlink()
    with pytest.raises(
        MissingDataError, match=r"panoptic.npz: expected a file, found nothing: unpack it again"
    ):
        frame.read()
    points.unlink()
    with pytest.raises(
        MissingDataError, match=r"pcd.bin: expected a file that the tables list, found nothing"
    ):
        frame.read()


def test_a_folder_without_tables_and_tables_without_files_are_refused(tmp_path):
    with pytest.raises(
        MissingDataError,
        match=r"expected v1.0-mini/scene.json, or another version, found none: give",
    ):
        NuScenes(tmp_path).sequences()
    with pytest.raises(MissingDataError, match="found no such folder"):
        NuScenes(tmp_path / "typo").sequences()
    write_nuscenes(tmp_path, {"scene-0103": nusc.drive(1)})
    for path in (tmp_path / "samples" / "LIDAR_TOP").iterdir():
        path.unlink()
    with pytest.raises(
        MissingDataError,
        match=r"expected the LiDAR scans that v1.0-mini lists.*found none of them: unpack",
    ):
        NuScenes(tmp_path).sequences()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "found ''"),
        ('{"token": 1}', "expected a JSON list of objects, found '{\"token\": 1}'"),
        ('[{"token": "1"}, 5]', "found int in row 1"),
        ('[{"token": "1"}, {"token": tru}]', "damaged after 1 rows"),
        ('[{"token": "1"}', "damaged after 1 rows"),
    ],
)
def test_text_that_is_no_table_is_named(tmp_path, text, message):
    path = tmp_path / "table.json"
    path.write_text(text)
    with pytest.raises(FormatError, match=f"table.json: .*{message}"):
        list(read_rows(path, ("token",)))


def test_text_of_another_encoding_is_named(tmp_path):
    path = tmp_path / "table.json"
    path.write_bytes(b'[{"token": "\xff"}]')
    with pytest.raises(
        FormatError,
        match=r"table.json: expected a JSON list of objects, found something else .*utf-8",
    ):
        list(read_rows(path, ("token",)))


def test_rows_of_a_large_table_need_little_memory_and_damage_in_it_is_found_at_once(
    tmp_path, monkeypatch
):
    monkeypatch.setattr("carlasc_converters.json_rows._CHUNK", 1 << 12)
    monkeypatch.setattr("carlasc_converters.json_rows._LONGEST_ROW", 1 << 14)
    path = tmp_path / "table.json"
    rows = [{"token": f"{number:032x}", "other": [number, "text" * 10]} for number in range(20_000)]
    write_table(path, rows)
    tracemalloc.start()
    count = sum(
        token == row["token"]
        for (token,), row in zip(read_rows(path, ("token",)), rows, strict=True)
    )
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert count == len(rows)
    assert peak < path.stat().st_size / 10
    path.write_text(path.read_text().replace(f"{100:032x}", '"'))
    with pytest.raises(FormatError, match="damaged after 100 rows"):
        list(read_rows(path, ("token",)))
