"""Classes of predictions: named, found, assumed or asked for; and what scores say about them."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from helpers import foreign_voxels as foreign
from helpers.errors import raises

from carlasc import ClassTable, GridSpec, Scoring, regrid, stats
from carlasc.core.tables import CARLA, REMAPS, SEMANTICKITTI19, SSCBENCH, SSCBENCH_TO_RAW
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.metrics import evaluate, scores
from carlasc.metrics.results import semantic_table
from carlasc.storage import FolderSink, layout

SIZE = (128, 128, 8)
PATHS = ("Test/Town10_Heavy/cartesian", "Test/Town10_Light/cartesian")
TO_11 = np.array([REMAPS["carlasc11"].mapping[i] for i in range(23)])


def write_sequence(root, path, labels, counts, *, grid="evaluation", spec=None, classes=None):
    """Write one frame of a grid in the layout."""
    writer = FolderSink(root).sequence(path)
    params = (spec or GridSpec.published()).to_params()
    params |= {"carlasc": {"classes": classes}} if classes else {}
    writer.write_document(layout.params_file(grid), json.dumps(params).encode())
    writer.write(f"{grid}/labels", 0, labels.astype(np.uint32))
    writer.write(f"{grid}/counts", 0, counts.astype(np.float32))


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """Truth of 23 classes, predictions of 11 classes, and the right IoU of each, in plain NumPy."""
    root, rng = tmp_path_factory.mktemp("town"), np.random.default_rng(0)
    predicted, both, either = {}, np.zeros(11), np.zeros(11)
    for path in PATHS:
        labels, counts = rng.integers(0, 23, SIZE), (rng.random(SIZE) < 0.8).astype(np.float32)
        write_sequence(root, path, labels, counts)
        true = TO_11[labels]
        pred = np.where(rng.random(SIZE) < 0.2, rng.integers(0, 11, SIZE), true)
        predicted[path] = pred
        for k in range(11):
            both[k] += ((pred == k) & (true == k) & (counts > 0)).sum()
            either[k] += (((pred == k) | (true == k)) & (counts > 0)).sum()
    return root, predicted, both / either


@pytest.mark.parametrize("dtype", ["<u4", "<u2"])
@pytest.mark.parametrize("beside", [True, False])
def test_predictions_without_params_are_found_and_read_as_the_eleven(town, tmp_path, dtype, beside):
    truth, predicted, iou = town
    source = truth if beside else tmp_path
    name = f"MotionSC_{dtype[1:]}"
    for path, labels in predicted.items():
        folder = source / path / name
        folder.mkdir(parents=True)
        labels.astype(dtype).tofile(folder / "000000.label")
    if not beside and dtype == "<u2":
        return  # two bytes per voxel are known beside the ground truth only
    result = evaluate(source, truth, grid=name, truth_grid="evaluation")
    assert result.miou == pytest.approx(iou.mean())
    assert [use.table for use in result.source_classes] == ["carlasc11"]


def test_predictions_with_copied_params_are_read_as_the_eleven_by_their_ids(town, tmp_path):
    truth, predicted, iou = town
    for path, labels in predicted.items():
        write_sequence(tmp_path, path, labels, np.ones(SIZE))
    result = evaluate(tmp_path, truth)
    assert result.class_iou["Road"] == pytest.approx(iou[6])
    assert [vars(use) for use in result.source_classes] == [{"table": "carlasc11", "found": "ids"}]
    assert result.to_dict()["truth_classes"] == [{"table": "carla", "found": "assumed"}]
    named = evaluate(tmp_path, truth, source_classes="carlasc11")
    assert (named.miou, named.source_classes[0].found) == (result.miou, "option")
    # the truth itself is not taken for eleven classes
    assert evaluate(truth, truth).source_classes[0].table == "carla"


SEVEN = {
    "name": "seven",
    "names": ["free", "built", "barrier", "other", "person", "flat", "green"],
    "map": "0->0 1,15->1 2,11,17->2 3,13,16,18..21->3 4,10->4 5,12,18->3 6..8,14,22->5 9->6",
}


def test_perfect_predictions_of_own_classes_are_noted_or_scored_by_their_file(town, tmp_path):
    truth, predicted, _ = town
    mapping = {}
    for part in SEVEN["map"].split():
        left, new = part.split("->")
        for ids in left.split(","):
            first, _, last = ids.partition("..")
            mapping |= dict.fromkeys(range(int(first), int(last or first) + 1), int(new))
    table = np.array([mapping[i] for i in range(23)])
    for path in predicted:
        labels = np.fromfile(truth / path / "evaluation/000000.label", "<u4")
        (tmp_path / path / "mine").mkdir(parents=True)
        table[labels].astype("<u4").tofile(tmp_path / path / "mine/000000.label")
    (tmp_path / "seven.json").write_text(json.dumps(SEVEN))
    (tmp_path / "seven.yaml").write_text(
        f"name: seven\nnames: [{', '.join(SEVEN['names'])}]\nmap: {SEVEN['map']}\n"
    )
    wrong = evaluate(tmp_path, truth, grid="mine", truth_grid="evaluation")
    assert wrong.miou < 0.5
    assert any("end at 6" in note and "source_classes" in note for note in wrong.notes)
    for file in ("seven.json", "seven.yaml"):
        right = evaluate(
            tmp_path, truth, grid="mine", truth_grid="evaluation", source_classes=tmp_path / file
        )
        assert (right.miou, right.classes.name, right.notes) == (1.0, "seven", ())
    assert stats(truth, remap=str(tmp_path / "seven.yaml")).remap.target.names[6] == "green"


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"map": {"1": 9}}, "map"),
        ({"map": "1=>2"}, "map"),
        ({"from": "no table"}, "seven.json"),
        ({"colors": {"0": [1, 2, 3]}}, "class table seven"),
    ],
)
def test_a_damaged_file_of_classes_is_named(town, tmp_path, change, where):
    (tmp_path / "seven.json").write_text(json.dumps(SEVEN | change))
    with raises(FormatError, where=where):
        evaluate(town[0], town[0], source_classes=tmp_path / "seven.json")
    with raises(ArgumentError, where="source_classes", expected="carlasc11", found="nothing"):
        evaluate(town[0], town[0], source_classes="nothing")


def write_kitti_pair(root, raw, learned, parent):
    voxels, predictions = root / "data" / parent / "voxels", root / "pred" / parent / "predictions"
    voxels.mkdir(parents=True), predictions.mkdir(parents=True)
    raw.astype("<u2").tofile(voxels / "000000.label")
    np.zeros(-(-raw.size // 8), np.uint8).tofile(voxels / "000000.invalid")
    learned.astype("<u2").tofile(predictions / "000000.label")


@pytest.mark.parametrize(
    ("parent", "table", "raws"),
    [
        (
            "sequences/08",
            SEMANTICKITTI19,
            [0, *(foreign.KITTI_RAW[name] for name in foreign.KITTI19)],
        ),
        ("data_2d_raw/2013_05_28_drive_0009_sync", SSCBENCH, [*SSCBENCH_TO_RAW.values()]),
    ],
)
def test_learning_ids_are_refused_with_the_option_that_reads_them(tmp_path, parent, table, raws):
    rng = np.random.default_rng(1)
    truth = rng.integers(0, len(raws), 16 * 16 * 8)
    predicted = np.where(rng.random(truth.shape) < 0.6, truth, rng.integers(0, len(raws)))
    write_kitti_pair(tmp_path, np.array(raws)[truth], predicted, parent)
    refused = evaluate(tmp_path / "pred", tmp_path / "data")
    assert (refused.frames, refused.to_dict()["miou"], refused.to_dict()["iou"]) == (0, None, None)
    option = re.search(r"`source_classes=(\S+)`", refused.failures[0][1])[1]
    assert option == table.name
    result = evaluate(tmp_path / "pred", tmp_path / "data", source_classes=option)
    ious = [
        ((predicted == i) & (truth == i)).sum() / ((predicted == i) | (truth == i)).sum()
        for i in range(1, len(raws))
    ]
    assert result.miou == pytest.approx(np.mean(ious), abs=1e-5)
    allowed = evaluate(tmp_path / "pred", tmp_path / "data", scoring=Scoring(allow_unknown=True))
    assert allowed.frames == 1 and any("are no class" in note for note in allowed.notes)
    unknown = allowed.to_dict()["unknown_ids"]["prediction"]
    assert sum(unknown.values()) == sum(int((predicted == int(i)).sum()) for i in unknown)


def write_ground(root, tag):
    """Write one scan and one grid of a flat ground with a stripe of a tag."""
    x, y = np.meshgrid(np.arange(-20, 20, 0.5), np.arange(-20, 20, 0.5))
    points = np.c_[x.ravel(), y.ravel(), np.full(x.size, -1.8), np.zeros(x.size)]
    labels, grid = np.where(np.abs(points[:, 1]) < 1, tag, 7), np.zeros(SIZE, np.uint32)
    grid[:, :, 0], grid[:, 62:66, 0] = 7, tag
    path = "Val/Town07_Light/cartesian"
    write_sequence(root, path, grid, np.ones(SIZE))
    writer = FolderSink(root).sequence(path)
    writer.write("points", 0, points.astype(np.float32))
    writer.write("labels", 0, labels.astype(np.uint32))
    writer.write_document(layout.POSES, layout.encode_poses(np.eye(4)[None]))
    return root / path, int((labels == tag).sum()), int((grid == tag).sum())


@pytest.mark.parametrize("tag", [23, 24, 28])
def test_tags_of_newer_versions_of_carla_are_refused_everywhere(tmp_path, tag):
    folder, points, voxels = write_ground(tmp_path, tag)
    counted = stats(tmp_path)
    messages = [message for _, message in counted.failures]
    assert counted.frames == 0 and f"{tag} ({points} times)" in messages[0]
    assert f"{tag} ({voxels} times)" in messages[1]
    allowed = stats(tmp_path, allow_unknown=True)
    assert allowed.failures == () and allowed.total.unlisted == {tag: points + voxels}
    with raises(FormatError, where="labels", expected="carla", found=str(tag)):
        regrid(folder, GridSpec.published().with_size((64, 64, 4)), name="g")
    (text,) = re.findall(r"write (\{.*\}) to carlasc\.json", messages[0])
    (folder / "carlasc.json").write_text(text)  # the proposal works as printed
    fixed = stats(tmp_path)
    assert fixed.failures == () and fixed.uses[0].found == "file"
    assert evaluate(tmp_path, tmp_path).miou_of_present == 1.0


def test_an_absent_class_is_said_beside_the_mean(tmp_path):
    labels = np.full(SIZE, 7)
    labels[:4], labels[4:8] = 1, 0
    write_sequence(tmp_path, PATHS[0], labels, np.ones(SIZE))
    zero = evaluate(tmp_path, tmp_path)
    assert zero.miou == pytest.approx(3 / 11)
    assert zero.miou_of_present == 1.0 and "Vehicles" in zero.absent_classes
    assert "count 0 in the mean" in zero.about_absent() and "100.00" in zero.about_absent()
    left_out = evaluate(tmp_path, tmp_path, convention="occ3d-lidar")
    assert left_out.miou == 1.0 and "left out of the mean" in left_out.about_absent()
    assert left_out.to_dict()["absent"] == "skip"
    own = evaluate(tmp_path, tmp_path, convention="own")
    assert own.miou == 1.0


def test_cartesian_and_cylindrical_frames_are_scored_apart(tmp_path):
    rng = np.random.default_rng(2)
    for coordinates in ("cartesian", "cylindrical"):
        spec = GridSpec.published(coordinates)
        labels = rng.integers(0, 23, spec.size)
        for side in ("truth", "pred"):
            wrong = side == "pred" and coordinates == "cylindrical"
            shown = np.where(rng.random(spec.size) < 0.5, 1, labels) if wrong else labels
            path = f"Test/Town10_Heavy/{coordinates}"
            write_sequence(tmp_path / side, path, shown, np.ones(spec.size), spec=spec)
    result = evaluate(tmp_path / "pred", tmp_path / "truth")
    assert (result.miou, result.frames, [*result.apart]) == (1.0, 1, ["cylindrical"])
    assert result.apart["cylindrical"].miou < 0.6
    assert result.to_dict()["apart"]["cylindrical"]["frames"] == 1


def test_tables_for_papers_have_the_same_figures(town, tmp_path):
    result = evaluate(town[0], town[0], name="A|B")
    markdown = semantic_table([result]).to_markdown().splitlines()
    assert markdown[2].startswith("| Network |") and markdown[4].startswith("| A\\|B | 100.00 |")
    (tmp_path / "a.json").write_text(json.dumps(result.to_dict()))
    table = scores([tmp_path / "a.json"])
    assert table.table().to_csv().splitlines()[1].startswith("A|B,100.00")


def test_only_named_sequences_are_scored_and_those_without_truth_are_listed(town, tmp_path):
    truth, predicted, _ = town
    for path in (*PATHS, "Test/Town99_Heavy/cartesian"):
        labels = predicted.get(path, np.zeros(SIZE))
        write_sequence(tmp_path, path, labels, np.ones(SIZE), classes="carlasc11")
    every = evaluate(tmp_path, truth)
    assert len(every.sequences) == 2
    assert any("1 of 3 predicted sequences have no ground truth" in note for note in every.notes)
    one = evaluate(tmp_path, truth, sequences=["Town10_Light"])
    assert [*one.sequences] == [PATHS[1]] and one.notes == ()
    with raises(MissingDataError, expected="sequences Town1"):
        evaluate(tmp_path, truth, sequences=["Town1"])


@pytest.mark.parametrize("form", ["challenge", pytest.param("flashocc", marks=pytest.mark.slow)])
def test_predictions_of_occ3d_are_scored_by_tokens_with_the_mask_of_cameras(form, tmp_path):
    truth = foreign.write_occ3d(tmp_path / "occ3d")
    pred = foreign.WRITERS[form](tmp_path / form, tokens=("aa0", "bb1", "zz9"))
    result = evaluate(pred, truth)
    assert result.convention.name == "occ3d-camera" and result.frames == 2
    assert any("without ground truth: zz9" in note for note in result.notes)
    true, ious = foreign.occ3d_labels(), []
    mask = np.load(truth / "gts/scene-0001/aa0/labels.npz")["mask_camera"] > 0
    guesses = [foreign.noisy(true, 17, seed) for seed in range(2)]
    for k in range(17):
        both = sum(((guess == k) & (true == k) & mask).sum() for guess in guesses)
        either = sum((((guess == k) | (true == k)) & mask).sum() for guess in guesses)
        ious += [both / either] if either else []
    assert result.miou == np.mean(ious)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["occ3d", "surroundocc", "occnet", "preprocessed"])
def test_rays_start_at_the_sensor_of_the_format(name, tmp_path):
    root = foreign.WRITERS[name](tmp_path / name)
    result = evaluate(root, root, scoring=Scoring(rays=True))
    if name == "preprocessed":  # the sensor is at the edge of the grid
        assert np.isnan(result.rays.rayiou) and "no ray was cast" in result.notes[0]
    else:
        assert result.rays.rayiou == 1.0


def test_a_table_given_as_an_object_is_taken(town):
    table = ClassTable("carla", CARLA.names, CARLA.colors)
    assert evaluate(town[0], town[0], source_classes=table).miou == 1.0


def test_the_table_of_any_labels_can_be_named_when_they_are_counted(tmp_path):
    write_ground(tmp_path, 24)
    counted = stats(tmp_path, source_classes="carla0.9.14")
    assert counted.failures == () and counted.uses[0].found == "option"
    assert counted.named(counted.total.points)["RoadLine"] > 0
    raws = np.array([*SSCBENCH_TO_RAW.values()])
    truth = np.random.default_rng(3).integers(0, len(raws), (256, 256, 32))
    write_kitti_pair(tmp_path / "k", raws[truth], truth, "data_2d_raw/a_sync")
    (message,) = [message for _, message in stats(tmp_path / "k/pred").failures]
    option = re.search(r"`source_classes=(\S+)`", message)[1]
    named = stats(tmp_path / "k/pred", source_classes=option)
    assert named.total.voxels[1] == (truth == 1).sum() and option == "sscbench"
