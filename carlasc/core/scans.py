"""A LiDAR scan with what is known of each of its points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import FormatError


@dataclass(frozen=True)
class Scan:
    """One sweep of one sensor, in that sensor's frame.

    Attributes:
        points: (N, 3) float32, metres, sensor frame.
        labels: (N,) unsigned integer class ids, 0 is unlabelled; or None.
        flow: (N, 3) float32 m/s, velocity of the actor hit, sensor frame, ego motion removed; or None.
        instances: (N,) uint32 actor ids, 0 is none; or None.
        remission: (N,) float32, the 4th column of the file (zero in CarlaSC); or None.

    Raises:
        FormatError: shapes do not fit each other.
    """

    points: NDArray[np.float32]
    labels: NDArray[np.unsignedinteger] | None = None
    flow: NDArray[np.float32] | None = None
    instances: NDArray[np.uint32] | None = None
    remission: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise FormatError("scan points", expected="shape (N, 3)", found=f"{self.points.shape}")
        count = len(self.points)
        expected = {"labels": (count,), "flow": (count, 3), "instances": (count,), "remission": (count,)}
        for name, shape in expected.items():
            array = getattr(self, name)
            if array is not None and array.shape != shape:
                raise FormatError(f"scan {name}", expected=f"shape {shape} for {count} points", found=f"{array.shape}")

    def __len__(self) -> int:
        return len(self.points)

    def select(self, keep: NDArray[np.bool_] | NDArray[np.integer]) -> Scan:
        """Return the scan of the points chosen by a mask or by indices, every field alike."""
        others: tuple[Any, ...] = (self.labels, self.flow, self.instances, self.remission)
        return Scan(self.points[keep], *(None if field is None else field[keep] for field in others))


def check_finite(points: NDArray[np.floating], name: str) -> None:
    """Raise FormatError naming the first point that is NaN or infinite; `name` is the file."""
    if not np.isfinite(points).all():
        row = int(np.flatnonzero(~np.isfinite(points).reshape(len(points), -1).all(axis=1))[0])
        raise FormatError(name, expected="finite coordinates", found=f"{points[row].tolist()} at point {row}")
