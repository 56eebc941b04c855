from __future__ import annotations

import json

import numpy as np
import pytest

from carlasc import GridSpec
from carlasc.core.tables import CARLASC11, REMAPS
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.metrics import ConfusionMatrix, distance_band, evaluate, geometric_table, semantic_table
from carlasc.storage import FolderSink, layout

SPEC = GridSpec("cartesian", (8, 8, 2), (-4.0, -4.0, -2.0), (4.0, 4.0, 1.0))
SHAPE = SPEC.size
SEQUENCES = ("Test/Town10_Heavy/cartesian", "Test/Town10_Light/cartesian")


def write_grids(root, labels, counts=None, grid="evaluation", spec=SPEC, classes=None):
    """Write {(sequence, frame): labels} as a data set of grids."""
    sink = FolderSink(root)
    for (path, frame), array in labels.items():
        writer = sink.sequence(path)
        params = spec.to_params() | ({"carlasc": {"classes": classes}} if classes else {})
        writer.write_document(layout.params_file(grid), json.dumps(params).encode())
        writer.write(f"{grid}/labels", frame, array.astype(np.uint32))
        if counts is not None:
            writer.write(f"{grid}/counts", frame, counts[path, frame].astype(np.float32))


@pytest.fixture
def world():
    """Truth in CARLA's ids, its counts, and predictions of the 11 classes: 2 sequences of 3 frames."""
    rng = np.random.default_rng(0)
    keys = [(path, frame) for path in SEQUENCES for frame in range(3)]
    truth = {key: rng.integers(0, 23, SHAPE) for key in keys}
    counts = {key: rng.integers(0, 3, SHAPE) for key in keys}
    pred = {
        key: np.where(rng.random(SHAPE) < 0.5, REMAPS["carlasc11"](truth[key]), rng.integers(0, 11, SHAPE))
        for key in keys
    }
    return truth, counts, pred


@pytest.fixture
def folders(tmp_path, world):
    truth, counts, pred = world
    write_grids(tmp_path / "truth", truth, counts)
    write_grids(tmp_path / "pred", pred, classes="carlasc11")
    return tmp_path / "pred", tmp_path / "truth"


def expected_matrix(world, keep=lambda key: True, mask=None):
    truth, counts, pred = world
    matrix = ConfusionMatrix(11)
    for key in truth:
        if keep(key):
            counted = counts[key] > 0 if mask is None else (counts[key] > 0) & mask
            matrix.update(pred[key], REMAPS["carlasc11"](truth[key]), counted)
    return matrix


def test_a_data_set_is_scored_as_the_sum_of_its_frames(folders, world):
    seen = []
    result = evaluate(*folders, progress=lambda done, total: seen.append((done, total)))
    assert result.matrix == expected_matrix(world)
    assert result.matrix.total < 6 * np.prod(SHAPE)
    assert set(result.sequences) == set(SEQUENCES)
    assert (result.frames, result.failures, result.classes) == (6, [], CARLASC11)
    assert seen == [(i, 6) for i in range(1, 7)]
    assert result.miou == pytest.approx(result.matrix.miou)
    assert result.miou_without_free == pytest.approx(result.matrix.mean_iou(with_free=False))


def test_frames_regions_and_masks_choose_what_counts(folders, world):
    result = evaluate(*folders, frames=(1, 2))
    assert result.matrix == expected_matrix(world, keep=lambda key: key[1] == 1)
    near = distance_band(SPEC, 0, 2)
    assert evaluate(*folders, region=lambda spec: distance_band(spec, 0, 2)).matrix == expected_matrix(world, mask=near)
    assert evaluate(*folders, mask="all").matrix.total == 6 * np.prod(SHAPE)


def test_predictions_beside_the_data_are_found_by_the_name_of_their_grid(folders, world):
    _, truth = folders
    write_grids(truth, world[2], grid="completion", classes="carlasc11")
    assert evaluate(truth, truth, grid="completion").matrix == expected_matrix(world)


def test_one_sequence_pairs_with_one_sequence_whatever_their_paths(folders, world):
    pred, truth = folders
    light = SEQUENCES[1]
    result = evaluate(pred / light, truth / light)
    assert result.matrix == expected_matrix(world, keep=lambda key: key[0] == light)


def test_plain_folders_of_label_files_are_scored(folders, world, tmp_path):
    heavy = SEQUENCES[0]
    plain = tmp_path / "plain"
    plain.mkdir()
    for frame in range(3):
        world[2][heavy, frame].astype(np.uint32).tofile(plain / f"{frame:06d}.label")
    result = evaluate(plain, folders[1] / heavy / "evaluation")
    assert result.matrix == expected_matrix(world, keep=lambda key: key[0] == heavy)


