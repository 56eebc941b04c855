"""The plan of a town while it is built: mesh, buildings, parking spaces, plants and occupied land.

Leaves of plants are separate triangles, so that some rays of a LiDAR enter a crown and some pass
through it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from carlasc.core.arrays import BoolArray, FloatArray
from carlasc.core.geometry import Transform, rotation_z, translation
from carlasc.core.tables import CARLA
from carlasc_recorders.town.meshes import Mesh, MeshBuilder
from carlasc_recorders.town.streets import HALF_ROAD_M, SIDEWALK_M

VEGETATION = CARLA.id_of("Vegetation")


class PlantCatalogue:
    """The plants of a town: a few of each kind, used many times with different rotations and
    scales.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._trees = [broadleaf(rng) for _ in range(12)] + [conifer(rng) for _ in range(4)]
        self._street_trees = self._trees[:12]
        self._bushes = [bush(rng) for _ in range(8)]

    def tree(self) -> Mesh:
        """Return a broadleaf tree or a conifer."""
        return self._pick(self._trees)

    def street_tree(self) -> Mesh:
        """Return a broadleaf tree: the lower part of its trunk has no branches."""
        return self._pick(self._street_trees)

    def bush(self) -> Mesh:
        """Return a bush."""
        return self._pick(self._bushes)

    def _pick(self, kinds: list[Mesh]) -> Mesh:
        plant = kinds[self._rng.integers(len(kinds))]
        scale = self._rng.uniform(0.85, 1.15)
        rotated = plant.transformed(rotation_z(self._rng.uniform(-np.pi, np.pi)))
        return Mesh(rotated.vertices * scale, rotated.faces, rotated.labels)


def broadleaf(rng: np.random.Generator) -> Mesh:
    """Return a tree, 5 to 10 m high, whose crown consists of several ellipsoids."""
    builder = MeshBuilder()
    height = rng.uniform(5.0, 10.0)
    clear = height * rng.uniform(0.28, 0.4)
    radius = height * rng.uniform(0.2, 0.3)
    trunk = rng.uniform(0.1, 0.22)
    builder.cylinder(VEGETATION, (0, 0, -0.3), trunk, height * 0.6 + 0.3, 8, top=0.6)
    for _ in range(rng.integers(4, 8)):
        angle = rng.uniform(0, 2 * np.pi)
        reach = radius * rng.uniform(0.2, 0.75)
        crown = np.array(
            [
                np.cos(angle) * reach,
                np.sin(angle) * reach,
                rng.uniform(clear + radius * 0.5, height - radius * 0.4),
            ]
        )
        builder.rod(VEGETATION, (0, 0, clear * 0.9), crown, trunk * 0.35, 5)
        _add_leaves(
            builder, rng, crown, radius * rng.uniform(0.5, 0.8, 3) * (1, 1, 0.8), 70, (0.25, 0.6)
        )
    _add_leaves(
        builder,
        rng,
        np.array([0, 0, (clear + height) / 2]),
        np.array([radius, radius, (height - clear) / 2]),
        120,
        (0.3, 0.7),
    )
    return builder.build()


def conifer(rng: np.random.Generator) -> Mesh:
    """Return a tree, 6 to 12 m high, that narrows towards its top."""
    builder = MeshBuilder()
    height = rng.uniform(6.0, 12.0)
    radius = rng.uniform(1.2, 2.0)
    builder.cylinder(VEGETATION, (0, 0, -0.3), 0.16, height * 0.9, 7, top=0.4)
    for level in np.linspace(1.0, height - 0.6, int(height / 0.7)):
        reach = radius * (1.05 - level / height)
        _add_leaves(
            builder, rng, np.array([0, 0, level]), np.array([reach, reach, 0.35]), 34, (0.25, 0.55)
        )
    return builder.build()


def bush(rng: np.random.Generator) -> Mesh:
    """Return a bush, about 1 m high."""
    builder = MeshBuilder()
    radii = rng.uniform((0.4, 0.4, 0.4), (0.9, 0.9, 0.8))
    _add_leaves(builder, rng, np.array([0, 0, radii[2] * 0.75]), radii, 70, (0.15, 0.35))
    _add_leaves(builder, rng, np.array([0, 0, radii[2] * 0.7]), radii * 0.6, 30, (0.3, 0.4))
    return builder.build()


