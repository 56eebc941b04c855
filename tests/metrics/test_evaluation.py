from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from helpers.errors import raises

from carlasc import ClassTable, GridSpec, Run
from carlasc.core.tables import CARLASC11, REMAPS
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.metrics import (
    CONVENTIONS,
    ConfusionMatrix,
    Evaluation,
    Scoring,
    distance_band,
    evaluate,
    evaluate_by_all_conventions,
    geometric_table,
    own_convention,
    semantic_table,
)
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
        key: np.where(
            rng.random(SHAPE) < 0.5, REMAPS["carlasc11"](truth[key]), rng.integers(0, 11, SHAPE)
        )
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
    result = evaluate(*folders, run=Run(1, progress=lambda done, total: seen.append((done, total))))
    assert result.matrix == expected_matrix(world)
    assert result.matrix.total < 6 * np.prod(SHAPE)
    assert set(result.sequences) == set(SEQUENCES)
    assert (result.frames, result.failures, result.classes) == (6, [], CARLASC11)
    assert seen == [(i, 6) for i in range(1, 7)]
    assert result.miou == pytest.approx(result.matrix.miou)
    assert result.miou_without_free == pytest.approx(result.matrix.mean_iou(with_free=False))
    assert [(f.sequence, f.frame) for f in result.frame_scores] == [
        (p, str(i)) for p in SEQUENCES for i in range(3)
    ]
    assert len(result.to_csv().splitlines()) == 7


def test_frames_regions_and_masks_choose_what_counts(folders, world):
    result = evaluate(*folders, frames=(1, 2))
    assert result.matrix == expected_matrix(world, keep=lambda key: key[1] == 1)
    near = distance_band(SPEC, 0, 2)
    assert evaluate(
        *folders, scoring=Scoring(region=lambda spec: distance_band(spec, 0, 2))
    ).matrix == expected_matrix(world, mask=near)
    assert evaluate(*folders, scoring=Scoring(voxels="all")).matrix.total == 6 * np.prod(SHAPE)


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
    result = evaluate(tmp_path / "predictions", tmp_path / "voxels", convention="semantickitti")

    counted = ~invalid & ~np.isin(truth, [1, 52])
    lookup = {0: 0, 10: 1, 252: 1, 40: 9, 70: 15, 1: 0, 52: 0}
    expected = ConfusionMatrix(20).update(
        np.array([lookup[v] for v in pred]), np.array([lookup[v] for v in truth]), counted
    )
    assert result.matrix == expected
    assert result.classes.name == "semantickitti19"
    assert result.miou == pytest.approx(expected.mean_iou(with_free=False))


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
    assert "class ids of carlasc11, found 11 (128 times)" in messages[f"{SEQUENCES[1]}:0"]
    keep = {(heavy, 0), (SEQUENCES[1], 1), (SEQUENCES[1], 2)}
    assert result.matrix == expected_matrix(world, keep=lambda key: key in keep)


def test_a_prediction_of_another_grid_is_refused(folders, world, tmp_path):
    other = GridSpec("cartesian", (4, 4, 2), SPEC.lower, SPEC.upper)
    write_grids(tmp_path / "other", {key: np.zeros(other.size) for key in world[0]}, spec=other)
    with pytest.raises(
        FormatError, match="expected the geometry of the ground truth, cartesian 8 x 8 x 2"
    ):
        evaluate(tmp_path / "other", folders[1])
    plain = tmp_path / "plain"
    plain.mkdir()
    np.zeros(other.size, np.uint32).tofile(plain / "000000.label")
    result = evaluate(plain, folders[1] / SEQUENCES[0], frames=(0, 1))
    assert "expected 128 labels" in result.failures[0][1]


def test_sides_that_cannot_be_compared_are_refused_in_one_line(folders, world, tmp_path):
    pred, truth = folders
    with pytest.raises(ArgumentError, match="convention: expected one of carlasc, semantickitti"):
        evaluate(pred, truth, convention="nuscenes")
    shutil.copytree(truth / "Test" / "Town10_Heavy", tmp_path / "renamed" / "Test" / "Town99_Heavy")
    shutil.copytree(truth / "Test" / "Town10_Light", tmp_path / "renamed" / "Test" / "Town98_Light")
    found = "found Test/Town98_Light/cartesian, Test/Town99_Heavy/cartesian: sequences are matched by path or by name"
    with pytest.raises(
        MissingDataError, match=f"expected ground truth for the sequence '{SEQUENCES[0]}', {found}"
    ):
        evaluate(pred, tmp_path / "renamed")
    with pytest.raises(MissingDataError, match="grid nothing"):
        evaluate(pred, truth, grid="nothing")
    with pytest.raises(MissingDataError, match="none in the range"):
        evaluate(pred, truth, frames=(7, 9))
    with raises(ArgumentError, where="voxels", expected="known, all", found="some"):
        evaluate(pred, truth, scoring=Scoring(voxels="some"))
    with pytest.raises(ArgumentError, match="frames: expected a range that holds a frame"):
        evaluate(pred, truth, frames=(2, 1))
    write_grids(tmp_path / "without_counts", world[0])
    assert "expected counts" in evaluate(pred, tmp_path / "without_counts").failures[0][1]


