"""Triangle meshes with a class on every triangle, and the few solids that a town is put together from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from carlasc.core.geometry import Transform, transform_points
from carlasc.errors import import_extra

Vertices = NDArray[np.float64]
Faces = NDArray[np.int32]


@dataclass(frozen=True)
class Mesh:
    """Triangles, each of one class.

    Attributes:
        vertices: (V, 3) float64, metres.
        faces: (F, 3) int32, rows of `vertices`.
        labels: (F,) uint8, class of each triangle.
    """

    vertices: Vertices
    faces: Faces
    labels: NDArray[np.uint8]

    def moved(self, dst_T_src: Transform) -> Mesh:
        """Return the mesh in the frame `dst`."""
        return Mesh(transform_points(dst_T_src, self.vertices), self.faces, self.labels)

    def select(self, keep: NDArray[np.bool_]) -> Mesh:
        """Return the mesh of some triangles, chosen by a mask (F,), without the vertices that no other uses."""
        faces = self.faces[keep]
        used = np.zeros(len(self.vertices), np.bool_)
        used[faces] = True
        renumbered = np.cumsum(used, dtype=np.int32) - np.int32(1)
        return Mesh(self.vertices[used], renumbered[faces], self.labels[keep])

    @property
    def triangles(self) -> NDArray[np.float64]:
        """(F, 3, 3) corners of each triangle."""
        return self.vertices[self.faces]


class MeshBuilder:
    """Collects solids into one mesh."""

    def __init__(self) -> None:
        self._vertices: list[Vertices] = []
        self._faces: list[Faces] = []
        self._labels: list[NDArray[np.uint8]] = []
        self._count = 0

    def build(self) -> Mesh:
        """Return everything added so far as one mesh."""
        if not self._faces:
            return Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32), np.empty(0, np.uint8))
        return Mesh(np.concatenate(self._vertices), np.concatenate(self._faces), np.concatenate(self._labels))

    def add(self, label: int, vertices: ArrayLike, faces: ArrayLike) -> None:
        """Add triangles of one class: vertices (V, 3), faces (F, 3)."""
        corners, rows = np.asarray(vertices, np.float64), np.asarray(faces, np.int32)
        self._vertices.append(corners)
        self._faces.append(rows + np.int32(self._count))
        self._labels.append(np.full(len(rows), label, np.uint8))
        self._count += len(corners)

    def add_mesh(self, mesh: Mesh, dst_T_src: Transform) -> None:
        """Add a mesh with its own classes, moved to the builder's frame."""
        self._vertices.append(transform_points(dst_T_src, mesh.vertices))
        self._faces.append(mesh.faces + np.int32(self._count))
        self._labels.append(mesh.labels)
        self._count += len(mesh.vertices)

    def boxes(self, label: int, base: ArrayLike, size: ArrayLike, yaw_rad: ArrayLike = 0.0) -> None:
        """Add upright boxes.

        Args:
            label: class.
            base: (3,) or (N, 3), the middle of the underside.
            size: (3,) or (N, 3), extent along the box's own x, y and z.
            yaw_rad: () or (N,), how the boxes are turned.
        """
        base, size = np.atleast_2d(np.asarray(base, np.float64)), np.atleast_2d(np.asarray(size, np.float64))
        count = max(len(base), len(size))
        corners, faces = _unit_box()
        local = corners * np.broadcast_to(size, (count, 3))[:, None, :]
        moved = _turned(local, np.broadcast_to(np.asarray(yaw_rad, np.float64), (count,))) + base[:, None, :]
        offsets = np.arange(count, dtype=np.int32)[:, None, None] * np.int32(len(corners))
        self.add(label, moved.reshape(-1, 3), (faces + offsets).reshape(-1, 3))

    def decals(self, label: int, centre: ArrayLike, size: ArrayLike, yaw_rad: float = 0.0) -> None:
        """Add level rectangles: paint on a road.

        Args:
            label: class.
            centre: (3,) or (N, 3).
            size: (2,) or (N, 2), extent along the rectangle's own x and y.
            yaw_rad: how they are turned.
        """
        centre, size = np.atleast_2d(np.asarray(centre, np.float64)), np.atleast_2d(np.asarray(size, np.float64))
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) / 2
        local = corners * lifted(np.broadcast_to(size, (len(centre), 2)), 1.0)[:, None, :]
        moved = _turned(local, np.full(len(centre), yaw_rad)) + centre[:, None, :]
        first = np.arange(len(centre), dtype=np.int32)[:, None, None] * np.int32(4)
        self.add(label, moved.reshape(-1, 3), (np.array([[0, 1, 2], [0, 2, 3]]) + first).reshape(-1, 3))

    def cylinder(
        self, label: int, base: ArrayLike, radius: float, height: float, sections: int = 8, top: float = 1.0
    ) -> None:
        """Add an upright cylinder on `base` (3,); its upper radius is `top` times the lower one."""
        vertices, faces = _unit_cylinder(sections)
        taper = 1.0 + (top - 1.0) * vertices[:, 2:]
        scaled = np.hstack([vertices[:, :2] * radius * taper, vertices[:, 2:] * height])
        self.add(label, scaled + np.asarray(base, np.float64), faces)

    def rod(self, label: int, start: ArrayLike, end: ArrayLike, radius: float, sections: int = 6) -> None:
        """Add a round rod from `start` to `end`, (3,) each."""
        start, end = np.asarray(start, np.float64), np.asarray(end, np.float64)
        length = float(np.linalg.norm(end - start))
        along = (end - start) / length
        side = np.cross(along, (1.0, 0.0, 0.0) if abs(along[0]) < 0.9 else (0.0, 1.0, 0.0))
        side /= np.linalg.norm(side)
        axes = np.stack([side, np.cross(along, side), along], axis=1)
        vertices, faces = _unit_cylinder(sections)
        self.add(label, (vertices * (radius, radius, length)) @ axes.T + start, faces)

    def ribbon(self, label: int, left: ArrayLike, right: ArrayLike) -> None:
        """Add the strip between two polylines of equally many points, (P, 3) each."""
        left, right = np.asarray(left, np.float64), np.asarray(right, np.float64)
        first = np.arange(len(left) - 1)
        a, b, c, d = first, first + 1, first + len(left), first + len(left) + 1
        faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
        self.add(label, np.concatenate([left, right]), faces)

    def prism(self, label: int, outline: ArrayLike, near: ArrayLike, far: ArrayLike) -> None:
        """Add the solid between two copies of a convex outline.

        Args:
            label: class.
            outline: (P, 2) corners, x and z.
            near: () or (P,), y of each corner on one side.
            far: () or (P,), y on the other.
        """
        outline = np.asarray(outline, np.float64)
        count = len(outline)
        sides = [
            np.column_stack([outline[:, 0], np.broadcast_to(np.asarray(y, np.float64), (count,)), outline[:, 1]])
            for y in (near, far)
        ]
        ring = np.arange(count)
        following = (ring + 1) % count
        walls = np.concatenate(
            [
                np.stack([ring, following, ring + count], axis=1),
                np.stack([following, following + count, ring + count], axis=1),
            ]
        )
        cap = np.stack([np.zeros(count - 2, int), np.arange(1, count - 1), np.arange(2, count)], axis=1)
        self.add(label, np.concatenate(sides), np.concatenate([walls, cap, cap + count]))


