"""Tracked boxes as the files of KITTI tracking, nuScenes and NCore, read again by the facts of the
formats and compared with what they were made from.
"""

import json
import lzma
import shutil
from dataclasses import replace

import numpy as np
import pytest
from carlasc_converters.kitti_boxes import KITTI
from carlasc_converters.kitti_tracking import KittiTracking
from carlasc_converters.ncore import Ncore
from carlasc_converters.ncore_classes import class_of_name
from converters.formats import nuscenes as nusc
from converters.formats.kitti_drive import small_drive
from converters.formats.kitti_tracking import TYPES, write_tracking
from exporters.test_opensceneflow import CARLA, DRIVE, scan_boxes, write_drive
from helpers.converters.ncore_files import START_US, contents, write_store
from helpers.errors import raises
from typer.testing import CliRunner

from carlasc.cli import app
from carlasc.converting import LayoutOptions, convert, export
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.motion import BoxTable, PoseOptions
from carlasc.running import Run
from carlasc.storage import FolderSource
from carlasc.testing import SimulatedDrive

ONE = Run(workers=1)
SCENE = "Train/Street.1/cartesian"


def box_table(drive, *, scale=1.0):
    """Return the table of the boxes of a drive in the frame of its first scan."""
    rows = []
    for frame, seconds in enumerate(drive.times.tolist()):
        boxes = scan_boxes(drive, frame).transform(
            np.linalg.inv(sensor_pose(drive, 0)) @ sensor_pose(drive, frame)
        )
        ahead = boxes.sensor_T_box[:, :2, 0]
        for row, track in enumerate(boxes.tracks.tolist()):
            heading = np.arctan2(ahead[row, 1], ahead[row, 0])
            velocity = [3.0, 4.0, 0.0] if track == 1 else [np.nan] * 3
            own = [*boxes.centers[row], *boxes.sizes[row] * scale, heading, *velocity]
            rows.append((seconds, track, [*own, 0.75, *[np.nan] * 6]))
    times, numbers, values = zip(*rows, strict=True)
    return BoxTable(np.array(times), np.array(numbers), ("Vehicle",) * len(rows), np.array(values))


def sensor_pose(drive, frame):
    pose = drive.world_T_vehicle(drive.times[frame]).copy()
    return pose @ translation_of(drive.sensors[0].vehicle_T_sensor)


def translation_of(pose):
    moved = np.eye(4)
    moved[:3, 3] = pose[:3, 3]
    return moved


def read_labels(file, classes=("Car", "Pedestrian")):
    """Return type and numbers of each line of KITTI's labels by frame and track."""
    rows = [line.split() for line in file.read_text().splitlines()]
    return {
        (int(row[0]), int(row[1])): (row[2], np.array(row[3:], np.float64))
        for row in rows
        if row[2] != "DontCare"
    }


@pytest.fixture(scope="module")
def tracking(tmp_path_factory):
    """KITTI tracking's files of a drive, and the sequence that was made from them."""
    root, drive = tmp_path_factory.mktemp("tracking"), small_drive()
    labels = {kind: KITTI.id_of(name) for kind, name in TYPES.items()}
    write_tracking(root / "in", drive, labels, first=20)
    calib = root / "in/training/calib/0000.txt"
    calib.write_text("P0: 721.5 0 609.6 0 0 721.5 172.9 0 0 0 1 0\n" + calib.read_text())
    layout = LayoutOptions(classes="kitti")
    how = {"layout": layout, "poses": PoseOptions(force=True), "grids": None, "run": ONE}
    convert("kitti-tracking", root / "in", root / "seq", **how)
    return root


def test_files_of_kitti_tracking_come_back(tracking, tmp_path):
    result = export("kitti-tracking", tracking / "seq", tmp_path, run=ONE)
    assert [*result.sequences.values()] == ["training/label_02/0000.txt"] and not result.notes
    was = read_labels(tracking / "in/training/label_02/0000.txt")
    now = read_labels(tmp_path / "training/label_02/0000.txt")
    assert set(now) == set(was) and len(now) > 5
    for key, (name, values) in now.items():
        assert name == was[key][0] and len(values) == 14  # no score
        assert np.abs(values[7:] - was[key][1][7:]).max() < 2e-6
        turn, x, z = values[13], values[10], values[12]
        assert np.cos(values[2] - turn + np.arctan2(x, z)) == pytest.approx(1)
    shutil.copytree(tracking / "in/training/velodyne", tmp_path / "training/velodyne")
    (there,), (here,) = (KittiTracking(root).sequences() for root in (tracking / "in", tmp_path))
    mine, theirs = here.boxes(), there.boxes()
    for frame, boxes in theirs.items():
        assert mine[frame].tracks.tolist() == boxes.tracks.tolist()
        assert mine[frame].labels.tolist() == boxes.labels.tolist()
        for name in ("centers", "sizes", "sensor_T_box"):
            found, expected = getattr(mine[frame], name), getattr(boxes, name)
            assert np.abs(found - expected).max(initial=0) < 5e-6
    for found, expected in zip(here.cameras(), there.cameras(), strict=True):
        assert np.allclose(found.sensor_T_camera, expected.sensor_T_camera, atol=1e-9)


