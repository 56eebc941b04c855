"""What one voter saw: the points of one scan, what they are, and where its sensor stood."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import Transform, check_rigid
from carlasc.errors import FormatError


@dataclass(frozen=True)
class Observation:
    """One voter: the scan of one sensor at one instant. It says what its points hit, and that its rays passed freely.

    Attributes:
        points: (N, 3) float32, metres, the sensor's own frame. float32 is part of the rule (FORMAT section 4).
        labels: (N,) unsigned integer class ids; points labelled 0 take no part, their rays neither.
        grid_T_sensor: (4, 4) float64, from the sensor's frame to the grid's.
        hits: (N,) bool, points that vote for their class; the others only let their rays vote. None: all.
        hit_region: region of the grid in which the points vote; None: all of it.
        free_region: region of the grid in which the rays vote; None: all of it.

    Raises:
        FormatError: points and labels disagree, have another shape or type, or the transform is not rigid.
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
            raise FormatError("observation points", expected="shape (N, 3) float32", found=f"{found}")
        if self.labels.shape != (len(self.points),):
            expected = f"shape ({len(self.points)},), one a point"
            raise FormatError("observation labels", expected=f"{expected}", found=f"{self.labels.shape}")
        if self.labels.dtype.kind != "u":
            raise FormatError("observation labels", expected="unsigned integers", found=f"{self.labels.dtype}")
        if self.hits is not None and self.hits.shape != self.labels.shape:
            raise FormatError("observation hits", expected=f"shape ({len(self.points)},)", found=f"{self.hits.shape}")
        check_rigid(self.grid_T_sensor, "observation grid_T_sensor")

    def __len__(self) -> int:
        return len(self.points)
