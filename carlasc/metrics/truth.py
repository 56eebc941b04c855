"""Scoring ground truth itself: a grid against a better one of the same scene and instant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlasc.core.grids import Grid
from carlasc.errors import FormatError
from carlasc.metrics.confusion import ConfusionMatrix


@dataclass(frozen=True)
class TruthScore:
    """How a ground truth compares with a reference. Scores of frames add up with `+`.

    Attributes:
        matrix: confusion over the voxels known to both: its `iou`, `accuracy`, `recall`, `false_positives`, `completeness()`.
        known: voxels that the grid knows, among those scored.
        known_reference: voxels that the reference knows.
        known_both: voxels that both know.
    """

    matrix: ConfusionMatrix
    known: int
    known_reference: int
    known_both: int

    @property
    def coverage(self) -> float:
        """Share of the voxels known to the reference that the grid knows too; NaN when there are none."""
        return self.known_both / self.known_reference if self.known_reference else float("nan")

    @property
    def accuracy(self) -> float:
        """Share of the voxels known to both whose classes agree."""
        return self.matrix.accuracy

    def __add__(self, other: TruthScore) -> TruthScore:
        return TruthScore(
            self.matrix + other.matrix,
            self.known + other.known,
            self.known_reference + other.known_reference,
            self.known_both + other.known_both,
        )


def score_truth(grid: Grid, reference: Grid, num_classes: int, mask: NDArray[np.bool_] | None = None) -> TruthScore:
    """Score a ground truth grid against a reference, over the voxels known to both.

    Args:
        grid: what is scored; voxels with count 0 are unknown.
        reference: what is right, of the same spec.
        num_classes: ids are below it.
        mask: (X, Y, Z) bool: only these voxels are looked at (a distance band, ...).

    Raises:
        FormatError: the grids differ in geometry, or ids are out of range.
    """
    if grid.spec != reference.spec:
        raise FormatError("grid", expected=f"the reference's {reference.spec}", found=f"{grid.spec} (or other bounds)")
    looked_at = np.ones(grid.spec.size, np.bool_) if mask is None else mask
    known, known_reference = grid.known & looked_at, reference.known & looked_at
    both = known & known_reference
    matrix = ConfusionMatrix(num_classes).update(grid.labels, reference.labels, both)
    return TruthScore(matrix, int(known.sum()), int(known_reference.sum()), int(both.sum()))
