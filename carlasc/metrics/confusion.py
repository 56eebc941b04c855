"""The confusion matrix, and the figures that follow from it.

Sums come first, quotients last: matrices of frames, sequences and processes add up, and every figure is taken from the sum, as
the paper does over a whole split.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Self

import numba
import numpy as np
from numpy.typing import NDArray

from carlasc.errors import ArgumentError, FormatError

if TYPE_CHECKING:
    import torch

    Labels = NDArray[Any] | torch.Tensor
else:
    Labels = Any

Absent = Literal["zero", "skip"]


@dataclass(frozen=True)
class Completeness:
    """How well the occupied space is found, whatever its class: every class but free is one.

    Attributes:
        precision: share of the voxels predicted as occupied that are.
        recall: share of the occupied voxels that are predicted so.
        iou: intersection over union of the two; each NaN where there is nothing to divide by.
    """

    precision: float
    recall: float
    iou: float


class ConfusionMatrix:
    """Counts how often each class was predicted as each.

    Attributes:
        num_classes: K; ids are 0..K-1.
        free: the id of free space, which is no class of things.
        counts: (K, K) int64, truth in rows, prediction in columns.
    """

    def __init__(self, num_classes: int, *, free: int = 0, counts: NDArray[np.integer] | None = None) -> None:
        """Start with an empty matrix, or with `counts`.

        Raises:
            ArgumentError: no class at all, `free` is none of them, or `counts` is of another shape.
        """
        if num_classes < 1 or not 0 <= free < num_classes:
            raise ArgumentError(
                "confusion matrix", expected="classes with free among them", found=f"{num_classes} classes, free {free}"
            )
        if counts is not None and np.shape(counts) != (num_classes, num_classes):
            raise ArgumentError(
                "confusion matrix",
                expected=f"counts of shape {(num_classes, num_classes)}",
                found=f"{np.shape(counts)}",
            )
        self.num_classes = num_classes
        self.free = free
        self.counts: NDArray[np.int64] = np.zeros((num_classes, num_classes), np.int64)
        if counts is not None:
            self.counts += counts

    def update(self, pred: Labels, target: Labels, mask: Labels | None = None) -> Self:
        """Add predictions and their truth: NumPy arrays, or torch tensors on any device (which count there).

        Args:
            pred: any shape, integer class ids.
            target: the same shape, integer class ids.
            mask: the same shape, bool: only these voxels count; what stands in the others does not matter.

        Returns:
            The matrix itself.

        Raises:
            FormatError: shapes differ, types are no integers, or an id that counts is not below `num_classes`.
        """
        if _shape(pred) != _shape(target) or (mask is not None and _shape(mask) != _shape(target)):
            raise FormatError(
                f"prediction: expected the truth's shape {_shape(target)}, found {_shape(pred)}"
                + (f" and a mask of {_shape(mask)}" if mask is not None else "")
            )
        device = next((d for array in (pred, target, mask) if (d := _device(array)) is not None), None)
        if device is None:
            self.counts += _count(_numpy(pred), _numpy(target), _numpy(mask), self.num_classes)
        else:
            self.counts += _count_on(device, pred, target, mask, self.num_classes)
        return self

    def __iadd__(self, other: ConfusionMatrix) -> Self:
        if (other.num_classes, other.free) != (self.num_classes, self.free):
            raise ArgumentError(
                "confusion matrices",
                expected=f"{self.num_classes} classes with free {self.free}",
                found=f"{other.num_classes} with {other.free}",
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

    __hash__ = None  # type: ignore[assignment]  # it changes

    def __repr__(self) -> str:
        return f"<ConfusionMatrix of {self.num_classes} classes, {self.total} voxels>"

    @property
    def total(self) -> int:
        """How many voxels were counted."""
        return int(self.counts.sum())

    @property
    def true_positives(self) -> NDArray[np.int64]:
        """(K,) voxels of each class predicted as it."""
        return np.diagonal(self.counts).copy()

    @property
    def false_positives(self) -> NDArray[np.int64]:
        """(K,) voxels wrongly predicted as each class."""
        return self.counts.sum(axis=0) - np.diagonal(self.counts)

    @property
    def false_negatives(self) -> NDArray[np.int64]:
        """(K,) voxels of each class predicted as another."""
        return self.counts.sum(axis=1) - np.diagonal(self.counts)

    @property
    def iou(self) -> NDArray[np.float64]:
        """(K,) intersection over union of each class; NaN for a class in neither the prediction nor the truth."""
        return _ratio(self.true_positives, self.true_positives + self.false_positives + self.false_negatives)

    @property
    def precision(self) -> NDArray[np.float64]:
        """(K,) share of the voxels predicted as a class that are of it; NaN where none was."""
        return _ratio(self.true_positives, self.counts.sum(axis=0))

    @property
    def recall(self) -> NDArray[np.float64]:
        """(K,) share of a class's voxels predicted as it; NaN where it has none."""
        return _ratio(self.true_positives, self.counts.sum(axis=1))

    @property
    def miou(self) -> float:
        """The paper's mIoU: over all classes, free among them, a class absent from both counting zero."""
        return self.mean_iou()

    def mean_iou(self, *, with_free: bool = True, absent: Absent = "zero") -> float:
        """Return the mean of the classes' IoU.

        Args:
            with_free: whether free space is one of the classes (CarlaSC's paper: yes; SemanticKITTI: no).
            absent: what a class in neither the prediction nor the truth counts: "zero" (the paper and SemanticKITTI),
                or "skip": it is left out of the mean. NaN when none is left.

        Raises:
            ArgumentError: `absent` is something else.
        """
        if absent not in ("zero", "skip"):
            raise ArgumentError("absent classes", expected="zero or skip", found=f"{absent!r}")
        iou = self.iou if with_free else np.delete(self.iou, self.free)
        iou = np.nan_to_num(iou) if absent == "zero" else iou[~np.isnan(iou)]
        return float(iou.mean()) if len(iou) else float("nan")

    @property
    def accuracy(self) -> float:
        """Share of the voxels predicted right; NaN when there are none."""
        return float(_ratio(np.trace(self.counts), self.counts.sum()))

    def completeness(self) -> Completeness:
        """Return precision, recall and IoU of occupied against free."""
        occupied = np.arange(self.num_classes) != self.free
        hit = self.counts[np.ix_(occupied, occupied)].sum()
        predicted, true = self.counts[:, occupied].sum(), self.counts[occupied].sum()
        return Completeness(
            float(_ratio(hit, predicted)), float(_ratio(hit, true)), float(_ratio(hit, predicted + true - hit))
        )


