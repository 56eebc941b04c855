"""What moves, written back to the points of the scans."""

import json
import tarfile
from pathlib import Path

import numpy as np
import pytest
from helpers.errors import raises
from helpers.scenes.passing_car import SPEED_M_S, scan, sensor_pose, street, write_sequence
from typer.testing import CliRunner

import carlasc
from carlasc import Boxes, FromScans, Run
from carlasc.cli import app
from carlasc.core.geometry import invert, transform_points, translation
from carlasc.errors import ArgumentError, ConflictError
from carlasc.motion import BoxTable, MotionOptions
from carlasc.storage import FolderSink, FolderSource
from carlasc.storage.files import to_json

ONE = Run(workers=1)
REAL = Path(__file__).parents[3] / "shared/real"


def the_sequence(folder):
    (sequence,) = FolderSource(folder).sequences().values()
    return sequence


def check_car(sequence, frames, number, tolerance):
    """Check that the points of the passing car, and no others, move and have a number."""
    counts = np.zeros(3, int)
    for frame in frames:
        _, _, moving = scan(frame, sensor_pose(frame))
        flow, instances = sequence.read("flow", frame), sequence.read("instances", frame)
        fast = np.linalg.norm(flow, axis=1) > 0.5
        assert (
            set(np.unique(instances[fast]).tolist()) <= {number}
            and fast.sum() == (instances == number).sum()
        )
        assert np.abs(flow[fast] - [SPEED_M_S, 0, 0]).max(initial=0) < tolerance
        counts += ((fast & moving).sum(), moving.sum(), fast.sum())
    assert counts[0] > 0.97 * counts[1] and counts[0] > 0.97 * counts[2]


@pytest.fixture(scope="module")
def numbered(tmp_path_factory):
    """A drive with numbers of actors, and what `label_motion` makes of it."""
    folder = tmp_path_factory.mktemp("drive")
    write_sequence(folder / "in", ("labels", "instances"), frames=16)
    observe = FromScans(motion=MotionOptions("instances"))
    out, boxes = folder / "out", folder / "boxes.json"
    return folder, carlasc.label_motion(
        folder / "in", out, observe=observe, boxes_out=boxes, run=ONE
    )


def test_points_get_numbers_and_velocities_and_what_stands_keeps_its_number(numbered):
    folder, result = numbered
    sequence, before = the_sequence(folder / "out"), the_sequence(folder / "in")
    check_car(sequence, range(2, 16, 4), 9, 1.0)
    for frame in (0, 8):
        kept = before.read("instances", frame) == 4
        assert kept.any() and (sequence.read("instances", frame)[kept] == 4).all()
        assert sequence.read("points", frame).tobytes() == before.read("points", frame).tobytes()
    assert sequence.metadata.extra["motion"] == "found by carlasc from instances"
    assert result.actors == 1 and result.linked == 32 and result.files == 32


def test_the_boxes_of_actors_are_a_table(numbered):
    folder, _ = numbered
    table = BoxTable.read(folder / "boxes.json")
    assert set(table.numbers.tolist()) == {9} and set(table.classes) == {"Vehicle"}
    assert np.allclose(table.times, np.arange(16) / 10)
    for row in (2, 8, 14):
        points, _, moving = scan(row, sensor_pose(row))
        first_T_sensor = invert(sensor_pose(0)) @ sensor_pose(row)
        world = transform_points(first_T_sensor, points[moving])
        world[:, 1] *= -1 if the_sequence(folder / "in").metadata.axes == "left" else 1
        half = table.values[row, 3:6] / 2 + 0.1
        assert (np.abs(world - table.values[row, :3]) < half).all(axis=1).mean() > 0.95
        assert abs(table.values[row, 6]) < 0.1
        assert np.abs(table.values[row, 7:10] - [SPEED_M_S, 0, 0]).max() < 1