def hedge(rng: np.random.Generator, length_m: float) -> Mesh:
    """Return a hedge along x, about 1.2 m high, with its middle at the origin."""
    builder = MeshBuilder()
    height = rng.uniform(0.9, 1.4)
    builder.boxes(VEGETATION, (0, 0, -0.3), (length_m, 0.45, height + 0.2))
    count = int(length_m * 22)
    positions = rng.uniform((-length_m / 2, -0.32, 0.1), (length_m / 2, 0.32, height), (count, 3))
    _add_leaf_triangles(builder, rng, positions, rng.uniform(0.15, 0.3, count))
    return builder.build()


def _add_leaves(
    builder: MeshBuilder,
    rng: np.random.Generator,
    centre: FloatArray,
    radii: FloatArray,
    count: int,
    size: tuple[float, float],
) -> None:
    """Add leaves inside an ellipsoid, denser towards its surface.

    Args:
        builder: takes the triangles.
        rng: source of the random numbers.
        centre: (3,) metres.
        radii: (3,) of the ellipsoid, metres.
        count: number of triangles.
        size: smallest and greatest size of a triangle, metres.
    """
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    depth = rng.uniform(0.35, 1.0, (count, 1)) ** 0.5
    _add_leaf_triangles(
        builder, rng, centre + directions * depth * radii, rng.uniform(*size, count)
    )


def _add_leaf_triangles(
    builder: MeshBuilder,
    rng: np.random.Generator,
    positions: FloatArray,
    sizes: FloatArray,
) -> None:
    """Add a randomly oriented triangle of a given size, (N,), at each position, (N, 3)."""
    corners = rng.normal(size=(len(positions), 3, 3))
    corners -= corners.mean(axis=1, keepdims=True)
    corners *= sizes[:, None, None] / np.linalg.norm(corners, axis=2, keepdims=True).mean(
        axis=1, keepdims=True
    )
    builder.add(
        VEGETATION,
        (positions[:, None, :] + corners).reshape(-1, 3),
        np.arange(3 * len(positions)).reshape(-1, 3),
    )


Points = FloatArray


@dataclass(frozen=True)
class Rectangle:
    """A rotated rectangle in the plane.

    Attributes:
        centre: (2,) metres.
        size: (2,) lengths along x and y of the rectangle, metres.
        yaw_rad: rotation, x towards y, radians.
    """

    centre: Points
    size: tuple[float, float]
    yaw_rad: float

    @cached_property
    def axes(self) -> Points:
        """(2, 2) unit vectors of x and y of the rectangle, one per row."""
        cos = np.cos(self.yaw_rad)
        sin = np.sin(self.yaw_rad)
        return np.array([[cos, sin], [-sin, cos]])

    def local(self, points: Points) -> Points:
        """Return points (..., 2) in the frame of the rectangle, relative to its centre."""
        return (points - self.centre) @ self.axes.T

    def contains(self, points: Points, margin_m: float = 0.0) -> BoolArray:
        """Return (...) bool: whether points (..., 2) are inside the rectangle, enlarged by a
        margin.
        """
        inside: BoolArray = np.abs(self.local(points)) <= np.array(self.size) / 2 + margin_m
        return np.asarray(inside.all(axis=-1))

    @cached_property
    def corners(self) -> Points:
        """(4, 2) corners."""
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
        return self.centre + (signs * self.size) @ self.axes

    @cached_property
    def _circle(self) -> tuple[float, float, float]:
        return float(self.centre[0]), float(self.centre[1]), float(np.hypot(*self.size)) / 2

    def overlaps(self, other: Rectangle, margin_m: float = 0.0) -> bool:
        """Whether two rectangles are closer than a margin: no axis of either separates them."""
        (x, y, radius), (other_x, other_y, other_radius) = self._circle, other._circle
        if math.hypot(x - other_x, y - other_y) > radius + other_radius + margin_m:
            return False
        axes = np.concatenate([self.axes, other.axes])
        a = self.corners @ axes.T
        b = other.corners @ axes.T
        apart = (a.max(axis=0) + margin_m <= b.min(axis=0)) | (
            b.max(axis=0) + margin_m <= a.min(axis=0)
        )
        return not bool(apart.any())


