from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
from helpers.errors import raises
from hypothesis import given, settings
from hypothesis import strategies as st

from carlasc import Grid, GridSpec
from carlasc.errors import ArgumentError, FormatError
from carlasc.metrics import ConfusionMatrix, score_truth

SMALL = GridSpec("cartesian", (8, 8, 2), (-4.0, -4.0, -1.0), (4.0, 4.0, 1.0))

K = 11


def per_class_loop(pred, target, mask, num_classes):
    """The straightforward way, for comparison: a pass over the voxels for each class and figure."""
    rows = []
    for c in range(num_classes):
        hit = ((pred == c) & (target == c) & mask).sum()
        missed = ((pred != c) & (target == c) & mask).sum()
        wrong = ((pred == c) & (target != c) & mask).sum()
        rows.append((hit, wrong, missed))
    return np.array(rows)


def labels_and_mask(seed, shape=(2, 9, 7, 5), dtype=np.uint8):
    rng = np.random.default_rng(seed)
    return (
        rng.integers(0, K, shape).astype(dtype),
        rng.integers(0, K, shape).astype(dtype),
        rng.random(shape) < 0.6,
    )


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32, np.int64])
def test_counts_are_those_of_the_per_class_loop_for_every_integer_type(dtype):
    pred, target, mask = labels_and_mask(0, dtype=dtype)
    matrix = ConfusionMatrix(K).update(pred, target, mask)
    expected = per_class_loop(pred, target, mask, K)
    found = np.stack([matrix.true_positives, matrix.false_positives, matrix.false_negatives], 1)
    np.testing.assert_array_equal(found, expected)
    assert matrix.total == mask.sum()


def test_figures_of_a_matrix_worked_out_by_hand():
    matrix = ConfusionMatrix(4)
    matrix.update(np.array([0, 0, 1, 1, 1, 2]), np.array([0, 1, 1, 1, 2, 0]))
    np.testing.assert_allclose(matrix.iou, [1 / 3, 2 / 4, 0, np.nan])
    assert matrix.miou == pytest.approx((1 / 3 + 1 / 2) / 4)  # the absent class 3 counts zero
    assert matrix.mean_iou(absent="skip") == pytest.approx((1 / 3 + 1 / 2) / 3)
    assert matrix.mean_iou(with_free=False) == pytest.approx((1 / 2) / 3)
    assert matrix.mean_iou(with_free=False, absent="skip") == pytest.approx((1 / 2) / 2)
    assert matrix.accuracy == pytest.approx(3 / 6)
    np.testing.assert_allclose(matrix.recall, [1 / 2, 2 / 3, 0, np.nan])
    np.testing.assert_allclose(matrix.precision, [1 / 2, 2 / 3, 0, np.nan])
    geometry = matrix.completeness()  # occupied: predicted at 2..5, true at 1..4
    assert (geometry.precision, geometry.recall, geometry.iou) == pytest.approx(
        (3 / 4, 3 / 4, 3 / 5)
    )


def test_an_empty_matrix_has_no_figures_rather_than_zeros_or_errors():
    matrix = ConfusionMatrix(3)
    assert np.isnan(matrix.accuracy)
    assert np.isnan(matrix.completeness().iou)
    assert np.isnan(matrix.iou).all()
    assert np.isnan(matrix.mean_iou(absent="skip"))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 59))
def test_matrices_of_parts_add_up_to_the_matrix_of_the_whole(seed, cut):
    pred, target, mask = (array.reshape(-1)[:60] for array in labels_and_mask(seed))
    whole = ConfusionMatrix(K).update(pred, target, mask)
    left = ConfusionMatrix(K).update(pred[:cut], target[:cut], mask[:cut])
    right = ConfusionMatrix(K).update(pred[cut:], target[cut:], mask[cut:])
    assert left + right == whole
    left += right
    assert left == whole