def test_places_in_the_image_are_those_of_the_corners(tracking, tmp_path):
    export("kitti-tracking", tracking / "seq", tmp_path, run=ONE)
    projection = np.array([721.5, 0, 609.6, 44.9, 0, 721.5, 172.9, 0.2, 0, 0, 1, 0.003])
    seen = 0
    for _, values in read_labels(tmp_path / "training/label_02/0000.txt").values():
        height, width, length, x, y, z, turn = values[7:]
        own = np.array(np.meshgrid([-0.5, 0.5], [-1, 0], [-0.5, 0.5])).reshape(3, -1).T
        own *= [length, height, width]
        cos, sin = np.cos(turn), np.sin(turn)
        points = own @ np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]).T + [x, y, z]
        if (points[:, 2] < 0.2).any():
            continue
        pixels = np.c_[points, np.ones(8)] @ projection.reshape(3, 4).T
        pixels = pixels[:, :2] / pixels[:, 2:]
        edges = np.r_[pixels.min(0), pixels.max(0)].clip(0, [1241, 374] * 2)
        if (edges[2:] > edges[:2]).all():
            seen += 1
            assert np.abs(values[3:7] - edges).max() < 0.01
        else:
            assert (values[3:7] == -1).all()
    assert seen > 3


@pytest.mark.parametrize("axes", ["left", pytest.param("right", marks=pytest.mark.slow)])
def test_without_cameras_boxes_are_seen_from_the_lidar(tmp_path, axes):
    write_drive(tmp_path / "in", axes=axes)
    result = export("kitti-tracking", tmp_path / "in", tmp_path / "out", run=ONE)
    assert "no camera image_00" in result.notes[0]
    now = read_labels(tmp_path / "out/training/label_02/Street.1.txt")
    calib = (tmp_path / "out/training/calib/Street.1.txt").read_text().splitlines()
    assert [line.partition(":")[0] for line in calib] == ["R0_rect", "Tr_velo_to_cam"]
    boxes = scan_boxes(DRIVE, 2)
    assert {track for frame, track in now if frame == 2} == {
        track + 70_000 - 1 for track in boxes.tracks.tolist()
    }
    for row, track in enumerate(boxes.tracks.tolist()):
        name, values = now[2, track + 69_999]
        assert name == ("Car" if boxes.labels[row] == CARLA["car"] else "Pedestrian")
        x, y, z = boxes.centers[row]
        assert values[10:13] == pytest.approx([-y, -z + boxes.sizes[row, 2] / 2, x], abs=1e-5)
        assert values[7:10] == pytest.approx(boxes.sizes[row, ::-1], abs=1e-5)
        assert (values[3:7] == -1).all()
        heading = np.arctan2(*boxes.sensor_T_box[row, [1, 0], 0])
        assert np.cos(values[13] + heading + np.pi / 2) == pytest.approx(1, abs=1e-9)


def test_boxes_of_a_table_have_scores_and_a_change_of_it_is_written(tmp_path):
    write_drive(tmp_path / "in", leave_out=("boxes", "instances"))
    table, file = box_table(DRIVE), tmp_path / "boxes.csv"
    late = replace(table, times=np.where(np.arange(len(table.times)) == 2, 0.06, table.times))
    late.write(file)
    command = ["export", "kitti-tracking", str(tmp_path / "in"), str(tmp_path / "out")]
    done = CliRunner().invoke(app, [*command, "--boxes", str(file), "--workers", "1"])
    assert done.exit_code == 0 and f"1 of {len(table.times)} boxes of" in done.output
    labels = tmp_path / "out/training/label_02/Street.1.txt"
    first = read_labels(labels)
    assert len(first) == len(table.times) - 1
    assert all(values[14] == 0.75 for _, values in first.values())
    box_table(DRIVE, scale=2.0).write(file)
    options = {"boxes": str(file)}
    changed, same = (
        export("kitti-tracking", tmp_path / "in", tmp_path / "out", options=options, run=ONE)
        for _ in range(2)
    )
    assert changed.made and not changed.skipped
    assert same.skipped and not same.made
    now = read_labels(labels)
    assert len(now) == len(table.times)
    assert now[0, 0][1][9] == pytest.approx(2 * first[0, 0][1][9], abs=1e-5)


