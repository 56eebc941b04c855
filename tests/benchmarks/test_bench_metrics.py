"""A frame's confusion matrix against the loop over classes, masks included."""

from __future__ import annotations

import numpy as np
import pytest

from carlasc.metrics import ConfusionMatrix, known

pytestmark = pytest.mark.slow

K = 11


@pytest.fixture(scope="module")
def frame():
    """Labels as common as in the data set: 9 of 10 voxels free, 6 of 10 known."""
    rng = np.random.default_rng(0)
    shape, shares = (128, 128, 8), np.r_[0.9, np.full(10, 0.01)]
    target = rng.choice(K, shape, p=shares).astype(np.uint8)
    pred = np.where(rng.random(shape) < 0.9, target, rng.choice(K, shape, p=shares)).astype(np.uint8)
    counts = rng.integers(0, 10, shape) * (rng.random(shape) < 0.6)
    return pred, target, counts.astype(np.float32)


def per_class_loop(pred, target, counts):
    """True positives, false positives and false negatives of each class, a pass over the voxels for each."""
    mask = counts > 0
    return [
        (
            ((pred == c) & (target == c) & mask).sum(),
            ((pred == c) & (target != c) & mask).sum(),
            ((pred != c) & (target == c) & mask).sum(),
        )
        for c in range(K)
    ]


@pytest.mark.benchmark(group="metrics")
def test_bench_confusion_matrix(benchmark, frame):
    pred, target, counts = frame
    matrix = benchmark(lambda: ConfusionMatrix(K).update(pred, target, known(counts)))
    assert matrix.total == (counts > 0).sum()


@pytest.mark.benchmark(group="metrics")
def test_bench_per_class_loop(benchmark, frame):
    figures = benchmark(per_class_loop, *frame)
    matrix = ConfusionMatrix(K).update(frame[0], frame[1], known(frame[2]))
    found = np.stack([matrix.true_positives, matrix.false_positives, matrix.false_negatives], 1)
    np.testing.assert_array_equal(found, figures)
