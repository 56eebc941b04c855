"""An observation: the points of one scan, their labels, and the pose of the sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import Transform, check_rigid
from carlasc.errors import FormatError

NOWHERE = 65534
"""A region without voxels: rays with it do not vote."""


@dataclass(frozen=True)
class Observation:
    """One voter: the scan of one sensor at one instant. Its points vote for their classes, its rays for free space.

    Attributes:
        points: (N, 3) float32, metres, in the sensor's frame. The rounding to float32 is part of the rule: see the format page,
            `docs/format.md#votes`.
        labels: (N,) unsigned integer class ids. Points labelled 0 and their rays do not vote.
        grid_T_sensor: (4, 4) float64, from the sensor's frame to the grid's.
        hits: (N,) bool, points that vote for their class; of the other points only the rays vote. None: all points.
        hit_region: region of the grid in which the points vote; None for the whole grid.
        free_region: region of the grid in which the rays vote; None for the whole grid.

    Raises:
        FormatError: points and labels differ in length, have another shape or type, or the transform is not rigid.
    """

    points: NDArray[np.float32]
    labels: NDArray[np.unsignedinteger]
    grid_T_sensor: Transform
    hits: NDArray[np.bool_] | None = None
    hit_region: int | None = None
    free_region: int | None = None

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 3 or self.points.dtype != np.float32:
            found = f"{self.points.shape} {self.points.dtype}"
            raise FormatError("observation points", expected="shape (N, 3) float32", found=found)
        if self.labels.shape != (len(self.points),):
            expected = f"shape ({len(self.points)},), one per point"
            raise FormatError("observation labels", expected=expected, found=str(self.labels.shape))
        if self.labels.dtype.kind != "u":
            raise FormatError("observation labels", expected="unsigned integers", found=str(self.labels.dtype))
        if self.hits is not None and self.hits.shape != self.labels.shape:
            raise FormatError("observation hits", expected=f"shape ({len(self.points)},)", found=str(self.hits.shape))
        check_rigid(self.grid_T_sensor, "observation grid_T_sensor")

    def __len__(self) -> int:
        return len(self.points)
