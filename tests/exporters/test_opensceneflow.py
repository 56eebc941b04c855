"""Scans and flow as OpenSceneFlow has them, read again by the facts of its format and compared with
the truth of a simulated drive.
"""

from dataclasses import replace

import numpy as np
import pytest
from carlasc_converters.exporters import opensceneflow
from helpers.datasets.exported import files_and_bytes, read_index

from carlasc.converting import export
from carlasc.core.boxes import Boxes, mirror_boxes
from carlasc.core.geometry import (
    invert,
    mirror_points,
    mirror_poses,
    rotate_vectors,
    rotation_z,
    transform_points,
)
from carlasc.errors import FormatError, MissingDataError
from carlasc.running import Run
from carlasc.storage import FolderSink, layout
from carlasc.storage.files import to_json
from carlasc.testing.drives import KINDS, MOVABLE, SimulatedDrive, world_T_sensor

h5py = pytest.importorskip("h5py")

CARLA = dict(zip(KINDS, (0, 7, 1, 9, 5, 10, 10, 4, 4), strict=True))
DRIVE = SimulatedDrive(frames=4, channels=10, columns=90)
TIMES = [str(10**18 + 10**8 * frame) for frame in range(4)]
FIRST, LAST = TIMES[0], TIMES[-1]
THINGS = dict(enumerate((thing for thing in DRIVE.things if thing.kind in MOVABLE), 1))


def write_drive(
    root, *, axes="left", leave_out=(), path="Train/Street.1/cartesian", drop=(), drive=DRIVE
):
    """Write the drive as a sequence; `leave_out` are fields and documents, `drop` (frame, track) of
    boxes that are left out.
    """
    writer = FolderSink(root).sequence(path)
    left = axes == "left"
    poses = np.stack(
        [
            invert(world_T_sensor(drive, 0)) @ world_T_sensor(drive, frame)
            for frame in range(drive.frames)
        ]
    )
    documents = {
        layout.POSES: layout.encode_poses(mirror_poses(poses) if left else poses),
        layout.TIMES: layout.encode_times(drive.times),
        layout.METADATA: to_json({"axes": axes, "classes": "carla"}),
    }
    for name, data in documents.items():
        if name not in leave_out:
            writer.write_document(name, data)
    for frame in range(drive.frames):
        scan = drive.scan(frame)
        velocity = np.zeros((len(scan.instances), 3))
        for track, thing in THINGS.items():
            world = thing.speed * np.array([np.cos(thing.heading), np.sin(thing.heading), 0])
            velocity[scan.instances == track] = rotate_vectors(
                invert(world_T_sensor(drive, frame)), world[None]
            )[0]
        boxes = scan_boxes(drive, frame)
        boxes = boxes.select(
            np.array([(frame, track) not in drop for track in boxes.tracks.tolist()], bool)
        )
        content = {
            "points": mirror_points(scan.deskewed) if left else scan.deskewed,
            "labels": np.array([CARLA[kind] for kind in KINDS], np.uint32)[scan.kinds],
            "instances": scan.instances + np.uint32(70_000) * (scan.instances > 0),
            "flow": mirror_points(velocity.astype(np.float32))
            if left
            else velocity.astype(np.float32),
            "seconds": scan.seconds.astype(np.float32),
            "sensor": (np.arange(len(scan.points)) % 2).astype(np.uint8),
            "boxes": renumber(mirror_boxes(boxes) if left else boxes, 70_000).to_table(),
        }
        for name, array in content.items():
            if name not in leave_out:
                writer.write(name, frame, array)
    return root


def scan_boxes(drive, frame):
    """Return the boxes of a frame in the frame of its scan, right-handed."""
    scan_T_vehicle = np.eye(4)
    scan_T_vehicle[:3, 3] = -drive.sensors[0].vehicle_T_sensor[:3, 3]
    return drive.boxes(frame, CARLA).transform(scan_T_vehicle)