def closed(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a loop's points (P, k) with the first one repeated at the end."""
    return np.concatenate([points, points[:1]])


def lifted(points: NDArray[np.float64], height: ArrayLike) -> NDArray[np.float64]:
    """Return points (P, 2) of the plane at a height, () or (P,), as (P, 3)."""
    return np.column_stack([points, np.broadcast_to(np.asarray(height, np.float64), (len(points),))])


def ellipsoid(subdivisions: int = 1) -> tuple[Vertices, NDArray[np.int64]]:
    """Return vertices and faces of a unit icosphere."""
    return _icosphere(subdivisions)


def _turned(points: NDArray[np.float64], yaw_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn points (N, P, 3) about z, x towards y, by (N,) angles."""
    cos, sin = np.cos(yaw_rad)[:, None], np.sin(yaw_rad)[:, None]
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=-1)


def _creation() -> Any:
    return import_extra("trimesh.creation", "simulate")


@cache
def _unit_box() -> tuple[Vertices, NDArray[np.int64]]:
    """Corners and faces of a box of 1 m whose underside is at z = 0."""
    box = _creation().box(extents=(1, 1, 1))
    return np.asarray(box.vertices) + (0, 0, 0.5), np.asarray(box.faces)


@cache
def _unit_cylinder(sections: int) -> tuple[Vertices, NDArray[np.int64]]:
    cylinder = _creation().cylinder(radius=1.0, height=1.0, sections=sections)
    return np.asarray(cylinder.vertices) + (0, 0, 0.5), np.asarray(cylinder.faces)


@cache
def _icosphere(subdivisions: int) -> tuple[Vertices, NDArray[np.int64]]:
    sphere = _creation().icosphere(subdivisions=subdivisions)
    return np.asarray(sphere.vertices), np.asarray(sphere.faces)
