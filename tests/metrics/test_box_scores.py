"""Scores of boxes, by hand and by TrackEval."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.errors import raises
from typer.testing import CliRunner

from carlasc import Boxes
from carlasc.cli import app
from carlasc.core.boxes import mirror_boxes
from carlasc.core.geometry import invert, mirror_poses, rotation_z
from carlasc.errors import FormatError, MissingDataError
from carlasc.metrics import evaluate_boxes
from carlasc.motion import BoxTable
from carlasc.storage import FolderSink
from carlasc.storage.layout import Metadata

pytest.importorskip("scipy")

DATA = Path(__file__).parents[1] / "data"
SIZE = (4.0, 2.0, 1.5)
SPEED_M_S = 5.0


def sensor_pose(frame):
    """The sensor turns and drives."""
    pose = rotation_z(0.05 * frame)
    pose[:3, 3] = [0.4 * frame, 0.1 * frame, 0]
    return pose


def places(frame):
    """Middle of each true box by its number: 1 to 3 move along x, 4 stands."""
    ahead = SPEED_M_S * 0.1 * frame
    return {1: (10 + ahead, 3), 2: (10 + ahead, -3), 3: (20 + ahead, 3), 4: (15, 10)}


def write_drive(folder, boxes, poses, axes="right"):
    """Write a drive with a scan per pose, and the boxes, world, of the annotated frames."""
    writer = FolderSink(folder).sequence("Val/Street/cartesian")
    for frame, pose in enumerate(poses):
        writer.write("points", frame, np.zeros((3, 4), np.float32))
        if frame in boxes:
            own = boxes[frame].transform(invert(pose))
            writer.write("boxes", frame, (mirror_boxes(own) if axes == "left" else own).to_table())
    poses = mirror_poses(poses) if axes == "left" else poses
    lines = [" ".join(f"{value:.9g}" for value in pose[:3].ravel()) for pose in poses]
    writer.write_document("poses.txt", "\n".join(lines).encode())
    writer.write_document("carlasc.json", Metadata(axes=axes).to_json())
    return folder


def boxes_at(middles, size=SIZE):
    """Boxes along x at (x, y), by number."""
    world_T_box = np.tile(np.eye(4), (len(middles), 1, 1))
    world_T_box[:, :2, 3] = np.reshape(list(middles.values()), (-1, 2))
    numbers, labels = np.array(list(middles), np.uint32), np.full(len(middles), 10, np.uint32)
    return Boxes.from_poses(numbers, labels, world_T_box, np.tile(size, (len(middles), 1)))


@pytest.fixture(scope="module", params=["right", "left"])
def drive(tmp_path_factory, request):
    """Ten frames with four boxes each; the last frame is not annotated."""
    poses = np.stack([sensor_pose(frame) for frame in range(10)])
    boxes = {frame: boxes_at(places(frame)) for frame in range(9)}
    return write_drive(tmp_path_factory.mktemp("drive"), boxes, poses, request.param)


def table_of(rows):
    """(frame, number, x, y, heading, confidence) of each box."""
    values = [
        [x, y, 0, *SIZE, turn, SPEED_M_S, 0, 0, confidence, *[np.nan] * 6]
        for _, _, x, y, turn, confidence in rows
    ]
    return BoxTable(
        np.array([row[0] / 10 for row in rows]),
        np.array([row[1] for row in rows]),
        ("Car",) * len(rows),
        np.array(values),
    )


def perfect(numbers=(1, 2, 3, 4)):
    return [(f, n, *places(f)[n], 0.0, 0.9) for f in range(9) for n in numbers]


def by(result):
    return {(one.objects, one.iou): one for one in result.scores}


def test_true_boxes_have_full_scores_and_static_ones_are_apart(drive):
    scores = by(evaluate_boxes(table_of(perfect()), drive))
    for (objects, _), one in scores.items():
        assert one.boxes == (27 if objects == "moving" else 36)
        assert (one.ap, one.precision, one.recall, one.mota, one.switches) == (1, 1, 1, 1, 0)
        assert one.heading < 1e-6 and one.velocity < 0.05
    scores = by(evaluate_boxes(table_of(perfect((1, 2, 3))), drive))
    assert scores["moving", 0.5].mota == 1
    assert scores["all", 0.5].recall == pytest.approx(0.75)
    assert scores["all", 0.5].ap == pytest.approx(0.75)


def test_scores_by_hand(drive):
    """Box 1 lies 1 m too far ahead: 3 of 4 m are shared, IoU 3 / 5. Box 2 is turned by 10 degrees.
    A sure false box in each frame; another number from frame 4 on.
    """
    rows = []
    for f in range(9):
        here = places(f)
        rows.append((f, 1, here[1][0] + 1, here[1][1], 0.0, 0.9))
        rows.append((f, 2 if f < 4 else 22, *here[2], math.radians(10), 0.8))
        rows.append((f, 5, -50, 0, 0.0, 0.95))
    scores = by(evaluate_boxes(table_of(rows), drive))
    half, most = scores["moving", 0.5], scores["moving", 0.7]
    assert half.recall == pytest.approx(18 / 27) and half.precision == pytest.approx(18 / 27)
    assert half.switches == 1
    assert half.mota == pytest.approx((18 - 9 - 1) / 27)
    assert half.heading == pytest.approx(5, abs=5.01)
    # 9 false ones come first: precision 9 / 18 at recall 9 / 27, 18 / 27 at recall 18 / 27
    assert half.ap == pytest.approx(26 / 40 * 18 / 27)
    assert most.recall == pytest.approx(9 / 27)
    assert most.heading == pytest.approx(10) and most.mota == pytest.approx((9 - 18 - 1) / 27)


def test_tracking_scores_are_those_of_trackeval(tmp_path):
    """TrackEval 1.3.0, `CLEAR`, of the same boxes: missed, false, swapped and renumbered ones."""
    given = json.loads((DATA / "box_tracks.json").read_text())
    truth = {}
    for frame, number, x, y in given["truth"]:
        truth.setdefault(frame, {})[number] = (x, y)
    boxes = {frame: boxes_at(middles) for frame, middles in truth.items()}
    write_drive(tmp_path, boxes, np.tile(np.eye(4), (30, 1, 1)))
    rows = [(frame, number, x, y, 0.0, sure) for frame, number, x, y, sure in given["found"]]
    scores = by(evaluate_boxes(table_of(rows), tmp_path))
    for threshold, expected in given["trackeval"].items():
        one = scores["all", float(threshold)]
        found = {name: getattr(one, name) for name in expected}
        assert found == pytest.approx(expected, abs=1e-12)


def test_what_is_out_of_the_region_does_not_count(drive):
    rows = [*perfect((1, 2, 3, 4)), *((f, 9, -30, 0, 0.0, 0.5) for f in range(9))]
    assert by(evaluate_boxes(table_of(rows), drive))["moving", 0.5].precision < 1
    ahead = by(evaluate_boxes(table_of(rows), drive, fov_rad=math.pi))["moving", 0.5]
    assert ahead.precision == ahead.recall == 1
    near = by(evaluate_boxes(table_of(rows), drive, far_m=15))["all", 0.5]
    assert near.precision == 1 and 9 < near.boxes < 36


def test_boxes_of_another_sequence_are_refused(drive, tmp_path):
    table, file = table_of(perfect()), tmp_path / "a.csv"
    replace(table, times=table.times + 100).write(file)
    with raises(FormatError, where="a.csv", expected="0 to 0.8 s", found="100 to 100.8 s"):
        evaluate_boxes(file, drive)
    replace(table, values=table.values + 9e3).write(file)
    with raises(FormatError, where="a.csv", expected="within 500 m", found="nearest"):
        evaluate_boxes(file, drive)
    writer = FolderSink(tmp_path / "none").sequence("Val/A/cartesian")
    writer.write("points", 0, np.zeros((3, 4), np.float32))
    with raises(MissingDataError, expected="boxes"):
        evaluate_boxes(table, tmp_path / "none")


def test_the_command_prints_what_the_function_returns(drive, tmp_path):
    rows = [*perfect((1, 2)), (9, 1, 14.5, 3, 0.0, 0.9)]  # the last frame was not annotated
    table_of(rows).write(tmp_path / "a.json")
    typed = ["evaluate", "--boxes", str(tmp_path / "a.json"), str(drive)]
    made = CliRunner().invoke(app, [*typed, "--json"])
    assert made.exit_code == 0, made.output
    printed, result = json.loads(made.stdout), evaluate_boxes(tmp_path / "a.json", drive)
    assert printed["frames"] == 9 and printed["left_out"] == 1
    assert [one["mota"] for one in printed["scores"]] == [one.mota for one in result.scores]
    made = CliRunner().invoke(app, [*typed, "--csv"])
    assert made.stdout.startswith("Objects,IoU,Boxes,AP,") and "moving,0.50,27," in made.stdout
    for option in ("--rays", "--all-conventions"):
        assert CliRunner().invoke(app, [*typed, option]).exit_code == 2


def test_frames_without_boxes_and_one_annotated_frame(tmp_path):
    poses = np.tile(np.eye(4), (3, 1, 1))
    write_drive(tmp_path / "empty", {0: boxes_at({}), 2: boxes_at({})}, poses)
    scores = by(evaluate_boxes(table_of([(0, 1, 5, 0, 0.0, 1)]), tmp_path / "empty"))
    assert scores["all", 0.5].precision == 0 and math.isnan(scores["all", 0.5].mota)
    write_drive(tmp_path / "one", {1: boxes_at({1: (5, 0)})}, poses)
    scores = by(evaluate_boxes(table_of([(1, 1, 5, 0, 0.0, 1)]), tmp_path / "one"))
    assert scores["all", 0.5].mota == 1 and scores["moving", 0.5].boxes == 0
    (tmp_path / "one/Val/Street/cartesian/poses.txt").unlink()
    with raises(MissingDataError, where="poses.txt"):
        evaluate_boxes(table_of([(1, 1, 5, 0, 0.0, 1)]), tmp_path / "one")