def test_a_table_of_boxes_is_of_one_sequence_and_has_a_known_ending(tmp_path, numbered):
    folder, _ = numbered
    with raises(ArgumentError, where="boxes_out", found=str(tmp_path / "a.txt")):
        carlasc.label_motion(folder / "in", tmp_path / "out", boxes_out=tmp_path / "a.txt", run=ONE)
    for name in "ab":
        write_sequence(tmp_path / "two" / name, ("labels",), frames=1)
    with raises(ArgumentError, where="boxes_out", found=r"2 \(a/Val"):
        carlasc.label_motion(
            tmp_path / "two", tmp_path / "out", boxes_out=tmp_path / "a.csv", run=ONE
        )
    assert not (tmp_path / "out").exists()


def test_the_exporter_of_kitti_makes_the_classes_that_move_of_it(numbered):
    folder, _ = numbered
    carlasc.export("kitti", folder / "out", folder / "kitti", options={"labels": "moving"}, run=ONE)
    _, _, moving = scan(8, sensor_pose(8))
    (file,) = (folder / "kitti").rglob("labels/000008.label")
    labels = np.fromfile(file, "<u4")
    assert ((labels & 0xFFFF) == 251).sum() == pytest.approx(moving.sum(), rel=0.03)
    assert set(np.unique(labels >> 16).tolist()) == {0, 4, 9}


def test_classes_of_what_moves_are_used_where_the_table_has_them_and_reach_the_files_of_kitti(
    numbered, tmp_path
):
    """SemanticKITTI's: the passing car becomes 252, the parked one stays 10; the number that it
    gets is nobody else's in a file either.
    """
    folder, result = numbered
    assert any("the classes carla do not separate moving" in note for note in result.notes)
    given = the_sequence(folder / "in")
    writer = FolderSink(tmp_path / "in").sequence("Val/Street/cartesian")
    writer.write_document("carlasc.json", to_json({"classes": "semantickitti", "axes": "right"}))
    for name in ("poses.txt", "times.txt"):
        writer.write_document(name, given.read_document(name))
    for frame in range(8):
        labels, instances = given.read("labels", frame), given.read("instances", frame)
        writer.write("points", frame, given.read("points", frame))
        writer.write(
            "labels", frame, np.select([labels == 10, labels == 7], [10, 40], 50).astype(np.uint32)
        )
        writer.write(
            "instances",
            frame,
            np.where(instances == 4, 10 << 16 | 4, 0).astype(np.uint32) * (frame < 4),
        )
        here = street(frame)  # from the fourth scan on, the parked car has a box only
        pose = invert(sensor_pose(frame)) @ translation((here.lower[-2] + here.upper[-2]) / 2)
        size, track = (here.upper - here.lower)[-2:-1] + 0.1, np.array([10 << 16 | 4], np.uint32)
        writer.write(
            "boxes", frame, Boxes.from_poses(track, np.array([10]), pose[None], size).to_table()
        )
        _, _, moving = scan(frame, sensor_pose(frame))
        writer.write(
            "flow", frame, (moving[:, None] * np.array([SPEED_M_S, 0, 0])).astype(np.float32)
        )
    observe = FromScans(motion=MotionOptions("flow"))
    result = carlasc.label_motion(tmp_path / "in", tmp_path / "out", observe=observe, run=ONE)
    assert result.actors == 1 and not any("do not tell" in note for note in result.notes)
    carlasc.export("kitti", tmp_path / "out", tmp_path / "kitti", run=ONE)
    (file,) = (tmp_path / "kitti").rglob("labels/000004.label")
    both, (_, _, moving) = np.fromfile(file, "<u4"), scan(4, sensor_pose(4))
    labels, numbers = both & 0xFFFF, both >> 16
    assert (labels == 252).sum() == pytest.approx(moving.sum(), rel=0.03) and (
        labels[~moving] != 252
    ).mean() > 0.999
    assert np.unique(numbers[labels == 252]).tolist() == [5]
    parked = labels == 10
    # by its box
    assert (numbers[parked] == 4).mean() > 0.97 and not numbers[~parked & (labels != 252)].any()


def test_what_exists_is_replaced_only_if_this_made_it(numbered, tmp_path):
    folder, _ = numbered
    with pytest.raises(ConflictError) as error:
        carlasc.label_motion(folder / "in", folder / "out", run=ONE)
    assert error.value.expected == "a new path"
    with pytest.raises(ConflictError) as error:
        carlasc.label_motion(folder / "out", folder / "in", overwrite=True, run=ONE)
    assert error.value.expected == "a data set with motion found by carlasc to overwrite"


