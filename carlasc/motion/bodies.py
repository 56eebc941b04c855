"""Bodies: how large an actor is, although no scan saw all of it.

A scan sees only the faces of an actor that are turned to the sensor. Pooled over its whole track, the sightings show some of its faces; a
car that drives ahead shows its rear alone. Length and width are known if they can be read off the faces that were seen. Otherwise they are
those of similar actors of the same data, or of a table, and the body extends from the face that was seen away from the sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_TRIM = 0.01  # fraction of points that may be outside an actor's body: outliers, points of a neighbour
_FACE_POINTS, _FACE_SHARE = (
    12,
    0.02,
)  # a face was seen if scans with so many points, and this share of them, looked at it
_FACE_SINE = 0.26  # a ray sees a face, and not along it, if it meets the face at 15 degrees or more
_ALIKE = 0.15  # actors are similar if their known sizes differ by this fraction
_SHORTEST = 0.6  # no vehicle is shorter than this fraction of the usual length of its kind
_EXAMPLES = 3  # a size is learned from at least this many actors
_ACTORS_WIDE_M = 1.3  # vehicles that are narrower have two wheels

_CLEARANCE_M, _SPACING_M = 0.15, 0.1
_INSET_M = 0.22  # by which the usual shell is inside the box: a voxel needs some depth of the body to be occupied
# Of a car, as fractions: the height of its body, the ends and the width of its cabin.
_BELT, _CABIN, _CABIN_WIDE = 0.62, (0.08, 0.75), 0.85

LENGTH, WIDTH = 0, 1
# Length and width, metres, of vehicles with two wheels, cars, and lorries and buses (at least so wide, or so high).
_TWO_WHEELS, _CAR, _LORRY = (1.8, 0.7), (4.4, 1.85), (7.5, 2.5)
_LORRY_WIDE_M, _LORRY_HIGH_M, _LORRY_LONG_M, _LORRY_TOP_M = 2.25, 2.3, 6.0, 2.8


@dataclass(frozen=True)
class Extent:
    """What the sightings of an actor show of its size.

    Attributes:
        lower: (3,) metres, lower corner of the box around its points, actor frame (x forward, y to the side).
        upper: (3,) metres, upper corner.
        faces: whether the rear, the front, the side of low y and the side of high y were seen.
        points: number of points that it is taken from.
        seen_from: x and y of the sensor, metres, actor frame: mean over the points.
    """

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    faces: tuple[bool, bool, bool, bool]
    points: int
    seen_from: tuple[float, float] = (0.0, 0.0)

    @property
    def size(self) -> NDArray[np.float64]:
        """(3,) metres: length, width and height of what was seen."""
        return self.upper - self.lower

    @property
    def known(self) -> tuple[bool, bool]:
        """Whether length and width are known: a side shows the length, front and rear show the width, and two ends show their distance."""
        rear, front, low, high = self.faces
        return (rear and front) or low or high, (low and high) or rear or front

    @property
    def plausible(self) -> bool:
        """Whether the length is one that a vehicle of this width and height can have; a shorter one is only a part of it."""
        return bool(self.size[LENGTH] > _SHORTEST * _table(self, LENGTH))


def measure(sightings: Sequence[NDArray[np.float64]], sensors: NDArray[np.float64]) -> Extent:
    """Return what sightings show of an actor's size.

    Args:
        sightings: (M, 3) points of the actor in each scan, metres, actor frame.
        sensors: (F, 3) position of the sensor in each scan, metres, actor frame.
    """
    points = np.concatenate(list(sightings))
    lower, upper = np.quantile(points, _TRIM, axis=0), np.quantile(points, 1 - _TRIM, axis=0)
    return seen_from(lower, upper, np.array([len(sighting) for sighting in sightings]), sensors)


def seen_from(
    lower: NDArray[np.float64], upper: NDArray[np.float64], counts: NDArray[np.integer], sensors: NDArray[np.float64]
) -> Extent:
    """Return the extent of a box whose faces were seen from some places.

    Args:
        lower: (3,) lower corner, metres, actor frame.
        upper: (3,) upper corner.
        counts: (F,) number of points of the actor in each scan.
        sensors: (F, 3) position of the sensor in each scan, metres, actor frame.
    """
    distance = np.maximum(np.linalg.norm(sensors[:, :2], axis=1), 1e-6)
    total = int(counts.sum())
    rear, front, low, high = (
        bool(counts[beyond > _FACE_SINE * distance].sum() >= max(_FACE_POINTS, _FACE_SHARE * total))
        for axis in (LENGTH, WIDTH)
        for beyond in (lower[axis] - sensors[:, axis], sensors[:, axis] - upper[axis])
    )
    mean = (counts[:, None] * sensors[:, :2]).sum(axis=0) / max(total, 1)  # not `@`, which is BLAS
    return Extent(lower, upper, (rear, front, low, high), total, (float(mean[0]), float(mean[1])))


class Sizes:
    """Lengths and widths of actors that were seen well, by class."""

    def __init__(self, extents: Sequence[tuple[int, Extent]]) -> None:
        """Learn from the extents of actors with their classes."""
        self._known: dict[int, NDArray[np.float64]] = {}
        for label in {label for label, _ in extents}:
            sizes = [e.size[:2] for other, e in extents if other == label and all(e.known) and e.plausible]
            self._known[label] = np.array(sizes).reshape(-1, 2)

    def complete(self, label: int, extent: Extent) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the corners of the whole body: lengths and widths that are not known are those of similar actors.

        A body is never smaller than what was seen of it.

        Returns:
            (3,) lower and (3,) upper corner, metres, actor frame.
        """
        lower, upper = extent.lower.copy(), extent.upper.copy()
        known = extent.known
        if not any(known):  # seen too little, or too far away, to say what it is
            return lower, upper
        for axis in (LENGTH, WIDTH):
            if known[axis] and (axis == WIDTH or extent.plausible):
                continue
            missing = max(self._expected(label, extent, axis) - (upper[axis] - lower[axis]), 0.0)
            if extent.seen_from[axis] < 0:
                upper[axis] += missing
            else:
                lower[axis] -= missing
        if _is_lorry(*(upper - lower).tolist()):  # the top of a lorry beside the sensor is above the highest ray
            upper[2] = max(upper[2], lower[2] + _LORRY_TOP_M)
        return lower, upper

    def _expected(self, label: int, extent: Extent, axis: int) -> float:
        """Return the length or the width of actors whose other size is that of `extent`."""
        other = 1 - axis
        sizes = self._known.get(label, np.empty((0, 2)))
        alike = sizes[np.abs(sizes[:, other] - extent.size[other]) < _ALIKE * extent.size[other]]
        if len(alike) >= _EXAMPLES:
            return float(np.median(alike[:, axis]))
        return _table(extent, axis)


