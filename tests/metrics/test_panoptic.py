"""Panoptic quality against a plain comparison of every pair of segments."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.errors import raises
from hypothesis import given, settings
from hypothesis import strategies as st

from carlasc.errors import ArgumentError, FormatError
from carlasc.metrics import PanopticQuality

K, THINGS = 6, frozenset({3, 4})


def frame(seed, shape=(12, 10, 3)):
    """Blocks of things on a ground of stuff, and the same with some of it moved and some wrong."""
    rng = np.random.default_rng(seed)
    classes, ids = np.zeros(shape, np.uint8), np.zeros(shape, np.uint32)
    classes[..., 0] = rng.choice([1, 2])
    for number in range(1, 7):
        x, y = rng.integers(0, 9, 2)
        classes[x : x + 3, y : y + 2, 1:], ids[x : x + 3, y : y + 2, 1:] = (
            rng.choice([3, 4]),
            number,
        )
    pred, pred_ids = np.roll(classes, rng.integers(0, 2), 0), np.roll(ids, rng.integers(0, 2), 0)
    wrong = rng.random(shape) < 0.1
    pred[wrong] = rng.integers(0, K, wrong.sum())
    return (pred, pred_ids), (classes, ids)


def plain(frames, variant="standard"):
    """PQ, SQ and RQ of each class, every pair of segments compared."""
    found = np.full((3, K), np.nan)
    for c in range(1, K):
        tp, fp, fn, iou_sum = 0, 0, 0, 0.0
        for pred, truth in frames:
            sides = []
            for classes, ids in (pred, truth):
                numbers = ids if c in THINGS else np.zeros_like(ids)
                masks = [(classes == c) & (numbers == i) for i in np.unique(numbers[classes == c])]
                sides.append(masks)
            matched = set()
            for i, a in enumerate(sides[0]):
                for j, b in enumerate(sides[1]):
                    iou = (a & b).sum() / (a | b).sum()
                    if iou > 0.5 or (variant == "pasco" and c not in THINGS and iou > 0):
                        matched |= {("p", i), ("t", j)}
                        tp, iou_sum = tp + 1, iou_sum + iou
            fp += sum(("p", i) not in matched for i in range(len(sides[0])))
            fn += sum(("t", j) not in matched for j in range(len(sides[1])))
        if tp + fp + fn:
            found[:, c] = (
                iou_sum / (tp + fp / 2 + fn / 2),
                iou_sum / tp if tp else 0,
                tp / (tp + fp / 2 + fn / 2),
            )
    return found


@pytest.mark.parametrize("variant", ["standard", "pasco"])
def test_every_class_is_that_of_the_plain_comparison(variant):
    frames = [frame(seed) for seed in range(6)]
    metric = PanopticQuality(K, THINGS, variant=variant)
    for pred, truth in frames:
        metric.update(pred, truth)
    score, (pq, sq, rq) = metric.compute(), plain(frames, variant)
    np.testing.assert_allclose(score.pq, pq)
    np.testing.assert_allclose(score.sq, sq)
    np.testing.assert_allclose(score.rq, rq)
    assert score.mean("pq") == pytest.approx(np.nanmean(pq))
    assert score.mean("rq", "things") == pytest.approx(np.nanmean(rq[[3, 4]]))
    assert score.mean("sq", "stuff") == pytest.approx(np.nanmean(sq[[1, 2, 5]]))


def test_pq_dagger_takes_the_iou_of_stuff():
    pred, truth = frame(3)
    score = PanopticQuality(K, THINGS).update(pred, truth).compute()
    occurs = ~np.isnan(score.pq)
    iou = np.array(
        [
            ((pred[0] == c) & (truth[0] == c)).sum()
            / max(1, ((pred[0] == c) | (truth[0] == c)).sum())
            for c in range(K)
        ]
    )
    expected = [score.pq[c] if c in THINGS else iou[c] for c in range(K) if occurs[c]]
    assert score.pq_dagger == pytest.approx(np.mean(expected))


def test_a_stuff_segment_that_overlaps_a_little_is_wrong_unless_pasco_scores():
    truth, pred = np.zeros(10, int), np.zeros(10, int)
    truth[:5], pred[4:9] = 1, 1
    ids = np.zeros(10, int)
    assert PanopticQuality(K, THINGS).update((pred, ids), (truth, ids)).compute().pq[1] == 0.0
    assert PanopticQuality(K, THINGS, variant="pasco").update(
        (pred, ids), (truth, ids)
    ).compute().pq[1] == pytest.approx(1 / 9)


@settings(max_examples=20, deadline=None)
@given(st.permutations(range(4)), st.permutations(range(K)))
def test_neither_the_order_of_merging_nor_the_numbers_of_classes_matter(order, numbers):
    frames = [frame(seed) for seed in range(4)]
    whole = PanopticQuality(K, THINGS)
    for pred, truth in frames:
        whole.update(pred, truth)
    numbers = np.array(numbers)
    renamed = PanopticQuality(K, frozenset(int(numbers[t]) for t in THINGS), free=int(numbers[0]))
    for index in order:
        (pred, pred_ids), (truth, ids) = frames[index]
        part = PanopticQuality(K, renamed.things, free=renamed.free)
        renamed.merge(part.update((numbers[pred], pred_ids), (numbers[truth], ids)))
    np.testing.assert_allclose(renamed.compute().pq[numbers], whole.compute().pq)


def test_a_perfect_prediction_scores_one_and_nothing_scores_nothing():
    _, truth = frame(1)
    assert PanopticQuality(K, THINGS).update(truth, truth).compute().mean() == 1.0
    metric = PanopticQuality(K, THINGS)
    assert math.isnan(metric.compute().mean())
    metric.update(truth, truth).reset()
    assert math.isnan(metric.compute().mean())


def test_only_the_elements_of_the_mask_count():
    pred, truth = frame(2)
    mask = np.random.default_rng(0).random(truth[0].shape) < 0.5
    flat = tuple(tuple(a[mask] for a in side) for side in (pred, truth))
    np.testing.assert_array_equal(
        PanopticQuality(K, THINGS).update(pred, truth, mask).compute().pq,
        PanopticQuality(K, THINGS).update(*flat).compute().pq,
    )


def test_wrong_input_is_named():
    _, truth = frame(0)
    with pytest.raises(FormatError, match="prediction: expected classes and instances"):
        PanopticQuality(K, THINGS).update((truth[0][:2], truth[1]), truth)
    with raises(FormatError, where="prediction", expected=r"class ids 0\.\.5", found="from 9 to 9"):
        PanopticQuality(K, THINGS).update((np.full_like(truth[0], 9), truth[1]), truth)
    with pytest.raises(ArgumentError, match="things"):
        PanopticQuality(K, frozenset({0}))
    with pytest.raises(ArgumentError, match="variant"):
        PanopticQuality(K, THINGS, variant="other")
    with pytest.raises(ArgumentError, match=r"expected a \w+ with \w+ "):
        PanopticQuality(K, THINGS).merge(PanopticQuality(K, frozenset()))
