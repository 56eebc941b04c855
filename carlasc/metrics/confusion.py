"""The confusion matrix and the figures computed from it.

Matrices of frames, sequences and processes can be added. Every figure is computed from the sum, as the paper does over a whole split.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from carlasc.core.grids import Grid
from carlasc.errors import ArgumentError, FormatError
from carlasc.metrics.counting import Labels, count_arrays, count_tensors, device_of

Absent = Literal["zero", "skip"]


@dataclass(frozen=True)
class Completeness:
    """Scores of occupied against free space: all classes other than free count as one. NaN where the divisor is zero.

    Attributes:
        precision: share of the voxels predicted as occupied that are occupied.
        recall: share of the occupied voxels that are predicted as occupied.
        iou: intersection over union of the predicted and the true occupied voxels.
    """

    precision: float
    recall: float
    iou: float


class ConfusionMatrix:
    """The number of voxels of each true class that were predicted as each class.

    Attributes:
        num_classes: K; ids are 0..K-1.
        free: the id of free space.
        counts: (K, K) int64, truth in rows, prediction in columns.
    """

    def __init__(self, num_classes: int, *, free: int = 0, counts: NDArray[np.integer] | None = None) -> None:
        """Start with an empty matrix, or with `counts`.

        Raises:
            ArgumentError: `num_classes` is less than 1, `free` is not one of the ids, or `counts` has another shape.
        """
        if num_classes < 1:
            raise ArgumentError("num_classes", expected="1 or more", found=str(num_classes))
        if not 0 <= free < num_classes:
            raise ArgumentError("free", expected=f"a class id in 0..{num_classes - 1}", found=str(free))
        if counts is not None and np.shape(counts) != (num_classes, num_classes):
            raise ArgumentError(
                "counts", expected=f"the shape {(num_classes, num_classes)}", found=str(np.shape(counts))
            )
        self.num_classes = num_classes
        self.free = free
        self.counts: NDArray[np.int64] = np.zeros((num_classes, num_classes), np.int64)
        if counts is not None:
            self.counts += counts

    def update(self, prediction: Labels, truth: Labels, mask: Labels | None = None) -> Self:
        """Add the voxels of a prediction and its truth.

        NumPy arrays and torch tensors are accepted, on any device; tensors are counted on their own device.

        Args:
            prediction: any shape, integer class ids.
            truth: the same shape, integer class ids.
            mask: the same shape, bool: only these voxels count. The ids of the others may have any value.

        Returns:
            The matrix itself.

        Raises:
            FormatError: shapes differ, labels are not integers, or an id that counts is not in 0..K-1.
        """
        for name, array in (("prediction", prediction), ("mask", mask)):
            if array is not None and np.shape(array) != np.shape(truth):
                raise FormatError(
                    name, expected=f"the truth's shape {tuple(np.shape(truth))}", found=str(tuple(np.shape(array)))
                )
        device = device_of(prediction, truth, mask)
        if device is None:  # torch tensors on the CPU are NumPy arrays without a copy
            known = None if mask is None else np.asarray(mask)
            self.counts += count_arrays(np.asarray(prediction), np.asarray(truth), known, self.num_classes)
        else:
            self.counts += count_tensors(device, prediction, truth, mask, self.num_classes)
        return self

    def reset(self) -> None:
        """Set all counts to zero."""
        self.counts[:] = 0

    def merge(self, other: ConfusionMatrix) -> Self:
        """Add what another matrix has counted, in any order; the same as `+=`."""
        return self.__iadd__(other)

    def compute(self) -> dict[str, float]:
        """Return the usual figures by name: `miou`, `accuracy`, and `precision`, `recall` and `iou` of occupied space."""
        return {"miou": self.miou, "accuracy": self.accuracy, **vars(self.completeness())}

    def __iadd__(self, other: ConfusionMatrix) -> Self:
        if (other.num_classes, other.free) != (self.num_classes, self.free):
            raise ArgumentError(
                "confusion matrix",
                expected=f"{self.num_classes} classes with free {self.free}",
                found=f"{other.num_classes} classes with free {other.free}",
            )
        self.counts += other.counts
        return self

    def __add__(self, other: ConfusionMatrix) -> ConfusionMatrix:
        total = ConfusionMatrix(self.num_classes, free=self.free, counts=self.counts)
        total += other
        return total

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, ConfusionMatrix) and self.free == other.free and np.array_equal(self.counts, other.counts)
        )

    __hash__ = None  # type: ignore[assignment]  # matrices are mutable

    def __repr__(self) -> str:
        return f"<ConfusionMatrix of {self.num_classes} classes, {self.total} voxels>"

    @property
    def total(self) -> int:
        """Number of voxels counted."""
        return int(self.counts.sum())

    @property
    def true_positives(self) -> NDArray[np.int64]:
        """(K,) number of voxels of each class that are predicted as this class."""
        return np.diagonal(self.counts).copy()

    @property
    def false_positives(self) -> NDArray[np.int64]:
        """(K,) number of voxels of other classes that are predicted as each class."""
        return self.counts.sum(axis=0) - np.diagonal(self.counts)

    @property
    def false_negatives(self) -> NDArray[np.int64]:
        """(K,) number of voxels of each class that are predicted as another class."""
        return self.counts.sum(axis=1) - np.diagonal(self.counts)

    @property
    def iou(self) -> NDArray[np.float64]:
        """(K,) intersection over union of each class; NaN for a class that is in neither the prediction nor the truth."""
        return _ratio(self.true_positives, self.true_positives + self.false_positives + self.false_negatives)

    @property
    def precision(self) -> NDArray[np.float64]:
        """(K,) share of the voxels predicted as a class that are of this class; NaN for a class that is never predicted."""
        return _ratio(self.true_positives, self.counts.sum(axis=0))

    @property
    def recall(self) -> NDArray[np.float64]:
        """(K,) share of the voxels of a class that are predicted as this class; NaN for a class that is not in the truth."""
        return _ratio(self.true_positives, self.counts.sum(axis=1))

    @property
    def miou(self) -> float:
        """The paper's mIoU: the mean over all classes, including free; a class in neither prediction nor truth counts as zero."""
        return self.mean_iou()

    def mean_iou(self, *, with_free: bool = True, absent: Absent = "zero") -> float:
        """Return the mean IoU over the classes.

        Args:
            with_free: include free space in the mean (CarlaSC's paper does, SemanticKITTI does not).
            absent: value of a class that is in neither the prediction nor the truth: "zero" (the paper and SemanticKITTI),
                or "skip", which leaves it out of the mean. The mean of no class is NaN.

        Raises:
            ArgumentError: `absent` is something else.
        """
        check_absent(absent)
        iou = self.iou if with_free else np.delete(self.iou, self.free)
        iou = np.nan_to_num(iou) if absent == "zero" else iou[~np.isnan(iou)]
        return float(iou.mean()) if len(iou) else float("nan")

    @property
    def accuracy(self) -> float:
        """Share of the voxels that are predicted correctly; NaN if no voxel was counted."""
        return float(_ratio(np.trace(self.counts), self.counts.sum()))

    def completeness(self) -> Completeness:
        """Return precision, recall and IoU of occupied against free space."""
        occupied = np.arange(self.num_classes) != self.free
        hit = self.counts[np.ix_(occupied, occupied)].sum()
        predicted, true = self.counts[:, occupied].sum(), self.counts[occupied].sum()
        return Completeness(
            float(_ratio(hit, predicted)), float(_ratio(hit, true)), float(_ratio(hit, predicted + true - hit))
        )


