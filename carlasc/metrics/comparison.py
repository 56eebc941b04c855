"""Comparison of a predicted grid with the ground truth, voxel by voxel."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from carlasc.core.grids import Grid, GridSpec
from carlasc.errors import ArgumentError


class VoxelOutcome(IntEnum):
    """How one voxel of a prediction compares with the ground truth."""

    NOT_COMPARED = 0
    """The truth is unknown, or both are free."""
    RIGHT = 1
    """Occupied in both, with the same class."""
    WRONG = 2
    """Occupied in both, with different classes."""
    MISSED = 3
    """Occupied in the truth, predicted free."""
    INVENTED = 4
    """Free in the truth, predicted occupied."""


def compare_grids(prediction: Grid, truth: Grid) -> NDArray[np.uint8]:
    """Compare a prediction with the ground truth, voxel by voxel.

    Args:
        prediction: its class ids must be of the same class table as the truth's.
        truth: voxels with count 0 are unknown and are not compared; without counts, every voxel is known.

    Returns:
        (X, Y, Z) uint8, an `VoxelOutcome` for each voxel.

    Raises:
        ArgumentError: the grids differ in their geometry.
    """
    check_same_geometry(prediction.spec, truth.spec)
    predicted, occupied = prediction.labels > 0, truth.labels > 0
    outcomes = np.select(
        [~truth.known, occupied & (prediction.labels == truth.labels), occupied & predicted, occupied, predicted],
        [VoxelOutcome.NOT_COMPARED, VoxelOutcome.RIGHT, VoxelOutcome.WRONG, VoxelOutcome.MISSED, VoxelOutcome.INVENTED],
        default=VoxelOutcome.NOT_COMPARED,
    )
    return outcomes.astype(np.uint8)


def check_same_geometry(prediction: GridSpec, truth: GridSpec) -> None:
    """Raise ArgumentError if a prediction's grid and the truth's have different sizes, bounds or coordinates."""
    if prediction != truth:
        raise ArgumentError(
            "truth",
            expected=f"the geometry of the prediction's grid ({_describe(prediction)})",
            found=_describe(truth),
            advice="choose another grid with `grid` or `truth_grid`",
        )


def _describe(spec: GridSpec) -> str:
    return f"{spec}, {spec.lower} to {spec.upper}"
