"""Bodies: the size and the surface of an actor, completed where no scan saw it.

A scan sees only the faces of an actor that are turned to the sensor. All observations of a track
together show some of its faces: of a car ahead, only the rear. Length and width are known if the
visible faces show them. The rest is expected from usual vehicles and actors of the same data, all
weighted by how well they fit what was seen; the body extends from the visible face away from the
sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from carlasc.core.arrays import AnyIntArray, Float32Array, FloatArray, IntArray

_TRIM = 0.01  # share of points that may be outside the body: outliers, points of a neighbour
# a face is visible if scans with so many points, and this share, see it
_FACE_POINTS, _FACE_SHARE = (
    12,
    0.02,
)
_FACE_SINE = 0.26  # a scan sees a face if its rays meet the face at 15 degrees or more
_ALIKE = 0.15  # the shapes of actors are similar if their sizes differ by this fraction
# no vehicle is shorter, or narrower, than these shares of what is expected of it
_SHORTEST = (
    0.6,
    0.85,
)
_EXAMPLES = 3  # a shape is learned from at most so many actors
# cells of surfaces, and cells in which surfaces of several actors are compared
_CELL_M, _BIN_M = (
    0.1,
    0.2,
)
_ACTORS_WIDE_M = 1.3  # narrower vehicles have two wheels
_LOWEST_M = 1.0  # of lower ones, only a part was seen

BODY_MARGIN_M = 0.1  # margin of the box of an actor around its body
_CLEARANCE_M, _SPACING_M = 0.15, 0.1
_INSET_M = (
    0.22  # depth of the usual shell inside the box: an occupied voxel holds some depth of the body
)
# Of a car, as fractions: the height of its body, the ends and the width of its cabin.
_BELT, _CABIN, _CABIN_WIDE = 0.62, (0.08, 0.75), 0.85

LENGTH, WIDTH = 0, 1
# Vehicles: share of all, mean length, width and height, metres, and their standard deviations:
# two-wheelers, small cars, cars, vans, large vans, lorries, buses and long vehicles.
_USUAL = np.array(
    [
        (0.2, 1.8, 0.72, 1.7, 0.12, 0.08, 0.15),
        (0.15, 3.8, 1.7, 1.5, 0.25, 0.06, 0.1),
        (0.35, 4.4, 1.82, 1.5, 0.3, 0.06, 0.1),
        (0.15, 4.8, 1.92, 1.85, 0.4, 0.08, 0.15),
        (0.07, 5.6, 2.05, 2.4, 0.5, 0.1, 0.25),
        (0.05, 7.5, 2.4, 3.0, 1.2, 0.12, 0.35),
        (0.03, 11.5, 2.55, 3.2, 1.0, 0.1, 0.25),
        (0.02, 16.0, 2.6, 3.5, 6.0, 0.2, 0.4),
    ]
)
_LARGEST_M = 32.0, 4.0, 5.6  # sizes from 0 to these are possible, in so many steps
_STEPS = 640
_ALIKE_SD = 0.06  # standard deviation of sizes around those of an actor of the data, as a fraction
# What was seen is smaller than the actor by about this share of it, and larger by so many metres.
# A share of the actors has parts that were hidden, or points of a neighbour.
_MISSED, _SMEAR_M, _HIDDEN, _NEIGHBOUR = (0.1, 0.08, 0.1), 0.06, 3e-3, 3e-4
# An end that was seen is eroded by up to this length; rays miss so much above the ground.
_ERODED_M, _ABOVE_GROUND_M = 0.1, 0.4
_LORRY_WIDE_M, _LORRY_HIGH_M, _LORRY_LONG_M = 2.25, 2.3, 6.0  # of shapes


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
        seen_from: x and y of the sensor, metres, actor frame: mean over the points.
    """

    lower: FloatArray
    upper: FloatArray
    faces: tuple[bool, bool, bool, bool]
    points: int
    seen_from: tuple[float, float] = (0.0, 0.0)

    @property
    def size(self) -> FloatArray:
        """(3,) metres: length, width and height of the visible part."""
        return self.upper - self.lower

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
        length, width = (self.size[:2] > _SHORTEST * _expected(self, _USUAL)[:2]).tolist()
        return length, width

    @property
    def exemplary(self) -> bool:
        """Whether its shape can complete similar actors: its front, its rear and one side are
        visible.
        """
        rear, front, low, high = self.faces
        return rear and front and (low or high) and all(self.plausible)


