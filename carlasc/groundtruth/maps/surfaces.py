"""What follows from occupied cells: the mesh of their surface, with the colours of classes, and signed distances to it."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.grids import Grid
from carlasc.errors import import_extra
from carlasc.storage.files import write_output

MESH_ENDINGS = (".ply", ".glb")
_BLOCK = 128  # cells along x and y that are meshed at once
_STEPS = 1024  # places of vertices are rounded to such parts of a cell, so that blocks share them
_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # glTF: y is up


@dataclass(frozen=True)
class SurfaceMesh:
    """The surface of occupied cells.

    Attributes:
        vertices: (V, 3) float64, metres, between the middles of occupied cells and of free ones beside them.
        faces: (F, 3) int64 vertices of each triangle, anticlockwise as seen from outside, in right-handed axes.
        labels: (V,) class of each vertex: that of its occupied cell.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    labels: NDArray[np.int64]

    @classmethod
    def of(
        cls,
        cells: NDArray[np.int64],
        labels: NDArray[np.integer],
        lower: NDArray[np.float64],
        size: NDArray[np.float64],
    ) -> SurfaceMesh:
        """Mesh cells by marching cubes.

        Args:
            cells: (N, 3) indices of the occupied cells.
            labels: (N,) their classes, none 0.
            lower: (3,) lower corner of the cell (0, 0, 0), metres.
            size: (3,) size of a cell, metres.

        Raises:
            DependencyError: scikit-image is not installed.
        """
        nodes, faces, classes, count = (
            [np.empty((0, 3), np.int64)],
            [np.empty((0, 3), np.int64)],
            [np.empty(0, np.int64)],
            0,
        )
        for corner, volume in _blocks(cells, labels):
            found, triangles, own = _march(volume)
            nodes.append(found + _STEPS * corner)
            faces.append(triangles + count)
            classes.append(own)
            count += len(found)
        whole, first, place = np.unique(np.concatenate(nodes), axis=0, return_index=True, return_inverse=True)
        return cls(
            lower + (whole / _STEPS + 0.5) * size,
            place.reshape(-1)[np.concatenate(faces)],
            np.concatenate(classes)[first],
        )

    def write(self, path: str | os.PathLike[str], classes: ClassTable) -> None:
        """Write the mesh with a colour for each vertex; the ending of the file, one of `MESH_ENDINGS`, says its format. In .glb, y is up.

        Raises:
            DependencyError: trimesh is not installed.
            StorageError: the file cannot be written; an earlier one stays.
        """
        trimesh = import_extra("trimesh", "mesh")
        kind = Path(path).suffix.lower()
        mesh = trimesh.Trimesh(
            self.vertices @ _UP.T if kind == ".glb" else self.vertices,
            self.faces,
            vertex_colors=classes.palette[self.labels],
            process=False,
        )
        write_output(Path(path), mesh.export(file_type=kind[1:]))


def _blocks(
    cells: NDArray[np.int64], labels: NDArray[np.integer]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.uint16]]]:
    """Yield the first cell of each block, and the classes of its cells and of those before and after it on every axis, 0 where free.

    Blocks share their outermost cells, so that every cube between eight cells is in one block.
    """
    owner = np.concatenate([cells[:, :2] - shift for shift in ([0, 0], [1, 0], [0, 1], [1, 1])]) // _BLOCK
    blocks, block = np.unique(owner, axis=0, return_inverse=True)
    order, row = np.argsort(block.reshape(-1), kind="stable"), np.tile(np.arange(len(cells)), 4)
    ends = np.searchsorted(block.reshape(-1)[order], np.arange(len(blocks) + 1))
    for number, (x, y) in enumerate(blocks.tolist()):
        own = np.unique(row[order[ends[number] : ends[number + 1]]])
        corner = np.array([x * _BLOCK, y * _BLOCK, int(cells[own, 2].min()) - 1])
        volume = np.zeros((_BLOCK + 1, _BLOCK + 1, int(cells[own, 2].max()) + 2 - corner[2]), np.uint16)
        volume[tuple((cells[own] - corner).T)] = labels[own]
        yield corner, volume


def _march(volume: NDArray[np.uint16]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the places of the vertices in 1 / `_STEPS` of a cell, the triangles, and the classes of the vertices."""
    measure = import_extra("skimage.measure", "mesh")
    if not volume.any():
        return np.empty((0, 3), np.int64), np.empty((0, 3), np.int64), np.empty(0, np.int64)
    found, triangles, _, _ = measure.marching_cubes((volume > 0).astype(np.float32), 0.5, gradient_direction="ascent")
    ends = np.stack([np.floor(found), np.ceil(found)]).astype(np.int64)
    labels = np.zeros(len(found), np.int64)
    for corner in np.ndindex(
        2, 2, 2
    ):  # one of them is occupied: few vertices are inside of a cube, the others on its edges
        near = volume[tuple(ends[side, :, axis] for axis, side in enumerate(corner))]
        labels = np.maximum(labels, near)
    return np.rint(_STEPS * found).astype(np.int64), triangles.astype(np.int64), labels


def write_distances(path: str | os.PathLike[str], grid: Grid) -> None:
    """Write how far each voxel is from the surface: arrays `distance`, `lower`, `upper` and `voxel_size` in a .npz file.

    `distance`, (X, Y, Z) float32, metres between middles of voxels: to the nearest occupied voxel; in occupied ones minus that to the nearest other
    one; NaN where it is unknown what is there. A grid in which nothing is occupied has infinite distances.

    Raises:
        DependencyError: SciPy is not installed.
        StorageError: the file cannot be written; an earlier one stays.
    """
    transform = import_extra("scipy.ndimage", "mesh").distance_transform_edt
    spec, buffer = grid.spec, io.BytesIO()
    occupied, size = grid.known & (grid.labels > 0), spec.voxel_size.astype(np.float64)
    if occupied.all() or not occupied.any():
        distance = np.full(spec.size, -np.inf if occupied.all() else np.inf)
    else:
        distance = transform(~occupied, sampling=size) - transform(occupied, sampling=size)
    distance[~grid.known] = np.nan
    np.savez_compressed(
        buffer, distance=distance.astype(np.float32), lower=spec.lower, upper=spec.upper, voxel_size=size
    )
    write_output(Path(path), buffer.getvalue())