def check_results(data):
    """Check a file of results by the rules of nuScenes' devkit for tracking and detection."""
    kinds = {"camera": False, "lidar": True, "radar": False, "map": False, "external": False}
    assert data["meta"] == {f"use_{kind}": used for kind, used in kinds.items()}
    assert set(data) == {"meta", "results"}
    names = "bicycle bus car motorcycle pedestrian trailer truck".split()
    for token, boxes in data["results"].items():
        assert len({box["tracking_id"] for box in boxes}) == len(boxes) <= 500
        for box in boxes:
            assert box["sample_token"] == token
            for key, count in {"translation": 3, "size": 3, "rotation": 4, "velocity": 2}.items():
                assert np.isfinite(box[key]).all() and len(box[key]) == count
            assert np.linalg.norm(box["rotation"]) == pytest.approx(1)
            assert box["tracking_name"] == box["detection_name"] and box["tracking_name"] in names
            assert isinstance(box["tracking_id"], str) and box["attribute_name"] == ""
            assert isinstance(box["tracking_score"], float) and 0 <= box["tracking_score"] <= 1
            assert box["detection_score"] == box["tracking_score"]
    return data["results"]


@pytest.mark.parametrize("classes", ["nuscenes", pytest.param("carla", marks=pytest.mark.slow)])
def test_nuscenes_comes_back_with_its_tokens_in_its_frame(tmp_path, classes):
    drives = {"scene-0061": nusc.drive(4), "scene-0103": nusc.drive()}
    nusc.write_nuscenes(tmp_path / "in", drives)
    layout, out = LayoutOptions(classes=classes), tmp_path / "out"
    convert("nuscenes", tmp_path / "in", tmp_path / "seq", layout=layout, grids=None, run=ONE)
    export("nuscenes", tmp_path / "seq", out, options={"tables": str(tmp_path / "in")}, run=ONE)
    samples, annotations, scenes = (
        json.loads((tmp_path / f"in/v1.0-mini/{name}.json").read_bytes())
        for name in ("sample", "sample_annotation", "scene")
    )
    names, every = {row["token"]: row["name"] for row in scenes}, {}
    for split, scene in (("train", "scene-0061"), ("val", "scene-0103")):
        results = check_results(json.loads((out / f"{split}.json").read_bytes()))
        wanted = {row["token"] for row in samples if names[row["scene_token"]] == scene}
        assert set(results) == wanted
        every |= results
    assert sum(map(len, every.values())) == len(annotations)
    for row in annotations:
        boxes = every[row["sample_token"]]
        away = [np.abs(np.subtract(b["translation"], row["translation"])).max() for b in boxes]
        box = boxes[int(np.argmin(away))]
        assert min(away) < 1e-5
        assert box["size"] == pytest.approx(row["size"], abs=1e-6)
        assert np.abs(np.dot(box["rotation"], row["rotation"])) == pytest.approx(1, abs=1e-9)


def test_other_drives_have_tokens_of_their_own_and_velocities(tmp_path):
    write_drive(tmp_path / "in", axes="right", leave_out=("boxes", "instances"))
    box_table(DRIVE).write(tmp_path / "boxes.json")
    options = {"boxes": str(tmp_path / "boxes.json")}
    export("nuscenes", tmp_path / "in", tmp_path / "out", options=options, run=ONE)
    results = check_results(json.loads((tmp_path / "out/train.json").read_bytes()))
    assert results == json.loads((tmp_path / "out/train/Street.1.json").read_bytes())["results"]
    assert len(results) == DRIVE.frames and sorted(results) == [*results]
    first = {box["tracking_id"]: box for box in results[min(results)]}
    assert first["Street.1-1"]["velocity"] == [3.0, 4.0]
    assert first["Street.1-1"]["tracking_score"] == 0.75
    table = box_table(DRIVE)
    for row in np.flatnonzero(table.times == 0).tolist():
        box = first[f"Street.1-{table.numbers[row]}"]
        assert box["translation"] == pytest.approx(table.values[row, :3], abs=1e-4)
        assert box["size"] == pytest.approx(table.values[row, [4, 3, 5]], abs=1e-4)


