"""LiDAR scans: points with labels, flow and other values, and boxes; and the rays of a scan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import reduce
from operator import or_
from typing import Any

import numpy as np

from carlasc.core.arrays import (
    AnyArray,
    AnyFloatArray,
    AnyIntArray,
    BoolArray,
    Float32Array,
    FloatArray,
    Int32Array,
    IntArray,
    LabelArray,
    Uint16Array,
    Uint32Array,
)
from carlasc.core.boxes import Boxes, mirror_boxes
from carlasc.core.geometry import mirror_points, translation
from carlasc.core.grids import GridSpec
from carlasc.core.notebook import describe
from carlasc.errors import FormatError, check_types, count

# Points that move by this share of the half of their distances, and more than a metre, while poses
# move by a fifth of that and the distance of the nearest points changes by a factor, are in a frame
# that they were moved to.
_CENTRE = 0.4
_CENTRE_M = 1.0
_STANDING = 0.2
_NEARER = 1.3
_SAMPLE = 4000  # points of a scan that tell it

_TURN = 65_000  # steps of azimuth per turn, of about 0.1 mrad; they fit into 16 bits


@dataclass(frozen=True)
class Scan:
    """One sweep of one sensor, in the frame of that sensor.

    Attributes:
        points: (N, 3) float32, metres, sensor frame.
        labels: (N,) unsigned integer class ids, 0 is unlabelled; or None.
        flow: (N, 3) float32 m/s, velocity of the actor hit, sensor frame, ego motion removed; or
            None.
        instances: (N,) uint32 actor ids, 0 is none; or None.
        remission: (N,) float32, the 4th column of the file (zero in CarlaSC); or None.
        others: other fields of the layout with one row per point, by name.
        boxes: tracked boxes of the frame, sensor frame; may be empty; or None if the frame is not
            annotated.

    Raises:
        FormatError: the shapes of the arrays do not match.
    """

    points: Float32Array
    labels: LabelArray | None = None
    flow: Float32Array | None = None
    instances: Uint32Array | None = None
    remission: Float32Array | None = None
    others: Mapping[str, AnyArray] = field(default_factory=dict)
    boxes: Boxes | None = None

    def __post_init__(self) -> None:
        check_types(Scan, vars(self))
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise FormatError("scan points", expected="shape (N, 3)", found=self.points.shape)
        count = len(self.points)
        expected = {
            "labels": (count,),
            "flow": (count, 3),
            "instances": (count,),
            "remission": (count,),
        }
        for name, shape in expected.items():
            array = getattr(self, name)
            if array is not None and array.shape != shape:
                raise FormatError(
                    f"scan {name}",
                    expected=f"shape {shape} for {count} points",
                    found=array.shape,
                )
        for name, array in self.others.items():
            if len(array) != count:
                raise FormatError(
                    f"scan {name}",
                    expected=f"{count} rows for {count} points",
                    found=len(array),
                )

    def __len__(self) -> int:
        return len(self.points)

    def fields(self) -> tuple[str, ...]:
        """Return the names of the fields with one row per point, without `points`."""
        own = (
            name
            for name in ("labels", "flow", "instances", "remission")
            if getattr(self, name) is not None
        )
        return (*own, *self.others)

    def __repr__(self) -> str:
        boxes = "" if self.boxes is None else f"; {count(len(self.boxes.tracks), 'box', 'boxes')}"
        fields = ", ".join(self.fields()) or "no other field"
        return f"<Scan of {count(len(self), 'point')}: {fields}{boxes}>"

    def _repr_html_(self) -> str:
        """Return the HTML for notebooks: the fields, and the heights of the points from above."""
        reach = float(np.percentile(np.abs(self.points[:, :2]), 99)) if len(self) else 1.0
        low, high = np.percentile(self.points[:, 2], (1, 99)).tolist() if len(self) else (0.0, 1.0)
        spec = GridSpec(
            "cartesian", (200, 200, 32), (-reach, -reach, low), (reach, reach, max(high, low + 0.1))
        )
        labels = np.zeros(spec.num_voxels, np.uint8)
        voxels = spec.flat_index(self.points)
        labels[voxels[voxels >= 0]] = 1
        rows = {"fields": ", ".join(self.fields()), "drawn": f"{reach:.0f} m in x and y"}
        return describe(repr(self), rows, spec.seen_from_above(labels.reshape(spec.size)))

    def select(self, keep: BoolArray | AnyIntArray) -> Scan:
        """Return a scan with the points selected by an (N,) mask or (M,) indices, with all their
        fields. Boxes are kept.
        """
        # of rows, `take` is several times faster than an index or a mask
        rows = np.flatnonzero(keep) if keep.dtype == np.bool_ else keep
        others = {name: values.take(rows, axis=0) for name, values in self.others.items()}
        own = {
            name: getattr(self, name).take(rows, axis=0)
            for name in ("points", *self.fields())
            if name not in others
        }
        return replace(self, others=others, **own)


def sorted_by_origin(origins: AnyFloatArray) -> IntArray:
    """Return (N,) indices that sort points by their (N, 3) origins, or (N, 4) origins and times.

    The sort is stable.
    """
    starts = _starts(origins)
    group = np.unique(origins[starts], axis=0, return_inverse=True)[1].reshape(-1)
    return np.argsort(np.repeat(group, np.diff([*starts, len(origins)])), kind="stable")


def runs_of_origins(origins: AnyFloatArray | None, count: int) -> list[tuple[slice, AnyFloatArray]]:
    """Return the runs of consecutive points with equal origins, and the row of each run.

    Args:
        origins: (N, 3) metres, or (N, 4) with times; None if all rays begin at (0, 0, 0).
        count: number of points.
    """
    if origins is None or not count:
        return [(slice(0, count), np.zeros(3, np.float32))]
    starts = _starts(origins).tolist()
    return [(slice(a, b), origins[a]) for a, b in zip(starts, [*starts[1:], count], strict=True)]


def _starts(origins: AnyFloatArray) -> IntArray:
    """Return where each run of equal rows begins."""
    # five times as fast column by column as row by row
    changes = reduce(or_, (axis[1:] != axis[:-1] for axis in origins.T))
    return np.concatenate([np.zeros(min(len(origins), 1), np.int64), np.flatnonzero(changes) + 1])


@dataclass(frozen=True)
class Rays:
    """The rays of a scan, from K origins and times: several for several sensors, or a sensor that
    moves or turns during the scan.

    Attributes:
        points: (N, 3) float32, where the rays end, relative to their origins, metres.
        ends: (K,) index after the last ray of each origin.
        sensor_T_places: (K, 4, 4), from the frame at each origin, with the axes of the sensor, to
            the sensor frame.
        seconds: (K,) time of the rays after that of the scan.
        order: (N,) int32, the rays of each origin by increasing azimuth.
        azimuth: (N,) uint16, their azimuths from -pi, in steps; a full circle has `_TURN` steps.
    """

    points: Float32Array
    ends: IntArray
    sensor_T_places: FloatArray
    seconds: FloatArray
    order: Int32Array
    azimuth: Uint16Array

    @classmethod
    def of(cls, points: Float32Array, origins: AnyFloatArray | None) -> Rays:
        """Return the rays to (N, 3) points, given relative to their origins: see
        `runs_of_origins`.
        """
        runs = runs_of_origins(origins, len(points))
        azimuth = _steps(np.arctan2(points[:, 1], points[:, 0])).astype(np.uint16)
        # a radix sort, because they have 16 bits
        order = [part.start + np.argsort(azimuth[part], kind="stable") for part, _ in runs]
        rays = np.concatenate(order).astype(np.int32)
        ends = np.array([part.stop for part, _ in runs])
        places = np.stack([translation(origin[:3]) for _, origin in runs])
        seconds = np.array([float(origin[3:].sum()) for _, origin in runs])
        return cls(points, ends, places, seconds, rays, azimuth[rays])

    def through(
        self, box_T_places: FloatArray, lower: FloatArray, upper: FloatArray
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """Return the (M,) indices of the rays, from the origin to the point, that intersect a box,
        the (K,) index after the last one of each origin, and the (M, 3) points in the frame of the
        box, metres.

        Args:
            box_T_places: (K, 4, 4), from the frame at each origin to the frame in which the box is
                axis-aligned.
            lower: (3,) lower corner.
            upper: (3,) upper corner.
        """
        from carlasc.core.cells import find_crossing

        rays = self.points, self.order, self.azimuth, self.ends
        poses = np.ascontiguousarray(box_T_places[:, :3]).reshape(-1, 12)
        return find_crossing(*rays, poses, np.stack([lower, upper]), _TURN)


def _steps(azimuth_rad: Any) -> Any:
    """Return azimuths in steps from -pi, not rounded."""
    return (azimuth_rad + np.pi) * (_TURN / (2 * np.pi))


def lengths(vectors: Float32Array) -> Float32Array:
    """Return the (N,) lengths of (N, 3) vectors, in the same dtype."""
    x, y, z = vectors.T
    return np.sqrt(x * x + y * y + z * z)


def finite(points: AnyFloatArray) -> BoolArray:
    """Return (N,) bool: whether each of (N, 3) points has three finite coordinates."""
    x, y, z = (np.isfinite(axis) for axis in points.T)
    return x & y & z


def check_finite(points: AnyFloatArray, name: str) -> None:
    """Raise a FormatError for the first of (N, 3) points that is NaN or infinite.

    `name` is the file named in the message.
    """
    if not np.isfinite(points).all():
        row = int(np.flatnonzero(~np.isfinite(points).reshape(len(points), -1).all(axis=1))[0])
        raise FormatError(
            name, expected="finite coordinates", found=f"{points[row].tolist()} at point {row}"
        )


def mirror_scan(scan: Scan) -> Scan:
    """Mirror a scan: points, flow, ray origins and boxes."""
    return replace(
        scan,
        points=mirror_points(scan.points),
        flow=None if scan.flow is None else mirror_points(scan.flow),
        others={
            name: mirror_points(v) if name == "origins" else v for name, v in scan.others.items()
        },
        boxes=None if scan.boxes is None else mirror_boxes(scan.boxes),
    )


class ScanCentres:
    """Where the points of the scans of a drive are."""

    def __init__(self) -> None:
        self._scans: list[tuple[float, ...]] = []

    def add(self, points: AnyFloatArray) -> None:
        """Add (N, 3 or more) points of the next scan, metres, N > 0."""
        sample = points[:: max(1, len(points) // _SAMPLE), :2].astype(np.float64)
        nearest, half = np.percentile(np.hypot(*sample.T), (1, 50))
        self._scans.append((*np.median(sample, axis=0), nearest, half))

    def moved_m(self, poses: FloatArray) -> float:
        """Return how far the points move, metres, if the poses stand meanwhile, as those of scans
        do that are in the world frame; else 0.

        Args:
            poses: (F, 4, 4) first_T_sensor.
        """
        if not self._scans or not len(poses):
            return 0.0
        scans = np.array(self._scans)
        part = max(1, len(scans) // 5)
        moved = np.median(scans[-part:], axis=0) - np.median(scans[:part], axis=0)
        moved_m = float(np.hypot(*moved[:2]))
        way = np.linalg.norm(poses[:, :2, 3] - poses[0, :2, 3], axis=1).max()
        nearest = scans[:, 2] + 1e-3
        stands = way < _STANDING * moved_m and nearest.max() > _NEARER * nearest.min()
        least = max(_CENTRE_M, _CENTRE * float(np.median(scans[:, 3])))
        return moved_m if stands and moved_m > least else 0.0
