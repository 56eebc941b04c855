"""Scores over time: the consistency of consecutive frames."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from carlasc.core.geometry import Transform, invert, transform_points
from carlasc.core.grids import Grid
from carlasc.errors import FormatError
from carlasc.metrics.confusion import ConfusionMatrix
from carlasc.metrics.summing import Summed


def moved_grid(grid: Grid, dst_T_src: Transform) -> Grid:
    """Return a grid in another frame: each voxel takes the label of the source voxel that contains its centre.

    Args:
        grid: labels and counts in the frame `src`.
        dst_T_src: (4, 4) rigid transform.

    Returns:
        A grid of the same geometry in the frame `dst`; voxels outside the source are unknown (count 0).
    """
    spec = grid.spec
    centers = transform_points(invert(dst_T_src), spec.from_axes(spec.centers()).reshape(-1, 3))
    voxel = spec.flat_index(centers)
    inside = voxel >= 0
    labels = np.zeros(spec.num_voxels, grid.labels.dtype)
    labels[inside] = grid.labels.reshape(-1)[voxel[inside]]
    counts = np.zeros(spec.num_voxels, np.float32)
    counts[inside] = grid.known.reshape(-1)[voxel[inside]]
    return Grid(spec, labels.reshape(spec.size), counts.reshape(spec.size))


class Consistency(Summed):
    """Adds up the agreement of consecutive frames in the static parts of the scene.

    Voxels of frame t with a static class or free space are moved to frame t + 1 and compared with the voxels of that frame, over the
    voxels that are known in both.

    Attributes:
        matrix: confusion of the later frame (columns) against the earlier one (rows).
    """

    _SETTINGS, _SUMS = ("moving",), ("matrix",)

    def __init__(self, num_classes: int, moving: Iterable[int], *, free: int = 0) -> None:
        """Start empty; `moving` are the ids of classes that may move and are left out."""
        self.moving = frozenset(moving)
        self.matrix = ConfusionMatrix(num_classes, free=free)

    def update(self, earlier: Grid, later: Grid, later_T_earlier: Transform, ignored: ArrayLike | None = None) -> Self:
        """Add a pair of consecutive frames.

        Args:
            earlier: grid of frame t.
            later: grid of frame t + 1, of the same geometry.
            later_T_earlier: (4, 4) motion of the sensor.
            ignored: (X, Y, Z) bool voxels of the later frame that are left out, such as moving objects of a static class.

        Raises:
            FormatError: the geometries differ.
        """
        if earlier.spec != later.spec:
            raise FormatError("later", expected=f"the earlier frame's {earlier.spec}", found=str(later.spec))
        before = moved_grid(earlier, later_T_earlier)
        movable = sorted(self.moving)
        counted = before.known & later.known & ~np.isin(before.labels, movable) & ~np.isin(later.labels, movable)
        if ignored is not None:
            counted &= ~np.asarray(ignored, np.bool_)
        self.matrix.update(later.labels, before.labels, counted)
        return self

    def compute(self) -> float:
        """Return the IoU of occupied voxels between consecutive frames; NaN if nothing was compared."""
        return self.matrix.completeness().iou

    def reset(self) -> None:
        """Remove everything that was added."""
        self.matrix = ConfusionMatrix(self.matrix.num_classes, free=self.matrix.free)


def shape_consistency(earlier: NDArray[np.bool_], later: NDArray[np.bool_]) -> float:
    """Return the IoU of an actor's shape in two frames, both in the actor's own frame of reference.

    Args:
        earlier: (X, Y, Z) bool voxels of the actor.
        later: likewise, of the same geometry.

    Returns:
        IoU from 0 to 1; NaN where the actor has no voxel in either.

    Raises:
        FormatError: shapes differ.
    """
    if earlier.shape != later.shape:
        raise FormatError("later", expected=f"shape {earlier.shape}", found=str(later.shape))
    union = int(np.count_nonzero(earlier | later))
    return np.count_nonzero(earlier & later) / union if union else float("nan")
