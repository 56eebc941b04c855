"""Grids in other benchmarks' files, written by the facts of their formats."""

from __future__ import annotations

import numpy as np
import pytest

from carlasc.errors import FormatError
from carlasc.metrics import evaluate


def write_occ3d(root, seed, keep=1.0, name="semantics", masks=True):
    """Two scenes of two frames each; returns {(scene, token): (labels, lidar mask)}."""
    frames = {}
    for scene, token in (("scene-0001", "aa"), ("scene-0001", "bb"), ("scene-0002", "cc"), ("scene-0002", "dd")):
        rng = np.random.default_rng([seed, *token.encode()])
        labels = rng.choice([0, 4, 11, 17], (200, 200, 16), p=[0.02, 0.02, 0.06, 0.9]).astype(np.uint8)
        lidar, camera = rng.random((2, 200, 200, 16)) < [[[[0.5]]], [[[0.2]]]]
        if rng.random() < keep:
            folder = root / scene / token
            folder.mkdir(parents=True)
            arrays = {name: labels} | (
                {"mask_lidar": lidar.astype(np.uint8), "mask_camera": camera.astype(np.uint8)} if masks else {}
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
    messages = dict(evaluate(tmp_path / "pred", tmp_path / "gts", convention="occ3d-lidar").failures)
    assert "cannot be read" in messages["scene-0001:aa"]
    assert "expected an array semantics of shape (200, 200, 16), found semantics (2, 2, 2)" in messages["scene-0001:bb"]


def test_a_pickle_in_an_npz_is_never_loaded(tmp_path):
    write_occ3d(tmp_path / "gts", 0)
    write_occ3d(tmp_path / "pred", 0)
    hostile = np.empty(1, object)
    hostile[0] = {"any": "object"}
    np.savez(tmp_path / "pred" / "scene-0001" / "aa" / "labels.npz", semantics=hostile)
    failures = dict(evaluate(tmp_path / "pred", tmp_path / "gts", convention="occ3d-lidar").failures)
    assert "cannot be read" in failures["scene-0001:aa"]


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
    with pytest.raises(FormatError, match="has a map for"):
        evaluate(tmp_path / "a", tmp_path / "a", convention="occ3d-lidar", source_classes="semantickitti")
