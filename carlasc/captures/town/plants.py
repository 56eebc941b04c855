"""Trees, bushes and hedges.

Leaves are separate triangles, so some rays of a LiDAR enter a crown and some pass through it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from carlasc.captures.town.meshes import Mesh, MeshBuilder
from carlasc.core.geometry import rotation_z
from carlasc.core.tables import CARLA

VEGETATION = CARLA.id_of("Vegetation")


class PlantCatalogue:
    """The plants of a town: a few of each kind, which are used many times with other rotations and scales."""

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
        plant = kinds[int(self._rng.integers(len(kinds)))]
        scale = float(self._rng.uniform(0.85, 1.15))
        rotated = plant.transformed(rotation_z(float(self._rng.uniform(-np.pi, np.pi))))
        return Mesh(rotated.vertices * scale, rotated.faces, rotated.labels)


def broadleaf(rng: np.random.Generator) -> Mesh:
    """Return a tree, 5 to 10 m high, whose crown consists of several ellipsoids."""
    builder = MeshBuilder()
    height = float(rng.uniform(5.0, 10.0))
    clear, radius = height * float(rng.uniform(0.28, 0.4)), height * float(rng.uniform(0.2, 0.3))
    trunk = float(rng.uniform(0.1, 0.22))
    builder.cylinder(VEGETATION, (0, 0, -0.3), trunk, height * 0.6 + 0.3, 8, top=0.6)
    for _ in range(int(rng.integers(4, 8))):
        angle = rng.uniform(0, 2 * np.pi)
        reach = radius * rng.uniform(0.2, 0.75)
        crown = np.array(
            [np.cos(angle) * reach, np.sin(angle) * reach, rng.uniform(clear + radius * 0.5, height - radius * 0.4)]
        )
        builder.rod(VEGETATION, (0, 0, clear * 0.9), crown, trunk * 0.35, 5)
        _add_leaves(builder, rng, crown, radius * rng.uniform(0.5, 0.8, 3) * (1, 1, 0.8), 70, (0.25, 0.6))
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
    height, radius = float(rng.uniform(6.0, 12.0)), float(rng.uniform(1.2, 2.0))
    builder.cylinder(VEGETATION, (0, 0, -0.3), 0.16, height * 0.9, 7, top=0.4)
    for level in np.linspace(1.0, height - 0.6, int(height / 0.7)):
        reach = radius * (1.05 - level / height)
        _add_leaves(builder, rng, np.array([0, 0, level]), np.array([reach, reach, 0.35]), 34, (0.25, 0.55))
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
    height = float(rng.uniform(0.9, 1.4))
    builder.boxes(VEGETATION, (0, 0, -0.3), (length_m, 0.45, height + 0.2))
    count = int(length_m * 22)
    positions = rng.uniform((-length_m / 2, -0.32, 0.1), (length_m / 2, 0.32, height), (count, 3))
    _add_leaf_triangles(builder, rng, positions, rng.uniform(0.15, 0.3, count))
    return builder.build()


def _add_leaves(
    builder: MeshBuilder,
    rng: np.random.Generator,
    centre: NDArray[np.float64],
    radii: NDArray[np.float64],
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
    _add_leaf_triangles(builder, rng, centre + directions * depth * radii, rng.uniform(*size, count))


def _add_leaf_triangles(
    builder: MeshBuilder, rng: np.random.Generator, positions: NDArray[np.float64], sizes: NDArray[np.float64]
) -> None:
    """Add a randomly oriented triangle of a given size, (N,), at each position, (N, 3)."""
    corners = rng.normal(size=(len(positions), 3, 3))
    corners -= corners.mean(axis=1, keepdims=True)
    corners *= sizes[:, None, None] / np.linalg.norm(corners, axis=2, keepdims=True).mean(axis=1, keepdims=True)
    builder.add(
        VEGETATION, (positions[:, None, :] + corners).reshape(-1, 3), np.arange(3 * len(positions)).reshape(-1, 3)
    )
