"""The height of the sensor above the ground, and grids that are moved to the ground for sensors
higher than CarlaSC's.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from carlasc.core.arrays import Float32Array, LabelArray
from carlasc.core.grids import GridSpec
from carlasc.motion import ground_height, ground_points

_BELOW = 0.05  # greatest share of ground points below a grid; fact: below-grid
_LOW = 0.05  # quantile of the heights of ground points that a moved grid contains
_OF_EACH = 1000  # number of heights that represent one drive
_REACH_M = 25.0  # greatest horizontal distance of ground points
_SLACK_M = 0.6  # a grid that begins so far below the ground is moved up


@dataclass(frozen=True)
class Ground:
    """The ground around a sensor.

    Attributes:
        heights_m: z of ground points around the sensor, sensor frame; at least one.
        below_m: height of the sensor above the ground under it.
    """

    heights_m: Float32Array
    below_m: float


def ground_of(
    points: Float32Array, labels: LabelArray | None, ground: Collection[int]
) -> Float32Array:
    """Return the points on the ground: by their labels, or by their heights if they have none.

    Args:
        points: (N, 3) metres, in the frame of the sensor.
        labels: (N,) class ids, or None.
        ground: ids of the ground classes; without any, heights decide.
    """
    on_ground = (
        ground_points(points) if labels is None or not ground else np.isin(labels, sorted(ground))
    )
    return points[on_ground]


def find_ground(scans: Iterable[Float32Array], reach_m: float = _REACH_M) -> Ground | None:
    """Return the ground in some scans, (N, 3) or (N, 4), within a horizontal distance of the
    sensor; None if there is none.
    """
    heights: list[Float32Array] = []
    near: list[float] = []
    for points in scans:
        ground = points[ground_points(points), :3]
        distance = np.hypot(ground[:, 0], ground[:, 1])
        heights.append(ground[distance < reach_m, 2])
        below = ground_height(points)
        near += [below] if np.isfinite(below) else []
    if not near or not sum(map(len, heights)):
        return None
    return Ground(np.concatenate(heights), -float(np.median(near)))


def joined(grounds: Sequence[Ground]) -> Ground:
    """Return the ground in the scans of one or more drives.

    Each drive has the same weight, for any number of points.
    """
    if len(grounds) == 1:
        return grounds[0]
    shares = np.linspace(0, 1, _OF_EACH)
    heights = [np.quantile(ground.heights_m, shares).astype(np.float32) for ground in grounds]
    return Ground(np.concatenate(heights), float(np.median([ground.below_m for ground in grounds])))


def share_below(ground: Ground, spec: GridSpec) -> float:
    """Return the share of ground points that are below a grid."""
    return float((ground.heights_m < spec.lower[2]).mean())


def fit_to_ground(spec: GridSpec, ground: Ground) -> GridSpec:
    """Return a grid moved up or down by whole voxels so that the ground is in its lowest layers;
    unchanged if it already is.
    """
    size = float(spec.voxel_size[2])
    low = float(np.quantile(ground.heights_m, _LOW))
    if share_below(ground, spec) <= _BELOW and low - spec.lower[2] < max(_SLACK_M, 2 * size):
        return spec
    layers = int(np.floor((low - spec.lower[2]) / size))
    if not layers:
        return spec
    (x0, y0, z0), (x1, y1, z1) = spec.lower, spec.upper
    # params.json has float32 bounds
    low, high = (float(np.float32(z + layers * size)) for z in (z0, z1))
    return replace(spec, lower=(x0, y0, low), upper=(x1, y1, high))
