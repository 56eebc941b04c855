"""Which voxels of a grid each camera sees: the field `seen`, one bit per camera.

A voxel is seen if a ray from the camera's centre reaches it before another occupied voxel stops it, as in Occ3D, whose masks are made from rays to
the centres of voxels. Here, an occupied voxel whose centre is hidden is tried at its faces and corners too: rays reach the ground at so
flat an angle that those to the centres of its voxels pass through voxels of the ground before. Unknown voxels stop nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from carlasc.core.cameras import CameraModel
from carlasc.core.compiling import cached, jit
from carlasc.core.geometry import Transform, invert, transform_points
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError

MOST_CAMERAS = 8
"""The number of cameras that the bits of a voxel have room for."""

Views = Sequence[tuple[CameraModel, Transform | None]]
"""Cameras, and (4, 4) scan_T_camera of each when it took its image; None where it took none."""

_BESIDE = 1.5  # voxels along the longest axis, from a point, that do not hide it
_HALF = 0.499  # of a voxel: from its centre to where it is tried, just inside of its faces and corners


def check_views(spec: GridSpec, views: Views, where: str) -> None:
    """Check that it can be said which voxels some cameras see.

    Raises:
        ArgumentError: the grid is not Cartesian, or there are no cameras, or more than eight.
    """
    if spec.coordinates != "cartesian":
        raise ArgumentError("keep_seen", expected="a Cartesian grid", found=f"a {spec.coordinates} one")
    if not 0 < len(views) <= MOST_CAMERAS:
        raise ArgumentError(
            "keep_seen",
            expected=f"1 to {MOST_CAMERAS} cameras",
            found=f"{len(views)} in {where}",
            advice="" if views else "convert or simulate with cameras: `carlasc simulate --cameras front`",
        )


def see_voxels(occupied: NDArray[np.bool_], spec: GridSpec, views: Views) -> NDArray[np.uint8]:
    """Return which cameras see each voxel.

    Args:
        occupied: (X, Y, Z) voxels that stop rays.
        spec: the grid, which is Cartesian.
        views: at most eight cameras, and where they are.

    Returns:
        (X, Y, Z) uint8: bit i is set where camera i sees the voxel. Its centre is in the image.
    """
    seen = np.zeros(spec.num_voxels, np.uint8)
    blocks = np.ascontiguousarray(occupied, np.bool_).reshape(-1)
    centers = spec.centers().reshape(-1, 3)
    lower, edge, size = np.array(spec.lower, np.float64), np.array(spec.voxel_size, np.float64), np.array(spec.size)
    for bit, (camera, place) in enumerate(views):
        if place is None:
            continue
        camera_T_scan = invert(place)
        ahead = np.flatnonzero(_in_front(centers, camera_T_scan, camera.model == "fisheye"))
        pixels = camera.project(transform_points(camera_T_scan, centers[ahead]))
        voxels = ahead[camera.contains(pixels)]
        eye = (place[:3, 3] - lower) / edge
        _mark_seen(voxels, blocks, eye, size, np.uint8(1 << bit), seen)
    return seen.reshape(spec.size)


def _in_front(centers: NDArray[np.float64], camera_T_scan: Transform, is_wide: bool) -> NDArray[np.bool_]:
    depth = centers @ camera_T_scan[2, :3] + camera_T_scan[2, 3]
    return np.asarray(depth > (-np.inf if is_wide else 0))


@cached
def _mark_seen(voxels, blocks, eye, size, bit, seen):  # type: ignore[no-untyped-def]
    """Set a bit of the voxels that rays from an eye reach. Everything is in units of voxels."""
    for n in range(len(voxels)):
        flat = voxels[n]
        z = flat % size[2]
        y = (flat // size[2]) % size[1]
        x = flat // (size[2] * size[1])
        near_x = _HALF if eye[0] > x + 0.5 else -_HALF
        near_y = _HALF if eye[1] > y + 0.5 else -_HALF
        near_z = _HALF if eye[2] > z + 0.5 else -_HALF
        reached = _reaches(x + 0.5, y + 0.5, z + 0.5, eye, x, y, z, size, blocks)
        if not blocks[flat]:
            if reached:
                seen[flat] |= bit
            continue
        reached = reached or _reaches(x + 0.5, y + 0.5, z + 0.5 + near_z, eye, x, y, z, size, blocks)
        reached = reached or _reaches(x + 0.5 + near_x, y + 0.5, z + 0.5, eye, x, y, z, size, blocks)
        reached = reached or _reaches(x + 0.5, y + 0.5 + near_y, z + 0.5, eye, x, y, z, size, blocks)
        k = 0
        while not reached and k < 8:
            at_x = x + 0.5 + (_HALF if k & 1 else -_HALF)
            at_y = y + 0.5 + (_HALF if k & 2 else -_HALF)
            at_z = z + 0.5 + (_HALF if k & 4 else -_HALF)
            reached = _reaches(at_x, at_y, at_z, eye, x, y, z, size, blocks)
            k += 1
        if reached:
            seen[flat] |= bit


def see_points(
    points: NDArray[np.floating], occupied: NDArray[np.bool_], spec: GridSpec, eye: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return (N,) which points no voxel of a grid hides from a place. What is outside of the grid hides nothing.

    The voxel that a point is in, and its neighbours, hide it as little as the surface that it lies on does. Ground is reached at so flat an
    angle that its own voxels would hide it, so a ray from above the point, by the height of a voxel, is tried too.

    Args:
        points: (N, 3) metres, in the frame of the grid.
        occupied: (X, Y, Z) voxels that stop rays.
        spec: the grid, which is Cartesian.
        eye: (3,) metres, the place.
    """
    lower, edge, size = np.array(spec.lower, np.float64), np.array(spec.voxel_size, np.float64), np.array(spec.size)
    blocks = np.ascontiguousarray(occupied, np.bool_).reshape(-1)
    reached = np.empty(len(points), np.bool_)
    _reach_points((np.asarray(points, np.float64) - lower) / edge, blocks, (eye - lower) / edge, size, reached)
    return reached