def renumber(boxes, more):
    return Boxes(
        boxes.tracks + np.uint32(more),
        boxes.labels,
        boxes.centers,
        boxes.quaternions,
        boxes.sizes,
        boxes.annotated,
    )


def read_log(file):
    """Return {timestamp: {name: array}}."""
    with h5py.File(file, "r") as log:
        return {time: {name: group[name][()] for name in group} for time, group in log.items()}


def true_flow(frame, drive=DRIVE):
    """Return where each point is in the next sensor's frame, less where it is now, by the motion of
    what it lies on.
    """
    scan, now, later = drive.scan(frame), drive.times[frame], drive.times[frame + 1]
    world = transform_points(world_T_sensor(drive, frame), scan.deskewed[:, :3])
    for track, thing in THINGS.items():
        on_it = scan.instances == track
        world[on_it] = transform_points(
            thing.world_T_box(later) @ invert(thing.world_T_box(now)), world[on_it]
        )
    return transform_points(invert(world_T_sensor(drive, frame + 1)), world) - scan.deskewed[:, :3]


@pytest.mark.parametrize("axes", ["left", "right"])
@pytest.mark.parametrize("leave_out", [(), ("boxes",), ("flow",)])
def test_flow_is_where_points_are_in_the_next_scan(tmp_path, axes, leave_out):
    write_drive(tmp_path / "in", axes=axes, leave_out=leave_out)
    result = export("opensceneflow", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    assert (result.made, result.failures) == (4, ())
    assert result.sequences == {"Train/Street.1/cartesian": "train/Street_1.h5"}
    log = read_log(tmp_path / "out" / "train" / "Street_1.h5")
    assert sorted(log) == TIMES  # as text too, as the loader orders them
    for frame, time in enumerate(sorted(log, key=int)):
        scan, group = DRIVE.scan(frame), log[time]
        assert np.array_equal(group["lidar"], scan.deskewed[:, :3])
        world = invert(world_T_sensor(DRIVE, 0)) @ world_T_sensor(DRIVE, frame)
        assert group["pose"] == pytest.approx(world, abs=1e-9)
        if time == LAST:
            assert not {"flow", "flow_is_valid", "ego_motion"} & set(group)
            continue
        expected = true_flow(frame)
        assert np.linalg.norm(expected, axis=1).max() > 0.5  # ego motion is in it
        assert np.abs(group["flow"] - expected).max() < 1e-4
        assert group["flow_is_valid"].all()
        step = invert(world_T_sensor(DRIVE, frame + 1)) @ world_T_sensor(DRIVE, frame)
        assert group["ego_motion"] == pytest.approx(step, abs=1e-9)
        still = scan.instances == 0
        own = transform_points(group["ego_motion"], group["lidar"]) - group["lidar"]
        assert np.abs(group["flow"][still] - own[still]).max() < 1e-4


@pytest.mark.parametrize("leave_out", [("instances",), ("flow", "instances"), ("flow",)])
def test_points_of_a_lidar_that_turns_move_with_the_box_of_their_own_time(tmp_path, leave_out):
    drive = replace(DRIVE, rolling=True, columns=180)
    write_drive(tmp_path / "in", leave_out=leave_out, drive=drive)
    export("opensceneflow", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    log = read_log(tmp_path / "out" / "train" / "Street_1.h5")
    late = 0
    for frame, time in enumerate(TIMES[:-1]):
        scan, expected = drive.scan(frame), true_flow(frame, drive)
        inside = scan_boxes(drive, frame).contains(scan.deskewed[:, :3], 0.01).any(axis=0)
        late += np.count_nonzero((scan.instances > 0) & ~inside)
        assert np.abs(log[time]["flow"] - expected).max() < 1e-4
    assert late > 10  # they are in no box of the time of the scan


def test_points_of_a_thing_that_turns_turn_with_it(tmp_path):
    thing = Boxes.from_poses(
        np.array([1]), np.array([10]), np.eye(4)[None], np.array([[4.0, 2.0, 1.5]])
    )
    turned = rotation_z(0.1)
    turned[0, 3] = 1.0
    later = Boxes.from_poses(thing.tracks, thing.labels, turned[None], thing.sizes)
    step = opensceneflow._Step(np.eye(4), 0.1)
    seconds = np.array([-0.05, 0.0, 0.05])
    points = (np.array([[1.9, 0, 0]] * 3) + seconds[:, None] * [10, 0, 0]).astype(np.float32)
    flow = step.flow(points, seconds, None, None, thing, later)["flow"]
    # 10 m/s, along the new heading after the step
    expected = turned[:2, 0] * (1.9 + 10 * seconds)[:, None] + [1, 0] - points[:, :2]
    assert np.abs(flow[:, :2] - expected).max() < 1e-5


def test_a_scan_has_the_types_of_the_format(tmp_path):
    write_drive(tmp_path / "in")
    export("opensceneflow", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    group = read_log(tmp_path / "out" / "train" / "Street_1.h5")[FIRST]
    types = {name: (array.dtype.name, array.shape[1:]) for name, array in group.items()}
    assert types == {
        "lidar": ("float32", (3,)),
        "lidar_id": ("uint8", ()),
        "lidar_dt": ("float32", ()),
        "ground_mask": ("bool", ()),
        "pose": ("float64", (4,)),
        "flow": ("float32", (3,)),
        "flow_is_valid": ("bool", ()),
        "eval_mask": ("bool", ()),
        "flow_category_indices": ("uint8", ()),
        "flow_instance_id": ("int16", ()),
        "ego_motion": ("float64", (4,)),
    }
    scan = DRIVE.scan(0)
    kinds = np.array(KINDS)[scan.kinds]
    assert np.array_equal(group["ground_mask"], kinds == "road")
    categories = {"car": 19, "van": 19, "pedestrian": 17, "cyclist": 17}
    assert np.array_equal(
        group["flow_category_indices"], [categories.get(kind, 0) for kind in kinds]
    )
    assert np.array_equal(group["lidar_id"], np.arange(len(kinds)) % 2)
    assert np.array_equal(group["lidar_dt"], scan.seconds.astype(np.float32))


def test_more_objects_than_16_bits_hold_are_named(tmp_path):
    with opensceneflow._LogFile(tmp_path / "log.h5", {0: "1"}) as log:
        found = log._number(np.arange(32_768, dtype=np.uint32)[::-1] << 5)
        assert (found.dtype, found.min(), found.max(), len(np.unique(found))) == (
            np.int16,
            0,
            32_767,
            32_768,
        )
        with pytest.raises(
            FormatError, match=r"log.h5: expected at most 32767 objects, found 32768"
        ):
            log.add(0, {"flow_instance_id": np.array([3], np.uint32)})


def test_objects_keep_their_numbers_although_the_source_has_larger_ones(tmp_path):
    write_drive(tmp_path / "in")
    export("opensceneflow", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    log = read_log(tmp_path / "out" / "train" / "Street_1.h5")
    pairs = set()
    for frame, time in enumerate(sorted(log, key=int)):
        pairs |= set(
            zip(
                DRIVE.scan(frame).instances.tolist(),
                log[time]["flow_instance_id"].tolist(),
                strict=True,
            )
        )
    assert (
        len(pairs) == len({track for track, _ in pairs}) == len({number for _, number in pairs}) > 3
    )
    assert (0, 0) in pairs


def test_flow_is_not_valid_where_a_box_vanishes(tmp_path):
    write_drive(tmp_path / "in", drop=((1, 1),))
    export("opensceneflow", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    log = read_log(tmp_path / "out" / "train" / "Street_1.h5")
    assert (DRIVE.scan(0).instances == 1).sum() > 3
    assert np.array_equal(log[FIRST]["flow_is_valid"], DRIVE.scan(0).instances != 1)
    assert log[TIMES[1]]["flow_is_valid"].all()


def test_nothing_is_known_of_scans_without_annotations_and_flow(tmp_path):
    write_drive(tmp_path / "in", leave_out=("flow",))
    (tmp_path / "in" / "Train/Street.1/cartesian/boxes/000001.bin").unlink()
    export("opensceneflow", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    log = read_log(tmp_path / "out" / "train" / "Street_1.h5")
    valid = [log[time]["flow_is_valid"] for time in TIMES[:3]]
    assert [bool(array.any()) for array in valid] == [False, False, True]


def test_without_labels_the_ground_is_found_and_what_does_not_exist_is_absent(tmp_path):
    write_drive(tmp_path / "in", leave_out=("labels", "instances", "seconds", "sensor"))
    result = export("opensceneflow", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    assert any(
        "has no labels: the ground is found by the shape of each scan" in note
        for note in result.notes
    )
    group = read_log(tmp_path / "out" / "train" / "Street_1.h5")[FIRST]
    assert not {"flow_category_indices", "flow_instance_id", "lidar_dt"} & set(group)
    assert not group["lidar_id"].any()
    road = np.array(KINDS)[DRIVE.scan(0).kinds] == "road"
    assert (group["ground_mask"] == road).mean() > 0.9
    assert np.abs(group["flow"] - true_flow(0)).max() < 1e-4  # points in a box move with it


def test_the_index_lists_all_logs_of_a_folder(tmp_path):
    write_drive(tmp_path / "in")
    write_drive(tmp_path / "in", path="Val/Other/cartesian")
    write_drive(tmp_path / "more", path="Train/Second/cartesian")
    export("opensceneflow", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    export("opensceneflow", tmp_path / "more", tmp_path / "out", run=Run(workers=1))
    index = read_index(tmp_path / "out" / "train" / "index_total.pkl")
    assert index == [[log, time] for log in ("Second", "Street_1") for time in TIMES]
    assert read_index(tmp_path / "out" / "val" / "index_total.pkl") == [
        ["Other", time] for time in TIMES
    ]
    flows = read_index(tmp_path / "out" / "train" / "index_flow.pkl")
    # the last scan has none
    assert flows == [[log, time] for log in ("Second", "Street_1") for time in TIMES[:3]]
    assert read_index(tmp_path / "out" / "train" / "index_eval.pkl") == [
        ["Second", FIRST],
        ["Street_1", FIRST],
    ]


def test_every_fifth_scan_with_flow_is_evaluated_where_points_are_near_and_not_on_the_ground(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(opensceneflow, "_EVALUATED", 2)
    monkeypatch.setattr(opensceneflow, "_EVALUATED_M", 15.0)
    write_drive(tmp_path / "in", drop=((1, 1),))
    export("opensceneflow", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    index = read_index(tmp_path / "out" / "train" / "index_eval.pkl")
    assert index == [["Street_1", TIMES[0]], ["Street_1", TIMES[2]]]
    total = read_index(tmp_path / "out" / "train" / "index_total.pkl")
    # the loader reads the next scan too
    assert all(entry in total and total.index(entry) < len(total) - 1 for entry in index)
    group = read_log(tmp_path / "out" / "train" / "Street_1.h5")[FIRST]
    near = (np.abs(group["lidar"][:, :2]) <= 15).all(axis=1)
    assert np.array_equal(group["eval_mask"], near & ~group["ground_mask"] & group["flow_is_valid"])
    assert 0 < group["eval_mask"].sum() < near.sum() < len(near)


def test_an_interrupted_export_gives_the_same_bytes(tmp_path):
    write_drive(tmp_path / "in")
    write_drive(tmp_path / "in", path="Train/Second/cartesian")
    for place in ("whole", "parts"):
        export("opensceneflow", tmp_path / "in", tmp_path / place, run=Run(workers=1))
    second = tmp_path / "parts" / "train" / "Second.h5"
    second.rename(second.with_name("Second.h5.part"))  # as a run leaves it that is killed
    result = export("opensceneflow", tmp_path / "in", tmp_path / "parts", run=Run(workers=1))
    assert (result.made, result.skipped) == (4, 4)
    assert files_and_bytes(tmp_path / "parts") == files_and_bytes(tmp_path / "whole")


def test_a_run_that_is_interrupted_leaves_no_file(tmp_path):
    write_drive(tmp_path / "in")

    def stop(done, total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(
            "opensceneflow", tmp_path / "in", tmp_path / "out", run=Run(workers=1, progress=stop)
        )
    assert not list((tmp_path / "out" / "train").iterdir())
    assert export("opensceneflow", tmp_path / "in", tmp_path / "out", run=Run(workers=1)).made == 4


@pytest.mark.slow
def test_workers_write_the_same_file(tmp_path):
    write_drive(tmp_path / "in")
    for place, workers in (("one", 1), ("two", 2)):
        export("opensceneflow", tmp_path / "in", tmp_path / place, run=Run(workers=workers))
    assert files_and_bytes(tmp_path / "one") == files_and_bytes(tmp_path / "two")


def test_a_frame_that_fails_is_made_again_with_the_others(tmp_path):
    write_drive(tmp_path / "in")
    labels = tmp_path / "in" / "Train/Street.1/cartesian/labels/000002.label"
    whole = labels.read_bytes()
    labels.write_bytes(whole[:8])
    result = export("opensceneflow", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    assert [failure.frame for failure in result.failures] == [2]
    assert "labels of frame 2: expected" in result.failures[0].message
    assert len(read_log(tmp_path / "out" / "train" / "Street_1.h5")) == 3
    labels.write_bytes(whole)
    result = export("opensceneflow", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    assert (result.made, result.skipped, result.failures) == (4, 0, ())
    assert len(read_log(tmp_path / "out" / "train" / "Street_1.h5")) == 4
    assert len(read_index(tmp_path / "out" / "train" / "index_total.pkl")) == 4


def test_what_cannot_be_exported_is_named_in_one_line(tmp_path):
    for field, message in (
        (layout.POSES, "expected poses.txt, found none"),
        ("points", "expected scans, found none"),
    ):
        write_drive(tmp_path / field, leave_out=(field,))
        with pytest.raises(MissingDataError, match=message):
            export("opensceneflow", tmp_path / field, tmp_path / "out", run=Run(workers=1))
    write_drive(tmp_path / "still", leave_out=("flow", "boxes"))
    with pytest.raises(
        MissingDataError, match="expected flow or boxes, for the motion of objects, found none"
    ):
        export("opensceneflow", tmp_path / "still", tmp_path / "out", run=Run(workers=1))
    write_drive(tmp_path / "in")
    folder = tmp_path / "in" / "Train/Street.1/cartesian"
    (folder / layout.TIMES).write_bytes(layout.encode_times(np.array([0.0, 0.1, 0.1, 0.3])))
    with pytest.raises(
        FormatError, match="times.txt: expected times that increase, found 0.1 s at frame 2"
    ):
        export("opensceneflow", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    (folder / layout.TIMES).write_bytes(layout.encode_times(DRIVE.times))
    table = {
        "name": "lab",
        "names": {"0": "free", "1": "road"},
        "colors": {"0": [0, 0, 0], "1": [1, 1, 1]},
    }
    (folder / layout.METADATA).write_bytes(to_json({"classes": table}))
    with pytest.raises(FormatError, match="expected classes with a map: carla, .*, found lab"):
        export("opensceneflow", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    assert not (tmp_path / "out").exists()


def test_a_file_that_is_no_log_is_named(tmp_path):
    write_drive(tmp_path / "in")
    (tmp_path / "out" / "train").mkdir(parents=True)
    (tmp_path / "out" / "train" / "Street_1.h5").write_bytes(b"something else")
    with pytest.raises(
        FormatError, match="Street_1.h5: expected an HDF5 file of scans.*`overwrite=True`"
    ):
        export("opensceneflow", tmp_path / "in", tmp_path / "out", run=Run(workers=1))
    assert (
        export(
            "opensceneflow", tmp_path / "in", tmp_path / "out", overwrite=True, run=Run(workers=1)
        ).made
        == 4
    )
