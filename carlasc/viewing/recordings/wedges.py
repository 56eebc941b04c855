"""The voxels of a cylindrical grid as few triangles: faces of one class that are next to each other along a line are one."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from carlasc.core.grids import Grid, GridSpec
from carlasc.viewing.rendering.meshes import SQUARE, split_arcs, surrounded


class Triangles(NamedTuple):
    """A surface.

    Attributes:
        corners: (V, 3) float32 metres, four for each flat face, in order around it.
        normals: (V, 3) float32 unit vectors, outward.
        indices: (T, 3) uint32 rows of `corners`, counter-clockwise seen from outside.
    """

    corners: NDArray[np.float32]
    normals: NDArray[np.float32]
    indices: NDArray[np.uint32]


def class_surfaces(grid: Grid) -> Iterator[tuple[int, Triangles]]:
    """Yield each class of a cylindrical grid with the surface of its voxels, without the faces that two voxels share.

    The lowest faces of the lowest cells, which are seen from below the ground only, are left out.
    """
    spec, labels = split_arcs(grid.spec, grid.labels)
    parts = [_faces(spec, labels, axis, side) for axis in range(3) for side in (0, 1)]
    corners, normals, owners = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    for label in np.unique(owners).tolist():
        chosen = owners == label
        first = 4 * np.arange(np.count_nonzero(chosen), dtype=np.uint32)[:, None, None]
        indices = (first + np.array([[0, 1, 2], [0, 2, 3]], np.uint32)).reshape(-1, 3)
        yield label, Triangles(corners[chosen].reshape(-1, 3), np.repeat(normals[chosen], 4, axis=0), indices)


def _faces(
    spec: GridSpec, labels: NDArray[np.unsignedinteger], axis: int, side: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.unsignedinteger]]:
    """Return the (Q, 4, 3) corners, the (Q, 3) normals and the (Q,) classes of the exposed faces towards one side of one axis."""
    solid = surrounded(spec, labels > 0)
    behind = np.roll(solid, 1 - 2 * side, axis)[1:-1, 1:-1, 1:-1]
    shown = np.where(behind, 0, labels)
    if axis == 0 and side == 0 and spec.lower[0] == 0:
        shown[0] = 0  # at radius 0 the wedge ends in a line
    if (axis, side) == (2, 0):
        shown[:, :, 0] = 0
    along = 2 if axis == 0 else 0  # the edges of cells are straight along the radius and along z
    before = np.roll(shown, 1, along)
    after = np.roll(shown, -1, along)
    ends: tuple[list[slice | int], list[slice | int]] = ([slice(None)] * 3, [slice(None)] * 3)
    ends[0][along], ends[1][along] = 0, -1
    before[tuple(ends[0])], after[tuple(ends[1])] = 0, 0

    def in_lines(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Return the cells of a mask, line after line along the axis of the runs."""
        moved = np.argwhere(np.moveaxis(mask, along, 2))
        return np.insert(moved[:, :2], along, moved[:, 2], axis=1)

    first, last = in_lines((shown > 0) & (shown != before)), in_lines((shown > 0) & (shown != after))
    edges = [spec.edges(a) for a in range(3)]
    across, up = (axis + 1) % 3, (axis + 2) % 3
    corners: NDArray[np.floating] = np.empty((len(first), 4, 3))
    for number, (one, two) in enumerate(SQUARE if side else SQUARE[::-1]):
        offset = np.zeros(3, np.int64)
        offset[[axis, across, up]] = side, one, two
        lattice = np.where(offset == 1, last + 1, first)
        lattice[:, axis] = first[:, axis] + side
        corners[:, number] = np.stack([edges[a][lattice[:, a]] for a in range(3)], axis=1)
    corners = spec.from_axes(corners)
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return corners.astype(np.float32), normals.astype(np.float32), labels[tuple(first.T)]