def _ratio(numerator: Any, denominator: Any) -> NDArray[np.float64]:
    """Divide; NaN where there is nothing to divide by."""
    numerator, denominator = np.asarray(numerator, np.float64), np.asarray(denominator, np.float64)
    return np.divide(numerator, denominator, out=np.full(denominator.shape, np.nan), where=denominator > 0)


def _count(
    pred: NDArray[Any], target: NDArray[Any], mask: NDArray[np.bool_] | None, num_classes: int
) -> NDArray[np.int64]:
    """Count on the CPU."""
    for name, array in (("prediction", pred), ("truth", target)):
        if array.dtype.kind not in "uib":
            raise FormatError(name, expected="integer class ids", found=f"{array.dtype}")
    pred, target = (np.ascontiguousarray(array).reshape(-1) for array in (pred, target))
    counted = np.ones(pred.shape, np.bool_) if mask is None else np.ascontiguousarray(mask, np.bool_).reshape(-1)
    pred, target = _in_range(pred, counted, num_classes, "prediction"), _in_range(target, counted, num_classes, "truth")
    return _bincount_pairs(pred, target, counted, num_classes)


def _in_range(labels: NDArray[Any], counted: NDArray[np.bool_], num_classes: int, name: str) -> NDArray[Any]:
    """Return labels below `num_classes` everywhere; only ids that do not count may be others."""
    if not labels.size or (labels.max() < num_classes and (labels.dtype.kind != "i" or labels.min() >= 0)):
        return labels
    wrong = ((labels < 0) | (labels >= num_classes)) & counted
    if wrong.any():
        raise _out_of_range(name, int(labels[wrong][0]), int(wrong.sum()), num_classes)
    return np.where(counted, labels, 0)


@numba.njit(cache=True, nogil=True)
def _bincount_pairs(
    pred: NDArray[Any], target: NDArray[Any], counted: NDArray[np.bool_], num_classes: int
) -> NDArray[np.int64]:
    """`np.bincount(target * K + pred)` of the voxels that count, in one pass.

    Most voxels are free and predicted free; four tables in turn spare the wait for the last store to the same bin.
    """
    tables = np.zeros((4, num_classes * num_classes), np.int64)
    row = np.uint32(num_classes)  # unsigned: a signed index would be checked for counting from the end
    for i in range(np.uint64(pred.size)):
        tables[i & np.uint64(3), np.uint32(target[i]) * row + np.uint32(pred[i])] += counted[i]
    return tables.sum(axis=0).reshape(num_classes, num_classes)


def _count_on(device: Any, pred: Labels, target: Labels, mask: Labels | None, num_classes: int) -> NDArray[np.int64]:
    """Count on the tensors' own device; only the matrix comes back."""
    import torch

    def there(array: Labels) -> torch.Tensor:
        if not isinstance(array, torch.Tensor):
            array = torch.from_numpy(np.asarray(array).astype(np.int64))
        return array.to(device).reshape(-1)

    ids = {"prediction": there(pred), "truth": there(target)}
    for name, labels in ids.items():
        if labels.is_floating_point() or labels.is_complex():
            raise FormatError(name, expected="integer class ids", found=f"{labels.dtype}")
        counted = labels.long() if mask is None else labels.long()[there(mask).bool()]
        wrong = counted[(counted < 0) | (counted >= num_classes)]
        if wrong.numel():
            raise _out_of_range(name, int(wrong[0]), wrong.numel(), num_classes)
        ids[name] = counted
    pairs = torch.bincount(ids["truth"] * num_classes + ids["prediction"], minlength=num_classes**2)
    return pairs.reshape(num_classes, num_classes).cpu().numpy()


def _out_of_range(name: str, found: int, times: int, num_classes: int) -> FormatError:
    return FormatError(
        name,
        expected=f"class ids 0..{num_classes - 1}",
        found=f"{found} ({times} voxels are out of range)",
        advice="remap the labels, or mask these voxels",
    )


def _device(array: Labels | None) -> Any:
    """The device of a tensor that is not on the CPU; torch is not imported to find out."""
    torch = sys.modules.get("torch")
    return array.device if torch and isinstance(array, torch.Tensor) and array.device.type != "cpu" else None


def _shape(array: Labels) -> tuple[int, ...]:
    return tuple(np.shape(array))


def _numpy(array: Any) -> Any:
    """A NumPy view of an array, or of a tensor on the CPU."""
    return array if array is None else np.asarray(array)
