"""Bodies: the size and the surface of an actor, completed where no scan saw it.

A scan sees only the faces of an actor that are turned to the sensor. All observations of a track
together show some of its faces: of a car ahead, only the rear. Length and width are known if the
visible faces show them. Otherwise they are taken from similar actors of the same data, or from a
table, and the body extends from the visible face away from the sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from carlasc.core.arrays import AnyIntArray, Float32Array, FloatArray, IntArray

_TRIM = 0.01  # share of points that may be outside the body: outliers, points of a neighbour
# a face is visible if scans with so many points, and this share, see it
_FACE_POINTS, _FACE_SHARE = (
    12,
    0.02,
)
_FACE_SINE = 0.26  # a scan sees a face if its rays meet the face at 15 degrees or more
_ALIKE = 0.15  # actors are similar if their known sizes differ by this fraction
# No vehicle is shorter, or narrower, than these shares of the usual size of its kind; from the
# second share on, all of it was seen.
_SHORTEST = (0.5, 0.7), (0.8, 0.9)
_HIGHER = 1.6  # the height may grow by less than this factor
_EXAMPLES = 3  # a size is learned from at least so many actors, and a shape from at most so many
# cells of surfaces, and cells in which surfaces of several actors are compared
_CELL_M, _BIN_M = (
    0.1,
    0.2,
)
_ACTORS_WIDE_M = 1.3  # narrower vehicles have two wheels
# Of cars, and of longer or higher vehicles: wider ones have points of a neighbour, or are smeared.
# They are cut to the usual width, gradually over this width.
_WIDEST_M, _CUT_M = (2.1, 2.6), 0.3
# By the first share of its distance, the ground below a vehicle may be higher, not by the second.
_SLOPE = 0.04, 0.08
_LOWEST_M = 1.0  # of lower ones, only a part was seen

BODY_MARGIN_M = 0.1  # margin of the box of an actor around its body
_CLEARANCE_M, _SPACING_M = 0.15, 0.1
# Depth of the usual shell inside the box, and of a learned surface inside the body: an occupied
# voxel holds some depth of the body.
_INSET_M, _LEARNED_INSET_M = 0.22, 0.06
# Of a car, as fractions: the height of its body, the ends and the width of its cabin.
_BELT, _CABIN, _CABIN_WIDE = 0.62, (0.08, 0.75), 0.85

# True sizes of vehicles less those that are found, of which one face, two or more were seen, by
# whether free space or the data show the actor: limits of length, width and height, metres. If five
# drives give them, they hold 90% of the vehicles of a sixth one.
_ERRORS_M = {
    True: {
        1: ((-0.61, -0.23, -0.02), (3.82, 1.10, 1.75)),
        2: ((-1.17, -0.10, -0.06), (2.59, 0.53, 0.99)),
        3: ((-0.16, -0.03, 0.05), (0.29, 0.08, 0.50)),
    },
    False: {
        1: ((-0.69, -0.03, 0.06), (3.36, 1.01, 1.43)),
        2: ((0.03, -0.05, 0.07), (1.52, 0.09, 0.49)),
        3: ((-0.02, -0.04, 0.07), (0.18, 0.08, 0.47)),
    },
}

LENGTH, WIDTH = 0, 1
# Length and width, metres, of vehicles with two wheels, cars, vans, and lorries and buses.
_TWO_WHEELS, _CAR, _VAN, _LORRY = (1.8, 0.7), (4.4, 1.85), (5.4, 2.0), (7.5, 2.5)
# Nothing changes in a step: sizes and shapes change gradually between two limits. From vehicles
# with two wheels to cars, by width and by length; from cars to vans, by height; to lorries, by
# width, height and length.
_FOUR_WHEELS_M, _VAN_HIGH_M = ((1.0, 1.4), (2.3, 2.9)), (1.7, 2.0)
_LORRY_WIDE_M, _LORRY_HIGH_M, _LORRY_LONG_M, _LORRY_TOP_M = (2.05, 2.4), (2.0, 2.6), (5.6, 6.8), 2.8


@dataclass(frozen=True)
class Extent:
    """The size of an actor, as its observations show it.

    Attributes:
        lower: (3,) metres, lower corner of the box around its points, actor frame (x forward, y to
            the side).
        upper: (3,) metres, upper corner.
        faces: whether the rear, the front, the side of low y and the side of high y are visible in
            some scan.
        points: number of points of the observations.
        seen_from: (3,) where the sensor is from the middle of the box, metres, actor frame: mean
            over the points.
    """

    lower: FloatArray
    upper: FloatArray
    faces: tuple[bool, bool, bool, bool]
    points: int
    seen_from: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def size(self) -> FloatArray:
        """(3,) metres: length, width and height of the visible part."""
        return self.upper - self.lower

    @property
    def below_sensor_m(self) -> float:
        """How far its lower end is below the sensor, metres."""
        return float(self.seen_from[2] + self.size[2] / 2)

    @property
    def known(self) -> tuple[bool, bool]:
        """Whether length and width are known: a side shows the length, front and rear show the
        width, and two ends show their distance.
        """
        rear, front, low, high = self.faces
        return (rear and front) or low or high, (low and high) or rear or front

    @property
    def plausible(self) -> tuple[bool, bool]:
        """Whether length and width are large enough for a vehicle of this width or length, and this
        height; smaller ones are of a part of it.
        """
        length, width = (
            bool(self.size[axis] > sum(shares) / 2 * _table(self, axis))
            for axis, shares in enumerate(_SHORTEST)
        )
        return length, width

    def interval(self, size: FloatArray, *, found: bool) -> FloatArray:
        """Return (2, 3) metres, between which the true length, width and height of 90 in 100
        vehicles are; NaN without points or a visible face, and for actors with two wheels.

        Args:
            size: (3,) length, width and height that were found.
            found: whether free space shows the actor, and not a field of the data.
        """
        faces = min(sum(self.faces), 3)
        if not faces or not self.points or size[WIDTH] < _ACTORS_WIDE_M:
            return np.full((2, 3), np.nan)
        return size + np.array(_ERRORS_M[found][faces])

    @property
    def exemplary(self) -> bool:
        """Whether its shape can complete similar actors: its front, its rear and one side are
        visible.
        """
        rear, front, low, high = self.faces
        return rear and front and (low or high) and all(self.plausible)


def measure(points: FloatArray, counts: AnyIntArray, sensors: FloatArray) -> Extent:
    """Return the size of an actor, as its observations show it.

    Args:
        points: (M, 3) points of the actor in all scans, metres, actor frame.
        counts: (F,) number of them in each scan.
        sensors: (F, 3) position of the sensor in each scan, metres, actor frame.
    """
    lower, upper = np.quantile(points, (_TRIM, 1 - _TRIM), axis=0)
    return seen_from(lower, upper, counts, sensors)


def seen_from(
    lower: FloatArray,
    upper: FloatArray,
    counts: AnyIntArray,
    sensors: FloatArray,
) -> Extent:
    """Return the extent of a box, with the faces that sensors saw.

    Args:
        lower: (3,) lower corner, metres, actor frame.
        upper: (3,) upper corner.
        counts: (F,) number of points of the actor in each scan.
        sensors: (F, 3) position of the sensor in each scan, metres, actor frame.
    """
    # A face is seen from beyond its plane. Height over distance is the sine of the angle between
    # the rays and the face; flatter rays give points of its edges only.
    distance = np.maximum(np.linalg.norm(sensors[:, :2], axis=1), 1e-6)
    total = int(counts.sum())
    rear, front, low, high = (
        bool(counts[beyond > _FACE_SINE * distance].sum() >= max(_FACE_POINTS, _FACE_SHARE * total))
        for axis in (LENGTH, WIDTH)
        for beyond in (lower[axis] - sensors[:, axis], sensors[:, axis] - upper[axis])
    )
    mean = (counts[:, None] * sensors).sum(axis=0) / max(total, 1)  # not `@`, which is BLAS
    x, y, z = (mean - (lower + upper) / 2).tolist()
    return Extent(lower, upper, (rear, front, low, high), total, (x, y, z))


class Sizes:
    """The lengths, widths and shapes of actors with many visible faces, by class."""

    def __init__(self, examples: Sequence[tuple[int, Extent, Float32Array]]) -> None:
        """Learn from the classes of actors, their extents, and the (P, 3) points of their surfaces,
        metres, actor frame; P may be 0.
        """
        self._known: dict[int, FloatArray] = {}
        self._shapes = {label: list[tuple[Extent, Float32Array]]() for label, _, _ in examples}
        for label, shapes in self._shapes.items():
            own = [(e, surface) for other, e, surface in examples if other == label]
            self._known[label] = np.array(
                [
                    e.size
                    for e, _ in own
                    if all(e.known + e.plausible) and _without_neighbours(e) is e
                ]
            ).reshape(-1, 3)
            shapes += [(e, surface) for e, surface in own if e.exemplary and len(surface)]
        below = [e.below_sensor_m for _, e, _ in examples if e.exemplary]
        self._sensor_m = float(np.median(below)) if below else 0.0  # height above the ground

    def complete(self, label: int, extent: Extent) -> tuple[FloatArray, FloatArray]:
        """Return the corners of the whole body: unknown lengths and widths are taken from similar
        actors.

        A body is never smaller than its visible part, unless that is wider than any vehicle.

        Returns:
            (3,) lower and (3,) upper corner, metres, actor frame.
        """
        extent = self._standing(_without_neighbours(extent))
        lower, upper = extent.lower.copy(), extent.upper.copy()
        known = extent.known
        if not any(known):  # too few points, or too far away
            return lower, upper
        for axis in (LENGTH, WIDTH):
            expected = self._expected(label, extent, axis)
            seen = extent.size[axis]
            missing = max(expected - seen, 0.0)
            if known[axis]:
                missing *= 1 - _share(seen / _table(extent, axis), _SHORTEST[axis])
            # What is missing is behind the actor, as the sensor sees it: the near end was seen.
            if extent.seen_from[axis] < 0:
                upper[axis] += missing
            else:
                lower[axis] -= missing
        # other things may hide the wheels, or the lowest ray may pass above them
        if not extent.exemplary:
            lower[2] -= max(self._height(label, upper - lower) - (upper[2] - lower[2]), 0.0)
        # the top of a lorry may be above the highest ray
        is_long = _share(upper[LENGTH] - lower[LENGTH], _LORRY_LONG_M)
        upper[2] += is_long * max(lower[2] + _LORRY_TOP_M - upper[2], 0.0)
        return lower, upper

    def _standing(self, extent: Extent) -> Extent:
        """Return the extent down to the ground: others may hide the lower part of a vehicle."""
        hidden, distance = self._sensor_m - extent.below_sensor_m, np.hypot(*extent.seen_from[:2])
        hidden *= _share(hidden, (_SLOPE[0] * distance, _SLOPE[1] * distance))
        return replace(extent, lower=extent.lower - (0, 0, max(hidden, 0.0)))

    def _expected(self, label: int, extent: Extent, axis: int) -> float:
        """Return the length or the width of actors like `extent` in the other size, and in the
        height if some are.
        """
        other = 1 - axis
        sizes = self._known.get(label, np.empty((0, 3)))
        far = (sizes - extent.size) / np.maximum(extent.size, _CELL_M)
        alike, as_high = np.abs(far[:, other]) < _ALIKE, far[:, 2] > -_ALIKE
        # Cars and vans are alike in one size, so the height decides between them, if there are
        # enough of the same height; the visible height is a lower limit in any case.
        for chosen in (sizes[alike & as_high & (far[:, 2] < _ALIKE)], sizes[alike & as_high]):
            if len(chosen) >= _EXAMPLES:
                return float(np.median(chosen[:, axis]))
        return _table(extent, axis)

    def _height(self, label: int, size: FloatArray) -> float:
        """Return the height of actors that are as long and as wide as `size`, (3,) metres; without
        such actors, its own height.
        """
        sizes = self._known.get(label, np.empty((0, 3)))
        alike = sizes[
            (np.abs(sizes - size) < _ALIKE * size)[:, :2].all(axis=1)
            & (sizes[:, 2] < _HIGHER * size[2])
        ]
        return float(np.median(alike[:, 2])) if len(alike) >= _EXAMPLES else float(size[2])

    def surface(
        self, label: int, lower: FloatArray, upper: FloatArray, extent: Extent
    ) -> Float32Array:
        """Return points on the surface of a vehicle of this size: from the most similar actors,
        otherwise the usual shell.

        Args:
            label: its class.
            lower: (3,) lower corner of its body, metres, actor frame.
            upper: (3,) upper corner.
            extent: its visible part.

        Returns:
            (P, 3) float32, metres, actor frame.
        """
        size = np.maximum(upper - lower, _CELL_M)
        unlike = [
            np.abs(np.log(np.maximum(other.size, _CELL_M) / size))
            for other, _ in self._shapes.get(label, [])
        ]
        best = np.argsort([far.sum() for far in unlike], kind="stable")[:_EXAMPLES].tolist()
        chosen = [self._shapes[label][row] for row in best if unlike[row].max() < _ALIKE]
        if not chosen or not any(extent.known):
            return usual_shell(lower - BODY_MARGIN_M, upper + BODY_MARGIN_M, extent)
        fitted = [(own - other.lower) * (size / other.size) for other, own in chosen]
        bins, points = list[IntArray](), list[FloatArray]()
        for own in fitted:
            # Vehicles are symmetric: what one side shows holds for the other.
            whole = np.concatenate([own, own * (1, -1, 1) + (0, size[1], 0)])
            cells, place = np.unique(
                np.floor(whole / _BIN_M).astype(np.int64), axis=0, return_inverse=True
            )
            count = np.bincount(place.reshape(-1))
            sums = [np.bincount(place.reshape(-1), whole[:, axis]) for axis in range(3)]
            bins.append(cells)
            points.append(np.stack(sums, axis=1) / count[:, None])
        _, place, count = np.unique(
            np.concatenate(bins), axis=0, return_inverse=True, return_counts=True
        )
        # Cells that more than half of the actors share are of the usual shape, not of a load or a
        # neighbour.
        shared = np.concatenate(points)[2 * count[place.reshape(-1)] > len(chosen)]
        shared = shared[shared[:, 2] > _CLEARANCE_M] - size / 2
        shared *= 1 - 2 * _LEARNED_INSET_M / size
        return (shared + lower + size / 2).astype(np.float32)


def surface_of(points: FloatArray) -> Float32Array:
    """Return the (P, 3) float32 centres of the cells that hold two or more of (M, 3) points,
    metres.
    """
    cells, count = np.unique(
        np.round(points / _CELL_M).astype(np.int32), axis=0, return_counts=True
    )
    return (cells[count > 1] * _CELL_M).astype(np.float32)


def _share(value: float, limits: tuple[float, float]) -> float:
    """Return how far a value is from the first limit to the second one: 0 to 1."""
    return float(np.interp(value, limits, (0.0, 1.0)))


def _without_neighbours(extent: Extent) -> Extent:
    """Return the extent, cut to the greatest width of a vehicle of its length; the side towards the
    sensor stays.
    """
    length, wide, height = extent.size.tolist()
    large = max(_share(length, _LORRY_LONG_M), _share(height, _LORRY_HIGH_M))
    widest = np.interp(large if extent.known[LENGTH] else 1.0, (0.0, 1.0), _WIDEST_M)
    if wide <= widest:
        return extent
    usual = np.interp(large, (0.0, 1.0), (_CAR[WIDTH], _LORRY[WIDTH]))
    width = np.interp(wide, (widest, widest + _CUT_M), (widest, usual))
    lower, upper = extent.lower.copy(), extent.upper.copy()
    if extent.seen_from[WIDTH] < 0:
        upper[WIDTH] = lower[WIDTH] + width
    else:
        lower[WIDTH] = upper[WIDTH] - width
    return replace(extent, lower=lower, upper=upper)


def _table(extent: Extent, axis: int) -> float:
    """Return the usual length or width of an actor whose other size is known."""
    other, height = float(extent.size[1 - axis]), float(extent.size[2])
    usual = float(np.interp(height, _VAN_HIGH_M, (_CAR[axis], _VAN[axis])))
    limits = *_FOUR_WHEELS_M[axis], *(_LORRY_WIDE_M, _LORRY_LONG_M)[axis]
    return float(np.interp(other, limits, (_TWO_WHEELS[axis], usual, usual, _LORRY[axis])))


def usual_shell(lower: FloatArray, upper: FloatArray, extent: Extent) -> Float32Array:
    """Return points on the surface that a vehicle of this size usually has; none for vehicles with
    two wheels.

    A car has a body of 60% of its height, and a narrower cabin above its rear three quarters.
    Lorries and buses are boxes.

    Args:
        lower: (3,) lower corner of the body's box, metres, actor frame.
        upper: (3,) upper corner.
        extent: its visible part.

    Returns:
        (P, 3) float32, metres, actor frame.
    """
    length, width, height = (upper - lower).tolist()
    lower, upper = lower + _INSET_M, upper - _INSET_M
    if width < _ACTORS_WIDE_M or height < _LOWEST_M or not any(extent.known):
        return np.empty((0, 3), np.float32)
    box = max(map(_share, (length, width, height), (_LORRY_LONG_M, _LORRY_WIDE_M, _LORRY_HIGH_M)))
    belt = (1 - box) * (lower[2] + _BELT * height) + box * upper[2]
    body = _box_surface(lower + (0, 0, _CLEARANCE_M), np.array([upper[0], upper[1], belt]))
    if box == 1:
        return body
    inset = (1 - _CABIN_WIDE) / 2 * width
    cabin = _box_surface(
        np.array([lower[0] + _CABIN[0] * length, lower[1] + inset, belt]),
        np.array([lower[0] + _CABIN[1] * length, upper[1] - inset, upper[2]]),
    )
    return np.concatenate([body, cabin])


def _box_surface(lower: FloatArray, upper: FloatArray) -> Float32Array:
    """Return points on the sides and the top of a box, `_SPACING_M` apart."""
    x, y, z = (
        np.linspace(a, b, max(2, round((b - a) / _SPACING_M) + 1))
        for a, b in zip(lower, upper, strict=True)
    )
    faces = [
        np.meshgrid(x, y, upper[2:]),
        np.meshgrid(x, [lower[1], upper[1]], z),
        np.meshgrid([lower[0], upper[0]], y, z),
    ]
    return np.concatenate([np.stack(face, axis=-1).reshape(-1, 3) for face in faces]).astype(
        np.float32
    )
