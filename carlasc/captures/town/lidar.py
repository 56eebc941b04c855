"""The LiDAR: its rays, and what they hit."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.captures.town.meshes import Mesh
from carlasc.core.geometry import Transform
from carlasc.errors import ArgumentError, import_extra

EDGE_ON = 1e-4  # sine of the angle between a ray and a triangle


@dataclass(frozen=True)
class Lidar:
    """A spinning LiDAR that takes its whole scan at one instant (FORMAT section 1).

    Attributes:
        channels: rays above each other.
        points: rays a scan, all channels together; every channel has the same number.
        range_m: how far it sees.
        upper_deg: elevation of the topmost channel.
        lower_deg: elevation of the lowest.
        noise_m: greatest error of a coordinate; errors are uniform.

    Raises:
        ArgumentError: a number makes no sense.
    """

    channels: int = 64
    points: int = 130_000
    range_m: float = 50.0
    upper_deg: float = 2.0
    lower_deg: float = -25.0
    noise_m: float = 0.02

    def __post_init__(self) -> None:
        if self.channels < 1:
            raise ArgumentError("channels", expected="at least 1", found=f"{self.channels}")
        if self.points < self.channels:
            raise ArgumentError(
                "points", expected=f"at least one for each of {self.channels} channels", found=f"{self.points}"
            )
        if not 0 < self.range_m < np.inf:
            raise ArgumentError("range", expected="a positive number of metres", found=f"{self.range_m}")
        if not 0 <= self.noise_m < np.inf:
            raise ArgumentError("noise", expected="0 or more metres", found=f"{self.noise_m}")
        if not -90 <= self.lower_deg <= self.upper_deg <= 90:
            raise ArgumentError("elevations", expected="lower <= upper", found=f"{self.lower_deg} and {self.upper_deg}")

    @cached_property
    def directions(self) -> NDArray[np.float64]:
        """(R, 3) unit rays in the sensor's frame, channel by channel from the top, each from the back round by the left."""
        elevation = np.radians(np.linspace(self.upper_deg, self.lower_deg, self.channels))[:, None]
        columns = self.points // self.channels
        azimuth = np.linspace(-np.pi, np.pi, columns, endpoint=False)[None, :]
        rays = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation) + 0 * azimuth
        return np.stack(rays, axis=-1).reshape(-1, 3)


def turned(dst_T_src: Transform, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn (N, 3) vectors from frame `src` to `dst`, to the same bits on any number of threads, unlike a matrix product."""
    x, y, z = vectors.T
    return np.stack([row[0] * x + row[1] * y + row[2] * z for row in dst_T_src[:3, :3]], axis=-1)


class RayScene:
    """Triangles that rays can be shot at. Coordinates are those of the mesh; precision is best near `centre`."""

    def __init__(self, mesh: Mesh, centre: NDArray[np.float64]) -> None:
        """Build the search tree.

        Args:
            mesh: the triangles.
            centre: (3,) the point that single-precision coordinates are counted from.
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
        """Shoot rays from one point.

        Args:
            origin: (3,) metres.
            directions: (R, 3) unit vectors.
            range_m: hits farther than this are none.

        Returns:
            rays: (H,) which rays hit something.
            triangles: (H,) which triangle each of them met first.
            distances: (H,) metres.
        """
        start = np.broadcast_to((origin - self._centre).astype(np.float32), directions.shape)
        limits = np.full(len(directions), range_m, np.float32)
        found = self._scene.run(np.ascontiguousarray(start), directions.astype(np.float32), limits)
        rays = np.flatnonzero(found >= 0)
        triangles = found[rays]
        x, y, z = (self._normals[triangles, axis] for axis in range(3))
        # Embree tells only which triangle: where the ray meets its plane is worked out here, in double precision.
        start_x, start_y, start_z = origin - self._centre
        height = self._offsets[triangles] - (x * start_x + y * start_y + z * start_z)
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = x * directions[rays, 0] + y * directions[rays, 1] + z * directions[rays, 2]
            distances = height / slope
        # A triangle seen exactly edge-on has no distance that could be told.
        sound = (np.abs(slope) > EDGE_ON) & (distances > 0) & (distances <= range_m)
        return rays[sound], triangles[sound], distances[sound]

    def normals(self, triangles: NDArray[np.integer]) -> NDArray[np.float64]:
        """Return (H, 3) unit normals of triangles, on no particular side."""
        return self._normals[triangles]
