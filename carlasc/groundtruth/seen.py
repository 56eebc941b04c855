"""Which voxels of a grid each camera sees: the field `seen`, one bit per camera.

A camera sees a voxel if no occupied voxel stops the ray from the centre of the camera to the centre
of the voxel. This is the rule of Occ3D, with one deviation: where the points in a voxel are known,
only the box around them stops rays (`carlasc.groundtruth.voting.filled`), because a pole or a kerb
fills a small part of its voxels. An occupied voxel is also seen if a ray reaches the middle of its
box. Unknown voxels stop no ray.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from carlasc.core.arrays import AnyFloatArray, BoolArray, FloatArray, IntArray, Uint8Array
from carlasc.core.cameras import CameraModel
from carlasc.core.compiling import cached, jit
from carlasc.core.geometry import Transform, invert, transform_points
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError
from carlasc.groundtruth.voting.filled import STEPS

MOST_CAMERAS = 8
"""The greatest number of cameras: one per bit of a voxel."""

Views = Sequence[tuple[CameraModel, Transform | None]]
"""Cameras, and (4, 4) scan_T_camera of each when it took its image; None without an image."""

_BESIDE = 1.5  # voxels within this distance of a point, along the longest axis, do not hide it
_BEYOND_M = 0.02  # margin of boxes. Chosen on simulated drives: see docs/howto/cameras.md


class _Solid(NamedTuple):
    """The obstacles for rays in a grid, in units of voxels.

    Attributes:
        size: (3,) numbers of voxels.
        occupied: (V,) bool, voxels that stop rays.
        boxes: (V, 6) uint8, the part of each voxel that stops rays, in 1/256 from first to last;
            (0, 6): whole voxels.
        beyond: (3,) margin of the boxes.
    """

    size: IntArray
    occupied: BoolArray
    boxes: Uint8Array
    beyond: FloatArray

    @classmethod
    def of(cls, occupied: BoolArray, spec: GridSpec, boxes: Uint8Array | None = None) -> _Solid:
        """Return the obstacles of a grid: its occupied voxels, or the boxes around their points
        where these are known.
        """
        blocks = np.ascontiguousarray(occupied, np.bool_).reshape(-1)
        filled = np.empty((0, 6), np.uint8) if boxes is None else boxes
        return cls(
            np.array(spec.size), blocks, filled, _BEYOND_M / np.array(spec.voxel_size, np.float64)
        )


def check_views(spec: GridSpec, views: Views, where: str) -> None:
    """Check that `see_voxels` can be used with a grid and cameras.

    Raises:
        ArgumentError: the grid is not Cartesian, or there are no cameras, or more than eight.
    """
    if spec.coordinates != "cartesian":
        raise ArgumentError(
            "keep_seen", expected="a Cartesian grid", found=f"a {spec.coordinates} one"
        )
    if not 0 < len(views) <= MOST_CAMERAS:
        raise ArgumentError(
            "keep_seen",
            expected=f"1 to {MOST_CAMERAS} cameras",
            found=f"{len(views)} in {where}",
            advice=""
            if views
            else "convert or simulate with cameras: `carlasc simulate --cameras front`",
        )


def see_voxels(
    occupied: BoolArray,
    spec: GridSpec,
    views: Views,
    boxes: Uint8Array | None = None,
) -> Uint8Array:
    """Return the cameras that see each voxel.

    Args:
        occupied: (X, Y, Z) voxels that stop rays.
        spec: the grid, which is Cartesian.
        views: at most eight cameras, with their poses.
        boxes: (V, 6) the boxes around the points in each voxel; None: voxels stop rays as a whole,
            as in Occ3D.

    Returns:
        (X, Y, Z) uint8: bit i is set where camera i sees the voxel. Its centre is in the image.
    """
    seen = np.zeros(spec.num_voxels, np.uint8)
    solid = _Solid.of(occupied, spec, boxes)
    centers = spec.centers().reshape(-1, 3)
    lower = np.array(spec.lower, np.float64)
    edge = np.array(spec.voxel_size, np.float64)
    for bit, (camera, place) in enumerate(views):
        if place is None:
            continue
        camera_T_scan = invert(place)
        depth = centers @ camera_T_scan[2, :3] + camera_T_scan[2, 3]
        ahead = np.flatnonzero(depth > (-np.inf if camera.model == "fisheye" else 0))
        pixels = camera.project(transform_points(camera_T_scan, centers[ahead]))
        voxels = ahead[camera.contains(pixels)]
        _mark_seen(voxels, (place[:3, 3] - lower) / edge, solid, np.uint8(1 << bit), seen)
    return seen.reshape(spec.size)


@cached
def _mark_seen(voxels, eye, solid, bit, seen):  # type: ignore[no-untyped-def]
    """Set a bit of the voxels that rays from an eye reach. Everything is in units of voxels."""
    size = solid.size
    boxes = solid.boxes
    middle = np.empty(3)
    for voxel in voxels:
        cell = voxel // (size[2] * size[1]), (voxel // size[2]) % size[1], voxel % size[2]
        reached = _reaches((cell[0] + 0.5, cell[1] + 0.5, cell[2] + 0.5), eye, cell, solid)
        if (
            not reached
            and solid.occupied[voxel]
            and len(boxes)
            and boxes[voxel, 0] <= boxes[voxel, 3]
        ):
            for axis in range(3):
                middle[axis] = cell[axis] + (1.0 + boxes[voxel, axis] + boxes[voxel, 3 + axis]) / (
                    2 * STEPS
                )
            reached = _reaches((middle[0], middle[1], middle[2]), eye, cell, solid)
        if reached:
            seen[voxel] |= bit


def see_points(
    points: AnyFloatArray,
    occupied: BoolArray,
    spec: GridSpec,
    eye: FloatArray,
) -> BoolArray:
    """Return (N,) bool: which points are visible from an eye, because no voxel of a grid hides
    them. Space outside of the grid hides nothing.

    The voxel of a point and its neighbours do not hide it: they hold the surface of the point. Rays
    meet the ground at a grazing angle, and its own voxels would hide it. A second ray therefore
    starts one voxel above the point.

    Args:
        points: (N, 3) metres, in the frame of the grid.
        occupied: (X, Y, Z) voxels that stop rays.
        spec: the grid, which is Cartesian.
        eye: (3,) position of the eye, metres, in the frame of the grid.
    """
    lower = np.array(spec.lower, np.float64)
    edge = np.array(spec.voxel_size, np.float64)
    reached = np.empty(len(points), np.bool_)
    cells = (np.asarray(points, np.float64) - lower) / edge
    _reach_points(cells, (eye - lower) / edge, _Solid.of(occupied, spec), reached)
    return reached


@cached
def _reach_points(points, eye, solid, reached):  # type: ignore[no-untyped-def]
    """Find which points rays from an eye reach. Everything is in units of voxels."""
    size = solid.size
    for n in range(len(points)):
        reached[n] = False
        for raised in range(2):
            at_x = points[n, 0]
            at_y = points[n, 1]
            at_z = points[n, 2] + raised
            ray_x = eye[0] - at_x
            ray_y = eye[1] - at_y
            ray_z = eye[2] - at_z
            far = max(abs(ray_x), abs(ray_y), abs(ray_z))
            # from this share of the ray on, voxels hide the point
            first = 1.0 if far <= _BESIDE else _BESIDE / far
            for at, ray, last in (
                (at_x, ray_x, size[0]),
                (at_y, ray_y, size[1]),
                (at_z, ray_z, size[2]),
            ):
                if at < 0 or at >= last:  # where the ray enters the grid
                    edge = 1e-9 if at < 0 else last - 1e-9
                    share = (edge - at) / ray if ray != 0 else 2.0
                    first = max(first, share if share > 0 else 2.0)
            at_x = at_x + first * ray_x
            at_y = at_y + first * ray_y
            at_z = at_z + first * ray_z
            x = int(np.floor(at_x))
            y = int(np.floor(at_y))
            z = int(np.floor(at_z))
            is_outside = _is_outside(x, y, z, size)
            if first >= 1.0 or is_outside or _reaches((at_x, at_y, at_z), eye, (x, y, z), solid):
                reached[n] = True
                break


@jit
def _reaches(at, eye, cell, solid):  # type: ignore[no-untyped-def]
    """Return whether no obstacle lies between a position in a voxel and the eye."""
    size = solid.size
    x, y, z = cell
    ray = eye[0] - at[0], eye[1] - at[1], eye[2] - at[2]
    step_x, each_x, next_x = _steps(at[0], ray[0], x)
    step_y, each_y, next_y = _steps(at[1], ray[1], y)
    step_z, each_z, next_z = _steps(at[2], ray[2], z)
    while min(next_x, next_y, next_z) < 1.0:
        if next_x <= next_y and next_x <= next_z:
            x += step_x
            next_x += each_x
        elif next_y <= next_z:
            y += step_y
            next_y += each_y
        else:
            z += step_z
            next_z += each_z
        if _is_outside(x, y, z, size):
            return True
        voxel = (x * size[1] + y) * size[2] + z
        if not solid.occupied[voxel] or min(next_x, next_y, next_z) >= 1.0:
            continue  # the voxel of the eye itself stops no ray
        if _is_stopped(at, ray, (x, y, z), voxel, solid):
            return False
    return True


@jit
def _steps(at, ray, cell):  # type: ignore[no-untyped-def]
    """Return how a ray steps from voxel to voxel along an axis: in which direction, how much of the
    ray each step takes, and how much lies before the first one.
    """
    if ray == 0:
        return 1, np.inf, np.inf
    return (1 if ray > 0 else -1), abs(1.0 / ray), (cell + (ray > 0) - at) / ray


@jit
def _is_outside(x, y, z, size):  # type: ignore[no-untyped-def]
    """Return whether a cell is not in the grid."""
    return x < 0 or y < 0 or z < 0 or x >= size[0] or y >= size[1] or z >= size[2]


@jit
def _is_stopped(at, ray, cell, voxel, solid):  # type: ignore[no-untyped-def]
    """Return whether an occupied voxel, or the box around its points if they are known, stops a ray
    through the voxel.
    """
    boxes = solid.boxes
    first = 0.0
    last = 1.0
    if not len(boxes) or boxes[voxel, 0] > boxes[voxel, 3]:
        return True
    for axis in range(3):
        low = cell[axis] + boxes[voxel, axis] / STEPS - solid.beyond[axis] - at[axis]
        high = cell[axis] + (1.0 + boxes[voxel, 3 + axis]) / STEPS + solid.beyond[axis] - at[axis]
        enter = low / ray[axis]
        leave = high / ray[axis]
        first = max(first, min(enter, leave))
        last = min(last, max(enter, leave))
    return first < last
