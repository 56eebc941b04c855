"""Rasterizing: the visible face of a mesh at each sample of a picture, by filling triangles into a
depth buffer.

The result equals that of a ray through each sample, at a fraction of its cost. The ray d hits the
triangle (A, B, C), relative to the camera, if d = a A + b B + c C with a, b and c of one sign, also
for triangles that reach behind the camera. Two triangles that share an edge compute the same number
for it with opposite signs, so that no sample is between them.
"""

from __future__ import annotations

import numpy as np

from carlasc.core.arrays import Float32Array, Int32Array
from carlasc.core.compiling import cached, jit
from carlasc.viewing.rendering.cameras import Camera
from carlasc.viewing.rendering.meshes import QuadMesh

_Floats = Float32Array
_NEAR_M = 1e-3  # a pinhole camera shows nothing nearer


def visible_triangles(mesh: QuadMesh, camera: Camera, width: int, height: int) -> Int32Array:
    """Return the number of the triangle that each sample shows, (height, width) int32; -1 where
    there is none.

    A sample that is exactly on the edge of two faces shows the later one.

    Args:
        mesh: its triangles are numbered as in `QuadMesh.triangles`.
        camera: from where it is seen.
        width: samples per row.
        height: rows of samples.
    """
    seen = np.full((height, width), -1, np.int32)
    nearness = np.full((height, width), -np.inf if camera.orthographic else 0.0, np.float32)
    corners = (mesh.corners.astype(np.float64) - camera.position) @ camera.axes.T
    step = camera.footprint(height)
    x = (np.arange(width) + 0.5 - width / 2) * step
    y = (height / 2 - np.arange(height) - 0.5) * step
    # seen from above, whole rows of samples are on edges of voxels: their rays begin at float32
    # numbers
    if camera.orthographic:
        x, y = (
            ((camera.position + offsets[:, None] * axis).astype(np.float32) - camera.position)
            @ axis
            for offsets, axis in ((x, camera.axes[0]), (y, camera.axes[1]))
        )
    _fill(corners, x, y, step, camera.orthographic, seen, nearness)
    return seen


@cached
def _fill(  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    corners, xs, ys, step, flat, seen, nearness
):
    """Fill the triangles of quads.

    `nearness` is 1 / depth for a pinhole camera, -depth for an orthographic one: both are linear.
    """
    height, width = seen.shape
    middle_x = width / 2 - 0.5
    middle_y = height / 2 - 0.5
    for quad in range(len(corners)):
        for half in range(2):
            first = _point(corners[quad, 0])
            second = _point(corners[quad, 1 + half])
            third = _point(corners[quad, 2 + half])
            left, right, top, bottom = _bounds((first, second, third), flat)
            first_x = max(0, int(np.floor(max(left / step + middle_x, -1.0))))
            last_x = min(width - 1, int(np.ceil(min(right / step + middle_x, width))))
            first_y = max(0, int(np.floor(max(middle_y - top / step, -1.0))))
            last_y = min(height - 1, int(np.ceil(min(middle_y - bottom / step, height))))
            if first_x > last_x or first_y > last_y:
                continue
            depths = first[2], second[2], third[2]
            if flat:
                first = (first[0], first[1], 1.0)
                second = (second[0], second[1], 1.0)
                third = (third[0], third[1], 1.0)
            ax, ay, az = _cross(second, third)
            bx, by, bz = _cross(third, first)
            cx, cy, cz = _cross(first, second)
            volume = first[0] * ax + first[1] * ay + first[2] * az
            if volume == 0:  # seen from its edge
                continue
            sign = 1.0 if volume > 0 else -1.0
            if flat:
                wa = -depths[0] / volume
                wb = -depths[1] / volume
                wc = -depths[2] / volume
            else:
                wa = wb = wc = 1 / volume
            slope = wa * ax + wb * bx + wc * cx
            for row in range(first_y, last_y + 1):
                y = ys[row]
                a = sign * (ay * y + az)
                b = sign * (by * y + bz)
                c = sign * (cy * y + cz)
                base = (wa * ay + wb * by + wc * cy) * y + (wa * az + wb * bz + wc * cz)
                for column in range(first_x, last_x + 1):
                    x = xs[column]
                    if a + sign * ax * x < 0 or b + sign * bx * x < 0 or c + sign * cx * x < 0:
                        continue
                    near = base + slope * x
                    if near >= nearness[row, column] and (not flat or near < 0):
                        nearness[row, column] = near
                        seen[row, column] = 2 * quad + half


