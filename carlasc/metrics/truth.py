"""Scores of ground truth: comparison of a grid with a better grid of the same scene at the same time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlasc.core.grids import Grid
from carlasc.errors import FormatError
from carlasc.metrics.confusion import ConfusionMatrix


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
