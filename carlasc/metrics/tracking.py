"""Quality of segmentation and tracking (LSTQ; Aygün et al., CVPR 2021): one number for each actor over time, and its classes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from carlasc.errors import FormatError
from carlasc.metrics.confusion import check_ids, ratio, to_numpy
from carlasc.metrics.summing import Summed

_Sizes = Counter[tuple[str | int, ...]]


@dataclass(frozen=True)
class TrackingScore:
    """Quality of segmentation and tracking.

    Attributes:
        lstq: square root of `association` times `classification`.
        association: S_assoc, the mean over all true actors of how well predicted numbers hold them in all frames.
        classification: S_cls, mean IoU of the classes that occur.
        actors: number of true actors.
    """

    lstq: float
    association: float
    classification: float
    actors: int


class TrackingQuality(Summed):
    """Adds up the frames of sequences, as SemanticKITTI's evaluation of 4D panoptic segmentation does.

    Attributes:
        num_classes: K; ids are 0..K-1.
        things: ids of the classes whose actors count.
        ignored: classes of the truth whose elements are left out.
        unaveraged: classes that are not in the mean IoU, such as free space.
        fewest: a true actor counts in the frames in which it has more elements than this.
    """

    _SETTINGS, _SUMS = (
        ("num_classes", "things", "ignored", "unaveraged", "fewest"),
        ("confusion", "predicted", "true", "common"),
    )

    def __init__(
        self,
        num_classes: int,
        things: Collection[int],
        *,
        ignored: Collection[int] = (),
        unaveraged: Collection[int] = (),
        fewest: int = 0,
    ) -> None:
        self.num_classes, self.things, self.ignored = num_classes, frozenset(things), frozenset(ignored)
        self.unaveraged, self.fewest = frozenset(unaveraged), fewest
        self.reset()

    def reset(self) -> None:
        """Remove everything that was added."""
        self.confusion = np.zeros((self.num_classes, self.num_classes), np.int64)  # predicted, true
        self.predicted: _Sizes = Counter()  # elements by sequence and number
        self.true: _Sizes = Counter()  # by sequence, class and number
        self.common: _Sizes = Counter()  # by sequence, class, true number and predicted number

    def update(
        self,
        sequence: str,
        prediction: tuple[ArrayLike, ArrayLike],
        truth: tuple[ArrayLike, ArrayLike],
        mask: ArrayLike | None = None,
    ) -> Self:
        """Add a frame.

        Args:
            sequence: the sequence that it is of; numbers are those of the whole sequence.
            prediction: class ids and numbers of actors, 0 for none, of equal shape.
            truth: likewise.
            mask: the same shape, bool: only these elements count.

        Raises:
            FormatError: shapes differ, or a class id is not below `num_classes`.
        """
        arrays = [to_numpy(array).reshape(-1) for side in (prediction, truth) for array in side]
        if len({array.shape for array in arrays}) > 1:
            found = " and ".join(str(array.shape) for array in arrays)
            raise FormatError("prediction", expected="classes and numbers of the truth's shape", found=found)
        for name, classes in (("prediction", arrays[0]), ("truth", arrays[2])):
            check_ids(name, classes, self.num_classes)
        counted = np.ones(len(arrays[0]), np.bool_) if mask is None else to_numpy(mask).astype(np.bool_).reshape(-1)
        counted = counted & ~np.isin(arrays[2], sorted(self.ignored))
        pred_class, pred, true_class, true = (array[counted].astype(np.int64) for array in arrays)
        k = self.num_classes
        self.confusion += np.bincount(pred_class * k + true_class, minlength=k * k).reshape(k, k)
        for number, size in _counts(pred[(pred > 0) & ~np.isin(pred_class, sorted(self.ignored))]):
            self.predicted[sequence, number] += size
        for label in self.things:
            own = (true_class == label) & (true > 0)
            for number, size in _counts(true[own]):
                if size > self.fewest:
                    self.true[sequence, label, number] += size
                    for other, common in _counts(pred[own & (true == number) & (pred > 0)]):
                        self.common[sequence, label, number, other] += common
        return self

    def compute(self) -> TrackingScore:
        """Return the scores of everything that was added; NaN where nothing occurs."""
        sums = dict.fromkeys(self.true, 0.0)
        for (sequence, label, number, other), common in self.common.items():
            predicted, true = self.predicted[sequence, other], self.true[sequence, label, number]
            if predicted:
                sums[sequence, label, number] += common * common / (true + predicted - common)
        quality = [total / self.true[key] for key, total in sums.items()]
        association = float(np.mean(quality)) if quality else float("nan")
        hit = self.confusion.diagonal()
        iou = ratio(hit, self.confusion.sum(axis=0) + self.confusion.sum(axis=1) - hit)
        iou = np.delete(iou, sorted(self.unaveraged | self.ignored))
        classification = float(np.nanmean(iou)) if (~np.isnan(iou)).any() else float("nan")
        return TrackingScore(float(np.sqrt(association * classification)), association, classification, len(quality))


def _counts(numbers: NDArray[np.int64]) -> list[tuple[int, int]]:
    found, sizes = np.unique(numbers, return_counts=True)
    return list(zip(found.tolist(), sizes.tolist(), strict=True))
