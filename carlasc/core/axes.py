"""Conversion between right-handed axes (y to the left) and the left-handed axes of CarlaSC (y to
the right), and all permutations of axes.

The conversion changes the sign of y. It is its own inverse, so each function works in both
directions.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from carlasc.core.arrays import AnyArray, Float32Array, FloatArray
from carlasc.core.boxes import Boxes
from carlasc.core.grids import Grid, GridSpec
from carlasc.core.scans import Scan

_Scalar = TypeVar("_Scalar", bound=np.generic)

_SIGNS = np.array([1, -1, 1, 1], np.float32)
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def choices_of_axes() -> Iterator[tuple[str, FloatArray]]:
    """Yield the 48 signed permutations of axes, the identity first: the new axes in terms of the
    old ones, such as "-y, x, z", and the (3, 3) matrix.
    """
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            yield (
                ", ".join(
                    f"{'-' if s < 0 else ''}{'xyz'[axis]}"
                    for s, axis in zip(signs, order, strict=True)
                ),
                matrix,
            )


def mirror_points(points: Float32Array) -> Float32Array:
    """Mirror (N, 3) or (N, 4) points or vectors. A fourth column is unchanged."""
    return points * _SIGNS[: points.shape[1]]


def mirror_poses(poses: FloatArray) -> FloatArray:
    """Mirror (..., 4, 4) poses, in both the source and the destination frame."""
    return _MIRROR @ poses @ _MIRROR


def mirror_boxes(boxes: Boxes) -> Boxes:
    """Mirror boxes.

    The frame of each box is mirrored too, so that x is still along its length and the rotation is
    proper.
    """
    return Boxes.from_poses(
        boxes.tracks, boxes.labels, mirror_poses(boxes.sensor_T_box), boxes.sizes, boxes.annotated
    )


def mirror_grid(grid: NDArray[_Scalar]) -> NDArray[_Scalar]:
    """Mirror an (X, Y, Z) grid along its second axis: y (Cartesian) or azimuth (cylindrical)."""
    mirrored: AnyArray = grid[:, ::-1]
    return mirrored


def mirror_spec(spec: GridSpec) -> GridSpec:
    """Return the geometry of a mirrored grid: the bounds of y, or of the azimuth, are swapped and
    negated.
    """
    (x0, y0, z0), (x1, y1, z1) = spec.lower, spec.upper
    return GridSpec(spec.coordinates, spec.size, (x0, -y1, z0), (x1, -y0, z1))


def mirror_voxels(grid: Grid) -> Grid:
    """Mirror a grid with its geometry."""
    counts = None if grid.counts is None else mirror_grid(grid.counts)
    return Grid(mirror_spec(grid.spec), mirror_grid(grid.labels), counts)


def mirror_scan(scan: Scan) -> Scan:
    """Mirror a scan: points, flow, ray origins and boxes."""
    return replace(
        scan,
        points=mirror_points(scan.points),
        flow=None if scan.flow is None else mirror_points(scan.flow),
        others={
            name: mirror_points(v) if name == "origins" else v for name, v in scan.others.items()
        },
        boxes=None if scan.boxes is None else mirror_boxes(scan.boxes),
    )
