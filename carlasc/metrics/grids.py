"""The frames of a grid of a sequence, and voxel-by-voxel comparison of grids."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from carlasc.core.arrays import BoolArray, FloatArray, IntArray, LabelArray, Uint8Array
from carlasc.core.grids import Grid, GridSpec
from carlasc.errors import ArgumentError
from carlasc.storage import Sequence, layout
from carlasc.storage.voxel_files import GridFrames, SeenBy


class SequenceGrid(GridFrames):
    """A grid of a sequence of a Source."""

    def __init__(self, sequence: Sequence, grid: str) -> None:
        self.sequence = sequence
        self.grid = grid
        self.path = sequence.path
        self.location = f"{sequence.location}/{grid}"
        self.spec = sequence.grids[grid]
        self.classes = sequence.classes_of(grid)
        self.named = sequence.table_use(grid).found
        has_poses = layout.POSES in sequence.documents()
        self.origin = (0.0, 0.0, 0.0) if has_poses else None

    def frames(self) -> IntArray:
        """Return the sorted frames that have labels."""
        return self.sequence.frames(f"{self.grid}/labels")

    def labels(self, frame: int) -> LabelArray:
        """Return (X, Y, Z) labels."""
        return self.sequence.read(f"{self.grid}/labels", frame)

    def known(self, frame: int, seen_by: SeenBy = "lidar") -> BoolArray | None:
        """Return (X, Y, Z) bool, the voxels with votes, or those that a camera also sees; None if
        the grid has no such fields.
        """
        fields = [f"{self.grid}/counts"] + ([f"{self.grid}/seen"] if seen_by == "camera" else [])
        if not set(fields) <= self.sequence.fields():
            return None
        return np.logical_and.reduce([self.sequence.read(field, frame) > 0 for field in fields])

    def poses(self) -> FloatArray:
        """Return (F, 4, 4) first_T_sensor of all frames with labels."""
        return np.stack([self.sequence.read_pose(frame) for frame in self.frames().tolist()])


class VoxelOutcome(IntEnum):
    """Result of the comparison of one voxel of a prediction with the ground truth."""

    NOT_COMPARED = 0
    """The ground truth is unknown, or both are free."""
    RIGHT = 1
    """Occupied in both, with the same class."""
    WRONG = 2
    """Occupied in both, with different classes."""
    MISSED = 3
    """Occupied in the ground truth, predicted free."""
    INVENTED = 4
    """Free in the ground truth, predicted occupied."""


def compare_grids(prediction: Grid, truth: Grid) -> Uint8Array:
    """Compare a prediction with the ground truth, voxel by voxel.

    Args:
        prediction: predicted grid, with the same class table as the ground truth.
        truth: true grid. Voxels with count 0 are unknown and are not compared; without counts, all
            voxels are known.

    Returns:
        (X, Y, Z) uint8, a `VoxelOutcome` per voxel.

    Raises:
        ArgumentError: the grids differ in their geometry.
    """
    check_same_geometry(prediction.spec, truth.spec)
    predicted = prediction.labels > 0
    occupied = truth.labels > 0
    right = occupied & (prediction.labels == truth.labels)
    # the first condition that holds decides
    conditions = [~truth.known, right, occupied & predicted, occupied, predicted]
    outcomes = np.select(conditions, list(VoxelOutcome), VoxelOutcome.NOT_COMPARED)
    return outcomes.astype(np.uint8)


def check_same_geometry(prediction: GridSpec, truth: GridSpec) -> None:
    """Raise ArgumentError if the grids of prediction and ground truth have different sizes, bounds
    or coordinates.
    """
    if prediction != truth:
        raise ArgumentError(
            "truth",
            expected=f"the geometry of the predicted grid ({prediction}, {prediction.lower} to "
            f"{prediction.upper})",
            found=f"{truth}, {truth.lower} to {truth.upper}",
            advice="choose another grid with `grid` or `truth_grid`",
        )
