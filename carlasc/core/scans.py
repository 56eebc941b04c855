"""A LiDAR scan: the labels, flow and other values of its points, and the boxes around its objects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.boxes import Boxes
from carlasc.core.grids import GridSpec
from carlasc.core.notebook import describe
from carlasc.core.wording import count
from carlasc.errors import FormatError


@dataclass(frozen=True)
class Scan:
    """One sweep of one sensor, in the frame of that sensor.

    Attributes:
        points: (N, 3) float32, metres, sensor frame.
        labels: (N,) unsigned integer class ids, 0 is unlabelled; or None.
        flow: (N, 3) float32 m/s, velocity of the actor hit, sensor frame, ego motion removed; or None.
        instances: (N,) uint32 actor ids, 0 is none; or None.
        remission: (N,) float32, the 4th column of the file (zero in CarlaSC); or None.
        others: other fields of the layout with one row per point, by name.
        boxes: tracked boxes of the frame, sensor frame, none if nothing was there; or None where the frame was not annotated.

    Raises:
        FormatError: the shapes of the arrays do not match.
    """

    points: NDArray[np.float32]
    labels: NDArray[np.unsignedinteger] | None = None
    flow: NDArray[np.float32] | None = None
    instances: NDArray[np.uint32] | None = None
    remission: NDArray[np.float32] | None = None
    others: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    boxes: Boxes | None = None

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise FormatError("scan points", expected="shape (N, 3)", found=str(self.points.shape))
        count = len(self.points)
        expected = {"labels": (count,), "flow": (count, 3), "instances": (count,), "remission": (count,)}
        for name, shape in expected.items():
            array = getattr(self, name)
            if array is not None and array.shape != shape:
                raise FormatError(f"scan {name}", expected=f"shape {shape} for {count} points", found=str(array.shape))
        for name, array in self.others.items():
            if len(array) != count:
                raise FormatError(f"scan {name}", expected=f"{count} rows for {count} points", found=str(len(array)))

    def __len__(self) -> int:
        return len(self.points)

    def fields(self) -> tuple[str, ...]:
        """Return the names of what the scan has for each point, without `points`."""
        own = (name for name in ("labels", "flow", "instances", "remission") if getattr(self, name) is not None)
        return (*own, *self.others)

    def __repr__(self) -> str:
        boxes = "" if self.boxes is None else f"; {count(len(self.boxes.tracks), 'box', 'boxes')}"
        return f"<Scan of {count(len(self), 'point')}: {', '.join(self.fields()) or 'no other field'}{boxes}>"

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the fields, and the heights of the points from above."""
        reach = float(np.percentile(np.abs(self.points[:, :2]), 99)) if len(self) else 1.0
        low, high = np.percentile(self.points[:, 2], (1, 99)).tolist() if len(self) else (0.0, 1.0)
        spec = GridSpec("cartesian", (200, 200, 32), (-reach, -reach, low), (reach, reach, max(high, low + 0.1)))
        labels = np.zeros(spec.num_voxels, np.uint8)
        voxels = spec.flat_index(self.points)
        labels[voxels[voxels >= 0]] = 1
        rows = {"fields": ", ".join(self.fields()), "drawn": f"{reach:.0f} m in x and y"}
        return describe(repr(self), rows, spec.seen_from_above(labels.reshape(spec.size)))

    def select(self, keep: NDArray[np.bool_] | NDArray[np.integer]) -> Scan:
        """Return the points that a mask of shape (N,) or indices of shape (M,) select, with all of their fields; boxes are kept."""

        def chosen(values: NDArray[Any] | None) -> NDArray[Any] | None:
            return None if values is None else values[keep]

        return Scan(
            self.points[keep],
            chosen(self.labels),
            chosen(self.flow),
            chosen(self.instances),
            chosen(self.remission),
            {name: values[keep] for name, values in self.others.items()},
            self.boxes,
        )


def sorted_by_origin(origins: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the order, (N,), in which points with equal (N, 3) origins are next to each other; the order of equal ones is kept."""
    starts = _starts(origins)
    group = np.unique(origins[starts], axis=0, return_inverse=True)[1].reshape(-1)
    return np.argsort(np.repeat(group, np.diff([*starts, len(origins)])), kind="stable")


def runs_of_origins(origins: NDArray[np.floating] | None, count: int) -> list[tuple[slice, NDArray[np.floating]]]:
    """Return the runs of points with equal (N, 3) origins, and the (3,) origin of each.

    Args:
        origins: metres; None if the rays of all points begin at (0, 0, 0).
        count: number of points.
    """
    if origins is None or not count:
        return [(slice(0, count), np.zeros(3, np.float32))]
    starts = _starts(origins).tolist()
    return [(slice(a, b), origins[a]) for a, b in zip(starts, [*starts[1:], count], strict=True)]


def _starts(origins: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return where each run of equal rows begins."""
    changes = (origins[1:] != origins[:-1]).any(axis=1)
    return np.concatenate([np.zeros(min(len(origins), 1), np.int64), np.flatnonzero(changes) + 1])


def check_finite(points: NDArray[np.floating], name: str) -> None:
    """Raise a FormatError that names the first point that is NaN or infinite; `name` is the file."""
    if not np.isfinite(points).all():
        row = int(np.flatnonzero(~np.isfinite(points).reshape(len(points), -1).all(axis=1))[0])
        raise FormatError(name, expected="finite coordinates", found=f"{points[row].tolist()} at point {row}")