def test_tensors_count_as_arrays_do():
    torch = pytest.importorskip("torch")
    pred, target, mask = labels_and_mask(3)
    expected = ConfusionMatrix(K).update(pred, target, mask)
    tensors = [torch.from_numpy(a) for a in (pred, target, mask)]
    assert ConfusionMatrix(K).update(*tensors) == expected
    assert ConfusionMatrix(K).update(tensors[0], target, mask) == expected
    assert ConfusionMatrix(K).update(tensors[0].long(), tensors[1]) == ConfusionMatrix(K).update(
        pred, target
    )


def test_the_count_on_another_device_is_that_on_the_cpu():
    torch = pytest.importorskip("torch")
    from carlasc.metrics.confusion import count_tensors

    pred, target, mask = labels_and_mask(4)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    tensors = [torch.from_numpy(a).to(device) for a in (pred, target, mask)]
    expected = ConfusionMatrix(K).update(pred, target, mask)
    np.testing.assert_array_equal(count_tensors(device, *tensors, K), expected.counts)
    np.testing.assert_array_equal(
        count_tensors(device, tensors[0], target, mask, K), expected.counts
    )
    with pytest.raises(FormatError, match=r"prediction: expected class ids 0\.\.2, found"):
        count_tensors(device, *tensors, 3)
    with pytest.raises(FormatError, match="truth: expected integer"):
        count_tensors(device, tensors[0], tensors[1].float(), None, K)


def test_ids_out_of_range_are_named_unless_masked():
    pred, target, mask = np.array([0, 11, 255]), np.array([0, 1, 2]), np.array([True, False, False])
    assert ConfusionMatrix(K).update(pred, target, mask).total == 1
    with pytest.raises(
        FormatError, match=r"prediction: expected class ids 0\.\.10, found 11 \(2 voxels"
    ):
        ConfusionMatrix(K).update(pred, target)
    with pytest.raises(FormatError, match=r"truth: expected class ids 0\.\.10, found -1"):
        ConfusionMatrix(K).update(target, np.array([0, -1, 2]))


def test_shapes_and_types_that_do_not_fit_are_refused():
    with pytest.raises(
        FormatError,
        match=r"prediction: expected the shape of the ground truth \(2, 2\), found \(4,\)",
    ):
        ConfusionMatrix(K).update(np.zeros(4, int), np.zeros((2, 2), int))
    with pytest.raises(
        FormatError, match=r"mask: expected the shape of the ground truth \(4,\), found \(3,\)"
    ):
        ConfusionMatrix(K).update(np.zeros(4, int), np.zeros(4, int), np.ones(3, bool))
    with pytest.raises(FormatError, match="prediction: expected integer class ids, found float64"):
        ConfusionMatrix(K).update(np.zeros(4), np.zeros(4, int))
    with pytest.raises(ArgumentError, match="num_classes: expected 1 or more, found 0"):
        ConfusionMatrix(0)
    for free in (-1, 3):
        with pytest.raises(
            ArgumentError, match=rf"free: expected a class id in 0\.\.2, found {free}"
        ):
            ConfusionMatrix(3, free=free)
    with pytest.raises(ArgumentError, match="counts"):
        ConfusionMatrix(3, counts=np.zeros((2, 2), int))
    with raises(ArgumentError, where="other", expected="num_classes 3", found="4"):
        ConfusionMatrix(3) + ConfusionMatrix(4)
    with raises(ArgumentError, where="other", expected="free 0", found="1"):
        ConfusionMatrix(3) + ConfusionMatrix(3, free=1)
    with raises(ArgumentError, where="absent", expected="zero, skip", found="maybe"):
        ConfusionMatrix(3).mean_iou(absent="maybe")