def test_sides_from_different_levels_are_matched_by_the_names_of_their_sequences(folders):
    pred, truth = folders
    assert evaluate(pred, truth / "Test").matrix == evaluate(pred, truth).matrix


def test_the_datas_own_classes_can_be_scored_as_they_are(folders, world):
    result = evaluate(folders[1], folders[1], convention="own")
    assert (result.classes.name, result.convention.name) == ("carla", "own")
    assert result.miou == 1.0


def test_every_convention_scores_the_same_frames_or_says_why_not(folders, world):
    found = evaluate_by_all_conventions(*folders)
    assert list(found) == list(CONVENTIONS)
    impossible = found.pop("occ3d-camera")
    assert "which voxels a camera observed" in str(impossible)
    known = sum(int((counts > 0).sum()) for counts in world[1].values())
    whole = ("openoccupancy", "surroundocc", "occnet")  # have no mask of known voxels
    for name, result in found.items():
        assert result.frames == 6, name
        alone = evaluate(*folders, convention=name)
        assert alone.matrix == result.matrix
        assert result.matrix.total <= (6 * np.prod(SHAPE) if name in whole else known)
    assert len({round(r.miou, 6) for r in found.values() if not np.isnan(r.miou)}) > 3


def test_voxels_that_no_camera_sees_do_not_count_for_cameras(folders):
    truth = folders[1]
    rng, seen = np.random.default_rng(0), 0
    for path in sorted(truth.rglob("*/evaluation/*.label")):
        bits = rng.integers(0, 3, SHAPE).astype(np.uint8)
        path.with_suffix(".seen").write_bytes(bits.tobytes())
        counts = np.fromfile(path.with_suffix(".bin"), np.float32)
        seen += int(((counts > 0) & (bits.reshape(-1) > 0)).sum())
    by_camera = evaluate(folders[0], truth, convention="occ3d-camera")
    by_lidar = evaluate(folders[0], truth, convention="occ3d-lidar")
    assert 0 < by_camera.matrix.total <= seen
    assert by_camera.matrix.total < 0.8 * by_lidar.matrix.total
    parts = evaluate(
        folders[0], truth, convention="occ3d-lidar", scoring=Scoring(by=["seen"])
    ).breakdown
    assert (
        parts["seen"] == by_camera.matrix and parts["seen"] + parts["not seen"] == by_lidar.matrix
    )
    with pytest.raises(MissingDataError, match="cameras and the field `seen`"):
        evaluate(folders[0], folders[0], convention="own", scoring=Scoring(by=["seen"]))


def test_a_sequence_without_prediction_is_named_in_a_note(folders):
    assert evaluate(*folders).notes == ()
    write_grids(
        folders[1],
        {("Test/Town10_New/cartesian", 0): np.zeros(SHAPE)},
        {("Test/Town10_New/cartesian", 0): np.ones(SHAPE)},
    )
    result = evaluate(*folders)
    assert set(result.sequences) == set(SEQUENCES)
    assert result.notes == (
        "1 of 3 sequences of the ground truth have no prediction and were not scored: "
        "Test/Town10_New/cartesian",
    )


def test_five_sequences_have_an_interval_and_can_be_compared(tmp_path, world):
    rng = np.random.default_rng(3)
    paths = [f"Test/Town{n}/cartesian" for n in range(6)]
    truth = {(path, 0): rng.integers(0, 11, SHAPE) for path in paths}
    for name, share in (("good", 0.8), ("bad", 0.5)):
        labels = {
            k: np.where(rng.random(SHAPE) < share, t, rng.integers(0, 11, SHAPE))
            for k, t in truth.items()
        }
        write_grids(tmp_path / name, labels, classes="carlasc11")
    write_grids(tmp_path / "truth", truth, {k: np.ones(SHAPE) for k in truth}, classes="carlasc11")
    good, bad = (evaluate(tmp_path / name, tmp_path / "truth") for name in ("good", "bad"))
    interval = good.interval()
    assert interval.low < good.miou < interval.high
    comparison = good.compare(bad)
    assert comparison.p_value < 0.05 and comparison.difference.low > 0
    assert (
        evaluate(tmp_path / "good", tmp_path / "truth", frames=(0, 1)).to_dict()["miou_interval"]
        is not None
    )
    with pytest.raises(ArgumentError, match="other: expected scores by carlasc, found sscbench"):
        good.compare(evaluate(tmp_path / "bad", tmp_path / "truth", convention="sscbench"))


