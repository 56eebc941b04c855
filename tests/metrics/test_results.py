from __future__ import annotations

import numpy as np
import pytest

from carlasc.errors import ArgumentError, MissingDataError
from carlasc.metrics import ConfusionMatrix, compare, confidence_interval, interval_of, jackknife
from carlasc.metrics.results import FigureTable


def matrices(accuracies, seed=0, size=4000):
    rng = np.random.default_rng(seed)
    found = {}
    for number, accuracy in enumerate(accuracies):
        truth = rng.integers(0, 3, size)
        pred = np.where(rng.random(size) < accuracy, truth, rng.integers(0, 3, size))
        found[f"s{number}"] = ConfusionMatrix(3).update(pred, truth)
    return found


def accuracy(matrix):
    return matrix.accuracy


def test_an_interval_holds_the_score_and_is_wide_where_sequences_differ():
    alike = confidence_interval(list(matrices([0.6] * 8).values()), accuracy)
    apart = confidence_interval(list(matrices(np.linspace(0.2, 0.9, 8)).values()), accuracy)
    for interval in (alike, apart):
        assert interval.low <= interval.value <= interval.high
    assert alike.high - alike.low < 0.03 < apart.high - apart.low
    # nothing is drawn
    assert confidence_interval(list(matrices([0.6] * 8).values()), accuracy) == alike


@pytest.mark.parametrize("number", [5, 8, 20])
def test_95_percent_of_intervals_hold_the_true_score_of_all_sequences(number):
    """The sequences differ much more than chance within each: the score is a ratio of sums."""
    rng = np.random.default_rng(number)
    held = 0
    for _ in range(1000):
        size = rng.integers(300, 600, number)
        right = rng.binomial(size, rng.beta(6, 4, number))

        def ratio(counts):
            return float(counts[:, 0].sum() / counts[:, 1].sum())

        counts = np.stack([right, size], axis=1)
        interval = interval_of(ratio(counts), jackknife(ratio, counts))
        held += interval.low <= 0.6 <= interval.high
    assert 930 <= held <= 970


def test_95_percent_of_intervals_hold_a_difference_over_few_seeds_and_drives():
    """Three seeds of each network, and six drives that both have: the two variances differ."""
    rng = np.random.default_rng(0)
    held = 0
    for _ in range(1000):
        drives = rng.normal(0, 2, 6)
        seeds = [rng.normal(0, deviation, 3) for deviation in (3, 1)]
        parts = [(seed.var(ddof=1) / 3, 2) for seed in seeds]
        value = drives.mean() + seeds[0].mean() - seeds[1].mean()
        interval = interval_of(value, (drives.var(ddof=1) / 6, 5), *parts)
        held += interval.low <= 0 <= interval.high
    assert 930 <= held <= 970


@pytest.mark.parametrize(
    ("degrees", "bound"), [(1, 12.706), (2, 4.303), (4.5, 2.659), (1e9, 1.962)]
)
def test_bounds_are_those_of_the_tables_of_student(degrees, bound):
    assert interval_of(3.0, (1.0, degrees)).high == pytest.approx(3 + bound, abs=2e-3)


def test_a_clear_difference_is_seen():
    rng = np.random.default_rng(2)
    hard = rng.uniform(0.3, 0.8, 7)  # sequences differ much more than the two predictions
    base, better = matrices(hard, 3), matrices(hard + 0.05, 4)
    found = compare(better, base, accuracy)
    assert found.p_value < 0.05
    assert 0 < found.difference.low < found.difference.value < found.difference.high
    assert compare(base, base, accuracy).p_value == 1.0
    assert compare(base, better, accuracy).difference.value == pytest.approx(
        -found.difference.value
    )
    assert found.sequences == tuple(sorted(base))


@pytest.mark.slow
def test_the_test_of_equals_is_wrong_as_often_as_it_says():
    rng = np.random.default_rng(6)
    p_values = []
    for trial in range(60):
        hard = rng.uniform(0.3, 0.8, 6)
        p_values.append(
            compare(matrices(hard, trial, 400), matrices(hard, 1000 + trial, 400), accuracy).p_value
        )
    assert np.mean(np.array(p_values) < 0.1) < 0.25
    assert np.mean(np.array(p_values) < 0.5) > 0.25


def test_fewer_than_five_sequences_say_nothing():
    few = matrices([0.5] * 4)
    with pytest.raises(ArgumentError, match="at least 5 sequences, found 4"):
        confidence_interval(list(few.values()), accuracy)
    with pytest.raises(ArgumentError, match="at least 5"):
        compare(few, few, accuracy)
    with pytest.raises(MissingDataError, match="sequences of the first"):
        compare(matrices([0.5] * 6), {"other": few["s0"]}, accuracy)


def test_only_sequences_that_both_have_are_compared():
    first, second = matrices([0.7] * 7), matrices([0.5] * 7)
    del second["s3"]
    assert compare(first, second, accuracy).sequences == ("s0", "s1", "s2", "s4", "s5", "s6")


def test_a_name_is_text_in_markdown_and_latex():
    name = r"<script>a|b</script>\\input{x}~^"
    table = FigureTable(name, ("Network", "mIoU"), ((name, 1.0),))
    row = table.to_markdown().splitlines()[-1]
    assert row == r"| &lt;script>a\|b&lt;/script>\\input{x}~^ | 1.00 |"
    escaped = r"\textbackslash{}\textbackslash{}input\{x\}\textasciitilde{}\textasciicircum{}"
    assert rf"<script>a|b</script>{escaped} & 1.00 \\" in table.to_latex()
