"""Grids in other benchmarks' files, written by the facts of their formats."""

from __future__ import annotations

import numpy as np
import pytest

from carlasc.errors import FormatError, MissingDataError
from carlasc.metrics import Scoring, distance_band, evaluate


def write_occ3d(root, seed, keep=1.0, name="semantics", masks=True):
    """Two scenes of two frames each; returns {(scene, token): (labels, lidar mask)}."""
    frames = {}
    for scene, token in (
        ("scene-0001", "aa"),
        ("scene-0001", "bb"),
        ("scene-0002", "cc"),
        ("scene-0002", "dd"),
    ):
        rng = np.random.default_rng([seed, *token.encode()])
        labels = rng.choice([0, 4, 11, 17], (200, 200, 16), p=[0.02, 0.02, 0.06, 0.9]).astype(
            np.uint8
        )
        lidar, camera = rng.random((2, 200, 200, 16)) < [[[[0.5]]], [[[0.2]]]]
        if rng.random() < keep:
            folder = root / scene / token
            folder.mkdir(parents=True)
            arrays = {name: labels} | (
                {"mask_lidar": lidar.astype(np.uint8), "mask_camera": camera.astype(np.uint8)}
                if masks
                else {}
            )
            np.savez_compressed(folder / "labels.npz", **arrays)
        frames[scene, token] = labels, lidar, camera
    return frames


def test_occ3d_is_scored_where_the_lidar_or_a_camera_looked(tmp_path):
    truth = write_occ3d(tmp_path / "gts", 0)
    pred = write_occ3d(tmp_path / "pred", 1, name="pred", masks=False)
    for convention, mask in (("occ3d-lidar", 1), ("occ3d-camera", 2)):
        result = evaluate(tmp_path / "pred", tmp_path, convention=convention)
        assert (result.frames, result.failures) == (4, [])
        ious = []
        for c in (0, 4, 11):
            tp = union = 0
            for key, frame in truth.items():
                seen = frame[mask]
                a, b = pred[key][0][seen] == c, frame[0][seen] == c
                tp, union = tp + (a & b).sum(), union + (a | b).sum()
            ious.append(tp / union)
        assert result.miou == pytest.approx(np.mean(ious))


@pytest.mark.slow
def test_frames_go_together_by_their_tokens_and_a_missing_one_is_named(tmp_path):
    write_occ3d(tmp_path / "gts", 0)
    write_occ3d(tmp_path / "pred", 0)
    (tmp_path / "pred" / "scene-0001" / "aa" / "labels.npz").unlink()
    result = evaluate(tmp_path / "pred", tmp_path / "gts", convention="occ3d-lidar")
    assert result.frames == 3
    assert result.miou == 1.0
    assert [name for name, _ in result.failures] == ["scene-0001:aa"]
    assert "a prediction for frame aa" in result.failures[0][1]


def test_damaged_files_of_occ3d_are_named(tmp_path):
    write_occ3d(tmp_path / "gts", 0)
    write_occ3d(tmp_path / "pred", 0)
    bad = tmp_path / "pred" / "scene-0001"
    (bad / "aa" / "labels.npz").write_bytes(b"no archive")
    np.savez(bad / "bb" / "labels.npz", semantics=np.zeros((2, 2, 2), np.uint8))
    messages = dict(
        evaluate(tmp_path / "pred", tmp_path / "gts", convention="occ3d-lidar").failures
    )
    assert "labels.npz: expected an .npz file, found something else" in messages["scene-0001:aa"]
    assert (
        "semantics: expected an array of 200 x 200 x 16 values, found 2 x 2 x 2"
        in messages["scene-0001:bb"]
    )


def test_a_pickle_in_an_npz_is_never_loaded(tmp_path):
    write_occ3d(tmp_path / "gts", 0)
    write_occ3d(tmp_path / "pred", 0)
    hostile = np.empty(1, object)
    hostile[0] = {"any": "object"}
    np.savez(tmp_path / "pred" / "scene-0001" / "aa" / "labels.npz", semantics=hostile)
    failures = dict(
        evaluate(tmp_path / "pred", tmp_path / "gts", convention="occ3d-lidar").failures
    )
    assert "semantics: expected numeric values, found object" in failures["scene-0001:aa"]


def write_openoccupancy(root, rows):
    folder = root / "scene_abc" / "occupancy"
    folder.mkdir(parents=True)
    for token, array in rows.items():
        np.save(folder / f"{token}.npy", array)