def test_scores_are_broken_down_by_distance_height_and_visibility(folders, world):
    result = evaluate(*folders, scoring=Scoring(by=("distance", "height", "visibility")))
    parts = result.breakdown
    assert sum(parts[name].total for name in ("visible", "hidden")) == result.matrix.total
    assert sum(m.total for name, m in parts.items() if name.endswith("up")) == result.matrix.total
    assert parts["0-10 m"].total == result.matrix.total
    assert result.tables()[-1].rows[0][0] == "0-10 m"
    with raises(
        ArgumentError,
        where="by",
        expected="distance, height, visibility, motion, seen",
        found="colour",
    ):
        evaluate(*folders, scoring=Scoring(by=("colour",)))


def test_tables_hold_the_figures_in_percent(folders):
    result = evaluate(*folders, name="Net_1")
    semantic, geometric = semantic_table([result, result]), geometric_table([result])
    assert semantic.header == (
        "Network",
        *CARLASC11.names.values(),
        "mIoU",
        "mIoU w/o free",
        "Accuracy",
    )
    assert len(semantic.rows) == 2
    assert semantic.rows[0][-1] == pytest.approx(100 * result.matrix.accuracy)
    found = result.matrix.completeness()
    assert geometric.rows[0][1:] == pytest.approx(
        (100 * found.precision, 100 * found.recall, 100 * found.iou, 100 - 100 * found.recall)
    )
    assert (
        geometric.to_csv().splitlines()[1]
        == f"Net_1,{100 * found.precision:.2f},{100 * found.recall:.2f},{100 * found.iou:.2f},{100 - 100 * found.recall:.2f}"
    )
    latex = geometric.to_latex()
    assert r"Net\_1 & " in latex
    assert latex.count(r"\\") == 2
    assert json.loads(json.dumps(result.to_dict()))["class_iou"].keys() == set(
        CARLASC11.names.values()
    )


def write_plain(folder, files):
    """Write a plain folder: {name: array}."""
    folder.mkdir()
    for name, array in files.items():
        array.tofile(folder / name)
    return folder


def test_a_plain_folder_of_truth_has_counts_or_all_its_voxels_are_unknown(tmp_path):
    # 7 is a road: class 6 of the eleven
    truth, pred = (
        np.array([7, 7, 0, 1], np.uint32),
        np.array([6, 0, 0, 1], np.uint32),
    )
    source = write_plain(tmp_path / "source", {"000000.label": pred})
    plain = {"000000.label": truth, "000000.bin": np.array([1, 2, 0, 3], np.float32)}
    result = evaluate(source, write_plain(tmp_path / "truth", plain))
    assert (result.matrix.total, result.matrix.accuracy) == (3, pytest.approx(2 / 3))
    without = write_plain(tmp_path / "without", {"000000.label": truth})
    assert "give `voxels=all`" in evaluate(source, without).failures[0][1]
    assert evaluate(source, without, scoring=Scoring(voxels="all")).matrix.total == 4


def test_plain_folders_of_different_sizes_are_told_by_the_size_of_their_files(tmp_path):
    source = write_plain(tmp_path / "source", {"000000.label": np.zeros(3, np.uint32)})
    without = write_plain(tmp_path / "without", {"000000.label": np.zeros(4, np.uint32)})
    counted = {"000000.label": np.zeros(4, np.uint32), "000000.bin": np.ones(4, np.float32)}
    assert (
        r"expected the shape of the ground truth (4,), found (3,)"
        in evaluate(source, without, scoring=Scoring(voxels="all")).failures[0][1]
    )
    assert (
        "expected 4 labels"
        in evaluate(source, write_plain(tmp_path / "counted", counted)).failures[0][1]
    )


def test_the_classes_of_plain_predictions_can_be_named(folders, world, tmp_path):
    heavy = SEQUENCES[0]
    files = {f"{frame:06d}.label": world[0][heavy, frame].astype(np.uint32) for frame in range(3)}
    source, truth = write_plain(tmp_path / "plain", files), folders[1] / heavy
    assert evaluate(source, truth, source_classes="carla").matrix.accuracy == 1.0
    # ids above 10 are not ids of the scored classes
    assert len(evaluate(source, truth).failures) == 3


