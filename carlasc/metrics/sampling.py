"""Statistical uncertainty of scores: confidence intervals by bootstrap over sequences, and a paired test of two predictions.

Sequences are drawn instead of frames, because the frames of one sequence show nearly the same scene.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import ArgumentError, MissingDataError
from carlasc.metrics.confusion import ConfusionMatrix

Score = Callable[[ConfusionMatrix], float]
FEWEST_SEQUENCES = 5
_DRAWS, _SEED, _EXACT = 2000, 0, 12


@dataclass(frozen=True)
class Interval:
    """A confidence interval.

    Attributes:
        value: the score of all sequences together.
        low: lower end.
        high: upper end.
        level: confidence level: share of such intervals that contain the true value.
    """

    value: float
    low: float
    high: float
    level: float


@dataclass(frozen=True)
class Comparison:
    """Two predictions of the same sequences.

    Attributes:
        difference: score of the first minus that of the second, with its interval.
        p_value: probability of a difference at least as large if both are equally good.
        sequences: the sequences that both predictions have.
    """

    difference: Interval
    p_value: float
    sequences: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the figures by name, as fractions, for JSON."""
        return {
            "difference": self.difference.value,
            "interval": [self.difference.low, self.difference.high],
            "p_value": self.p_value,
            "sequences": list(self.sequences),
        }


def bootstrap(matrices: Sequence[ConfusionMatrix], score: Score, *, level: float = 0.95) -> Interval:
    """Return a score with its confidence interval by bootstrap: sequences are drawn again with replacement.

    Args:
        matrices: confusion matrix of each sequence.
        score: function that computes the score from the sum of the matrices.
        level: confidence level of the interval.

    Raises:
        ArgumentError: there are fewer than five sequences.
    """
    _check_number(len(matrices))
    counts = np.stack([matrix.counts for matrix in matrices])
    draws = np.random.default_rng(_SEED).integers(0, len(counts), (_DRAWS, len(counts)))
    values = [score(_matrix(counts[draw].sum(axis=0), matrices[0])) for draw in draws]
    return _interval(score(_matrix(counts.sum(axis=0), matrices[0])), values, level)


def compare(
    first: Mapping[str, ConfusionMatrix], second: Mapping[str, ConfusionMatrix], score: Score, *, level: float = 0.95
) -> Comparison:
    """Compare two predictions, sequence by sequence.

    For the interval, the same sequences are drawn again for both predictions. For the p-value, the two predictions are swapped in some of
    the sequences: in all possible ways for up to twelve sequences, in 2,000 random ways for more.

    Args:
        first: confusion matrix of each sequence, by path.
        second: likewise; sequences that only one of them has are left out.
        score: function that computes the score from a sum of matrices.
        level: confidence level of the interval.

    Raises:
        MissingDataError: they have no sequence in common.
        ArgumentError: they have fewer than five in common.
    """
    common = tuple(sorted(set(first) & set(second)))
    if not common:
        raise MissingDataError("second", expected="sequences of the first", found=", ".join(sorted(second)) or "none")
    _check_number(len(common))
    like = first[common[0]]
    a, b = (np.stack([side[path].counts for path in common]) for side in (first, second))

    def difference(one: NDArray[np.int64], other: NDArray[np.int64]) -> float:
        return score(_matrix(one, like)) - score(_matrix(other, like))

    found = difference(a.sum(axis=0), b.sum(axis=0))
    rng = np.random.default_rng(_SEED)
    draws = rng.integers(0, len(common), (_DRAWS, len(common)))
    spread = [difference(a[draw].sum(axis=0), b[draw].sum(axis=0)) for draw in draws]
    if len(common) <= _EXACT:
        swaps = (np.arange(2 ** len(common))[:, None] >> np.arange(len(common)) & 1).astype(bool)
    else:
        swaps = rng.random((_DRAWS, len(common))) < 0.5
        swaps[0] = False  # the actual assignment is one of them
    swapped = [
        difference(np.where(s[:, None, None], b, a).sum(axis=0), np.where(s[:, None, None], a, b).sum(axis=0))
        for s in swaps
    ]
    p_value = float(np.mean(np.abs(swapped) >= abs(found) - 1e-12))
    return Comparison(_interval(found, spread, level), p_value, common)


def _check_number(sequences: int) -> None:
    if sequences < FEWEST_SEQUENCES:
        raise ArgumentError("sequences", expected=f"at least {FEWEST_SEQUENCES} to draw from", found=str(sequences))


def _matrix(counts: NDArray[np.int64], like: ConfusionMatrix) -> ConfusionMatrix:
    return ConfusionMatrix(like.num_classes, free=like.free, counts=counts)


def _interval(value: float, draws: Sequence[float], level: float) -> Interval:
    present = np.array(draws)[~np.isnan(draws)]
    if not len(present):
        return Interval(value, float("nan"), float("nan"), level)
    low, high = np.quantile(present, [(1 - level) / 2, (1 + level) / 2])
    return Interval(value, float(low), float(high), level)
