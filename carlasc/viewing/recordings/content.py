"""The contents of a recording frame by frame, for all formats: right-handed, thinned, with the
track of each actor.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from carlasc.core.arrays import (
    BoolArray,
    Float32Array,
    FloatArray,
    IntArray,
    LabelArray,
    Uint32Array,
)
from carlasc.core.grids import Grid, GridSpec
from carlasc.core.scans import Scan
from carlasc.storage.layout import FRAME_PERIOD_S
from carlasc.viewing.actor_lines import Trail, Trails, motion_arrows
from carlasc.viewing.photos import Photo
from carlasc.viewing.rendering.meshes import (
    SIDES,
    exposed_cells,
    face_corners,
    quad_triangles,
    split_arcs,
    surrounded,
)
from carlasc.viewing.scene import FrameContent, SceneReader

MAX_POINTS = 30_000
"""Default number of points per frame, so that a frame is smaller than half a megabyte."""

# 2**32 over the golden ratio: multiples of it, modulo 2**32, are spread evenly, however many are
# taken
_GOLDEN = 2654435769


class Triangles(NamedTuple):
    """A surface.

    Attributes:
        corners: (V, 3) float32 metres, four for each flat face, in order around it.
        normals: (V, 3) float32 unit vectors, outward.
        indices: (T, 3) uint32 rows of `corners`, counter-clockwise seen from outside.
    """

    corners: Float32Array
    normals: Float32Array
    indices: Uint32Array


def class_surfaces(grid: Grid) -> Iterator[tuple[int, Triangles]]:
    """Yield each class of a cylindrical grid with the surface of its voxels, without the faces that
    two voxels share.

    The lowest faces of the lowest cells are left out, because they are visible only from below the
    ground.
    """
    spec, labels = split_arcs(grid.spec, grid.labels)
    parts = [_faces(spec, labels, axis, side) for axis, side in SIDES]
    corners, normals, owners = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    for label in np.unique(owners).tolist():
        chosen = owners == label
        indices = quad_triangles(int(np.count_nonzero(chosen))).astype(np.uint32)
        points = corners[chosen].reshape(-1, 3)
        yield label, Triangles(points, np.repeat(normals[chosen], 4, axis=0), indices)


def _faces(
    spec: GridSpec, labels: LabelArray, axis: int, side: int
) -> tuple[Float32Array, Float32Array, LabelArray]:
    """Return the (Q, 4, 3) corners, counter-clockwise seen from outside, the (Q, 3) normals and the
    (Q,) classes of the exposed faces towards one side of one axis. Neighbours become one face.
    """
    shown = np.where(exposed_cells(spec, surrounded(spec, labels > 0), axis, side, True), labels, 0)
    along = 2 if axis == 0 else 0  # the edges of cells are straight along the radius and along z
    lines = np.moveaxis(shown, along, 2)  # a view: runs are along the last axis
    free = np.zeros((*lines.shape[:2], 1), lines.dtype)
    steps = np.diff(lines, axis=2, prepend=free, append=free) != 0

    def cells_of(mask: BoolArray) -> IntArray:
        """Return the cells of a mask, line after line."""
        moved = np.argwhere(mask)
        return np.insert(moved[:, :2], along, moved[:, 2], axis=1)

    first, last = (cells_of((lines > 0) & ends) for ends in (steps[..., :-1], steps[..., 1:]))
    corners, normals = face_corners(spec, first, last, axis, side)
    corners = corners if side else corners[:, ::-1]
    return corners.astype(np.float32), normals.astype(np.float32), labels[tuple(first.T)]


@dataclass(frozen=True, kw_only=True)
class RecordedFrame(FrameContent):
    """One frame, in right-handed axes: x forward, y to the left, z up; in the frame of the sensor,
    unless noted.

    Attributes:
        number: frame number.
        time_s: seconds since the first frame; 0.1 s per frame if the sequence has no times.
        scan: the thinned points; None if the frame has no points.
        tails: (M, 3) start points of the arrows that show how actors move, metres.
        vectors: (M, 3) vectors of the arrows, metres per second.
        trails: the tracks of the actors up to this frame, in the world, the frame of the first
            scan.
        picture: the bird's-eye camera picture as its JPEG bytes, or None.
        photos: the images of the cameras.
    """

    number: int
    time_s: float
    tails: FloatArray
    vectors: FloatArray
    trails: tuple[Trail, ...]
    picture: bytes | None
    photos: tuple[Photo, ...] = ()


class RecordingWriter(Protocol):
    """Writes the frames of a scene to a file one by one, without keeping them in memory."""

    def write(self, frame: RecordedFrame) -> None:
        """Append a frame."""

    def close(self) -> None:
        """Finish the file.

        Raises:
            OSError: it could not be written.
        """


def record_frames(reader: SceneReader, max_points: int | None) -> Iterator[RecordedFrame]:
    """Read the frames of a right-handed scene.

    Args:
        reader: the scene.
        max_points: points that are kept of each frame; None keeps all.
    """
    trails = Trails()
    for position, number in enumerate(reader.frames):
        content = reader.read(number)
        fields = dict[str, Any]()
        scan = content.scan
        moving = reader.read_motion(number, scan)
        if content.time_s is None:
            fields["time_s"] = number * FRAME_PERIOD_S
        if scan is not None and max_points is not None:
            fields["scan"] = thin_scan(scan, max_points)
        tails, vectors = motion_arrows(
            Scan(np.empty((0, 3), np.float32)) if moving is None else moving
        )
        yield RecordedFrame(
            **vars(content) | fields,
            number=number,
            tails=tails,
            vectors=vectors,
            trails=trails.follow(position, content, moving),
            picture=reader.read_picture(number),
            photos=reader.read_photos(number),
        )


def thin_scan(scan: Scan, most: int) -> Scan:
    """Return at most `most` points of a scan, spread evenly over their order in the file: the same
    ones in each call.
    """
    if len(scan) <= most:
        return scan
    order = np.arange(len(scan), dtype=np.uint64) * np.uint64(_GOLDEN) % np.uint64(2**32)
    return scan.select(np.sort(np.argpartition(order, most)[:most]))


def class_cells(grid: Grid) -> Iterator[tuple[int, IntArray]]:
    """Yield each class of a grid with the (K, 3) indices of its voxels."""
    cells = np.argwhere(grid.labels)
    labels = grid.labels[tuple(cells.T)]
    for label in np.unique(labels).tolist():
        yield label, cells[labels == label]
