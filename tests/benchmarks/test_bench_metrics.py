"""One frame's metrics, compiled and in plain NumPy: processor times of one thread."""

from __future__ import annotations

import time

import numpy as np
import pytest
from helpers.references.plain_metrics import panoptic_quality, rayiou

from carlasc import GridSpec
from carlasc.metrics import (
    ConfusionMatrix,
    PanopticQuality,
    RayIoU,
    evaluate_by_all_conventions,
    rayiou_directions,
)
from carlasc.storage.files import to_json
from carlasc.storage.folder import FolderSink

pytestmark = pytest.mark.slow

K, THINGS, FRAMES = 11, frozenset({4, 10}), 20


@pytest.fixture(scope="module")
def frame():
    """Labels as common as in the data set: 9 of 10 voxels free, 6 of 10 known."""
    rng = np.random.default_rng(0)
    shape, shares = (128, 128, 8), np.r_[0.9, np.full(10, 0.01)]
    target = rng.choice(K, shape, p=shares).astype(np.uint8)
    pred = np.where(rng.random(shape) < 0.9, target, rng.choice(K, shape, p=shares)).astype(
        np.uint8
    )
    counts = rng.integers(0, 10, shape) * (rng.random(shape) < 0.6)
    return pred, target, counts.astype(np.float32)


def per_class_loop(pred, target, counts):
    """True positives, false positives and false negatives of each class, a pass over the voxels for
    each.
    """
    mask = counts > 0
    return [
        (
            ((pred == c) & (target == c) & mask).sum(),
            ((pred == c) & (target != c) & mask).sum(),
            ((pred != c) & (target == c) & mask).sum(),
        )
        for c in range(K)
    ]


@pytest.mark.benchmark(group="metrics", timer=time.process_time)
def test_bench_confusion_matrix(benchmark, frame):
    pred, target, counts = frame
    matrix = benchmark(lambda: ConfusionMatrix(K).update(pred, target, counts > 0))
    assert matrix.total == (counts > 0).sum()


@pytest.mark.benchmark(group="metrics", timer=time.process_time)
def test_bench_per_class_loop(benchmark, frame):
    figures = benchmark(per_class_loop, *frame)
    matrix = ConfusionMatrix(K).update(frame[0], frame[1], frame[2] > 0)
    found = np.stack([matrix.true_positives, matrix.false_positives, matrix.false_negatives], 1)
    np.testing.assert_array_equal(found, figures)


@pytest.fixture(scope="module")
def street():
    """A street of 128 x 128 x 8 voxels: ground, walls, cars with instance ids; a prediction that
    errs here and there; 8 origins.
    """
    rng = np.random.default_rng(1)
    spec = GridSpec.published("cartesian")
    truth, ids = np.zeros(spec.size, np.uint8), np.zeros(spec.size, np.uint32)
    truth[..., 0] = 6
    truth[:30, :, :6], truth[98:, :, :6] = 1, 1
    for number in range(1, 40):
        x, y = rng.integers(32, 92), rng.integers(0, 118)
        truth[x : x + 5, y : y + 10, 1:4], ids[x : x + 5, y : y + 10, 1:4] = 10, number
    pred = np.where(
        rng.random(spec.size) < 0.03, rng.integers(0, K, spec.size), np.roll(truth, 1, axis=0)
    ).astype(np.uint8)
    pred_ids = np.where(pred == 10, np.roll(ids, 1, axis=0), 0)
    origins = np.column_stack([np.zeros(8), np.linspace(-20, 20, 8), np.zeros(8)])
    return spec, (pred, pred_ids), (truth, ids), origins


@pytest.mark.benchmark(group="rays", timer=time.process_time)
def test_bench_rayiou(benchmark, street):
    spec, (pred, _), (truth, _), origins = street
    score = benchmark(lambda: RayIoU(K).update(pred, truth, spec, origins).compute().rayiou)
    assert 0 < score < 1


@pytest.mark.benchmark(group="rays", timer=time.process_time)
def test_bench_rayiou_in_numpy(benchmark, street):
    spec, (pred, _), (truth, _), origins = street
    score = benchmark.pedantic(
        rayiou, (pred, truth, spec, origins, rayiou_directions(), K), rounds=2
    )
    assert score == pytest.approx(
        RayIoU(K).update(pred, truth, spec, origins).compute().rayiou, abs=1e-9
    )


@pytest.mark.benchmark(group="segments", timer=time.process_time)
def test_bench_panoptic_quality(benchmark, street):
    _, pred, truth, _ = street
    assert (
        0 < benchmark(lambda: PanopticQuality(K, THINGS).update(pred, truth).compute().mean()) < 1
    )


@pytest.mark.benchmark(group="segments", timer=time.process_time)
def test_bench_panoptic_quality_in_numpy(benchmark, street):
    _, pred, truth, _ = street
    found = benchmark(panoptic_quality, pred, truth, K, THINGS)
    assert found == pytest.approx(PanopticQuality(K, THINGS).update(pred, truth).compute().mean())


@pytest.mark.benchmark(group="conventions", timer=time.process_time)
def test_bench_all_conventions(benchmark, frame, tmp_path):
    pred, target, counts = frame
    for name, labels in (("predicted", pred), ("true", target)):
        with (
            FolderSink(tmp_path / name) as sink,
            sink.sequence("Val/Town01_Light/cartesian") as writer,
        ):
            writer.write_document(
                "evaluation/params.json", to_json(GridSpec.published().to_params())
            )
            for number in range(FRAMES):
                writer.write("evaluation/labels", number, labels.astype(np.uint32))
                writer.write("evaluation/counts", number, counts)
    found = benchmark(evaluate_by_all_conventions, tmp_path / "predicted", tmp_path / "true")
    assert found["carlasc"].matrix.total == FRAMES * (counts > 0).sum()
