"""The confusion matrix, counting for NumPy arrays and torch tensors, and the scores computed from
it.

Matrices of frames, sequences and processes can be added. Scores are computed from the sum, as in
the paper for a whole split.
"""

from __future__ import annotations

import operator
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from carlasc.core.arrays import AnyArray, AnyIntArray, BoolArray, FloatArray, IntArray
from carlasc.core.compiling import cached
from carlasc.core.grids import Grid
from carlasc.errors import ArgumentError, FormatError, check_choice
from carlasc.metrics.scoring import Summed

if TYPE_CHECKING:
    import torch

    Labels = AnyArray | torch.Tensor
else:
    Labels = Any

Absent = Literal["zero", "skip"]


@dataclass(frozen=True)
class Completeness:
    """Scores of occupied against free space: all classes except free count as one.

    NaN if the denominator is zero.

    Attributes:
        precision: share of the voxels predicted as occupied that are occupied.
        recall: share of the occupied voxels that are predicted as occupied.
        iou: intersection over union of the predicted and the true occupied voxels.
    """

    precision: float
    recall: float
    iou: float


class ConfusionMatrix(Summed):
    """The number of voxels for each pair of true and predicted class.

    Attributes:
        num_classes: K; ids are 0..K-1.
        free: the id of free space.
        counts: (K, K) int64, ground truth in rows, prediction in columns.
    """

    _SETTINGS = ("num_classes", "free")
    _SUMS = ("counts",)

    def __init__(
        self, num_classes: int, *, free: int = 0, counts: AnyIntArray | None = None
    ) -> None:
        """Start with an empty matrix, or with `counts`.

        Raises:
            ArgumentError: `num_classes` is less than 1, `free` is not in 0..K-1, or `counts` has
                another shape.
        """
        if num_classes < 1:
            raise ArgumentError("num_classes", expected="1 or more", found=num_classes)
        check_free(free, num_classes)
        if counts is not None and np.shape(counts) != (num_classes, num_classes):
            raise ArgumentError(
                "counts",
                expected=f"the shape {(num_classes, num_classes)}",
                found=np.shape(counts),
            )
        self.num_classes = num_classes
        self.free = free
        self.counts: IntArray = np.zeros((num_classes, num_classes), np.int64)
        if counts is not None:
            self.counts += counts

    def update(self, prediction: Labels, truth: Labels, mask: Labels | None = None) -> Self:
        """Add the voxels of a prediction and its ground truth.

        Accepts NumPy arrays and torch tensors. Tensors are counted on their device.

        Args:
            prediction: any shape, integer class ids.
            truth: the same shape, integer class ids.
            mask: the same shape, bool: only these voxels are counted; None counts all. The ids of
                other voxels may have any value.

        Returns:
            The matrix itself.

        Raises:
            FormatError: shapes differ, labels are not integers, or a counted id is not in 0..K-1.
        """
        for name, array in (("prediction", prediction), ("mask", mask)):
            if array is not None and np.shape(array) != np.shape(truth):
                raise FormatError(
                    name,
                    expected=f"the shape of the ground truth {tuple(np.shape(truth))}",
                    found=tuple(np.shape(array)),
                )
        device = device_of(prediction, truth, mask)
        if device is None:  # torch tensors on the CPU convert to NumPy without a copy
            known = None if mask is None else np.asarray(mask)
            self.counts += count_arrays(
                np.asarray(prediction), np.asarray(truth), known, self.num_classes
            )
        else:
            self.counts += count_tensors(device, prediction, truth, mask, self.num_classes)
        return self

    def reset(self) -> None:
        """Set all counts to zero."""
        self.counts[:] = 0

    def compute(self) -> dict[str, float]:
        """Return the usual scores by name: `miou`, `accuracy`, and `precision`, `recall` and `iou`
        of occupied space.
        """
        return {"miou": self.miou, "accuracy": self.accuracy, **vars(self.completeness())}

    def __add__(self, other: ConfusionMatrix) -> ConfusionMatrix:
        return ConfusionMatrix(self.num_classes, free=self.free, counts=self.counts).merge(other)

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, ConfusionMatrix)
            and self.free == other.free
            and np.array_equal(self.counts, other.counts)
        )

    __hash__ = None  # type: ignore[assignment]  # matrices are mutable

    def __repr__(self) -> str:
        return f"<ConfusionMatrix of {self.num_classes} classes, {self.total} voxels>"

    @property
    def total(self) -> int:
        """Number of voxels counted."""
        return int(self.counts.sum())

    @property
    def true_positives(self) -> IntArray:
        """(K,) number of correctly predicted voxels per class."""
        return np.diagonal(self.counts).copy()

    @property
    def false_positives(self) -> IntArray:
        """(K,) number of voxels per predicted class that have another true class."""
        return self.counts.sum(axis=0) - np.diagonal(self.counts)

    @property
    def false_negatives(self) -> IntArray:
        """(K,) number of voxels per true class that are predicted as another class."""
        return self.counts.sum(axis=1) - np.diagonal(self.counts)

    @property
    def iou(self) -> FloatArray:
        """(K,) intersection over union per class; NaN for classes that do not occur in the
        prediction or the ground truth.
        """
        return ratio(
            self.true_positives, self.true_positives + self.false_positives + self.false_negatives
        )

    @property
    def precision(self) -> FloatArray:
        """(K,) precision per class: share of the predicted voxels that are correct; NaN for classes
        that are never predicted.
        """
        return ratio(self.true_positives, self.counts.sum(axis=0))

    @property
    def recall(self) -> FloatArray:
        """(K,) recall per class: share of the true voxels that are predicted correctly; NaN for
        classes without true voxels.
        """
        return ratio(self.true_positives, self.counts.sum(axis=1))

    @property
    def miou(self) -> float:
        """Mean IoU as in the paper: over all classes, including free.

        Absent classes count as zero.
        """
        return self.mean_iou()

    def mean_iou(self, *, with_free: bool = True, absent: Absent = "zero") -> float:
        """Return the mean IoU over the classes.

        Args:
            with_free: whether free space is in the mean (in the paper of CarlaSC it is, in
                SemanticKITTI not).
            absent: treatment of classes that do not occur in the prediction or the ground truth:
                "zero" (the paper and SemanticKITTI) counts them as 0, "skip" leaves them out of the
                mean. The mean over no class is NaN.

        Raises:
            ArgumentError: `absent` has another value.
        """
        check_choice("absent", absent, Absent)
        iou = self.iou if with_free else np.delete(self.iou, self.free)
        return mean_of(np.nan_to_num(iou) if absent == "zero" else iou)

    @property
    def accuracy(self) -> float:
        """Share of correctly predicted voxels; NaN if no voxel was counted."""
        return float(ratio(np.trace(self.counts), self.counts.sum()))

    def completeness(self) -> Completeness:
        """Return precision, recall and IoU of occupied against free space."""
        occupied = np.arange(self.num_classes) != self.free
        hit = self.counts[np.ix_(occupied, occupied)].sum()
        predicted = self.counts[:, occupied].sum()
        true = self.counts[occupied].sum()
        return Completeness(*ratio([hit] * 3, [predicted, true, predicted + true - hit]).tolist())