@cached
def _reach_points(points, blocks, eye, size, reached):  # type: ignore[no-untyped-def]
    """Find which points rays from an eye reach. Everything is in units of voxels."""
    for n in range(len(points)):
        reached[n] = False
        for raised in range(2):
            at_x, at_y, at_z = points[n, 0], points[n, 1], points[n, 2] + raised
            way_x, way_y, way_z = eye[0] - at_x, eye[1] - at_y, eye[2] - at_z
            far = max(abs(way_x), abs(way_y), abs(way_z))
            first = 1.0 if far <= _BESIDE else _BESIDE / far  # share of the way after which voxels hide the point
            for at, way, last in ((at_x, way_x, size[0]), (at_y, way_y, size[1]), (at_z, way_z, size[2])):
                if at < 0 or at >= last:  # where the way comes into the grid
                    edge = 1e-9 if at < 0 else last - 1e-9
                    share = (edge - at) / way if way != 0 else 2.0
                    first = max(first, share if share > 0 else 2.0)
            if first >= 1.0:
                reached[n] = True
                break
            at_x, at_y, at_z = at_x + first * way_x, at_y + first * way_y, at_z + first * way_z
            x, y, z = int(np.floor(at_x)), int(np.floor(at_y)), int(np.floor(at_z))
            if x < 0 or y < 0 or z < 0 or x >= size[0] or y >= size[1] or z >= size[2]:
                reached[n] = True
                break
            if _reaches(at_x, at_y, at_z, eye, x, y, z, size, blocks):
                reached[n] = True
                break


@jit
def _reaches(at_x, at_y, at_z, eye, x, y, z, size, blocks):  # type: ignore[no-untyped-def]
    """Return whether nothing occupied lies between a place in a voxel and the eye."""
    way_x, way_y, way_z = eye[0] - at_x, eye[1] - at_y, eye[2] - at_z
    step_x, step_y, step_z = (1 if way_x > 0 else -1), (1 if way_y > 0 else -1), (1 if way_z > 0 else -1)
    each_x = abs(1.0 / way_x) if way_x != 0 else np.inf
    each_y = abs(1.0 / way_y) if way_y != 0 else np.inf
    each_z = abs(1.0 / way_z) if way_z != 0 else np.inf
    next_x = ((x + (1 if way_x > 0 else 0)) - at_x) / way_x if way_x != 0 else np.inf
    next_y = ((y + (1 if way_y > 0 else 0)) - at_y) / way_y if way_y != 0 else np.inf
    next_z = ((z + (1 if way_z > 0 else 0)) - at_z) / way_z if way_z != 0 else np.inf
    while True:
        if next_x <= next_y and next_x <= next_z:
            if next_x >= 1.0:
                return True
            x += step_x
            next_x += each_x
            if x < 0 or x >= size[0]:
                return True
        elif next_y <= next_z:
            if next_y >= 1.0:
                return True
            y += step_y
            next_y += each_y
            if y < 0 or y >= size[1]:
                return True
        else:
            if next_z >= 1.0:
                return True
            z += step_z
            next_z += each_z
            if z < 0 or z >= size[2]:
                return True
        if blocks[(x * size[1] + y) * size[2] + z]:
            return next_x >= 1.0 and next_y >= 1.0 and next_z >= 1.0  # what the eye itself is in stops nothing
