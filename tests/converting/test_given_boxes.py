"""A table of boxes as an input of a conversion, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.converters import bags
from helpers.converters.scan_writers import write_poses, write_scan
from helpers.errors import raises
from helpers.scenes.passing_car import SPEED_M_S, scan, sensor_pose, write_sequence
from typer.testing import CliRunner

import carlasc
from carlasc import FromScans, LayoutOptions, Run
from carlasc.cli import app
from carlasc.converting import preview
from carlasc.core.boxes import mirror_boxes
from carlasc.core.geometry import invert, mirror_poses, transform_points
from carlasc.errors import ArgumentError, FormatError
from carlasc.motion import BoxTable, MotionOptions, PoseOptions
from carlasc.storage import FolderSource
from carlasc.testing import KINDS, SimulatedDrive
from carlasc.testing.drives import world_T_sensor

ONE, FRAMES = Run(workers=1), 10
BY_BOXES = FromScans(motion=MotionOptions("boxes"))


def sequence_in(folder):
    (sequence,) = FolderSource(folder).sequences().values()
    return sequence


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """The drive past a car as a folder of scans, and the table of its moving actor."""
    folder = tmp_path_factory.mktemp("drive")
    write_sequence(folder / "in", ("labels", "instances"), frames=FRAMES)
    observe, boxes = FromScans(motion=MotionOptions("instances")), folder / "boxes.csv"
    carlasc.label_motion(folder / "in", folder / "out", observe=observe, boxes_out=boxes, run=ONE)
    for frame in range(FRAMES):
        points = scan(frame, sensor_pose(frame), columns=250)[0] * [1, -1, 1]  # right-handed
        fields = dict(zip("xyz", points.T.astype(np.float32), strict=True))
        write_scan(folder / f"scans/{frame:02}.npy", fields)
    poses = mirror_poses(np.stack([sensor_pose(frame) for frame in range(FRAMES)]))
    seconds = 5e8 + np.arange(FRAMES) / 10  # the clock of a recording
    write_poses(folder / "poses.tum", poses, seconds, "tum")
    np.savetxt(folder / "times.txt", seconds, "%.17g")
    return folder


def given(drive, boxes):
    options = {"pose_file": str(drive / "poses.tum"), "time_file": str(drive / "times.txt")}
    return {"layout": LayoutOptions(boxes=boxes), "options": options}


def convert(drive, out, boxes, **how):
    how |= given(drive, boxes)
    return carlasc.convert("scans", drive / "scans", out, grids=None, run=ONE, **how)


def test_boxes_that_were_written_are_read_and_the_same_actors_are_found(drive, tmp_path):
    result = convert(drive, tmp_path / "out", drive / "boxes.csv")
    assert not result.failures and not any("boxes.csv" in note for note in result.notes)
    sequence, table = sequence_in(tmp_path / "out"), BoxTable.read(drive / "boxes.csv")
    assert sequence.metadata.extra["labels"] == "boxes"
    for frame in (2, 5, 8):
        points, _, moving = scan(frame, sensor_pose(frame), columns=250)
        boxes, labels = sequence.boxes(frame), sequence.read("labels", frame)
        assert boxes.tracks.tolist() == [9] and boxes.annotated.all()
        assert boxes.contains(points[moving], 0.1).mean() > 0.95
        assert np.allclose(boxes.sizes[0], table.values[frame, 3:6], atol=1e-4)
        vehicle = sequence.metadata.classes.id_of("vehicle")
        inside = sequence.read("instances", frame) == 9
        assert inside.sum() > 0.8 * moving.sum() and (labels[inside] == vehicle).all()
        flow = sequence.read("flow", frame)
        assert np.abs(flow[inside] - [SPEED_M_S, 0, 0]).max() < 1

    # from the boxes, `label` makes the table again, and `regrid` the body of the actor
    again = tmp_path / "again.json"
    carlasc.label_motion(
        tmp_path / "out", tmp_path / "moving", observe=BY_BOXES, boxes_out=again, run=ONE
    )
    found = BoxTable.read(again)
    assert found.numbers.tolist() == table.numbers.tolist() and found.classes == table.classes
    assert np.allclose(found.times, table.times)
    assert np.abs(found.values[:, :3] - table.values[:, :3]).max() < 0.15
    grids = {"out": tmp_path / "grids", "frames": "5:6", "boxes_out": tmp_path / "grids.json"}
    carlasc.regrid(tmp_path / "out", "coarse", observe=BY_BOXES, run=ONE, **grids)
    assert (tmp_path / "grids.json").read_bytes() == again.read_bytes()
    with raises(ArgumentError, where="boxes_out", expected="actors that move"):
        carlasc.regrid(
            tmp_path / "out", "coarse", observe=FromScans(dynamic="tube"), run=ONE, **grids
        )
    scores = carlasc.metrics.evaluate_boxes(drive / "boxes.csv", tmp_path / "out")
    assert {one.ap for one in scores.scores} == {1.0} and scores.left_out == 0


def test_the_command_takes_boxes_and_a_change_of_them_makes_frames_again(drive, tmp_path):
    table, boxes = BoxTable.read(drive / "boxes.csv"), tmp_path / "boxes.json"
    table.write(boxes)
    command = ["convert", "scans", str(drive / "scans"), str(tmp_path / "out"), "--grids", "none"]
    command += ["--pose-file", str(drive / "poses.tum"), "--time-file", str(drive / "times.txt")]
    command += ["--frames", "0:4", "--workers", "1", "--boxes", str(boxes)]
    assert CliRunner().invoke(app, command).exit_code == 0
    first = sequence_in(tmp_path / "out").boxes(3)
    wider = table.values + [*[0] * 4, 0.5, *[0] * 12]
    replace(table, values=wider).write(boxes)
    assert CliRunner().invoke(app, command).exit_code == 0
    assert sequence_in(tmp_path / "out").boxes(3).sizes[0, 1] == first.sizes[0, 1] + 0.5
    assert CliRunner().invoke(app, command[:-2]).exit_code == 0
    assert "boxes" not in sequence_in(tmp_path / "out").fields()


def test_boxes_at_no_scan_are_counted_and_named(drive, tmp_path):
    table = BoxTable.read(drive / "boxes.csv")
    times = table.times + np.where(np.arange(len(table.times)) == 3, 0.0501, 0.02)
    numbers = table.numbers - 9  # from 0, as KITTI counts
    replace(table, times=times, numbers=numbers).write(tmp_path / "boxes.csv")
    (note,) = [
        note
        for note in convert(drive, tmp_path / "out", tmp_path / "boxes.csv").notes
        if "boxes.csv" in note
    ]
    assert f"1 of {len(times)} boxes" in note and note.endswith("0 at 0.3501 s")
    sequence = sequence_in(tmp_path / "out")
    own = sequence.boxes(8)  # moved by its velocity to the time of the scan
    assert own.tracks.tolist() == [1] and not sequence.boxes(3).annotated.any()
    moved = transform_points(sequence.read_pose(8), own.centers[0])[0] - table.values[8, 0]
    assert moved == pytest.approx(-0.02 * table.values[8, 7], abs=1e-4)


def test_bad_boxes_are_refused_in_one_line_before_anything_is_written(drive, tmp_path):
    table = BoxTable.read(drive / "boxes.csv")
    lines = (drive / "boxes.csv").read_text().splitlines()
    size = lines[1].split(",")
    size[6] = "0.0"
    away = table.values + np.eye(17)[0] * 1000
    near, beside = table.values + np.eye(17)[2] * 5, table.values + np.eye(17)[1] * 100
    for name, content, found in (
        ("no time", "\n".join(line.partition(",")[2] for line in lines), "time absent"),
        ("size", "\n".join([lines[0], ",".join(size)]), "0.0"),
        ("twice", "\n".join([*lines, lines[4]]), "9.0"),
        ("class", "\n".join(lines).replace("Vehicle", "Spaceship"), "class 'Spaceship'"),
        ("late", replace(table, times=table.times + 60), "boxes at 60 to 60.9 s"),
        ("away", replace(table, values=away), "the nearest 98"),
        ("air", replace(table, values=near), "no point in"),
        ("beside", replace(table, values=beside), "no point in 5 of 5 boxes"),
    ):
        file = tmp_path / f"{name}.csv"
        if isinstance(content, str):
            file.write_text(content)
        else:
            content.write(file)
        with pytest.raises(FormatError) as error:
            convert(drive, tmp_path / "out", file)
        assert str(error.value).startswith(str(file)) and "\n" not in str(error.value)
        assert found in error.value.found, name
        assert not (tmp_path / "out").exists()
        if name in ("size", "away", "air"):  # the dry run says the same
            with pytest.raises(FormatError) as same:
                preview("scans", drive / "scans", **given(drive, file))
            assert str(same.value) == str(error.value)
    with raises(ArgumentError, where="boxes", found=str(tmp_path / "boxes.txt")):
        convert(drive, tmp_path / "out", tmp_path / "boxes.txt")
    with raises(ArgumentError, where="boxes", found="a list of clips"):
        carlasc.convert(
            "scans",
            drive,
            tmp_path / "out",
            layout=LayoutOptions(boxes=drive / "boxes.csv"),
            run=Run(sequences_from=tmp_path / "clips.txt"),
            grids=None,
        )


def test_boxes_of_other_times_are_refused_before_poses_are_estimated(drive, tmp_path, monkeypatch):
    def stop(*given, **how):
        raise AssertionError("poses are estimated")

    monkeypatch.setattr("carlasc.motion.odometry.follow_scans", stop)
    table, poses = BoxTable.read(drive / "boxes.csv"), PoseOptions("kiss-icp")
    replace(table, times=table.times + 60).write(tmp_path / "late.csv")
    with raises(FormatError, where="late.csv", expected="boxes at 0 to 0.9 s", found="60 to 60.9"):
        convert(drive, tmp_path / "out", tmp_path / "late.csv", poses=poses)
    with raises(FormatError, where="late.csv", found="60 to 60.9"):
        preview("scans", drive / "scans", poses=poses, **given(drive, tmp_path / "late.csv"))
    assert not (tmp_path / "out").exists()
    preview("scans", drive / "scans", poses=poses, **given(drive, drive / "boxes.csv"))
    with pytest.raises(AssertionError, match="poses are estimated"):
        convert(drive, tmp_path / "out", drive / "boxes.csv", poses=poses)


def test_a_dry_run_says_which_boxes_are_at_no_scan(drive, tmp_path):
    table = BoxTable.read(drive / "boxes.csv")
    times = table.times + np.where(np.arange(len(table.times)) == 3, 0.0501, 0.02)
    replace(table, times=times).write(tmp_path / "boxes.csv")
    command = ["convert", "scans", str(drive / "scans"), str(tmp_path / "out"), "--dry-run"]
    command += ["--pose-file", str(drive / "poses.tum"), "--time-file", str(drive / "times.txt")]
    done = CliRunner().invoke(app, [*command, "--boxes", str(tmp_path / "boxes.csv")])
    assert done.exit_code == 0 and "1 of 10 boxes of" in done.stdout
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.needs("rosbags")
def test_a_bag_gets_the_boxes_of_a_table(tmp_path):
    drive, store = SimulatedDrive(6, channels=12, columns=90), bags.Messages("mcap")
    bag = bags.write_bag(tmp_path, "mcap", bags.drive_messages(store, drive), store=store)
    rows, expected = [], []
    for frame, seconds in enumerate(drive.times.tolist()):
        sensor_T_vehicle = invert(world_T_sensor(drive, frame)) @ drive.world_T_vehicle(seconds)
        own = drive.boxes(frame, dict.fromkeys(KINDS, 10)).transform(sensor_T_vehicle)
        expected.append(own)
        first_T_sensor = invert(world_T_sensor(drive, 0)) @ world_T_sensor(drive, frame)
        first = own.transform(first_T_sensor)
        ahead = first.sensor_T_box[:, :2, 0]
        for row, track in enumerate(first.tracks.tolist()):
            heading = np.arctan2(ahead[row, 1], ahead[row, 0])
            values = [
                *first.centers[row],
                *first.sizes[row],
                heading,
                *[np.nan] * 3,
                1,
                *[np.nan] * 6,
            ]
            rows.append((seconds - drive.times[0], track, values))
    times, numbers, values = zip(*rows, strict=True)
    names = ("Vehicle",) * len(rows)
    BoxTable(np.array(times), np.array(numbers), names, np.array(values)).write(tmp_path / "b.csv")
    layout = LayoutOptions(boxes=tmp_path / "b.csv")
    carlasc.convert("bag", bag, tmp_path / "out", layout=layout, grids=None, run=ONE)
    for frame, own in enumerate(expected):
        found = sequence_in(tmp_path / "out").boxes(frame)
        assert set(found.tracks.tolist()) >= set(own.tracks.tolist())
        order = np.argsort(own.tracks)
        kept = found.select(np.isin(found.tracks, own.tracks))
        assert np.allclose(
            kept.select(np.argsort(kept.tracks)).centers,
            mirror_boxes(own).centers[order],
            atol=0.02,
        )
        assert kept.annotated.all()