def test_openoccupancy_rows_are_z_y_x_and_the_class_comes_last(tmp_path):
    truth = np.array([[1, 2, 300, 4], [39, 511, 0, 11], [5, 5, 5, 0]], np.uint16)
    pred = np.array([[1, 2, 300, 0.5, -0.5, 4], [39, 511, 0, 0, 0, 12], [5, 5, 5, 0, 0, 7]])
    pred = np.insert(pred, 5, 0.0, axis=1)  # seven columns: z, y, x, three of velocity, class
    write_openoccupancy(tmp_path / "truth", {"t": truth})
    write_openoccupancy(tmp_path / "pred", {"t": pred})
    result = evaluate(tmp_path / "pred", tmp_path / "truth", convention="openoccupancy")
    assert result.frames == 1
    assert result.class_iou["car"] == 1.0
    assert result.class_iou["driveable-surface"] == 0.0
    assert result.matrix.total == 512 * 512 * 40 - 1  # noise does not count
    assert np.isnan(result.miou)  # most classes are absent
    assert (result.score.precision, result.score.recall) == (1.0, 1.0)


def test_openoccupancy_rows_outside_of_the_grid_are_refused(tmp_path):
    write_openoccupancy(tmp_path / "truth", {"t": np.array([[1, 2, 3, 4]])})
    write_openoccupancy(tmp_path / "pred", {"t": np.array([[40, 2, 3, 4]])})
    result = evaluate(tmp_path / "pred", tmp_path / "truth", convention="openoccupancy")
    assert "expected voxels inside" in result.failures[0][1]


@pytest.mark.parametrize("packed", [True, False])
def test_sequences_of_semantickitti_and_sscbench_go_together_by_their_names(tmp_path, packed):
    rng = np.random.default_rng(0)
    size = 16 * 16 * 4
    truth, invalid = {}, {}
    for name in ("08", "09"):
        for folder in ("voxels", "predictions"):
            (tmp_path / "sequences" / name / folder).mkdir(parents=True)
        truth[name] = rng.choice([0, 10, 40, 50], size).astype("<u2")
        invalid[name] = rng.random(size) < 0.3
        truth[name].tofile(tmp_path / "sequences" / name / "voxels" / "000000.label")
        mask = np.packbits(invalid[name]) if packed else invalid[name].astype(np.uint8)
        mask.tofile(tmp_path / "sequences" / name / "voxels" / "000000.invalid")
        np.where(truth[name] == 50, 51, truth[name]).astype("<u2").tofile(
            tmp_path / "sequences" / name / "predictions" / "000000.label"
        )
    for convention in ("semantickitti", "sscbench"):
        result = evaluate(tmp_path, tmp_path, convention=convention)
        assert (result.frames, sorted(result.sequences)) == (2, ["08", "09"])
        assert result.matrix.total == sum((~mask).sum() for mask in invalid.values())
        assert result.class_iou["car"] == pytest.approx(1.0, abs=1e-4)
        assert result.class_iou["building"] == 0.0