@dataclass
class Land:
    """The land of a block and its occupied parts.

    Attributes:
        boundary: (K, 2) loop around it, metres. The inside is on the right.
        occupied: footprints of the existing objects.
    """

    boundary: Points
    occupied: list[Rectangle] = field(default_factory=list)

    def draw(self, rng: np.random.Generator) -> Points:
        """Return a random position, (2,), in the box around the land."""
        low = self.boundary.min(axis=0)
        return low + rng.uniform(0, 1, 2) * np.ptp(self.boundary, axis=0)

    def inside(self, points: Points, margin_m: float = 0.0) -> bool:
        """Whether all points (N, 2) are inside the boundary, and at least a margin away from it."""
        (start_x, start_y), (end_x, end_y) = self.boundary.T, np.roll(self.boundary, -1, axis=0).T
        along_x = end_x - start_x
        along_y = end_y - start_y
        x = points[:, :1]
        y = points[:, 1:]
        share = ((x - start_x) * along_x + (y - start_y) * along_y) / np.maximum(
            along_x**2 + along_y**2, 1e-12
        )
        share = np.clip(share, 0, 1)
        beside_x = x - (start_x + share * along_x)
        beside_y = y - (start_y + share * along_y)
        far_enough = np.sqrt(beside_x**2 + beside_y**2).min(axis=1) >= margin_m
        # From a point inside, a ray along +x crosses the boundary an odd number of times.
        crossed = (start_y > y) != (end_y > y)
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = start_x + (y - start_y) / along_y * along_x
        odd = (crossed & (crossing > x)).sum(axis=1) % 2 == 1
        return bool((odd & far_enough).all())

    def reserve(self, rectangle: Rectangle, margin_m: float = 0.3, edge_m: float = 0.0) -> bool:
        """Occupy a rectangle if it is inside the boundary and free.

        Args:
            rectangle: the footprint.
            margin_m: minimum distance to other footprints.
            edge_m: minimum distance to the boundary.

        Returns:
            Whether the rectangle was free.
        """
        around = np.concatenate(
            [rectangle.corners, (rectangle.corners + rectangle.corners[[3, 0, 1, 2]]) / 2]
        )
        free = self.inside(around, edge_m) and not any(
            rectangle.overlaps(other, margin_m) for other in self.occupied
        )
        self.occupied += [rectangle] if free else []
        return free


KERB_M = 0.15  # height of the sidewalks above the road
PAINT_M = 0.01  # height of road markings above the road
# distance from the centre line of a street to the land behind the sidewalk
INNER_M = HALF_ROAD_M + SIDEWALK_M


@dataclass
class TownPlan:
    """A town while it is built. Each step adds to it.

    Attributes:
        rng: source of all random numbers.
        plants: the plants to choose from.
        builder: the mesh of the town so far.
        buildings: footprints of the buildings with the heights of their roofs, metres.
        parking: parking spaces: world_T_vehicle of a vehicle parked in each.
    """

    rng: np.random.Generator
    plants: PlantCatalogue
    builder: MeshBuilder = field(default_factory=MeshBuilder)
    buildings: list[tuple[Rectangle, float]] = field(default_factory=list)
    parking: list[Transform] = field(default_factory=list)

    def park(self, position: FloatArray, yaw_rad: float, height_m: float) -> None:
        """Add a place for a parked vehicle."""
        self.parking.append(translation((*position, height_m)) @ rotation_z(yaw_rad))

    def add(
        self, mesh: Mesh, position: FloatArray, yaw_rad: float, height_m: float = KERB_M
    ) -> None:
        """Add an object.

        Args:
            mesh: the object in its own frame.
            position: (2,) x and y of its origin, metres.
            yaw_rad: heading, radians.
            height_m: z of its origin, metres.
        """
        self.builder.add_mesh(mesh, translation((*position, height_m)) @ rotation_z(yaw_rad))
