"""Open3D: how it is loaded, and how a window makes its geometry: meshes with light, lines and
points.

It needs libraries of the system: the error names the missing one, and what to install.
"""

from __future__ import annotations

import importlib
import re
import shutil
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import DependencyError, import_extra
from carlasc.viewing.rendering.meshes import QuadMesh

_SUN = np.array([-0.38, -0.5, 0.78]) / np.linalg.norm([0.38, 0.5, 0.78])
_EDGE = 0.8  # brightness of the edges of voxels, relative to their faces


class Shapes:
    """Makes geometry of Open3D.

    Colours are RGB, 0 to 255; the colours of meshes include the light of sun and sky.
    """

    def __init__(self, o3d: ModuleType) -> None:
        self._o3d: Any = o3d

    def mesh(self, mesh: QuadMesh) -> Any:
        """Return the faces of a mesh."""
        corners, triangles = mesh.triangles()
        light = self._light(mesh)[:, None] * mesh.openness
        indices = self._o3d.utility.Vector3iVector(triangles.astype(np.int32))
        shown = self._o3d.geometry.TriangleMesh(self._vectors(corners), indices)
        shown.vertex_colors = self._vectors(
            np.clip(mesh.colors[:, None] / 255.0 * light[..., None], 0, 1)
        )
        return shown

    def edges(self, mesh: QuadMesh) -> Any:
        """Return the edges of voxels as lines, darker than their faces and slightly in front of
        them.
        """
        face, side = np.nonzero(mesh.edges)
        corners = mesh.corners + 4e-3 * mesh.normals[:, None]
        ends = np.stack([corners[face, side], corners[face, (side + 1) % 4]], axis=1)
        return self.lines(ends, mesh.colors[face] * _EDGE * self._light(mesh)[face, None])

    def lines(self, ends: NDArray[np.floating], colors: NDArray[Any]) -> Any:
        """Return straight lines with the (L, 2, 3) ends, in the (L, 3) colours, or in one colour,
        (3,).
        """
        pairs = self._o3d.utility.Vector2iVector(
            np.arange(2 * len(ends), dtype=np.int32).reshape(-1, 2)
        )
        lines = self._o3d.geometry.LineSet(self._vectors(ends), pairs)
        lines.colors = self._vectors(np.broadcast_to(colors, (len(ends), 3)) / 255.0)
        return lines

    def points(self, points: NDArray[np.floating], colors: NDArray[np.uint8]) -> Any:
        """Return (N, 3) points in their (N, 3) colours."""
        cloud = self._o3d.geometry.PointCloud(self._vectors(points))
        cloud.colors = self._vectors(colors / 255.0)
        return cloud

    def _light(self, mesh: QuadMesh) -> NDArray[np.floating]:
        """Return the brightness of each face in the sun; a level face without shade has exactly its
        own colour.
        """
        lit = np.clip(mesh.normals @ _SUN, 0, None) / _SUN[2]
        return 0.58 + 0.42 * np.minimum(lit, 1.25)

    def _vectors(self, values: NDArray[Any]) -> Any:
        return self._o3d.utility.Vector3dVector(np.asarray(values, np.float64).reshape(-1, 3))


PAGE_ADVICE = 'or write a page instead with `out="page.html"`'

_DEBIAN = {  # shared library -> its package in Debian and Ubuntu
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libGLX.so.0": "libglx0",
    "libX11.so.6": "libx11-6",
    "libudev.so.1": "libudev1",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libidn2.so.0": "libidn2-0",
    "libgomp.so.1": "libgomp1",
    "libstdc++.so.6": "libstdc++6",
    "libz.so.1": "zlib1g",
}


def import_open3d() -> ModuleType:
    """Import Open3D.

    Raises:
        DependencyError: Open3D is not installed, or a system library is missing; the advice says
            what to install.
    """
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        missing = missing_library(str(error))
        if missing is None and isinstance(error, ImportError):
            # the package is not installed, or the loader failed
            return import_extra("open3d", "view")
        problem = str(error) if missing is None else f"{missing} is missing"
        raise DependencyError(
            "open3d", problem=f"cannot be loaded: {problem}", advice=advice(missing)
        ) from error


def missing_library(message: str) -> str | None:
    """Return the shared library that is missing according to a loader's message, or None."""
    match = re.search(r"(\S+\.so[.0-9]*): cannot open shared object file", message)
    return match[1] if match else None


def advice(library: str | None) -> str:
    """Return what to install for a library, or what to do if its package is not known."""
    package = _DEBIAN.get(library or "")
    if package is None:
        return f"install the library that the message names, {PAGE_ADVICE}"
    root = "sudo " if shutil.which("sudo") else ""
    return f"{root}apt-get install {package} (Debian, Ubuntu), {PAGE_ADVICE}"