@pytest.mark.needs("cbor2", "numcodecs")
@pytest.mark.parametrize("level", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_ncore_gets_a_store_with_the_observations_of_the_recording(tmp_path, level):
    drive = SimulatedDrive(4)
    (tmp_path / "in").mkdir()
    write_store(tmp_path / "in", drive)
    layout = LayoutOptions(classes="ncore", level=level)
    convert("ncore", tmp_path / "in", tmp_path / "seq", layout=layout, grids=None, run=ONE)
    options = {"recording": str(tmp_path / "in")}
    export("ncore", tmp_path / "seq", tmp_path / "out", options=options, run=ONE)
    import cbor2

    (store,) = (tmp_path / "out").glob("*.ncore4*.zarr")
    metadata = cbor2.loads(lzma.decompress((store / ".zmetadata.cbor.xz").read_bytes()))["metadata"]
    about = metadata[".zattrs"]
    assert (about["version"], about["sequence_id"]) == ("v4", "drive 1")
    assert about["component_group_name"] == "carlasc"
    found = metadata["cuboids/carlasc/cuboids/.zattrs"]["cuboid_track_observations"]
    given = contents(drive)["observations"]
    key = lambda one: (one["timestamp_us"], *np.round(one["bbox3"]["centroid"], 2))  # noqa: E731
    assert len(found) == len(given) > 4
    for mine, theirs in zip(sorted(found, key=key), sorted(given, key=key), strict=True):
        assert mine["timestamp_us"] == mine["reference_frame_timestamp_us"] >= START_US
        assert mine["timestamp_us"] == theirs["timestamp_us"]
        assert mine["reference_frame_id"] == "rig" and mine["source"] == "EXTERNAL"
        assert class_of_name(mine["class_id"]) == class_of_name(theirs["class_id"])
        for part in ("centroid", "dim", "rot"):
            assert mine["bbox3"][part] == pytest.approx(theirs["bbox3"][part], abs=1e-6)
    shutil.copytree(store, tmp_path / "in" / store.name)
    (recording,) = Ncore(tmp_path / "in").sequences()
    assert "several cuboids: only one was read, not carlasc" in recording.notes()


def test_what_cannot_be_exported_is_one_line(tmp_path):
    write_drive(tmp_path / "in", leave_out=("boxes", "instances"))
    source, out = tmp_path / "in", tmp_path / "out"

    def fails(kind, name="kitti-tracking", **parts):
        options = parts.pop("options", None)
        with raises(kind, **parts) as error:
            export(name, source, out, options=options, run=ONE)
        assert "\n" not in str(error.value)
        assert not out.exists()

    for name in ("kitti-tracking", "nuscenes"):
        fails(MissingDataError, name, where="Street.1", expected="boxes", advice="a table")
    fails(ArgumentError, "ncore", where="recording", expected="stores of NCore", found="none")
    file = tmp_path / "boxes.csv"
    given = {"boxes": str(file)}
    fails(MissingDataError, options=given, where="boxes.csv", found="no file")
    table = box_table(DRIVE)
    replace(table, times=table.times + 60).write(file)
    fails(FormatError, options=given, where="boxes.csv", found="boxes at 60 to 60.3 s")
    replace(table, classes=("Spaceship",) * len(table.times)).write(file)
    fails(FormatError, options=given, where="boxes.csv", found="Spaceship")
    table.write(file)
    write_drive(tmp_path / "in", path="Val/Other/cartesian", leave_out=("boxes", "instances"))
    fails(ArgumentError, options=given, where="boxes", found="2 .*Other, Street.1|Street.1, Other")
    nusc.write_nuscenes(tmp_path / "nuscenes", {"scene-0103": nusc.drive()})
    options = given | {"tables": str(tmp_path / "nuscenes")}
    shutil.rmtree(tmp_path / "in/Val")
    fails(
        MissingDataError,
        "nuscenes",
        options=options,
        where="nuscenes",
        expected="recording from which .*Street.1",
        found="NUSC_scene-0103",
    )


@pytest.mark.slow
def test_scans_of_other_times_are_refused(tmp_path):
    nusc.write_nuscenes(tmp_path / "in", {"scene-0103": nusc.drive()})
    convert("nuscenes", tmp_path / "in", tmp_path / "seq", grids=None, run=ONE)
    (sequence,) = FolderSource(tmp_path / "seq").sequences().values()
    times = tmp_path / "seq" / sequence.path / "times.txt"
    times.write_text("".join(f"{1.5 * float(one)}\n" for one in times.read_text().split()))
    options = {"tables": str(tmp_path / "in")}
    with raises(FormatError, where="in", expected="scans at the times of", found="s apart"):
        export("nuscenes", tmp_path / "seq", tmp_path / "out", options=options, run=ONE)
