"""LSTQ: the example of semantic-kitti-api, and random frames against the definition in plain loops."""

import math

import numpy as np
import pytest
from helpers.errors import raises

from carlasc.errors import ArgumentError, FormatError
from carlasc.metrics import TrackingQuality


def test_the_example_of_semantickittis_evaluation():
    true_class = np.array([0] * 5 + [1] * 5 + [2] * 10)
    true = np.array([0] * 5 + [1] * 10 + [2] * 5)
    pred_class = np.array([0] * 5 + [1] * 5 + [2] * 5 + [1] * 5)
    pred = np.array([0] * 5 + [1] * 5 + [2] * 10)
    metric = TrackingQuality(3, {1, 2}, ignored={0}, fewest=1)
    score = metric.update("1", (pred_class, pred), (true_class, true)).compute()
    assert score.lstq == pytest.approx(math.sqrt(1 / 3)) and score.association == pytest.approx(
        2 / 3
    )
    assert score.classification == 0.5 and score.actors == 3


def plain(frames, things, ignored, fewest):
    """Return LSTQ by its definition: loops over sequences, classes, true actors and predicted
    numbers.
    """
    confusion, qualities = np.zeros((5, 5), int), []
    frames = [
        (
            name,
            *(
                array[~np.isin(true_class, ignored)]
                for array in (pred_class, pred, true_class, true)
            ),
        )
        for name, pred_class, pred, true_class, true in frames
    ]
    for _, pred_class, _, true_class, _ in frames:
        np.add.at(confusion, (pred_class, true_class), 1)
    for name in {frame[0] for frame in frames}:
        own = [frame[1:] for frame in frames if frame[0] == name]
        for label in things:
            for actor in {
                int(n) for *_, true_class, true in own for n in true[true_class == label]
            } - {0}:
                held = [(t_c == label) & (t == actor) for *_, t_c, t in own]
                held = [mask * (mask.sum() > fewest) for mask in held]
                size = sum(mask.sum() for mask in held)
                if not size:
                    continue
                total = 0.0
                for number in {int(n) for _, pred, *_ in own for n in pred} - {0}:
                    whole = sum(
                        ((p == number) & ~np.isin(p_c, ignored)).sum() for p_c, p, *_ in own
                    )
                    common = sum(
                        (mask & (p == number)).sum()
                        for mask, (_, p, *_) in zip(held, own, strict=True)
                    )
                    if whole:
                        total += common * common / (size + whole - common)
                qualities.append(total / size)
    hits = confusion.diagonal()
    union = confusion.sum(0) + confusion.sum(1) - hits
    iou = [hits[k] / union[k] for k in range(5) if union[k] and k not in ignored]
    return math.sqrt(np.mean(qualities) * np.mean(iou)), np.mean(qualities), np.mean(iou)


@pytest.mark.parametrize(("ignored", "fewest"), [((), 0), ((0,), 0), ((0,), 7), ((0, 3), 2)])
def test_it_follows_the_definition_and_parts_can_be_merged(ignored, fewest):
    rng = np.random.default_rng(fewest)
    frames = []
    for number in range(6):
        true_class, true = rng.integers(0, 5, 300), rng.integers(0, 9, 300)
        pred_class = np.where(rng.random(300) < 0.7, true_class, rng.integers(0, 5, 300))
        pred = np.where(rng.random(300) < 0.6, true + 3, rng.integers(0, 12, 300))
        frames.append((f"s{number % 2}", pred_class, pred, true_class, true))
    parts = [TrackingQuality(5, {1, 2}, ignored=ignored, fewest=fewest) for _ in range(2)]
    for number, (name, *arrays) in enumerate(frames):
        parts[number // 4].update(name, arrays[:2], arrays[2:])
    score = parts[0].merge(parts[1]).compute()
    wanted = plain(frames, (1, 2), ignored, fewest)
    assert (score.lstq, score.association, score.classification) == pytest.approx(wanted)


def test_nothing_is_no_number_and_wrong_input_is_refused():
    metric = TrackingQuality(3, {1})
    assert math.isnan(metric.compute().lstq)
    with raises(FormatError, expected="classes and instances with the shape"):
        metric.update(
            "", (np.zeros(3, int), np.zeros(3, int)), (np.zeros(3, int), np.zeros(2, int))
        )
    with pytest.raises(FormatError, match="truth"):
        metric.update("", (np.zeros(3, int), np.zeros(3, int)), (np.full(3, 3), np.zeros(3, int)))
    with pytest.raises(ArgumentError, match=r"expected a \w+ with \w+ "):
        metric.merge(TrackingQuality(3, {2}))
