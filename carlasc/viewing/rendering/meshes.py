"""Meshes of quads for ray casting: exposed faces of occupied voxels, boxes and arrows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from carlasc.core.arrays import (
    AnyFloatArray,
    BoolArray,
    Float32Array,
    Int32Array,
    IntArray,
    Uint8Array,
)
from carlasc.core.grids import GridSpec

_Value = TypeVar("_Value", bound=np.generic)
_WIDEST_ARC_RAD = np.deg2rad(4.0)  # wider cylindrical cells are drawn in several flat pieces
SQUARE = ((0, 0), (1, 0), (1, 1), (0, 1))
"""Corners of a face, in order around it."""
SIDES = [(axis, side) for axis in range(3) for side in (0, 1)]
"""The sides of a cell: an axis, and 0 for its lower or 1 for its upper side."""
# by the number of cells next to a corner that hide the sky; two beside the face hide the third
_OPENNESS = np.array([1.0, 0.82, 0.68, 0.56], np.float32)


@dataclass(frozen=True)
class QuadMesh:
    """Flat faces with four corners.

    Attributes:
        corners: (Q, 4, 3) float32, metres, in order around each face.
        normals: (Q, 3) float32 unit vectors, outward.
        colors: (Q, 3) uint8 RGB.
        openness: (Q, 4) float32, 0 to 1: share of the sky that the adjacent voxels leave free at
            each corner.
        edges: (Q, 4) bool: whether the edge from corner i to i + 1 is drawn.
        open_sky: (Q,) bool: whether the whole sky is assumed visible, because the face is too large
            for a single value.
    """

    corners: Float32Array
    normals: Float32Array
    colors: Uint8Array
    openness: Float32Array
    edges: BoolArray
    open_sky: BoolArray

    def __len__(self) -> int:
        return len(self.corners)

    def triangles(self) -> tuple[Float32Array, Int32Array]:
        """Return vertices (4 Q, 3) and triangles (2 Q, 3): quad q is triangles 2 q and 2 q + 1."""
        return self.corners.reshape(-1, 3), quad_triangles(len(self))


def quad_triangles(count: int) -> Int32Array:
    """Return (2 N, 3) the corners of the triangles of `count` quads, of which each has four."""
    first = 4 * np.arange(count, dtype=np.int32)[:, None, None]
    return (first + np.array([[0, 1, 2], [0, 2, 3]], np.int32)).reshape(-1, 3)


def _normals_of(corners: AnyFloatArray) -> AnyFloatArray:
    """Return the (N, 3) unit normals of quads with (N, 4, 3) corners."""
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def join(meshes: Sequence[QuadMesh]) -> QuadMesh:
    """Return several meshes as one."""
    return QuadMesh(
        *(
            np.concatenate([getattr(mesh, name) for mesh in meshes])
            for name in QuadMesh.__dataclass_fields__
        )
    )


def quads(
    corners: ArrayLike, color: ArrayLike, *, edges: bool = False, open_sky: bool = False
) -> QuadMesh:
    """Return a mesh of (Q, 4, 3) faces with one colour or (Q, 3) colours; the order of the corners
    gives the normals.
    """
    points = np.asarray(corners, np.float32).reshape(-1, 4, 3)
    count = len(points)
    return QuadMesh(
        points,
        _normals_of(points),
        np.broadcast_to(np.asarray(color, np.uint8), (count, 3)),
        np.ones((count, 4), np.float32),
        np.full((count, 4), edges),
        np.full(count, open_sky),
    )


def grid_mesh(
    spec: GridSpec,
    colors: Uint8Array,
    occupied: BoolArray,
    *,
    on_floor: bool = False,
) -> QuadMesh:
    """Return the exposed faces of a grid's occupied cells: boxes, or wedges in a cylindrical grid.

    Args:
        spec: geometry of the grid.
        colors: (X, Y, Z, 3) uint8 RGB of each cell.
        occupied: (X, Y, Z) bool.
        on_floor: whether a floor below the grid hides the lowest faces of the lowest cells, which
            are then left out.
    """
    whole = spec
    spec, occupied = split_arcs(whole, occupied)
    _, colors = split_arcs(whole, colors)
    pieces = spec.size[1] // whole.size[1]
    solid = surrounded(spec, occupied)
    meshes = []
    for axis, side in SIDES:
        exposed = exposed_cells(spec, solid, axis, side, on_floor)
        meshes.append(_faces(spec, colors, solid, np.argwhere(exposed), axis, side, pieces))
    return join(meshes)


def split_arcs(spec: GridSpec, values: NDArray[_Value]) -> tuple[GridSpec, NDArray[_Value]]:
    """Return a grid with wide cylindrical cells divided into narrow ones, which are drawn flat;
    other grids are not changed.

    Args:
        spec: geometry.
        values: (X, Y, Z, ...) values of the cells.
    """
    if spec.coordinates != "cylindrical":
        return spec, values
    pieces = int(np.ceil(spec.voxel_size[1] / _WIDEST_ARC_RAD))
    return spec.with_size((spec.size[0], spec.size[1] * pieces, spec.size[2])), np.repeat(
        values, pieces, axis=1
    )


def surrounded(spec: GridSpec, occupied: BoolArray) -> BoolArray:
    """Return the cells padded by one empty cell on each side; a full turn of azimuth continues on
    its other side.
    """
    solid = np.pad(occupied, 1)
    if spec.coordinates == "cylindrical" and spec.upper[1] - spec.lower[1] > 2 * np.pi - 1e-3:
        solid[:, 0], solid[:, -1] = solid[:, -2], solid[:, 1]
    return solid


def exposed_cells(
    spec: GridSpec, solid: BoolArray, axis: int, side: int, on_floor: bool
) -> BoolArray:
    """Return the (X, Y, Z) solid cells whose face towards one side of one axis is visible.

    Args:
        spec: geometry of the grid.
        solid: the solid cells, as `surrounded` returns them.
        axis: number of the axis.
        side: 0 for the lower, 1 for the upper side.
        on_floor: whether the lowest faces of the lowest cells are left out.
    """
    behind = np.roll(solid, 1 - 2 * side, axis)[1:-1, 1:-1, 1:-1]
    exposed = solid[1:-1, 1:-1, 1:-1] & ~behind
    if spec.coordinates == "cylindrical" and axis == 0 and side == 0 and spec.lower[0] == 0:
        exposed[0] = False  # at radius 0 the wedge ends in a line
    if on_floor and (axis, side) == (2, 0):
        exposed[:, :, 0] = False
    return exposed


def _unit_face(axis: int, side: int) -> IntArray:
    """Return the (4, 3) corners of a side of a unit cell, in order around it."""
    corners = np.full((4, 3), side)
    corners[:, [(axis + 1) % 3, (axis + 2) % 3]] = SQUARE
    return corners


def face_corners(
    spec: GridSpec, first: IntArray, last: IntArray, axis: int, side: int
) -> tuple[AnyFloatArray, AnyFloatArray]:
    """Return the (Q, 4, 3) corners and the (Q, 3) outward normals of faces of runs of cells.

    Args:
        spec: geometry of the grid.
        first: (Q, 3) first cell of each run.
        last: (Q, 3) last cell of each run, equal to the first for a single cell.
        axis: number of the axis that the faces are perpendicular to.
        side: 0 for the lower, 1 for the upper side of the cells.
    """
    lattice = np.where(_unit_face(axis, side) == 1, last[:, None] + 1, first[:, None])
    corners = spec.from_axes(
        np.stack([spec.edges(a)[lattice[..., a]] for a in range(3)], axis=-1).astype(np.float64)
    )
    return corners, (2 * side - 1) * _normals_of(corners)


def _faces(
    spec: GridSpec,
    colors: Uint8Array,
    solid: BoolArray,
    cells: IntArray,
    axis: int,
    side: int,
    pieces: int,
) -> QuadMesh:
    """Return the faces of cells towards one side of one axis."""
    across = (axis + 1) % 3
    along = (axis + 2) % 3
    front = cells + 1
    front[:, axis] += 2 * side - 1
    openness = np.empty((len(cells), 4), np.float32)
    for number, towards in enumerate(2 * _unit_face(axis, side) - 1):
        # the three cells next to a corner, in the layer in front of the face
        steps = np.diag(towards)
        nearby = front + steps[across], front + steps[along], front + steps[across] + steps[along]
        a, b, c = (solid[tuple(places.T)] for places in nearby)
        openness[:, number] = _OPENNESS[np.where(a & b, 3, a.astype(np.int64) + b + c)]
    # all edges are drawn except those between the flat pieces of one wide wedge
    drawn = np.ones((len(cells), 4), np.bool_)
    piece = cells[:, 1] % pieces
    if pieces > 1 and axis != 1:  # edge 0: along low, 1: across high, 2: along high, 3: across low
        low, high = (3, 1) if across == 1 else (0, 2)
        drawn[:, low] = piece == 0
        drawn[:, high] = piece == pieces - 1
    corners, normals = face_corners(spec, cells, cells, axis, side)
    return QuadMesh(
        corners.astype(np.float32),
        normals.astype(np.float32),
        colors[tuple(cells.T)],
        openness,
        drawn,
        np.zeros(len(cells), np.bool_),
    )


def footprint(spec: GridSpec, height: float) -> Float32Array:
    """Return (Q, 4, 3) faces, facing upwards, of the ground plan of a grid at a height, metres."""
    pieces = (1, 1)
    # several along the radius too: Embree is slow with very thin faces
    if spec.coordinates == "cylindrical":
        pieces = (16, int(np.ceil((spec.upper[1] - spec.lower[1]) / _WIDEST_ARC_RAD)))
    first, second = (np.linspace(spec.lower[a], spec.upper[a], pieces[a] + 1) for a in range(2))
    corners = [
        [(first[i + di], second[j + dj], height) for di, dj in SQUARE]
        for i in range(pieces[0])
        for j in range(pieces[1])
    ]
    return spec.from_axes(np.array(corners)).astype(np.float32)


def box(lower: ArrayLike, upper: ArrayLike, color: ArrayLike, *, taper: float = 0.0) -> QuadMesh:
    """Return an axis-aligned box whose top is smaller by `taper` metres on every side."""
    low_high = np.array([lower, upper], np.float32)
    inwards = np.array([[taper, taper, 0.0], [-taper, -taper, 0.0]], np.float32)
    faces = []
    for axis, side in SIDES:
        pick = _unit_face(axis, side)[:: 2 * side - 1]  # counter-clockwise seen from outside
        faces.append(low_high[pick, np.arange(3)] + pick[:, 2:] * inwards[pick, np.arange(3)])
    return quads(np.array(faces), color, edges=True, open_sky=True)


def arrows(
    tails: AnyFloatArray, vectors: AnyFloatArray, color: ArrayLike, width: float
) -> QuadMesh:
    """Return arrows: shafts with six sides, and cones.

    Args:
        tails: (N, 3) start points, metres.
        vectors: (N, 3) from tail to tip, metres, none of length 0.
        color: RGB.
        width: width of the shaft, metres; the head is three times as wide. Short arrows are thinner
            in proportion.
    """
    lengths = np.linalg.norm(vectors, axis=1)[:, None]
    forward = vectors / lengths
    helper = np.where(np.abs(forward[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    right = np.cross(forward, helper)
    right /= np.linalg.norm(right, axis=1)[:, None]
    up = np.cross(right, forward)
    head = np.minimum(4.5 * width, 0.5 * lengths)
    neck = tails + vectors - head * forward
    tip = tails + vectors
    angles = np.arange(7) * (np.pi / 3)
    faces = []
    for one, two in pairwise(angles):
        a, b = (np.cos(angle) * right + np.sin(angle) * up for angle in (one, two))
        thin = head / 9
        thick = head / 3
        faces += [
            (tails + thin * a, tails + thin * b, neck + thin * b, neck + thin * a),
            (neck + thick * a, neck + thick * b, tip, tip),
            (neck + thin * a, neck + thin * b, neck + thick * b, neck + thick * a),
            (tails, tails, tails + thin * b, tails + thin * a),
        ]
    corners = np.array(faces).transpose(2, 0, 1, 3).reshape(-1, 4, 3)
    return quads(corners[:, ::-1], color)
