"""RayIoU and RayPQ (SparseOcc): comparison of grids by the first surface on each ray instead of
voxel by voxel.

A wall that is predicted too thick reduces the IoU of voxels, although its visible surface is
correct. Rays from sensor positions along the trajectory compare only the first surface.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from carlasc.core.arrays import AnyArray, FloatArray, IntArray
from carlasc.core.geometry import Transform, invert
from carlasc.core.grids import GridSpec
from carlasc.errors import FormatError
from carlasc.metrics.casting import cast_rays, rayiou_directions
from carlasc.metrics.confusion import check_free, check_ids, mean_of, ratio, to_numpy
from carlasc.metrics.panoptic import PanopticQuality, PanopticScore, match_segments
from carlasc.metrics.scoring import Summed

THRESHOLDS_M = (1.0, 2.0, 4.0)  # between the distances of a correct ray
_MOST_ORIGINS = 8
# minimum distance of origins from the sides of the grid: up to 39 m in the grid of Occ3D, which
# ends at 40 m
_MARGIN_M = 1.0
_FEWEST_RAYS = 10  # segments with fewer rays are not counted as false negatives or false positives


def ray_origins(
    world_T_sensors: FloatArray,
    frame: int,
    spec: GridSpec,
    sensor: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> FloatArray:
    """Return the ray origins of a frame: sensor positions along the trajectory that are inside the
    grid of the frame.

    Args:
        world_T_sensors: (F, 4, 4) poses of the (key) frames of the sequence.
        frame: row of the scored frame in `world_T_sensors`.
        spec: the grid of the frame.
        sensor: position of the sensor in the frame of the poses, such as that of a LiDAR on a
            vehicle, metres.

    Returns:
        (O, 3) metres, in the frame of the scored frame. At most 8 positions, evenly selected
        from those that are at least 1 m from the sides of the grid in x and y.
    """
    here: Transform = invert(world_T_sensors[frame])
    places = ((here @ world_T_sensors) @ [*sensor, 1.0])[:, :3]
    inside = (places[:, :2] > np.array(spec.lower[:2]) + _MARGIN_M) & (
        places[:, :2] < np.array(spec.upper[:2]) - _MARGIN_M
    )
    near = places[inside.all(axis=1)]
    chosen = np.round(np.linspace(0, len(near) - 1, min(len(near), _MOST_ORIGINS))).astype(int)
    return near[chosen]


@dataclass(frozen=True)
class RayScore:
    """RayIoU of all rays.

    Attributes:
        class_iou: (T, K) IoU of each class at each depth threshold; NaN for classes that do not
            occur in prediction or ground truth.
        free: id of free space, which is not scored.
    """

    class_iou: FloatArray
    free: int

    @property
    def by_threshold(self) -> dict[float, float]:
        """RayIoU by threshold, metres: the mean over the occurring classes except free."""
        things = np.delete(self.class_iou, self.free, axis=1)
        return {t: mean_of(row) for t, row in zip(THRESHOLDS_M, things, strict=True)}

    @property
    def rayiou(self) -> float:
        """Mean RayIoU over the thresholds."""
        return mean_of(np.delete(self.class_iou, self.free, axis=1))


class RayIoU(Summed):
    """Accumulates the first surfaces on rays through predicted and true grids.

    A ray is correct if the first voxels of prediction and ground truth have the same class, and
    their distances differ by less than a threshold. Rays without a surface in the ground truth are
    left out. IoU is computed from counts summed over all frames.

    Attributes:
        num_classes: K; ids are 0..K-1.
        free: id of free space.
    """

    _SETTINGS = ("num_classes", "free")
    _SUMS = ("true", "predicted", "hits")

    def __init__(
        self,
        num_classes: int,
        *,
        free: int = 0,
        directions: ArrayLike | None = None,
    ) -> None:
        """Create an empty metric.

        `directions` are (R, 3) unit vectors of the rays; None takes `rayiou_directions`.
        """
        check_free(free, num_classes)
        self.num_classes = num_classes
        self.free = free
        self.directions = directions
        self.reset()

    def reset(self) -> None:
        """Set all sums to zero."""
        self.true = np.zeros(self.num_classes, np.int64)
        self.predicted = np.zeros(self.num_classes, np.int64)
        self.hits = np.zeros((len(THRESHOLDS_M), self.num_classes), np.int64)

    def update(
        self, prediction: ArrayLike, truth: ArrayLike, spec: GridSpec, origins: ArrayLike
    ) -> Self:
        """Add a frame.

        Args:
            prediction: (X, Y, Z) class ids, NumPy or a torch tensor.
            truth: (X, Y, Z) class ids, NumPy or a torch tensor.
            spec: geometry of both, Cartesian.
            origins: (O, 3) ray origins, metres, in the frame of the grid (see `ray_origins`).

        Returns:
            The metric itself.

        Raises:
            FormatError: shapes differ, or an id is not below `num_classes`.
            ArgumentError: the grid is cylindrical.
        """
        pred = self._check(prediction, "prediction", spec)
        true = self._check(truth, "truth", spec)
        near, far, off = _first_surfaces(pred, true, spec, origins, self)
        flat_pred = pred.reshape(-1)[near]
        flat_true = true.reshape(-1)[far]
        self.true += np.bincount(flat_true, minlength=self.num_classes)
        self.predicted += np.bincount(flat_pred, minlength=self.num_classes)
        same = flat_pred == flat_true
        for row, threshold in enumerate(THRESHOLDS_M):
            self.hits[row] += np.bincount(
                flat_true[same & (off < threshold)], minlength=self.num_classes
            )
        return self

    def compute(self) -> RayScore:
        """Return the score of all added frames."""
        iou = ratio(self.hits, self.true + self.predicted - self.hits)
        return RayScore(iou, self.free)

    def _check(self, labels: ArrayLike, name: str, spec: GridSpec) -> AnyArray:
        array = to_numpy(labels)
        if array.shape != spec.size:
            raise FormatError(name, expected=f"shape {spec.size}", found=array.shape)
        check_ids(name, array, self.num_classes)
        return array.astype(np.uint16, copy=False)


class RayPQ:
    """Panoptic quality of rays (SparseOcc): segments are sets of rays, and rays are common only if
    their depths agree within a threshold.

    Segments match at an IoU above 0.5. Each stuff class of the ground truth is one segment.
    Segments with fewer than 10 rays are not counted as false negatives or false positives. The
    arguments are those of `RayIoU`; `things` are the ids of classes with separate instances.
    """

    def __init__(
        self,
        num_classes: int,
        things: frozenset[int],
        *,
        free: int = 0,
        directions: ArrayLike | None = None,
    ) -> None:
        """Create an empty metric.

        `directions` are (R, 3) unit vectors of the rays; None takes `rayiou_directions`.
        """
        self.num_classes = num_classes
        self.things = things
        self.free = free
        self.directions = directions
        self.reset()

    def reset(self) -> None:
        """Set all sums to zero."""
        self.qualities = {
            threshold: PanopticQuality(self.num_classes, self.things, free=self.free)
            for threshold in THRESHOLDS_M
        }

    def update(
        self,
        prediction: tuple[ArrayLike, ArrayLike],
        truth: tuple[ArrayLike, ArrayLike],
        spec: GridSpec,
        origins: ArrayLike,
    ) -> Self:
        """Add a frame.

        Args:
            prediction: (X, Y, Z) class ids, and (X, Y, Z) instance ids.
            truth: (X, Y, Z) true class ids, and (X, Y, Z) true instance ids.
            spec: geometry of both, Cartesian.
            origins: (O, 3) ray origins, metres, in the frame of the grid (see `ray_origins`).
        """
        (pred, pred_ids), (true, true_ids) = (
            [to_numpy(a) for a in side] for side in (prediction, truth)
        )
        near, far, off = _first_surfaces(pred, true, spec, origins, self)
        classes = pred.reshape(-1)[near], true.reshape(-1)[far]
        is_thing = np.isin(classes[1], sorted(self.things))
        ids = pred_ids.reshape(-1)[near], np.where(is_thing, true_ids.reshape(-1)[far], 0)
        for threshold, quality in self.qualities.items():
            segments = match_segments(
                (classes[0], ids[0]), (classes[1], ids[1]), overlap=off < threshold, free=self.free
            )
            quality.add(segments, fewest=_FEWEST_RAYS)
        return self

    def compute(self) -> Mapping[float, PanopticScore]:
        """Return the panoptic score at each depth threshold, metres; RayPQ is the mean of their
        `pq`.
        """
        return {threshold: quality.compute() for threshold, quality in self.qualities.items()}

    def merge(self, other: RayPQ) -> Self:
        """Add the sums of another metric with the same settings.

        Raises:
            ArgumentError: its settings differ.
        """
        for threshold, quality in self.qualities.items():
            quality.merge(other.qualities[threshold])
        return self


def _first_surfaces(
    prediction: AnyArray,
    truth: AnyArray,
    spec: GridSpec,
    origins: ArrayLike,
    metric: RayIoU | RayPQ,
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return the first voxel of the prediction and of the ground truth on each ray with a surface
    in the ground truth, and the difference of their distances, metres.

    Args:
        prediction: (X, Y, Z) class ids.
        truth: (X, Y, Z) class ids.
        spec: geometry of the grids.
        origins: (O, 3) metres.
        metric: has the directions of the rays and the id of free space.
    """
    directions = rayiou_directions() if metric.directions is None else metric.directions
    voxels, depths = cast_rays(
        np.stack([prediction, truth]),
        spec,
        np.asarray(origins),
        np.asarray(directions),
        free=metric.free,
    )
    valid = (voxels[1] >= 0) & (truth.reshape(-1)[voxels[1]] != metric.free)
    return voxels[0][valid], voxels[1][valid], np.abs(depths[0] - depths[1])[valid]
