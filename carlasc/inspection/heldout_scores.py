"""How well grids predict scans that did not take part in them: counts of rays by class and
distance, and shares of these.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from carlasc.core.arrays import (
    AnyFloatArray,
    AnyIntArray,
    BoolArray,
    FloatArray,
    IntArray,
    Uint8Array,
)
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform, invert, transform_points
from carlasc.core.grids import Grid, GridSpec
from carlasc.core.scans import runs_of_origins, sorted_by_origin
from carlasc.inspection.points_in_voxels import OUTSIDE, UNKNOWN, labels_at
from carlasc.metrics.casting import follow_rays

BANDS_M = (0.0, 10.0, 20.0, 30.0, np.inf)
"""Bounds of the distance bands, metres."""
VEHICLE_M = ((-2.2, -0.75, -1.2), (2.2, 0.75, 0.0))
"""Lower and upper corner of a box that is inside of the recording vehicle, in the frame of its
sensor (x forward), metres.
"""

# bits of a voxel: it is occupied; its class is not ground
_SOLID = 1
_OBJECT = 2
# histogram of the errors of the first hit; the last bin holds all larger ones
_STEP_M = 0.02
_STEPS = 500


@dataclass(frozen=True)
class RayShares:
    """Shares of some held-out rays, of the returns inside the grid; None if nothing could be
    measured.

    Attributes:
        returns: number of returns.
        free: share of returns that lie in a voxel called free.
        unknown: share of returns that lie in an unknown voxel.
        occupied: share of returns that lie in an occupied voxel.
        passed: share of rays that pass through an occupied voxel before their return; the voxel of
            the return and its 26 neighbours do not count.
        passed_object: the same for voxels of classes other than ground. Without labels, the lowest
            occupied voxel of each column and the one above it are taken as ground.
        missed: share of rays without an occupied voxel, both before and behind their return.
        error_median_m: median over the other rays of |first hit - measured range|, metres; the
            first hit is in the middle of the ray's path through its first occupied voxel.
        error_90_m: 90% of these errors are at most this large, metres.
    """

    returns: int
    free: float | None
    unknown: float | None
    occupied: float | None
    passed: float | None
    passed_object: float | None
    missed: float | None
    error_median_m: float | None
    error_90_m: float | None


@dataclass(frozen=True, eq=False)
class HeldOutScores:
    """Counts of the held-out rays of some frames; `merge` adds those of other frames.

    Attributes:
        classes: class table of the scans.
        labelled: whether the scans have labels.
        frames: number of frames that were left out and measured.
        counts: (K, B, 6) int64 rays by class and band: returns, in free voxels, in unknown ones,
            passed, passed an object, missed.
        errors: (K, B, E) int64 histogram of the errors of the first hit.
        swept_voxels: number of voxels that the vehicle itself drove through in the other frames of
            the windows.
        swept_known: how many of them are known.
        swept_occupied: how many of them are occupied.
    """

    classes: ClassTable
    labelled: bool
    frames: int
    counts: IntArray
    errors: IntArray
    swept_voxels: int = 0
    swept_known: int = 0
    swept_occupied: int = 0

    @classmethod
    def empty(cls, classes: ClassTable) -> HeldOutScores:
        """Return the scores of no frame."""
        counts, errors = (
            np.zeros((classes.num_channels, len(BANDS_M) - 1, columns), np.int64)
            for columns in (6, _STEPS + 1)
        )
        return cls(classes, True, 0, counts, errors)

    @classmethod
    def of(
        cls,
        grid: Grid,
        classes: ClassTable,
        points: AnyFloatArray,
        labels: AnyIntArray | None,
        grid_T_vehicles: Iterable[Transform] = (),
        origins: AnyFloatArray | None = None,
    ) -> HeldOutScores:
        """Measure one frame.

        Args:
            grid: the grid at the frame, made without its scan; Cartesian, in the sensor frame of
                the scan.
            classes: class table of grid and labels.
            points: (N, 3) metres, the scan, sensor frame.
            labels: (N,) class ids; None if the scan has no labels.
            grid_T_vehicles: (4, 4) poses of the sensor in the other frames of the window, in the
                frame of the grid.
            origins: (N, 3) metres, where the ray of each point began, sensor frame; None: at the
                sensor.

        Raises:
            ArgumentError: the grid is cylindrical.
        """
        spec = grid.spec
        occupied = grid.known & (grid.labels != 0)
        if labels is None:
            ground = lowest_of_columns(occupied)
            kinds = np.full(len(points), classes.geometry_id)
        else:
            ground = np.isin(grid.labels, sorted(classes.ground))
            kinds = labels.astype(np.int64)
        solid = np.where(occupied, np.where(ground, _SOLID, _SOLID | _OBJECT), 0).astype(np.uint8)
        at_points = labels_at(points, spec, grid.labels, grid.known)
        inside = (at_points != OUTSIDE) & np.any(points != 0, axis=1)
        begun = np.zeros_like(points) if origins is None else origins
        ends = points[inside].astype(np.float64)
        begun = begun[inside].astype(np.float64)
        first, passed = _follow(solid, spec, begun, ends)
        ranges = np.linalg.norm(ends - begun, axis=1)
        at_points = at_points[inside]
        missed = np.isinf(first)
        cells = kinds[inside], np.searchsorted(BANDS_M, ranges, side="right") - 1
        free = at_points == 0
        unknown = at_points == UNKNOWN
        columns = (free | True, free, unknown, passed != 0, passed & _OBJECT != 0, missed)
        scores = cls.empty(classes)
        np.add.at(scores.counts, cells, np.column_stack(columns))
        step = np.minimum(np.abs(first - ranges) / _STEP_M, _STEPS).astype(np.int64)
        np.add.at(scores.errors, (*cells, step), ~missed)
        swept = swept_voxels(spec, grid_T_vehicles)
        figures = (int((swept & those).sum()) for those in (swept, grid.known, occupied))
        return cls(classes, labels is not None, 1, scores.counts, scores.errors, *figures)

    def merge(self, other: HeldOutScores) -> HeldOutScores:
        """Return the scores of the frames of both, which have the same class table."""
        sums = {
            name: getattr(self, name) + getattr(other, name)
            for name in vars(self)
            if name not in ("classes", "labelled")
        }
        return HeldOutScores(self.classes, self.labelled and other.labelled, **sums)

    @property
    def swept_share(self) -> float | None:
        """Share of the voxels that the vehicle itself drove through in the other frames that are
        occupied; None if there are none.
        """
        return self.swept_occupied / self.swept_voxels if self.swept_voxels else None

    @property
    def all(self) -> RayShares:
        """All rays."""
        return self._shares(...)

    def by_class(self) -> dict[str, RayShares]:
        """Return the rays of each class that occurs, by its name; empty if the scans have no
        labels.
        """
        if not self.labelled:
            return {}
        return {
            self.classes.names.get(i, str(i)): self._shares(i)
            for i in np.flatnonzero(self.counts[:, :, 0].any(axis=1)).tolist()
        }

    def by_distance(self) -> dict[str, RayShares]:
        """Return the rays of each band of distances, by its name, such as "10-20 m"."""
        names = [f"{low:.0f}-{high:.0f} m" for low, high in pairwise(BANDS_M[:-1])]
        names.append(f"{BANDS_M[-2]:.0f} m and more")
        return {name: self._shares((slice(None), i)) for i, name in enumerate(names)}

    def to_dict(self) -> dict[str, Any]:
        """Return all figures as plain values for JSON."""
        return {
            "frames": self.frames,
            "rays": vars(self.all),
            "by_class": {name: vars(shares) for name, shares in self.by_class().items()},
            "by_distance": {name: vars(shares) for name, shares in self.by_distance().items()},
            "swept": {
                "voxels": self.swept_voxels,
                "known": self.swept_known,
                "occupied": self.swept_occupied,
                "occupied_share": self.swept_share,
            },
        }

    def _shares(self, chosen: Any) -> RayShares:
        """Return the shares of the rays of some classes and bands, by an index of both."""
        returns, free, unknown, *others = _summed(self.counts[chosen]).tolist()
        counts = (free, unknown, returns - free - unknown, *others)
        errors = _summed(self.errors[chosen])
        shares = [part / returns if returns else None for part in counts]
        shares += [_quantile(errors, 0.5), _quantile(errors, 0.9)]
        return RayShares(returns, *shares)


def _summed(counts: IntArray) -> IntArray:
    return counts.reshape(-1, counts.shape[-1]).sum(axis=0)


def swept_voxels(spec: GridSpec, grid_T_vehicles: Iterable[Transform]) -> BoolArray:
    """Return (X, Y, Z) bool: the voxels whose centre lies in the space that the vehicle fills at
    any of some poses.

    Args:
        spec: geometry of the grid, Cartesian.
        grid_T_vehicles: (4, 4) poses of the vehicle's sensor in the frame of the grid, x forward.
    """
    centers, (lower, upper) = spec.centers(), np.array(VEHICLE_M)
    axes = (centers[:, 0, 0, 0], centers[0, :, 0, 1], centers[0, 0, :, 2])
    swept = np.zeros(spec.size, np.bool_)
    reach_m = np.linalg.norm(np.abs(VEHICLE_M).max(axis=0))
    for pose in grid_T_vehicles:
        near = np.ix_(
            *(np.abs(axis - at) < reach_m for axis, at in zip(axes, pose[:3, 3], strict=True))
        )
        body = transform_points(invert(pose), centers[near])
        swept[near] |= ((body > lower) & (body < upper)).all(axis=-1)
    return swept


def lowest_of_columns(occupied: BoolArray) -> BoolArray:
    """Return (X, Y, Z) bool: the lowest occupied voxel of each column, and the one above it."""
    lowest = occupied & (occupied.cumsum(axis=2) == 1)
    above = np.zeros_like(lowest)
    above[:, :, 1:] = lowest[:, :, :-1]
    return lowest | above


def _quantile(errors: IntArray, share: float) -> float | None:
    """Return a quantile of a histogram of errors, in metres, to the width of its bins; 10 m stands
    for all larger ones.
    """
    total = int(errors.sum())
    if not total:
        return None
    middle = int(np.searchsorted(errors.cumsum(), share * total)) + 0.5
    return round(min(middle, _STEPS) * _STEP_M, 3)


def depth_errors(
    occupied: BoolArray, spec: GridSpec, origins: FloatArray, points: FloatArray
) -> FloatArray:
    """Return (N,) metres, absolute: the distance from the origin of a ray to the first occupied
    voxel on it, compared with its return (MAE of Kälble et al., CVPR 2024).

    Where no voxel on the ray is occupied, its end at the edge of the grid counts.

    Args:
        occupied: (X, Y, Z) bool.
        spec: geometry of the grid, Cartesian.
        origins: (N, 3) metres, in the frame of the grid; few different ones.
        points: (N, 3) metres, returns inside the grid.
    """
    first, _ = _follow(occupied.astype(np.uint8), spec, origins, points)
    rays = points - origins
    lengths = np.linalg.norm(rays, axis=1)
    edges = np.where(rays > 0, spec.upper, spec.lower)
    with np.errstate(divide="ignore", invalid="ignore"):
        until = np.where(rays == 0, np.inf, (edges - origins) / rays).min(axis=1) * lengths
    depth = np.where(np.isfinite(first), first, until)
    return np.where(lengths > 0, np.abs(depth - lengths), 0.0)


def _follow(
    solid: Uint8Array, spec: GridSpec, origins: FloatArray, points: FloatArray
) -> tuple[FloatArray, Uint8Array]:
    """Return what `follow_rays` returns, for (N, 3) rays that begin at (N, 3) origins, of which
    there are few different ones.
    """
    order = sorted_by_origin(origins)
    first = np.empty(len(points))
    passed = np.empty(len(points), np.uint8)
    for part, origin in runs_of_origins(origins[order], len(points)):
        rows = order[part]
        first[rows], passed[rows] = follow_rays(solid, spec, origin, points[rows])
    return first, passed