def test_a_truncated_label_file_is_named(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    np.zeros(64, "<u2").tofile(tmp_path / "a" / "000000.label")
    np.packbits(np.zeros(64, bool)).tofile(tmp_path / "a" / "000000.invalid")
    np.zeros(63, "<u2").tofile(tmp_path / "b" / "000000.label")
    result = evaluate(tmp_path / "b", tmp_path / "a", convention="semantickitti")
    assert "expected 64 labels of 2 or 4 bytes, found 126 bytes" in result.failures[0][1]
    with pytest.raises(FormatError, match="with a map in the convention"):
        evaluate(
            tmp_path / "a", tmp_path / "a", convention="occ3d-lidar", source_classes="semanticposs"
        )


def write_kitti(
    root, rng, shape=(256, 256, 32), folders=("voxels", "predictions"), parent="sequences/08"
):
    """One frame in the files of SemanticKITTI; returns the true labels, the prediction and the
    invalid voxels.
    """
    truth = rng.choice(
        [0, 10, 40, 50, 52, 99], shape, p=[0.9, 0.02, 0.05, 0.01, 0.01, 0.01]
    ).astype("<u2")
    prediction = np.where(
        rng.random(shape) < 0.9, np.where(np.isin(truth, (52, 99)), 50, truth), 40
    ).astype("<u2")
    invalid = (rng.random(shape) < 0.3) & (truth == 0)
    for folder, labels in zip(folders, (truth, prediction), strict=True):
        (root / parent / folder).mkdir(parents=True, exist_ok=True)
        labels.tofile(root / parent / folder / "000000.label")
    (root / parent / "voxels" / "000000.invalid").write_bytes(np.packbits(invalid).tobytes())
    (root / parent / "voxels" / "000000.occluded").write_bytes(np.packbits(truth > 0).tobytes())
    # occupancy, no counts
    (root / parent / "voxels" / "000000.bin").write_bytes(np.packbits(truth > 0).tobytes())
    return truth, prediction, invalid


def official_ious(truth, prediction, invalid):
    """The scores of the benchmark's script: raw ids by its table, ignored classes and invalid
    voxels masked, class 0 empty.
    """
    learning = {0: 0, 52: 255, 99: 255, 10: 1, 40: 9, 50: 13}
    table = np.zeros(300, int)
    table[list(learning)] = list(learning.values())
    true, pred = table[truth], table[prediction]
    mask = (true != 255) & ~invalid
    ious = {}
    for name, c in (("car", 1), ("road", 9), ("building", 13)):
        a, b = pred[mask] == c, true[mask] == c
        ious[name] = (a & b).sum() / (a | b).sum()
    completion = ((pred[mask] > 0) & (true[mask] > 0)).sum() / (
        (pred[mask] > 0) | (true[mask] > 0)
    ).sum()
    return ious, completion


def test_files_of_semantickitti_are_read_as_they_are(tmp_path):
    truth, prediction, invalid = write_kitti(tmp_path, np.random.default_rng(1))
    result = evaluate(tmp_path, tmp_path)
    ious, completion = official_ious(truth, prediction, invalid)
    assert result.convention.name == "semantickitti"
    assert {name: result.class_iou[name] for name in ious} == pytest.approx(ious)
    assert result.score.iou == pytest.approx(completion)


def test_the_geometry_of_semantickitti_is_known(tmp_path):
    truth, prediction, invalid = write_kitti(tmp_path, np.random.default_rng(2))
    near = evaluate(
        tmp_path, tmp_path, scoring=Scoring(region=lambda spec: distance_band(spec, 0, 10))
    )
    x, y = np.meshgrid(
        (np.arange(256) + 0.5) * 0.2, (np.arange(256) + 0.5) * 0.2 - 25.6, indexing="ij"
    )
    beyond = np.broadcast_to((np.hypot(x, y) >= 10)[:, :, None], truth.shape)
    ious, _ = official_ious(truth, prediction, invalid | beyond)
    assert {name: near.class_iou[name] for name in ious} == pytest.approx(ious)


def test_predictions_and_truth_of_semantickitti_may_be_in_two_places(tmp_path):
    write_kitti(tmp_path / "all", np.random.default_rng(3))
    (tmp_path / "ours" / "sequences" / "08").mkdir(parents=True)
    (tmp_path / "all" / "sequences" / "08" / "predictions").rename(
        tmp_path / "ours" / "sequences" / "08" / "predictions"
    )
    assert evaluate(tmp_path / "ours", tmp_path / "all").frames == 1
    with pytest.raises(MissingDataError):
        evaluate(tmp_path / "all", tmp_path / "all")


def test_labels_of_semantickitti_without_masks_have_two_bytes(tmp_path):
    write_kitti(tmp_path, np.random.default_rng(4), shape=(16, 16, 4))
    for suffix in ("invalid", "occluded", "bin"):
        (tmp_path / "sequences" / "08" / "voxels" / f"000000.{suffix}").unlink()
    result = evaluate(tmp_path, tmp_path, scoring=Scoring(voxels="all"))
    truth = np.fromfile(tmp_path / "sequences" / "08" / "voxels" / "000000.label", "<u2")
    assert result.matrix.total == np.isin(truth, (52, 99), invert=True).sum()


def test_a_mask_that_is_cut_short_is_named(tmp_path):
    write_kitti(tmp_path, np.random.default_rng(5), shape=(16, 16, 4))
    mask = tmp_path / "sequences" / "08" / "voxels" / "000000.invalid"
    second = mask.with_name("000001.invalid")
    for folder in ("voxels", "predictions"):
        first = tmp_path / "sequences" / "08" / folder / "000000.label"
        first.with_name("000001.label").write_bytes(first.read_bytes())
    second.write_bytes(mask.read_bytes()[:-3])
    failures = dict(evaluate(tmp_path, tmp_path).failures)
    assert (
        "000001.invalid: expected 1024 bytes, or 128 of packed bits, found 125" in failures["08:1"]
    )


def test_drives_of_sscbench_are_found(tmp_path):
    parent = "data_2d_raw/2013_05_28_drive_0009_sync"
    write_kitti(tmp_path, np.random.default_rng(6), parent=parent)
    folder = tmp_path / parent / "voxels"
    invalid = np.unpackbits(np.fromfile(folder / "000000.invalid", np.uint8))
    invalid.tofile(folder / "000000.invalid")  # one byte for each voxel
    result = evaluate(tmp_path, tmp_path)
    assert result.convention.name == "sscbench"
    assert list(result.sequences) == ["2013_05_28_drive_0009_sync"]
    assert result.matrix.total == (invalid == 0).sum()
