"""What a window draws, as geometry of Open3D: meshes with light, lines, points."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.viewing.rendering.meshes import QuadMesh

_SUN = np.array([-0.38, -0.5, 0.78]) / np.linalg.norm([0.38, 0.5, 0.78])
_EDGE = 0.8  # brightness of the edges of voxels, relative to their faces


class Shapes:
    """Makes geometry of Open3D. Colours are RGB, 0 to 255; the light of sun and sky is in those of meshes."""

    def __init__(self, o3d: ModuleType) -> None:
        self._o3d: Any = o3d

    def mesh(self, mesh: QuadMesh) -> Any:
        """Return the faces of a mesh."""
        corners, triangles = mesh.triangles()
        light = self._light(mesh)[:, None] * mesh.openness
        indices = self._o3d.utility.Vector3iVector(triangles.astype(np.int32))
        shown = self._o3d.geometry.TriangleMesh(self._vectors(corners), indices)
        shown.vertex_colors = self._vectors(np.clip(mesh.colors[:, None] / 255.0 * light[..., None], 0, 1))
        return shown

    def edges(self, mesh: QuadMesh) -> Any:
        """Return the edges of voxels as lines, darker than their faces and slightly in front of them."""
        face, side = np.nonzero(mesh.edges)
        corners = mesh.corners + 4e-3 * mesh.normals[:, None]
        ends = np.stack([corners[face, side], corners[face, (side + 1) % 4]], axis=1)
        return self.lines(ends, mesh.colors[face] * _EDGE * self._light(mesh)[face, None])

    def lines(self, ends: NDArray[np.floating], colors: NDArray[Any]) -> Any:
        """Return straight lines with the (L, 2, 3) ends, in the (L, 3) colours, or in one colour, (3,)."""
        pairs = self._o3d.utility.Vector2iVector(np.arange(2 * len(ends), dtype=np.int32).reshape(-1, 2))
        lines = self._o3d.geometry.LineSet(self._vectors(ends), pairs)
        lines.colors = self._vectors(np.broadcast_to(colors, (len(ends), 3)) / 255.0)
        return lines

    def points(self, points: NDArray[np.floating], colors: NDArray[np.uint8]) -> Any:
        """Return (N, 3) points in their (N, 3) colours."""
        cloud = self._o3d.geometry.PointCloud(self._vectors(points))
        cloud.colors = self._vectors(colors / 255.0)
        return cloud

    def _light(self, mesh: QuadMesh) -> NDArray[np.floating]:
        """Return the brightness of each face in the sun; a level face without shade has exactly its own colour."""
        lit = np.clip(mesh.normals @ _SUN, 0, None) / _SUN[2]
        return 0.58 + 0.42 * np.minimum(lit, 1.25)

    def _vectors(self, values: NDArray[Any]) -> Any:
        return self._o3d.utility.Vector3dVector(np.asarray(values, np.float64).reshape(-1, 3))
