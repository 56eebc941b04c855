"""Scores of predicted probabilities: calibration error, likelihood and reliability diagrams (as
PaSCo reports them).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from carlasc.core.arrays import FloatArray, IntArray
from carlasc.errors import FormatError
from carlasc.metrics.confusion import check_free, check_ids, to_numpy
from carlasc.metrics.scoring import Summed

_BINS = 15  # of equal width
# maximum deviation of the sum of the probabilities of a voxel from 1; half precision has 5e-4
_TOLERANCE = 1e-3
_EPSILON = 1e-12  # added in the argument of the logarithm


@dataclass(frozen=True)
class Reliability:
    """A reliability diagram with bins of equal width of the probability of the predicted class.

    Attributes:
        count: (B,) number of voxels per bin.
        confidence: (B,) mean probability per bin; NaN for empty bins.
        accuracy: (B,) share of correctly predicted voxels per bin.
    """

    count: IntArray
    confidence: FloatArray
    accuracy: FloatArray

    @property
    def ece(self) -> float:
        """Expected calibration error: mean of |confidence - accuracy| over voxels; NaN without
        voxels.
        """
        if not self.count.sum():
            return float("nan")
        gap = np.nan_to_num(np.abs(self.confidence - self.accuracy))
        return float((gap * self.count).sum() / self.count.sum())


@dataclass(frozen=True)
class UncertaintyScore:
    """Calibration over all added frames.

    Attributes:
        ece_empty: calibration error of voxels that are predicted free, mean over frames.
        ece_occupied: calibration error of voxels that are predicted occupied, mean over frames.
        nll_empty: negative log-likelihood of the true class, mean over all voxels that are
            predicted free.
        nll_occupied: negative log-likelihood of the true class, mean over all voxels that are
            predicted occupied.
        empty: reliability of voxels that are predicted free, over all frames.
        occupied: reliability of voxels that are predicted occupied, over all frames.
    """

    ece_empty: float
    ece_occupied: float
    nll_empty: float
    nll_occupied: float
    empty: Reliability
    occupied: Reliability


class Uncertainty(Summed):
    """Accumulates the confidence and the accuracy of predictions.

    As in PaSCo, calibration errors are averaged over frames, likelihoods over voxels, and both are
    separate for voxels that are predicted free and occupied.

    Attributes:
        num_classes: K.
        free: id of free space.
    """

    _SETTINGS = ("num_classes", "free")
    _SUMS = ("sums", "nll", "ece")

    def __init__(self, num_classes: int, *, free: int = 0) -> None:
        check_free(free, num_classes)
        self.num_classes = num_classes
        self.free = free
        self.reset()

    def reset(self) -> None:
        """Set all sums to zero."""
        # (free or occupied prediction; count, confidence, correct; bin)
        self.sums = np.zeros((2, 3, _BINS))
        self.nll = np.zeros((2, 2))  # (free or occupied prediction; sum, count)
        # (free or occupied prediction; sum over frames, number of frames)
        self.ece = np.zeros((2, 2))

    def update(self, probabilities: Any, truth: ArrayLike, mask: ArrayLike | None = None) -> Self:
        """Add a frame.

        Args:
            probabilities: (..., K) float, with a sum of 1 per voxel; a NumPy array or torch tensor.
            truth: (...) class ids.
            mask: (...) bool: only these voxels are scored; None scores all.

        Returns:
            The metric itself.

        Raises:
            FormatError: shapes differ, or probabilities do not sum to one.
        """
        prob = to_numpy(probabilities)
        target = to_numpy(truth)
        if prob.shape != (*target.shape, self.num_classes):
            raise FormatError(
                "probabilities",
                expected=f"shape {(*target.shape, self.num_classes)}",
                found=prob.shape,
            )
        counted = (
            np.ones(target.shape, np.bool_) if mask is None else to_numpy(mask).astype(np.bool_)
        )
        prob = prob[counted].astype(np.float64)
        target = target[counted]
        off = np.abs(prob.sum(axis=1) - 1)
        if not (off <= _TOLERANCE).all() or (prob < 0).any():
            worst = int(np.nanargmax(np.where(np.isnan(off), np.inf, off))) if len(off) else 0
            raise FormatError(
                "probabilities",
                expected="values of 0 or more that sum to one per voxel",
                found=f"a sum of {prob[worst].sum():.4g} (lowest value {prob.min():.4g})",
                advice="apply a softmax first",
            )
        check_ids("truth", target, self.num_classes)
        predicted = prob.argmax(axis=1)
        confidence = prob.max(axis=1, initial=0.0)
        right = predicted == target
        loss = -np.log(prob[np.arange(len(target)), target] + _EPSILON)
        occupied = predicted != self.free
        for row, chosen in enumerate((~occupied, occupied)):
            # Bins are (low, high], so a confidence of exactly 1 is in the last bin.
            bins = np.clip(np.ceil(confidence[chosen] * _BINS).astype(int) - 1, 0, _BINS - 1)
            weights = None, confidence[chosen], right[chosen]
            sums: FloatArray = np.stack([np.bincount(bins, weight, _BINS) for weight in weights])
            self.sums[row] += sums
            if chosen.any():
                self.ece[row] += _reliability(sums).ece, 1
                self.nll[row] += loss[chosen].sum(), chosen.sum()
        return self

    def compute(self) -> UncertaintyScore:
        """Return the score of all added frames; NaN without voxels."""
        with np.errstate(invalid="ignore"):
            ece = self.ece[:, 0] / self.ece[:, 1]
            nll = self.nll[:, 0] / self.nll[:, 1]
        empty, occupied = map(_reliability, self.sums)
        return UncertaintyScore(
            float(ece[0]), float(ece[1]), float(nll[0]), float(nll[1]), empty, occupied
        )


def _reliability(sums: FloatArray) -> Reliability:
    count = sums[0]
    confidence, accuracy = np.divide(
        sums[1:], count, out=np.full((2, len(count)), np.nan), where=count > 0
    )
    return Reliability(count.astype(np.int64), confidence, accuracy)