def check_free(free: int, num_classes: int) -> None:
    """Raise ArgumentError if the id of free space is not in 0..K-1."""
    if not 0 <= free < num_classes:
        raise ArgumentError("free", expected=f"a class id in 0..{num_classes - 1}", found=free)


def ratio(numerator: Any, denominator: Any) -> FloatArray:
    """Return the quotient; NaN where the denominator is zero."""
    numerator = np.asarray(numerator, np.float64)
    denominator = np.asarray(denominator, np.float64)
    return np.divide(
        numerator, denominator, out=np.full(denominator.shape, np.nan), where=denominator > 0
    )


def mean_of(values: FloatArray) -> float:
    """Return the mean of the values that are not NaN; NaN if there are none."""
    present = values[~np.isnan(values)]
    return float(present.mean()) if present.size else float("nan")


def json_number(value: float) -> float | None:
    """Return a score for JSON: None for NaN."""
    return None if np.isnan(value) else float(value)


@dataclass(frozen=True)
class TruthScore:
    """The comparison of ground truth with a reference. Scores of frames are added with `+`.

    Attributes:
        matrix: confusion matrix over the voxels that are known in both grids, with the reference in
            rows.
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
        """Share of the known voxels of the reference that are also known in the grid; NaN if the
        reference has no known voxels.
        """
        return self.known_both / self.known_reference if self.known_reference else float("nan")

    @property
    def accuracy(self) -> float:
        """Share of the voxels known in both grids that have equal classes."""
        return self.matrix.accuracy

    def __add__(self, other: TruthScore) -> TruthScore:
        return TruthScore(*map(operator.add, vars(self).values(), vars(other).values()))


def score_truth(
    grid: Grid, reference: Grid, num_classes: int, mask: BoolArray | None = None
) -> TruthScore:
    """Score a ground truth grid against a reference, over the voxels that are known in both.

    Args:
        grid: the grid to score; voxels with count 0 are unknown.
        reference: the grid that is regarded as correct, with the same spec.
        num_classes: number of classes; ids are below it.
        mask: (X, Y, Z) bool: only these voxels are scored, such as a distance band; None scores
            all.

    Raises:
        FormatError: the grids differ in geometry, or an id is out of range.
    """
    if grid.spec != reference.spec:
        expected, found = (
            f"{spec}, {spec.lower} to {spec.upper}" for spec in (reference.spec, grid.spec)
        )
        raise FormatError(
            "grid", expected=f"the geometry of the reference, {expected}", found=found
        )
    selected = np.ones(grid.spec.size, np.bool_) if mask is None else mask
    known = grid.known & selected
    known_reference = reference.known & selected
    both = known & known_reference
    matrix = ConfusionMatrix(num_classes).update(grid.labels, reference.labels, both)
    return TruthScore(matrix, int(known.sum()), int(known_reference.sum()), int(both.sum()))


def device_of(*arrays: Any) -> Any:
    """Return the device of the first torch tensor that is not on the CPU, otherwise None.

    Does not import torch.
    """
    torch = sys.modules.get("torch")
    tensors = [
        array
        for array in arrays
        if torch and isinstance(array, torch.Tensor) and array.device.type != "cpu"
    ]
    return tensors[0].device if tensors else None


def to_numpy(array: Any) -> AnyArray:
    """Convert a NumPy array, or a torch tensor on any device, to a NumPy array."""
    return np.asarray(array.detach().cpu() if hasattr(array, "detach") else array)


def count_arrays(
    prediction: AnyArray, truth: AnyArray, mask: BoolArray | None, num_classes: int
) -> IntArray:
    """Count pairs of classes on the CPU.

    Args:
        prediction: any shape, integer class ids.
        truth: the same shape, integer class ids.
        mask: the same shape, bool: only these voxels are counted; None counts all.
        num_classes: K.

    Returns:
        (K, K) int64 number of voxels, ground truth in rows, prediction in columns.

    Raises:
        FormatError: labels are not integers, or a counted id is not in 0..K-1.
    """
    for name, labels in (("prediction", prediction), ("truth", truth)):
        if labels.dtype.kind not in "uib":
            raise FormatError(name, expected="integer class ids", found=labels.dtype)
    prediction, truth = (np.ascontiguousarray(labels).reshape(-1) for labels in (prediction, truth))
    counted = (
        np.ones(prediction.shape, np.bool_)
        if mask is None
        else np.ascontiguousarray(mask, np.bool_).reshape(-1)
    )
    prediction = _in_range(prediction, counted, num_classes, "prediction")
    truth = _in_range(truth, counted, num_classes, "truth")
    return (
        _count_pairs(prediction, truth, counted, num_classes)
        .sum(axis=0)
        .reshape(num_classes, num_classes)
    )


def count_tensors(
    device: torch.device, prediction: Labels, truth: Labels, mask: Labels | None, num_classes: int
) -> IntArray:
    """Count on a torch device.

    Only the (K, K) result is copied back. Arguments, result and errors are those of `count_arrays`.
    """
    import torch

    def flat(array: Labels) -> torch.Tensor:
        return torch.as_tensor(array, device=device).reshape(-1)

    predicted = flat(prediction)
    true = flat(truth)
    if mask is not None:
        counted = flat(mask).bool()
        predicted = predicted[counted]
        true = true[counted]
    for ids in (predicted, true):
        whole = not (ids.is_floating_point() or ids.is_complex())
        if not whole or (ids.numel() and (ids.min() < 0 or ids.max() >= num_classes)):
            known = None if mask is None else to_numpy(mask)
            # raises the error that names the id
            return count_arrays(to_numpy(prediction), to_numpy(truth), known, num_classes)
    pairs = torch.bincount(true.long() * num_classes + predicted.long(), minlength=num_classes**2)
    return pairs.reshape(num_classes, num_classes).cpu().numpy()


def _in_range(labels: AnyArray, counted: BoolArray, num_classes: int, name: str) -> AnyArray:
    """Return labels with all ids in 0..K-1.

    An id out of range is an error in counted voxels, and becomes 0 in other voxels.
    """
    if not labels.size or (
        labels.max() < num_classes and (labels.dtype.kind != "i" or labels.min() >= 0)
    ):
        return labels
    wrong = ((labels < 0) | (labels >= num_classes)) & counted
    if wrong.any():
        raise FormatError(
            name,
            expected=f"class ids 0..{num_classes - 1}",
            found=f"{int(labels[wrong][0])} ({wrong.sum()} voxels are out of range)",
            advice="remap the labels, or mask these voxels",
        )
    return np.where(counted, labels, 0)


@cached(error_model="python")
def _count_pairs(
    prediction: AnyArray, truth: AnyArray, counted: BoolArray, num_classes: int
) -> IntArray:
    """Return `np.bincount(truth * K + prediction)` of the counted voxels, in one pass.

    Most voxels are free and predicted as free, so successive voxels increment the same element.
    Using four tables in turn avoids stalls on the previous store. The caller adds them up, because
    `sum` would take most of the compile time.

    Returns:
        (4, K * K) int64; the result is the sum over the first axis.
    """
    tables = np.zeros((4, num_classes * num_classes), np.int64)
    row = np.uint32(num_classes)  # unsigned: signed indices would be checked for negative values
    for i in range(np.uint64(prediction.size)):
        tables[i & np.uint64(3), np.uint32(truth[i]) * row + np.uint32(prediction[i])] += counted[i]
    return tables


def check_ids(name: str, ids: AnyArray, num_classes: int) -> None:
    """Raise FormatError if class ids, of any shape, are not integers in 0..K-1."""
    if ids.dtype.kind not in "uib" or (ids.size and (ids.min() < 0 or ids.max() >= num_classes)):
        found = f"{ids.dtype} from {ids.min()} to {ids.max()}" if ids.size else str(ids.dtype)
        raise FormatError(name, expected=f"class ids 0..{num_classes - 1}", found=found)


def flat_sides(
    prediction: tuple[ArrayLike, ArrayLike],
    truth: tuple[ArrayLike, ArrayLike],
    mask: ArrayLike | None,
    num_classes: int,
) -> list[AnyArray]:
    """Return class ids and instance ids of the prediction, then those of the ground truth, of the
    scored elements, (N,) each.

    Args:
        prediction: class ids and instance ids, of equal shape.
        truth: true class ids and instance ids, of the same shape.
        mask: the same shape, bool: the scored elements; None for all.
        num_classes: K.

    Raises:
        FormatError: shapes differ, or a class id is not below K.
    """
    arrays = [to_numpy(array).reshape(-1) for side in (prediction, truth) for array in side]
    if len({array.shape for array in arrays}) > 1:
        raise FormatError(
            "prediction",
            expected="classes and instances with the shape of the ground truth",
            found=" and ".join(str(array.shape) for array in arrays),
        )
    if mask is not None:
        counted = to_numpy(mask).astype(np.bool_).reshape(-1)
        arrays = [array[counted] for array in arrays]
    check_ids("prediction", arrays[0], num_classes)
    check_ids("truth", arrays[2], num_classes)
    return arrays