def test_a_region_needs_grids_whose_geometry_is_known(tmp_path):
    folder = write_plain(tmp_path / "plain", {"000000.label": np.zeros(4, np.uint32)})
    with pytest.raises(ArgumentError, match="region: expected None for grids without geometry"):
        evaluate(
            folder,
            folder,
            scoring=Scoring(voxels="all", region=lambda spec: distance_band(spec, 0, 1)),
        )


def test_semantickittis_mask_is_combined_with_its_invalid_voxels_and_a_region(tmp_path):
    labels = np.array([[[0, 1], [10, 40]]])  # 1 is ignored
    spec = GridSpec("cartesian", (1, 2, 2), (0.0, -1.0, 0.0), (1.0, 1.0, 2.0))
    write_grids(
        tmp_path / "a",
        {(SEQUENCES[0], 0): labels},
        {(SEQUENCES[0], 0): np.array([[[1, 1], [1, 0]]])},
        spec=spec,
    )
    path = tmp_path / "a" / SEQUENCES[0] / layout.METADATA
    path.write_text(json.dumps({"classes": "semantickitti"}))
    result = evaluate(tmp_path / "a", tmp_path / "a", convention="semantickitti")
    assert result.matrix.total == 2
    half = evaluate(
        tmp_path / "a",
        tmp_path / "a",
        convention="semantickitti",
        scoring=Scoring(region=lambda spec: spec.centers()[..., 1] < 0),
    )
    assert half.matrix.total == 1


def test_sequences_of_different_classes_are_summed_in_the_classes_of_the_convention(
    world, tmp_path
):
    labels, counts = world[2], world[1]
    for path, classes in zip(SEQUENCES, ("carlasc11", "carla"), strict=True):
        write_grids(
            tmp_path, {k: v for k, v in labels.items() if k[0] == path}, counts, classes=classes
        )
    result = evaluate(tmp_path, tmp_path)
    assert (result.frames, result.matrix.accuracy) == (6, 1.0)
    with pytest.raises(
        FormatError,
        match=r"a class table with a map in the convention own \(carlasc11\), found carla",
    ):
        evaluate(tmp_path, tmp_path, convention="own")


def test_of_several_grids_one_is_to_be_named(world, tmp_path):
    for grid in ("evaluation_a", "evaluation_b"):
        write_grids(tmp_path, world[0], world[1], grid=grid)
    with pytest.raises(
        MissingDataError,
        match="expected the grid evaluation, found evaluation_a, evaluation_b: choose a grid with",
    ):
        evaluate(tmp_path, tmp_path)
    assert evaluate(tmp_path, tmp_path, truth_grid="evaluation_b").miou > 0.9


def evaluation(classes, matrix, absent="zero"):
    return Evaluation(
        "Net_1", replace(own_convention(classes), absent=absent), matrix, {}, 1, "known", []
    )


def test_ids_that_are_no_class_are_not_in_the_mean():
    classes = ClassTable("two", {0: "free", 2: "thing"}, {0: (0, 0, 0), 2: (1, 1, 1)})
    result = evaluation(classes, ConfusionMatrix(3, counts=np.diag([4, 0, 4])))
    assert (result.miou, result.miou_without_free) == (1.0, 1.0)
    assert result.to_dict()["class_iou"] == {"free": 1.0, "thing": 1.0}


def test_figures_that_are_not_defined_are_dashes_and_null():
    classes = ClassTable("two", {0: "free", 1: "thing & co"}, {0: (0, 0, 0), 1: (1, 1, 1)})
    result = evaluation(classes, ConfusionMatrix(2, counts=np.diag([4, 0])), "skip")
    semantic, geometric = result.tables()
    assert semantic.texts() == [["Net_1", "100.00", "-", "100.00", "0.00", "100.00"]]
    assert geometric.texts() == [["Net_1", "-", "-", "-", "-"]]
    assert r"Network & free & thing \& co & mIoU" in semantic.to_latex()
    assert result.to_dict()["class_iou"] == {"free": 1.0, "thing & co": None}
    assert (result.to_dict()["iou"], result.to_dict()["miou"]) == (None, 1.0)


def test_a_table_needs_evaluations_by_the_same_convention():
    with pytest.raises(ArgumentError, match="found none"):
        semantic_table([])
    results = [
        Evaluation("Net_1", CONVENTIONS[name], ConfusionMatrix(20), {}, 1, "known", [])
        for name in ("sscbench", "semantickitti")
    ]
    with pytest.raises(
        ArgumentError, match="evaluations by one convention, found semantickitti, sscbench"
    ):
        semantic_table(results)