@pytest.mark.parametrize(
    "options", [{"dynamic": "drop"}, {"motion": MotionOptions("none")}], ids=["drop", "none"]
)
def test_something_must_show_what_moves(numbered, options):
    folder, _ = numbered
    with pytest.raises(ArgumentError) as error:
        carlasc.label_motion(folder / "in", folder / "other", observe=FromScans(**options))
    assert error.value.where == "observe"
    assert not (folder / "other").exists()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["--from", "motion", "--logits"], "no --logits with --from motion"),
        (["--from", "motion", "--classes", "carla"], "no --classes with --from motion"),
        (["--from", "predictions", "--motion", "flow"], "--motion: expected --from motion"),
        (["--from", "motion", "--motion", "flow"], "expected flow in the sequence"),
    ],
)
def test_the_command_says_what_does_not_fit(numbered, given, message):
    folder, _ = numbered
    result = CliRunner().invoke(
        app, ["label", str(folder / "in"), "-o", str(folder / "other"), *given]
    )
    assert result.exit_code in (1, 2) and message in " ".join(result.output.split())
    assert not (folder / "other").exists()


@pytest.mark.slow
def test_the_command_finds_what_moves_from_points_alone(tmp_path):
    write_sequence(tmp_path / "in", ())
    given = [
        "label",
        str(tmp_path / "in"),
        "-o",
        str(tmp_path / "out"),
        "--from",
        "motion",
        "--workers",
        "2",
        "--json",
    ]
    result = CliRunner().invoke(app, given)
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["actors"] == 1
    check_car(the_sequence(tmp_path / "out"), range(4, 37, 8), 1, 1.0)


@pytest.mark.slow
def test_a_real_drive_without_labels(tmp_path):
    """KITTI tracking 0000: a van ahead and a cyclist beside move, a parked van does not, and each
    has one number.
    """
    archive = REAL / "kitti_tracking_0000.tar.xz"
    if not archive.exists():
        pytest.skip("the archive of the real drive is absent")
    pytest.importorskip("kiss_icp")
    with tarfile.open(archive) as file:
        file.extractall(tmp_path / "raw", filter="data")
    (training,) = (tmp_path / "raw").rglob("training")
    carlasc.convert("kitti-tracking", training.parent, tmp_path / "boxes", grids=None, run=ONE)
    boxed = the_sequence(tmp_path / "boxes")
    bare = tmp_path / "bare/cartesian"
    bare.mkdir(parents=True)
    for name in ("velodyne", "poses.txt", "times.txt", "carlasc.json"):
        (Path(boxed.location) / name).rename(bare / name)
    carlasc.label_motion(tmp_path / "bare", tmp_path / "out", run=ONE)
    found = the_sequence(tmp_path / "out")
    moving, all_points, numbers = (
        dict.fromkeys((1, 2, 4), 0),
        dict.fromkeys((1, 2, 4), 0),
        {1: [], 2: []},
    )
    for frame in boxed.frames("boxes").tolist():
        boxes, points = boxed.boxes(frame), found.read("points", frame)[:, :3]
        fast = np.linalg.norm(found.read("flow", frame), axis=1) > 0.5
        for row, track in enumerate(boxes.tracks.tolist()):
            local, half = (
                transform_points(invert(boxes.sensor_T_box[row]), points),
                boxes.sizes[row] / 2,
            )
            own = (np.abs(local) < half).all(axis=1) & (local[:, 2] > 0.3 - half[2])
            moving[track] += int((own & fast).sum())
            all_points[track] += int(own.sum())
            if track in numbers and (own & fast).any():
                numbers[track].append(
                    int(np.bincount(found.read("instances", frame)[own & fast]).argmax())
                )
    assert moving[1] > 0.95 * all_points[1] and moving[2] > 0.95 * all_points[2]
    assert moving[4] == 0 and all_points[4] > 10_000
    assert len(set(numbers[1])) == len(set(numbers[2])) == 1