@jit
def _point(corner):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    """Return a corner as a tuple: assigning arrays to arrays would take seconds to compile."""
    return corner[0], corner[1], corner[2]


@jit
def _bounds(points, flat):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    """Return left, right, top and bottom of the part of a triangle before the camera; left > right
    where there is none.
    """
    left = np.inf
    right = -np.inf
    top = -np.inf
    bottom = np.inf
    for corner in range(3):
        x, y, z = points[corner]
        if flat or z >= _NEAR_M:
            zoom = 1.0 if flat else 1 / z
            left = min(left, x * zoom)
            right = max(right, x * zoom)
            bottom = min(bottom, y * zoom)
            top = max(top, y * zoom)
        other_x, other_y, other_z = points[(corner + 1) % 3]
        # the edge crosses the plane in front of the camera
        if not flat and (z < _NEAR_M) != (other_z < _NEAR_M):
            share = (_NEAR_M - z) / (other_z - z)
            cut_x = (x + share * (other_x - x)) / _NEAR_M
            cut_y = (y + share * (other_y - y)) / _NEAR_M
            left = min(left, cut_x)
            right = max(right, cut_x)
            bottom = min(bottom, cut_y)
            top = max(top, cut_y)
    return left, right, top, bottom


@jit
def _cross(a, b):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def hits(corners: _Floats, triangle: Int32Array, origins: _Floats, directions: _Floats) -> _Floats:
    """Return where rays hit given triangles, (3, n): the weights u and v of the second and third
    corner, and the depth.

    The steps are those of Embree in single precision: Pluecker coordinates with fused products.
    Values that depend only on the triangle and the origin are kept for the next ray.

    Args:
        corners: (Q, 4, 3), metres.
        triangle: (n,) the triangle of each ray, or -1.
        origins: (n, 3), metres.
        directions: (n, 3).
    """
    weights = np.zeros((3, len(triangle)), np.float32)
    _write_hits(corners, triangle, origins, directions, weights)
    return weights


@cached
def _write_hits(  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    corners, triangle, origins, directions, weights
):
    one = np.float32(1)
    zero = np.float32(0)
    origin = edge_a = edge_b = edge_c = normal = (zero, zero, zero)
    height = zero
    last = -1
    for i in range(len(triangle)):
        if triangle[i] < 0:
            weights[2, i] = np.inf
            continue
        start = _point(origins[i])
        ray = _point(directions[i])
        if triangle[i] != last or start != origin:
            origin = start
            last = triangle[i]
            quad = last >> 1
            half = last & 1
            a = _minus(_point(corners[quad, 0]), origin)
            b = _minus(_point(corners[quad, 1 + half]), origin)
            c = _minus(_point(corners[quad, 2 + half]), origin)
            from_c = _minus(c, a)
            from_a = _minus(a, b)
            from_b = _minus(b, c)
            edge_b = _cross32(from_c, _plus(c, a))
            edge_c = _cross32(from_a, _plus(a, b))
            edge_a = _cross32(from_b, _plus(b, c))
            normal = _cross32(from_c, from_a)
            height = _dot(a, normal)
        beside_b = _dot(edge_b, ray)
        beside_c = _dot(edge_c, ray)
        inverse = one / (beside_b + beside_c + _dot(edge_a, ray))
        weights[0, i] = min(beside_b * inverse, one)
        weights[1, i] = min(beside_c * inverse, one)
        weights[2, i] = height * (one / _dot(normal, ray))


@jit
def _plus(a, b):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@jit
def _minus(a, b):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@jit
def _fused(a, b, c):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    """Return a b + c, rounded once."""
    return np.float32(np.float64(a) * np.float64(b) + np.float64(c))


@jit
def _dot(a, b):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    return _fused(a[0], b[0], _fused(a[1], b[1], a[2] * b[2]))


@jit
def _cross32(a, b):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    return (
        _fused(a[1], b[2], -(a[2] * b[1])),
        _fused(a[2], b[0], -(a[0] * b[2])),
        _fused(a[0], b[1], -(a[1] * b[0])),
    )
