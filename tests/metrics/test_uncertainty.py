"""Calibration and likelihood against plain loops."""

from __future__ import annotations

import math

import numpy as np
import pytest

from carlasc.errors import ArgumentError, FormatError
from carlasc.metrics import Uncertainty

K = 4


def frame(seed, count=400):
    rng = np.random.default_rng(seed)
    prob = rng.dirichlet(np.full(K, 0.5), count)
    truth = np.array([rng.choice(K, p=row**0.7 / (row**0.7).sum()) for row in prob])
    return prob, truth


def plain_ece(prob, truth, bins=15):
    confidence, right = prob.max(axis=1), prob.argmax(axis=1) == truth
    error = 0.0
    for b in range(bins):
        inside = (confidence > b / bins) & (confidence <= (b + 1) / bins)
        if inside.any():
            error += (
                inside.sum() / len(truth) * abs(confidence[inside].mean() - right[inside].mean())
            )
    return error


def test_errors_are_means_of_frames_and_likelihoods_are_pooled():
    frames = [frame(seed, 300 + 100 * seed) for seed in range(3)]
    metric = Uncertainty(K)
    for prob, truth in frames:
        metric.update(prob, truth)
    score = metric.compute()
    for name, chosen in (
        ("empty", lambda p: p.argmax(1) == 0),
        ("occupied", lambda p: p.argmax(1) != 0),
    ):
        parts = [(p[chosen(p)], t[chosen(p)]) for p, t in frames]
        assert getattr(score, f"ece_{name}") == pytest.approx(
            np.mean([plain_ece(*part) for part in parts])
        )
        pooled = np.concatenate([-np.log(p[np.arange(len(t)), t] + 1e-12) for p, t in parts])
        assert getattr(score, f"nll_{name}") == pytest.approx(pooled.mean())
        reliability = getattr(score, name)
        assert reliability.count.sum() == sum(len(t) for _, t in parts)
        together = tuple(np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        assert reliability.ece == pytest.approx(plain_ece(*together))


def test_certain_and_right_has_no_error_and_certain_and_wrong_has_all():
    prob, truth = np.eye(K)[[1, 2, 3, 1]], np.array([1, 2, 3, 1])
    score = Uncertainty(K).update(prob, truth).compute()
    assert score.ece_occupied == 0.0
    assert score.nll_occupied == pytest.approx(0.0, abs=1e-9)
    assert math.isnan(score.ece_empty)
    assert Uncertainty(K).update(prob, np.roll(truth, 1)).compute().ece_occupied == pytest.approx(
        0.75
    )


def test_merged_in_any_order_it_is_the_same():
    frames = [frame(seed) for seed in range(3)]
    whole = Uncertainty(K)
    for prob, truth in frames:
        whole.update(prob, truth)
    parts = [Uncertainty(K).update(*f) for f in frames]
    merged = Uncertainty(K).merge(parts[2]).merge(parts[0]).merge(parts[1])
    assert merged.compute().ece_occupied == pytest.approx(whole.compute().ece_occupied)
    np.testing.assert_array_equal(merged.compute().empty.count, whole.compute().empty.count)
    whole.reset()
    assert whole.compute().occupied.count.sum() == 0
    with pytest.raises(ArgumentError, match=r"expected a \w+ with \w+ "):
        whole.merge(Uncertainty(K + 1))


def test_only_the_voxels_of_the_mask_count_and_tensors_do_as_arrays():
    torch = pytest.importorskip("torch")
    prob, truth = frame(5)
    mask = np.arange(len(truth)) % 3 == 0
    alone = Uncertainty(K).update(prob[mask], truth[mask]).compute()
    masked = Uncertainty(K).update(torch.from_numpy(prob), truth, mask).compute()
    assert masked.ece_occupied == pytest.approx(alone.ece_occupied)
    assert masked.nll_empty == pytest.approx(alone.nll_empty)


def test_probabilities_that_do_not_sum_to_one_are_refused():
    prob, truth = frame(0)
    with pytest.raises(FormatError, match="sum to one per voxel, found a sum of 2 .*softmax"):
        Uncertainty(K).update(2 * prob, truth)
    with pytest.raises(FormatError, match="sum to one"):
        Uncertainty(K).update(np.where(np.arange(K) == 0, np.nan, prob), truth)
    with pytest.raises(FormatError, match=r"shape \(400, 4\)"):
        Uncertainty(K).update(prob[:, :3], truth)