def check_absent(absent: str) -> None:
    """Check a value of `absent`.

    Raises:
        ArgumentError: it is not "zero" or "skip".
    """
    if absent not in ("zero", "skip"):
        raise ArgumentError("absent", expected="zero or skip", found=repr(absent))


def _ratio(numerator: Any, denominator: Any) -> NDArray[np.float64]:
    """Divide; NaN where the denominator is zero."""
    numerator, denominator = np.asarray(numerator, np.float64), np.asarray(denominator, np.float64)
    return np.divide(numerator, denominator, out=np.full(denominator.shape, np.nan), where=denominator > 0)


@dataclass(frozen=True)
class TruthScore:
    """The comparison of a ground truth with a reference. Scores of frames are added with `+`.

    Attributes:
        matrix: confusion matrix over the voxels that are known in both grids, the reference in rows.
        known: number of voxels that are known in the grid.
        known_reference: number of voxels that are known in the reference.
        known_both: number of voxels that are known in both.
    """

    matrix: ConfusionMatrix
    known: int
    known_reference: int
    known_both: int

    @property
    def coverage(self) -> float:
        """Share of the voxels known in the reference that are known in the grid too; NaN if the reference has none."""
        return self.known_both / self.known_reference if self.known_reference else float("nan")

    @property
    def accuracy(self) -> float:
        """Share of the voxels known in both grids whose classes agree."""
        return self.matrix.accuracy

    def __add__(self, other: TruthScore) -> TruthScore:
        return TruthScore(
            self.matrix + other.matrix,
            self.known + other.known,
            self.known_reference + other.known_reference,
            self.known_both + other.known_both,
        )


def score_truth(grid: Grid, reference: Grid, num_classes: int, mask: NDArray[np.bool_] | None = None) -> TruthScore:
    """Score a ground truth grid against a reference, over the voxels that are known in both.

    Args:
        grid: the grid that is scored; voxels with count 0 are unknown.
        reference: the grid that is taken to be correct, with the same spec.
        num_classes: number of classes; ids are below it.
        mask: (X, Y, Z) bool: only these voxels are scored, such as a distance band; None scores all.

    Raises:
        FormatError: the grids differ in geometry, or an id is out of range.
    """
    if grid.spec != reference.spec:
        raise FormatError("grid", expected=f"the reference's {reference.spec}", found=f"{grid.spec}, or other bounds")
    selected = np.ones(grid.spec.size, np.bool_) if mask is None else mask
    known, known_reference = grid.known & selected, reference.known & selected
    both = known & known_reference
    matrix = ConfusionMatrix(num_classes).update(grid.labels, reference.labels, both)
    return TruthScore(matrix, int(known.sum()), int(known_reference.sum()), int(both.sum()))
