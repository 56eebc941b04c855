"""The scores of predictions over a data set, and the paper's two tables of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from carlasc.core.classes import ClassTable
from carlasc.errors import ArgumentError
from carlasc.metrics.confusion import Absent, ConfusionMatrix
from carlasc.metrics.tables import Cell, Table

Mask = Literal["known", "semantickitti", "all"]


@dataclass(frozen=True)
class Evaluation:
    """The scores of predictions. All figures are computed from the sum of the confusion matrices of all frames.

    Attributes:
        name: of the predictions: a network's name, or where they are stored.
        classes: the classes that are scored.
        matrix: the confusion matrix over all frames.
        sequences: the confusion matrix of each sequence, by path.
        frames: number of frames scored.
        mask: which voxels counted.
        absent: how a class counts in the mean that is in neither the prediction nor the truth: "zero", or "skip".
        failures: (frame, message) of the frames that could not be scored.
    """

    name: str
    classes: ClassTable
    matrix: ConfusionMatrix
    sequences: Mapping[str, ConfusionMatrix]
    frames: int
    mask: Mask
    absent: Absent
    failures: list[tuple[str, str]]

    @property
    def class_iou(self) -> dict[str, float]:
        """IoU of each class by name; NaN for a class that is in neither the prediction nor the truth."""
        return {name: float(self.matrix.iou[index]) for index, name in sorted(self.classes.names.items())}

    @property
    def miou(self) -> float:
        """Mean IoU over all classes, including free: the paper's figure."""
        return self._mean_iou(with_free=True)

    @property
    def miou_without_free(self) -> float:
        """Mean IoU over all classes except free: SemanticKITTI's figure."""
        return self._mean_iou(with_free=False)

    def _mean_iou(self, *, with_free: bool) -> float:
        """Average over the ids that are classes: a table such as SemanticKITTI's has gaps, the matrix has none."""
        values = [v for i, v in enumerate(self.matrix.iou) if i in self.classes.names and (with_free or i)]
        present = [v for v in values if not np.isnan(v)]
        count = len(values) if self.absent == "zero" else len(present)
        return sum(present) / count if count else float("nan")

    def tables(self) -> tuple[Table, Table]:
        """Return the paper's two tables: IoU of each class, and completeness."""
        return semantic_table([self]), geometric_table([self])

    def to_dict(self) -> dict[str, Any]:
        """Return every figure by name, as fractions, for JSON; None for a figure that is not defined."""
        completeness = self.matrix.completeness()
        figures = {
            "miou": self.miou,
            "miou_without_free": self.miou_without_free,
            "accuracy": self.matrix.accuracy,
            "precision": completeness.precision,
            "recall": completeness.recall,
            "iou": completeness.iou,
        }
        return {
            "name": self.name,
            "classes": self.classes.name,
            "frames": self.frames,
            "voxels": self.matrix.total,
            "mask": self.mask,
            "absent": self.absent,
            **{name: _number(value) for name, value in figures.items()},
            "class_iou": {name: _number(value) for name, value in self.class_iou.items()},
            "confusion": self.matrix.counts.tolist(),
            "failures": [list(failure) for failure in self.failures],
        }


def semantic_table(evaluations: Sequence[Evaluation]) -> Table:
    """Return the table of the IoU of each class, both means of them, and accuracy; one row per evaluation.

    Raises:
        ArgumentError: there is no evaluation, or they score different classes.
    """
    classes = {evaluation.classes.name for evaluation in evaluations}
    if len(classes) != 1:
        raise ArgumentError(
            "evaluations", expected="evaluations of one class table", found=", ".join(sorted(classes)) or "none"
        )
    header = ("Network", *evaluations[0].class_iou, "mIoU", "mIoU w/o free", "Accuracy")
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (e.name, *_percent(*e.class_iou.values(), e.miou, e.miou_without_free, e.matrix.accuracy)) for e in evaluations
    )
    return Table("Semantic scene completion: IoU of each class", header, rows)


def geometric_table(evaluations: Sequence[Evaluation]) -> Table:
    """Return the table of completeness: precision, recall and IoU of occupied against free space; one row per evaluation."""
    rows: list[tuple[Cell, ...]] = []
    for evaluation in evaluations:
        found = evaluation.matrix.completeness()
        rows.append((evaluation.name, *_percent(found.precision, found.recall, found.iou)))
    return Table("Scene completion: occupied against free", ("Network", "Precision", "Recall", "IoU"), tuple(rows))


def _percent(*values: float) -> tuple[float, ...]:
    return tuple(100 * value for value in values)


def _number(value: float) -> float | None:
    return None if np.isnan(value) else float(value)