def measure(observations: Sequence[FloatArray], sensors: FloatArray) -> Extent:
    """Return the size of an actor, as its observations show it.

    Args:
        observations: (M, 3) points of the actor in each scan, metres, actor frame.
        sensors: (F, 3) position of the sensor in each scan, metres, actor frame.
    """
    points = np.concatenate(list(observations))
    lower, upper = np.quantile(points, _TRIM, axis=0), np.quantile(points, 1 - _TRIM, axis=0)
    return seen_from(
        lower, upper, np.array([len(observation) for observation in observations]), sensors
    )


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
    mean = (counts[:, None] * sensors[:, :2]).sum(axis=0) / max(total, 1)  # not `@`, which is BLAS
    return Extent(lower, upper, (rear, front, low, high), total, (float(mean[0]), float(mean[1])))


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
            known = np.array([e.size for e, _ in own if all(e.known + e.plausible)]).reshape(-1, 3)
            alike = np.column_stack([np.ones(len(known)), known, _ALIKE_SD * known])
            self._known[label] = np.concatenate([_USUAL, alike])
            shapes += [(e, surface) for e, surface in own if e.exemplary and len(surface)]

    def complete(self, label: int, extent: Extent) -> tuple[FloatArray, FloatArray]:
        """Return the corners of the whole body: the mean of its size over the usual sizes and those
        of actors of the same class, given what was seen.

        Returns:
            (3,) lower and (3,) upper corner, metres, actor frame.
        """
        lower, upper = extent.lower.copy(), extent.upper.copy()
        if not any(extent.known):  # too few points, or too far away
            return lower, upper
        usual = self._known.get(label, _USUAL)
        others = (usual[:, 1:4] != extent.size).any(axis=1)  # an actor is no example of itself
        size = _expected(extent, usual[others])
        missing = size - extent.size
        for axis in (LENGTH, WIDTH):
            # What is missing is behind the actor, as the sensor sees it: the near end was seen.
            eroded = float(np.clip(missing[axis] / 2, 0, _ERODED_M))
            if extent.seen_from[axis] < 0:
                lower[axis] -= eroded
                upper[axis] = lower[axis] + size[axis]
            else:
                upper[axis] += eroded
                lower[axis] = upper[axis] - size[axis]
        # Other things may hide the wheels, or the lowest ray may pass above them; the top of a
        # lorry may be above the highest ray.
        lower[2] -= np.clip(missing[2], 0, _ABOVE_GROUND_M)
        upper[2] = lower[2] + size[2]
        return lower, upper

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
        return (shared[shared[:, 2] > _CLEARANCE_M] + lower).astype(np.float32)


def surface_of(points: FloatArray) -> Float32Array:
    """Return the (P, 3) float32 centres of the cells that hold two or more of (M, 3) points,
    metres.
    """
    cells, count = np.unique(
        np.round(points / _CELL_M).astype(np.int32), axis=0, return_counts=True
    )
    return (cells[count > 1] * _CELL_M).astype(np.float32)


def _expected(extent: Extent, usual: FloatArray) -> FloatArray:
    """Return the mean (3,) length, width and height of an actor, given what was seen of it.

    It is continuous: nearly equal observations have nearly equal sizes.

    Args:
        extent: what was seen.
        usual: (K, 7) shares, means and standard deviations, as in `_USUAL`.
    """
    weights, means = np.log(usual[:, 0]), np.empty((len(usual), 3))
    for axis, known in enumerate((*extent.known, True)):
        sizes = np.linspace(0, _LARGEST_M[axis], _STEPS + 1)
        more = sizes - float(extent.size[axis])
        missed = np.exp(-np.maximum(more, 0) / (_MISSED[axis] * np.clip(extent.size[axis], 1, 5)))
        missed = _HIDDEN + (1 - _HIDDEN) * missed if known else np.ones(_STEPS + 1)
        smeared = np.exp(-((np.minimum(more, 0) / _SMEAR_M) ** 2) / 2)
        seen = missed * (_NEIGHBOUR + (1 - _NEIGHBOUR) * smeared)
        mean, deviation = usual[:, 1 + axis, None], usual[:, 4 + axis, None]
        joint = seen * np.exp(-(((sizes - mean) / deviation) ** 2) / 2) / deviation
        total = joint.sum(axis=1)
        weights = weights + np.log(total)
        means[:, axis] = (joint * sizes).sum(axis=1) / total
    share = np.exp(weights - weights.max())
    return np.asarray((share[:, None] * means).sum(axis=0) / share.sum())


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
    if width > _LORRY_WIDE_M or height > _LORRY_HIGH_M or length > _LORRY_LONG_M:
        return _box_surface(lower + (0, 0, _CLEARANCE_M), upper)
    belt = lower[2] + _BELT * height
    body = _box_surface(lower + (0, 0, _CLEARANCE_M), np.array([upper[0], upper[1], belt]))
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
