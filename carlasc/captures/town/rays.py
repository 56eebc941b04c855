"""Casting rays at the triangles of a mesh."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.captures.town.meshes import Mesh
from carlasc.core.geometry import Transform
from carlasc.errors import import_extra

_EDGE_ON = 1e-4  # sine of the angle between a ray and a triangle below which the triangle counts as seen edge-on


def rotate_exactly(dst_T_src: Transform, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotate (N, 3) vectors from frame `src` to `dst`.

    Unlike a matrix product, the result has the same bits with any number of threads.
    """
    x, y, z = vectors.T
    return np.stack([row[0] * x + row[1] * y + row[2] * z for row in dst_T_src[:3, :3]], axis=-1)


class RayScene:
    """A mesh that rays can be cast at. Coordinates are in the mesh's frame."""

    def __init__(self, mesh: Mesh, centre: NDArray[np.float64]) -> None:
        """Build the search tree.

        Args:
            mesh: the triangles.
            centre: (3,) origin of the single-precision coordinates in the search tree, metres. Precision is best near it.

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
        self, origin: NDArray[np.float64], directions: NDArray[np.float64], range_m: float
    ) -> tuple[NDArray[np.intp], NDArray[np.int32], NDArray[np.float64]]:
        """Cast rays from one point.

        Args:
            origin: (3,) metres.
            directions: (R, 3) unit vectors.
            range_m: greatest distance of a hit.

        Returns:
            rays: (H,) indices of the rays that hit a triangle.
            triangles: (H,) index of the first triangle that each of them hits.
            distances: (H,) metres.
        """
        start = np.broadcast_to((origin - self._centre).astype(np.float32), directions.shape)
        limits = np.full(len(directions), range_m, np.float32)
        found = self._scene.run(np.ascontiguousarray(start), directions.astype(np.float32), limits)
        rays = np.flatnonzero(found >= 0)
        triangles = found[rays]
        x, y, z = (self._normals[triangles, axis] for axis in range(3))
        # Embree returns the triangle only. The distance to its plane is computed here in double precision.
        start_x, start_y, start_z = origin - self._centre
        height = self._offsets[triangles] - (x * start_x + y * start_y + z * start_z)
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = x * directions[rays, 0] + y * directions[rays, 1] + z * directions[rays, 2]
            distances = height / slope
        # The distance to a triangle that is seen edge-on is not defined.
        valid = (np.abs(slope) > _EDGE_ON) & (distances > 0) & (distances <= range_m)
        return rays[valid], triangles[valid], distances[valid]

    def normals(self, triangles: NDArray[np.integer]) -> NDArray[np.float64]:
        """Return (H, 3) unit normals of triangles. They may point to either side."""
        return self._normals[triangles]
