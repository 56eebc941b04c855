"""Triangle meshes with a class per triangle, solids to build the town from, and ray casting."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from carlasc.core.arrays import AnyIntArray, BoolArray, FloatArray, Int32Array, IntArray, Uint8Array
from carlasc.core.geometry import Transform, transform_points
from carlasc.errors import import_extra

Vertices = FloatArray
Faces = Int32Array


@dataclass(frozen=True)
class Mesh:
    """Triangles, each of one class.

    Attributes:
        vertices: (V, 3) float64, metres.
        faces: (F, 3) int32, rows of `vertices`.
        labels: (F,) uint8, class id of each triangle.
    """

    vertices: Vertices
    faces: Faces
    labels: Uint8Array

    def transformed(self, dst_T_src: Transform) -> Mesh:
        """Return the mesh in the frame `dst`."""
        return Mesh(transform_points(dst_T_src, self.vertices), self.faces, self.labels)

    def select(self, keep: BoolArray) -> Mesh:
        """Return the mesh of the triangles selected by a mask (F,), without unused vertices."""
        faces = self.faces[keep]
        used = np.zeros(len(self.vertices), np.bool_)
        used[faces] = True
        renumbered = np.cumsum(used, dtype=np.int32) - np.int32(1)
        return Mesh(self.vertices[used], renumbered[faces], self.labels[keep])

    @property
    def triangles(self) -> FloatArray:
        """(F, 3, 3) corners of each triangle."""
        return self.vertices[self.faces]


class MeshBuilder:
    """Collects buildings in one mesh."""

    def __init__(self) -> None:
        self._parts = list[Mesh]()

    def build(self) -> Mesh:
        """Return the mesh of all added parts."""
        return concatenate(self._parts)

    def add(self, label: int, vertices: ArrayLike, faces: ArrayLike) -> None:
        """Add triangles of one class.

        Args:
            label: class id.
            vertices: (V, 3) metres.
            faces: (F, 3) rows of `vertices`.
        """
        corners = np.asarray(vertices, np.float64)
        rows = np.asarray(faces, np.int32)
        self._parts.append(Mesh(corners, rows, np.full(len(rows), label, np.uint8)))

    def add_mesh(self, mesh: Mesh, dst_T_src: Transform) -> None:
        """Add a mesh with its classes, transformed from its frame `src` to the frame `dst` of the
        builder.
        """
        self._parts.append(mesh.transformed(dst_T_src))

    def boxes(self, label: int, base: ArrayLike, size: ArrayLike, yaw_rad: ArrayLike = 0.0) -> None:
        """Add upright boxes.

        Args:
            label: class id.
            base: (3,) or (N, 3) centres of the lower faces, metres.
            size: (3,) or (N, 3) lengths along x, y and z of each box, metres.
            yaw_rad: () or (N,) rotations about z.
        """
        self._copies(label, _unit_box(), base, np.array(size, np.float64, ndmin=2), yaw_rad)

    def level_rectangles(
        self, label: int, centre: ArrayLike, size: ArrayLike, yaw_rad: float = 0.0
    ) -> None:
        """Add horizontal rectangles, such as road markings.

        Args:
            label: class id.
            centre: (3,) or (N, 3) metres.
            size: (2,) or (N, 2) lengths along x and y of each rectangle, metres.
            yaw_rad: rotation about z.
        """
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) / 2
        square = corners, np.array([[0, 1, 2], [0, 2, 3]])
        sizes = at_height(np.array(size, np.float64, ndmin=2), 1.0)
        self._copies(label, square, centre, sizes, yaw_rad)

    def _copies(
        self,
        label: int,
        shape: tuple[Vertices, IntArray],
        place: ArrayLike,
        sizes: FloatArray,
        yaw_rad: ArrayLike,
    ) -> None:
        """Add copies of a shape of size 1: its corners and faces."""
        corners, faces = shape
        places = np.array(place, np.float64, ndmin=2)
        count = max(len(places), len(sizes))
        local = corners * np.broadcast_to(sizes, (count, 3))[:, None, :]
        turns = np.broadcast_to(np.asarray(yaw_rad, np.float64), (count,))
        moved = _rotate_z(local, turns) + places[:, None, :]
        first = np.arange(count, dtype=np.int32)[:, None, None] * np.int32(len(corners))
        self.add(label, moved.reshape(-1, 3), (faces + first).reshape(-1, 3))

    def cylinder(
        self,
        label: int,
        base: ArrayLike,
        radius: float,
        height: float,
        sections: int = 8,
        top: float = 1.0,
    ) -> None:
        """Add an upright cylinder, or a truncated cone.

        Args:
            label: class id.
            base: (3,) centre of the lower face, metres.
            radius: radius of the lower face, metres.
            height: metres.
            sections: number of flat faces around it.
            top: radius of the upper face, relative to the lower one.
        """
        vertices, faces = _unit_cylinder(sections)
        taper = 1.0 + (top - 1.0) * vertices[:, 2:]
        scaled = np.hstack([vertices[:, :2] * radius * taper, vertices[:, 2:] * height])
        self.add(label, scaled + np.asarray(base, np.float64), faces)

    def rod(
        self, label: int, start: ArrayLike, end: ArrayLike, radius: float, sections: int = 6
    ) -> None:
        """Add a cylinder in any direction.

        Args:
            label: class id.
            start: (3,) centre of one end, metres.
            end: (3,) centre of the other end.
            radius: metres.
            sections: number of flat faces around it.
        """
        start = np.asarray(start, np.float64)
        end = np.asarray(end, np.float64)
        length = float(np.linalg.norm(end - start))
        along = (end - start) / length
        side = np.cross(along, (1.0, 0.0, 0.0) if abs(along[0]) < 0.9 else (0.0, 1.0, 0.0))
        side /= np.linalg.norm(side)
        axes = np.stack([side, np.cross(along, side), along], axis=1)
        vertices, faces = _unit_cylinder(sections)
        self.add(label, (vertices * (radius, radius, length)) @ axes.T + start, faces)

    def ribbon(self, label: int, left: ArrayLike, right: ArrayLike) -> None:
        """Add the strip between two polylines, (P, 3) each, metres."""
        left = np.asarray(left, np.float64)
        right = np.asarray(right, np.float64)
        first = np.arange(len(left) - 1)
        a = first
        b = first + 1
        c = first + len(left)
        d = first + len(left) + 1
        faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
        self.add(label, np.concatenate([left, right]), faces)

    def prism(self, label: int, outline: ArrayLike, near: ArrayLike, far: ArrayLike) -> None:
        """Add the solid between two copies of a convex outline.

        Args:
            label: class id.
            outline: (P, 2) corners, x and z, metres.
            near: () or (P,) y of each corner of one copy.
            far: () or (P,) y of each corner of the other copy.
        """
        outline = np.asarray(outline, np.float64)
        count = len(outline)
        sides = [
            np.column_stack(
                [outline[:, 0], np.broadcast_to(np.asarray(y, np.float64), (count,)), outline[:, 1]]
            )
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
        cap = np.stack(
            [np.zeros(count - 2, int), np.arange(1, count - 1), np.arange(2, count)], axis=1
        )
        self.add(label, np.concatenate(sides), np.concatenate([walls, cap, cap + count]))


def concatenate(meshes: list[Mesh]) -> Mesh:
    """Return the mesh of all triangles of several meshes of one frame."""
    if not meshes:
        return Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32), np.empty(0, np.uint8))
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)], dtype=np.int32)
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + row for mesh, row in zip(meshes, first, strict=False)]),
        np.concatenate([mesh.labels for mesh in meshes]),
    )


def close_loop(points: FloatArray) -> FloatArray:
    """Return the (P, k) points of a loop with the first point repeated at the end."""
    return np.concatenate([points, points[:1]])


def at_height(points: FloatArray, height: ArrayLike) -> FloatArray:
    """Return (P, 3) points from their x and y, (P, 2), and their z, () or (P,)."""
    return np.column_stack(
        [points, np.broadcast_to(np.asarray(height, np.float64), (len(points),))]
    )


@cache
def unit_sphere(subdivisions: int = 1) -> tuple[Vertices, IntArray]:
    """Return vertices and faces of an icosphere of radius 1."""
    sphere = _trimesh_creation().icosphere(subdivisions=subdivisions)
    return np.asarray(sphere.vertices), np.asarray(sphere.faces)


def _rotate_z(points: FloatArray, yaw_rad: FloatArray) -> FloatArray:
    """Rotate points (N, P, 3) about z, x towards y, by (N,) angles."""
    cos = np.cos(yaw_rad)[:, None]
    sin = np.sin(yaw_rad)[:, None]
    x = points[..., 0]
    y = points[..., 1]
    z = points[..., 2]
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=-1)


def _trimesh_creation() -> Any:
    return import_extra("trimesh.creation", "simulate")


@cache
def _unit_box() -> tuple[Vertices, IntArray]:
    """Return corners and faces of a cube of 1 m whose lower face is at z = 0."""
    box = _trimesh_creation().box(extents=(1, 1, 1))
    return np.asarray(box.vertices) + (0, 0, 0.5), np.asarray(box.faces)


@cache
def _unit_cylinder(sections: int) -> tuple[Vertices, IntArray]:
    """Return vertices and faces of a cylinder of radius and height 1 m whose lower face is at z =
    0.
    """
    cylinder = _trimesh_creation().cylinder(radius=1.0, height=1.0, sections=sections)
    return np.asarray(cylinder.vertices) + (0, 0, 0.5), np.asarray(cylinder.faces)


_EDGE_ON = (
    1e-4  # below this sine of the angle between ray and triangle, the triangle counts as edge-on
)


def rotate_exactly(dst_T_src: Transform, vectors: FloatArray) -> FloatArray:
    """Rotate (N, 3) vectors from frame `src` to `dst`.

    Unlike a matrix product, the result has the same bits with any number of threads.
    """
    x, y, z = vectors.T
    return np.stack([row[0] * x + row[1] * y + row[2] * z for row in dst_T_src[:3, :3]], axis=-1)


class RayScene:
    """A mesh for ray casting. Coordinates are in the frame of the mesh."""

    def __init__(self, mesh: Mesh, centre: FloatArray) -> None:
        """Build the search tree.

        Args:
            mesh: the triangles.
            centre: (3,) origin of the single-precision coordinates in the search tree, metres.
                Precision is best near it.

        Raises:
            DependencyError: embreex is not installed.
        """
        scenes: Any = import_extra("embreex.rtcore_scene", "simulate")
        geometry: Any = import_extra("embreex.mesh_construction", "simulate")
        self._centre = centre
        self._scene = scenes.EmbreeScene()
        vertices = np.ascontiguousarray(mesh.vertices - centre, np.float32)
        geometry.TriangleMesh(self._scene, vertices, np.ascontiguousarray(mesh.faces, np.int32))
        triangles = vertices.astype(np.float64)[mesh.faces]
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        self._normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        self._offsets = np.einsum("fi,fi->f", self._normals, triangles[:, 0])

    def cast(
        self, origin: FloatArray, directions: FloatArray, range_m: float
    ) -> tuple[NDArray[np.intp], Int32Array, FloatArray]:
        """Cast rays.

        Args:
            origin: (3,) or (R, 3) metres.
            directions: (R, 3) unit vectors.
            range_m: maximum distance of a hit, metres.

        Returns:
            rays: (H,) indices of the rays that hit a triangle.
            triangles: (H,) index of the first triangle that each of them hits.
            distances: (H,) metres.
        """
        starts = np.broadcast_to(origin - self._centre, directions.shape)
        limits = np.full(len(directions), range_m, np.float32)
        first_hits = self._scene.run(
            np.ascontiguousarray(starts, np.float32), directions.astype(np.float32), limits
        )
        rays = np.flatnonzero(first_hits >= 0)
        triangles = first_hits[rays]
        x, y, z = (self._normals[triangles, axis] for axis in range(3))
        # Embree returns the triangle only. The distance to its plane is computed here in double
        # precision.
        start_x, start_y, start_z = starts[rays].T
        height = self._offsets[triangles] - (x * start_x + y * start_y + z * start_z)
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = x * directions[rays, 0] + y * directions[rays, 1] + z * directions[rays, 2]
            distances = height / slope
        # The distance to an edge-on triangle is not defined.
        valid = (np.abs(slope) > _EDGE_ON) & (distances > 0) & (distances <= range_m)
        return rays[valid], triangles[valid], distances[valid]

    def normals(self, triangles: AnyIntArray) -> FloatArray:
        """Return (H, 3) unit normals of triangles, which may point to either side."""
        return self._normals[triangles]
