"""The plan of a town while it is built: its mesh, its buildings and its parking spaces so far, and which land is occupied."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from carlasc.captures.town.meshes import Mesh, MeshBuilder
from carlasc.captures.town.plants import PlantCatalogue
from carlasc.captures.town.streets import HALF_ROAD_M, SIDEWALK_M
from carlasc.core.geometry import Transform, rotation_z, translation

Points = NDArray[np.float64]


@dataclass(frozen=True)
class Rectangle:
    """A rotated rectangle in the plane.

    Attributes:
        centre: (2,) metres.
        size: (2,) lengths along its own x and y, metres.
        yaw_rad: rotation, x towards y.
    """

    centre: Points
    size: tuple[float, float]
    yaw_rad: float

    @cached_property
    def axes(self) -> Points:
        """(2, 2) unit vectors of its own x and y, one per row."""
        cos, sin = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return np.array([[cos, sin], [-sin, cos]])

    def local(self, points: Points) -> Points:
        """Return points (..., 2) on its own axes, relative to its centre."""
        return (points - self.centre) @ self.axes.T

    def contains(self, points: Points, margin_m: float = 0.0) -> NDArray[np.bool_]:
        """Return which points (..., 2) are inside it, or outside by no more than a margin."""
        inside: NDArray[np.bool_] = np.abs(self.local(points)) <= np.array(self.size) / 2 + margin_m
        return np.asarray(inside.all(axis=-1))

    @cached_property
    def corners(self) -> Points:
        """(4, 2) corners."""
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
        return self.centre + (signs * self.size) @ self.axes

    def overlaps(self, other: Rectangle, margin_m: float = 0.0) -> bool:
        """Whether two rectangles are closer to each other than a margin: no axis of either separates them."""
        reach = (float(np.hypot(*self.size)) + float(np.hypot(*other.size))) / 2 + margin_m
        if float(np.hypot(*(self.centre - other.centre))) > reach:
            return False
        axes = np.concatenate([self.axes, other.axes])
        a, b = self.corners @ axes.T, other.corners @ axes.T
        apart = (a.max(axis=0) + margin_m <= b.min(axis=0)) | (b.max(axis=0) + margin_m <= a.min(axis=0))
        return not bool(apart.any())


@dataclass
class Land:
    """The land of a block, and which parts of it are occupied.

    Attributes:
        boundary: (K, 2) loop around it, metres. The inside is on the right.
        occupied: footprints of what has been built.
    """

    boundary: Points
    occupied: list[Rectangle] = field(default_factory=list)

    def inside(self, points: Points, margin_m: float = 0.0) -> bool:
        """Whether all points (N, 2) are inside the boundary, and at least a margin away from it."""
        start, along = self.boundary, np.roll(self.boundary, -1, axis=0) - self.boundary
        offsets = points[:, None, :] - start
        share = (offsets * along).sum(axis=-1) / np.maximum((along**2).sum(axis=-1), 1e-12)
        nearest = start + np.clip(share, 0, 1)[..., None] * along
        far_enough = np.linalg.norm(points[:, None, :] - nearest, axis=-1).min(axis=1) >= margin_m
        # From a point inside, a ray along +x crosses the boundary an odd number of times.
        above = self.boundary[:, 1] > points[:, 1:]
        crossed = above != np.roll(above, -1, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            x = start[:, 0] + offsets[..., 1] / along[:, 1] * along[:, 0]
        odd = (crossed & (x > points[:, :1])).sum(axis=1) % 2 == 1
        return bool((odd & far_enough).all())

    def reserve(self, rectangle: Rectangle, margin_m: float = 0.3, edge_m: float = 0.0) -> bool:
        """Occupy a rectangle if it is inside the boundary and free.

        Args:
            rectangle: the footprint.
            margin_m: smallest distance to other footprints.
            edge_m: smallest distance to the boundary.

        Returns:
            Whether the rectangle was free.
        """
        corners = rectangle.corners
        if not self.inside(np.concatenate([corners, (corners + np.roll(corners, 1, axis=0)) / 2]), edge_m):
            return False
        if any(rectangle.overlaps(other, margin_m) for other in self.occupied):
            return False
        self.occupied.append(rectangle)
        return True


KERB_M = 0.15  # height of the sidewalks above the road
PAINT_M = 0.01  # height of road markings above the road
INNER_M = HALF_ROAD_M + SIDEWALK_M  # from a street's centre line to the land behind the sidewalk


@dataclass
class TownPlan:
    """A town while it is built: each step adds to it.

    Attributes:
        rng: source of all random numbers.
        plants: the plants to choose from.
        builder: the town's mesh so far.
        buildings: footprints of the buildings with the heights of their roofs, metres.
        parking: parking spaces: world_T_vehicle of a vehicle parked in each.
    """

    rng: np.random.Generator
    plants: PlantCatalogue
    builder: MeshBuilder = field(default_factory=MeshBuilder)
    buildings: list[tuple[Rectangle, float]] = field(default_factory=list)
    parking: list[Transform] = field(default_factory=list)

    def add(self, mesh: Mesh, position: NDArray[np.float64], yaw_rad: float, height_m: float = KERB_M) -> None:
        """Add an object.

        Args:
            mesh: the object in its own frame.
            position: (2,) x and y of its origin, metres.
            yaw_rad: its heading.
            height_m: z of its origin.
        """
        self.builder.add_mesh(mesh, translation((*position, height_m)) @ rotation_z(yaw_rad))