def test_counts_given_at_the_start_are_copied_and_compared():
    counts = np.array([[5, 1], [2, 3]])
    matrix = ConfusionMatrix(2, counts=counts)
    matrix.update(np.array([1]), np.array([0]))
    np.testing.assert_array_equal(matrix.counts, [[5, 2], [2, 3]])
    np.testing.assert_array_equal(counts, [[5, 1], [2, 3]])
    assert ConfusionMatrix(2, counts=counts) == ConfusionMatrix(2, counts=counts)
    assert ConfusionMatrix(2, counts=counts) != ConfusionMatrix(2, counts=counts.T)
    assert ConfusionMatrix(2, counts=counts) != ConfusionMatrix(2, counts=counts, free=1)


def test_free_may_be_any_class():
    matrix = ConfusionMatrix(3, free=2, counts=np.array([[4, 1, 3], [0, 2, 1], [2, 0, 9]]))
    geometry = matrix.completeness()  # occupied are 0 and 1: 7 of them right, 9 predicted, 11 true
    assert (geometry.precision, geometry.recall, geometry.iou) == pytest.approx(
        (7 / 9, 7 / 11, 7 / 13)
    )
    assert matrix.mean_iou(with_free=False) == pytest.approx((4 / 10 + 2 / 4) / 2)


@pytest.mark.slow
def test_metrics_of_arrays_do_not_import_torch():
    code = (
        "import sys, numpy as np; from carlasc.metrics import ConfusionMatrix; a = np.zeros(3, "
        "int);"
        "ConfusionMatrix(2).update(a, a); assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_matrix_is_reset_merged_and_computed_as_every_metric_is():
    pred, target, mask = labels_and_mask(7)
    whole = ConfusionMatrix(K).update(pred, target, mask)
    merged = ConfusionMatrix(K).merge(whole).merge(whole)
    assert merged.total == 2 * whole.total
    found = merged.compute()
    assert found == {"miou": whole.miou, "accuracy": whole.accuracy} | {
        name: getattr(whole.completeness(), name) for name in ("precision", "recall", "iou")
    }
    merged.reset()
    assert merged == ConfusionMatrix(K)


def test_truth_is_scored_over_voxels_known_to_both():
    spec = GridSpec("cartesian", (4, 1, 1), (0.0, 0.0, 0.0), (4.0, 1.0, 1.0))

    def grid(labels, counts):
        return Grid(
            spec,
            np.array(labels, np.uint8).reshape(4, 1, 1),
            np.array(counts, np.float32).reshape(4, 1, 1),
        )

    score = score_truth(grid([1, 2, 0, 2], [1, 1, 0, 3]), grid([1, 1, 0, 2], [1, 2, 5, 0]), 3)
    assert (score.known, score.known_reference, score.known_both) == (3, 3, 2)
    assert score.coverage == pytest.approx(2 / 3)
    assert score.accuracy == pytest.approx(1 / 2)
    np.testing.assert_array_equal(score.matrix.false_positives, [0, 0, 1])
    total = score + score
    assert (total.known_both, total.matrix.total) == (4, 4)
    assert total.coverage == score.coverage


def test_truth_is_scored_only_where_the_mask_says():
    spec = GridSpec("cartesian", (4, 1, 1), (0.0, 0.0, 0.0), (4.0, 1.0, 1.0))
    grid = Grid(
        spec, np.array([1, 2, 0, 2], np.uint8).reshape(4, 1, 1), np.ones(spec.size, np.float32)
    )
    score = score_truth(grid, grid, 3, np.array([True, True, False, False]).reshape(4, 1, 1))
    assert (score.known, score.known_reference, score.known_both, score.matrix.total) == (
        2,
        2,
        2,
        2,
    )
    empty = score_truth(grid, grid, 3, np.zeros(spec.size, bool))
    assert math.isnan(empty.coverage) and math.isnan(empty.accuracy)


def test_truth_of_another_grid_is_refused():
    grid = Grid(SMALL, np.zeros(SMALL.size, np.uint8))
    other = SMALL.with_size((4, 4, 2))
    with pytest.raises(FormatError, match="expected the geometry of the reference"):
        score_truth(grid, Grid(other, np.zeros(other.size, np.uint8)), 2)