def test_semantickittis_own_files_are_scored_by_its_rule(tmp_path):
    rng = np.random.default_rng(1)
    size = 8 * 8 * 4
    truth = rng.choice([0, 1, 10, 40, 52, 252], size).astype(np.uint16)
    pred = rng.choice([0, 10, 40, 70], size).astype(np.uint16)
    invalid = rng.random(size) < 0.3
    (tmp_path / "voxels").mkdir()
    (tmp_path / "predictions").mkdir()
    truth.tofile(tmp_path / "voxels" / "000005.label")
    np.packbits(invalid).tofile(tmp_path / "voxels" / "000005.invalid")
    pred.tofile(tmp_path / "predictions" / "000005.label")
    result = evaluate(tmp_path / "predictions", tmp_path / "voxels", mask="semantickitti")

    counted = ~invalid & ~np.isin(truth, [1, 52])
    lookup = {0: 0, 10: 1, 252: 1, 40: 9, 70: 15, 1: 0, 52: 0}
    expected = ConfusionMatrix(20).update(
        np.array([lookup[v] for v in pred]), np.array([lookup[v] for v in truth]), counted
    )
    assert result.matrix == expected
    assert result.classes.name == "semantickitti19"
    assert result.miou_without_free == pytest.approx(expected.mean_iou(with_free=False))


def test_frames_that_cannot_be_scored_are_listed_and_the_others_done(folders, world):
    pred, truth = folders
    heavy = SEQUENCES[0]
    (pred / heavy / "evaluation" / "000001.label").unlink()
    (pred / heavy / "evaluation" / "000002.label").write_bytes(b"1234")
    bad = np.full(SHAPE, 11, np.uint32)
    bad.tofile(pred / SEQUENCES[1] / "evaluation" / "000000.label")
    result = evaluate(pred, truth)
    assert result.frames == 3
    messages = dict(result.failures)
    assert "prediction for frame 1" in messages[f"{heavy}:1"]
    assert "000002.label" in messages[f"{heavy}:2"]
    assert "class ids 0..10, found 11" in messages[f"{SEQUENCES[1]}:0"]
    keep = {(heavy, 0), (SEQUENCES[1], 1), (SEQUENCES[1], 2)}
    assert result.matrix == expected_matrix(world, keep=lambda key: key in keep)


def test_a_prediction_of_another_grid_is_refused(folders, world, tmp_path):
    other = GridSpec("cartesian", (4, 4, 2), SPEC.lower, SPEC.upper)
    write_grids(tmp_path / "other", {key: np.zeros(other.size) for key in world[0]}, spec=other)
    with pytest.raises(FormatError, match="expected the truth's grid cartesian 8 x 8 x 2"):
        evaluate(tmp_path / "other", folders[1])
    plain = tmp_path / "plain"
    plain.mkdir()
    np.zeros(other.size, np.uint32).tofile(plain / "000000.label")
    result = evaluate(plain, folders[1] / SEQUENCES[0], frames=(0, 1))
    assert "expected 128 labels" in result.failures[0][1]


def test_sides_that_cannot_be_compared_are_refused_in_one_line(folders, world, tmp_path):
    pred, truth = folders
    with pytest.raises(FormatError, match="expected classes of semantickitti"):
        evaluate(pred, truth, remap="semantickitti19")
    with pytest.raises(MissingDataError, match="expected ground truth for the sequence"):
        evaluate(pred, truth / "Test")
    with pytest.raises(MissingDataError, match="grid nothing"):
        evaluate(pred, truth, grid="nothing")
    with pytest.raises(MissingDataError, match="none in the range"):
        evaluate(pred, truth, frames=(7, 9))
    with pytest.raises(ArgumentError, match="mask: expected known, semantickitti or all, found 'some'"):
        evaluate(pred, truth, mask="some")
    with pytest.raises(ArgumentError, match="absent: expected zero or skip"):
        evaluate(pred, truth, absent="maybe")
    with pytest.raises(ArgumentError, match="frames: expected a range that holds a frame"):
        evaluate(pred, truth, frames=(2, 1))
    write_grids(tmp_path / "without_counts", world[0])
    assert "expected counts" in evaluate(pred, tmp_path / "without_counts").failures[0][1]


def test_absent_classes_count_zero_or_are_left_out(folders, world, tmp_path):
    only_road = {key: np.where(array == 7, 7, 0) for key, array in world[0].items()}
    write_grids(tmp_path / "road", only_road, world[1])
    zero = evaluate(tmp_path / "road", tmp_path / "road")
    skip = evaluate(tmp_path / "road", tmp_path / "road", absent="skip")
    assert zero.miou == pytest.approx(2 / 11)
    assert skip.miou == 1.0
    assert skip.miou_without_free == 1.0


def test_tables_hold_the_figures_in_percent(folders):
    result = evaluate(*folders, name="Net_1")
    semantic, geometric = semantic_table([result, result]), geometric_table([result])
    assert semantic.header == ("Network", *CARLASC11.names.values(), "mIoU", "mIoU w/o free", "Accuracy")
    assert len(semantic.rows) == 2
    assert semantic.rows[0][-1] == pytest.approx(100 * result.matrix.accuracy)
    found = result.matrix.completeness()
    assert geometric.rows[0] == pytest.approx(("Net_1", 100 * found.precision, 100 * found.recall, 100 * found.iou))
    assert (
        geometric.to_csv().splitlines()[1]
        == f"Net_1,{100 * found.precision:.2f},{100 * found.recall:.2f},{100 * found.iou:.2f}"
    )
    latex = geometric.to_latex()
    assert r"Net\_1 & " in latex
    assert latex.count(r"\\") == 2
    assert json.loads(json.dumps(result.to_dict()))["class_iou"].keys() == set(CARLASC11.names.values())
