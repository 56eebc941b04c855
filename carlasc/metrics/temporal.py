"""Scores over time: consistency of consecutive frames, and LSTQ for segmentation and tracking of
actors (Aygün et al., CVPR 2021).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from carlasc.core.classes import ids_in
from carlasc.core.geometry import Transform, invert, transform_points
from carlasc.core.grids import Grid
from carlasc.errors import FormatError
from carlasc.metrics.confusion import ConfusionMatrix, flat_sides, mean_of
from carlasc.metrics.scoring import Summed


def moved_grid(grid: Grid, dst_T_src: Transform) -> Grid:
    """Transform a grid to another frame.

    Each voxel takes the label of the source voxel that contains its centre.

    Args:
        grid: labels and counts in the frame `src`.
        dst_T_src: (4, 4) rigid transform.

    Returns:
        A grid of the same geometry in the frame `dst`; voxels outside the source are unknown (count
        0).
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
    """Accumulates the agreement of consecutive frames in the static parts of the scene.

    Voxels of frame t with a static class or free space are moved to frame t + 1, and compared with
    the voxels of that frame that are also known.

    Attributes:
        matrix: confusion matrix with the earlier frame in rows and the later frame in columns.
    """

    _SETTINGS = ("moving",)
    _SUMS = ("matrix",)

    def __init__(self, num_classes: int, moving: Iterable[int], *, free: int = 0) -> None:
        """Create an empty metric.

        Args:
            num_classes: K; ids are 0..K-1.
            moving: ids of classes that can move, which are left out.
            free: id of free space.
        """
        self.moving = frozenset(moving)
        self.matrix = ConfusionMatrix(num_classes, free=free)

    def update(
        self,
        earlier: Grid,
        later: Grid,
        later_T_earlier: Transform,
        ignored: ArrayLike | None = None,
    ) -> Self:
        """Add a pair of consecutive frames.

        Args:
            earlier: grid of frame t.
            later: grid of frame t + 1, of the same geometry.
            later_T_earlier: (4, 4) transform from the earlier to the later sensor frame.
            ignored: (X, Y, Z) bool, voxels of the later frame to leave out, such as moving objects
                of a static class; None for none.

        Raises:
            FormatError: the geometries differ.
        """
        if earlier.spec != later.spec:
            raise FormatError(
                "later",
                expected=f"the geometry of the earlier frame, {earlier.spec}",
                found=later.spec,
            )
        before = moved_grid(earlier, later_T_earlier)
        movable = sorted(self.moving)
        counted = (
            before.known
            & later.known
            & ~np.isin(before.labels, movable)
            & ~np.isin(later.labels, movable)
        )
        if ignored is not None:
            counted &= ~np.asarray(ignored, np.bool_)
        self.matrix.update(later.labels, before.labels, counted)
        return self

    def compute(self) -> float:
        """Return the IoU of occupied voxels between consecutive frames; NaN if nothing was
        compared.
        """
        return self.matrix.completeness().iou

    def reset(self) -> None:
        """Set all sums to zero."""
        self.matrix = ConfusionMatrix(self.matrix.num_classes, free=self.matrix.free)


_Sizes = Counter[tuple[str | int, ...]]


@dataclass(frozen=True)
class TrackingScore:
    """Quality of segmentation and tracking.

    Attributes:
        lstq: square root of `association` times `classification`.
        association: S_assoc, the mean over all true actors of the association with predicted
            numbers over all frames.
        classification: S_cls, mean IoU of the occurring classes.
        actors: number of true actors.
    """

    lstq: float
    association: float
    classification: float
    actors: int


class TrackingQuality(Summed):
    """Accumulates the frames of sequences, as in the evaluation of 4D panoptic segmentation of
    SemanticKITTI.

    Attributes:
        num_classes: K; ids are 0..K-1.
        things: ids of classes with actors.
        ignored: ids of true classes whose elements are left out.
        unaveraged: ids of classes that are not in the mean IoU, such as free space.
        fewest: a true actor is scored only in frames in which it has more elements than this.
    """

    _SETTINGS = ("num_classes", "things", "ignored", "unaveraged", "fewest")
    _SUMS = ("confusion", "predicted", "true", "common")

    def __init__(
        self,
        num_classes: int,
        things: Collection[int],
        *,
        ignored: Collection[int] = (),
        unaveraged: Collection[int] = (),
        fewest: int = 0,
    ) -> None:
        self.num_classes = num_classes
        self.things = frozenset(things)
        self.ignored = frozenset(ignored)
        self.unaveraged = frozenset(unaveraged)
        self.fewest = fewest
        self.reset()

    def reset(self) -> None:
        """Set all sums to zero."""
        self.confusion = np.zeros((self.num_classes, self.num_classes), np.int64)  # predicted, true
        self.predicted: _Sizes = Counter()  # number of elements by sequence and actor number
        self.true: _Sizes = Counter()  # by sequence, class and actor number
        self.common: _Sizes = Counter()  # by sequence, class, true and predicted actor number

    def update(
        self,
        sequence: str,
        prediction: tuple[ArrayLike, ArrayLike],
        truth: tuple[ArrayLike, ArrayLike],
        mask: ArrayLike | None = None,
    ) -> Self:
        """Add a frame.

        Args:
            sequence: path of the sequence. Actor numbers are constant over a sequence.
            prediction: class ids and actor numbers, 0 for none, of equal shape.
            truth: true class ids and actor numbers, of the same shape.
            mask: the same shape, bool: only these elements are scored; None scores all.

        Raises:
            FormatError: shapes differ, or a class id is not below `num_classes`.
        """
        arrays = flat_sides(prediction, truth, mask, self.num_classes)
        counted = ~np.isin(arrays[2], sorted(self.ignored))
        pred_class, pred, true_class, true = (array[counted].astype(np.int64) for array in arrays)
        k = self.num_classes
        self.confusion += np.bincount(pred_class * k + true_class, minlength=k * k).reshape(k, k)
        scored = pred[(pred > 0) & ~np.isin(pred_class, sorted(self.ignored))]
        for number, size in ids_in(scored).items():
            self.predicted[sequence, number] += size
        for label in self.things:
            of_class = (true_class == label) & (true > 0)
            for number, size in ids_in(true[of_class]).items():
                if size > self.fewest:
                    self.true[sequence, label, number] += size
                    beside = pred[of_class & (true == number) & (pred > 0)]
                    for predicted_number, common in ids_in(beside).items():
                        self.common[sequence, label, number, predicted_number] += common
        return self

    def compute(self) -> TrackingScore:
        """Return the scores of all added frames; NaN if nothing occurs."""
        sums = dict.fromkeys(self.true, 0.0)
        for (sequence, label, number, other), common in self.common.items():
            predicted = self.predicted[sequence, other]
            true = self.true[sequence, label, number]
            if predicted:
                sums[sequence, label, number] += common * common / (true + predicted - common)
        quality = [total / self.true[key] for key, total in sums.items()]
        association = mean_of(np.array(quality))
        iou = ConfusionMatrix(self.num_classes, counts=self.confusion).iou
        iou = np.delete(iou, sorted(self.unaveraged | self.ignored))
        classification = float(np.nanmean(iou)) if (~np.isnan(iou)).any() else float("nan")
        return TrackingScore(
            float(np.sqrt(association * classification)), association, classification, len(quality)
        )