def _is_lorry(length: float, width: float, height: float) -> bool:
    return width > _LORRY_WIDE_M or height > _LORRY_HIGH_M or length > _LORRY_LONG_M


def _table(extent: Extent, axis: int) -> float:
    """Return a usual length or width for an actor of which the other size is known."""
    length, width, height = extent.size.tolist()
    if axis == LENGTH:
        kind = (
            _LORRY
            if width > _LORRY_WIDE_M or height > _LORRY_HIGH_M
            else _CAR
            if width > _ACTORS_WIDE_M
            else _TWO_WHEELS
        )
    else:
        kind = _LORRY if length > _LORRY_LONG_M or height > _LORRY_HIGH_M else _CAR if length > 2.6 else _TWO_WHEELS
    return kind[axis]


def usual_shell(lower: NDArray[np.float64], upper: NDArray[np.float64], extent: Extent) -> NDArray[np.float32] | None:
    """Return points on the surface that a vehicle of this size usually has; None for vehicles with two wheels.

    A car has a body of 60 % of its height, and a narrower cabin above its rear three quarters. Lorries and buses are boxes.

    Args:
        lower: (3,) lower corner of the body's box, metres, actor frame.
        upper: (3,) upper corner.
        extent: what was seen of it.

    Returns:
        (P, 3) float32, metres, actor frame.
    """
    length, width, height = (upper - lower).tolist()
    lower, upper = lower + _INSET_M, upper - _INSET_M
    if width < _ACTORS_WIDE_M or not any(extent.known):
        return None
    if _is_lorry(length, width, height):
        return _box_surface(lower + (0, 0, _CLEARANCE_M), upper)
    belt = lower[2] + _BELT * height
    body = _box_surface(lower + (0, 0, _CLEARANCE_M), np.array([upper[0], upper[1], belt]))
    inset = (1 - _CABIN_WIDE) / 2 * width
    cabin = _box_surface(
        np.array([lower[0] + _CABIN[0] * length, lower[1] + inset, belt]),
        np.array([lower[0] + _CABIN[1] * length, upper[1] - inset, upper[2]]),
    )
    return np.concatenate([body, cabin])


def _box_surface(lower: NDArray[np.float64], upper: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return points on the sides and the top of a box, `_SPACING_M` apart."""
    x, y, z = (np.linspace(a, b, max(2, round((b - a) / _SPACING_M) + 1)) for a, b in zip(lower, upper, strict=True))
    faces = [
        np.meshgrid(x, y, upper[2:]),
        np.meshgrid(x, [lower[1], upper[1]], z),
        np.meshgrid([lower[0], upper[0]], y, z),
    ]
    return np.concatenate([np.stack(face, axis=-1).reshape(-1, 3) for face in faces]).astype(np.float32)
