"""Pictures of meshes and points, with light from rays that Embree casts on the CPU: neither a
screen nor a GPU is needed.

Light comes from a sun with soft shadows and from the sky: a few rays per face measure the visible
share of the sky. Voxels have thin edges, which fade if a voxel is only a few pixels wide. Points
are small balls: nearer ones hide farther ones, and points behind others are darker.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyFloatArray, Float32Array, Uint8Array
from carlasc.core.choices import Axes
from carlasc.core.compiling import cached
from carlasc.errors import import_extra
from carlasc.viewing.rendering.cameras import Camera
from carlasc.viewing.rendering.meshes import QuadMesh
from carlasc.viewing.rendering.rasterizing import hits, visible_triangles

BACKGROUND = 255
SAMPLES = 2  # per pixel and direction
_SKY_RAYS = 12
_SKY_RANGE_M = 6.0  # only nearer faces hide the sky
_TO_SUN = np.array([-0.42, -0.62, 1.0])  # the sun is behind the vehicle, on its left
_AMBIENT = 0.6
# so that a level face in the sun has exactly its own colour
_SUN = (1 - _AMBIENT) * float(np.linalg.norm(_TO_SUN))
_EDGE_DARKNESS = 0.34
_BAND = 1 << 19  # rays cast at a time, which bounds memory
POINT_RADIUS_M = 0.07
_LEAST_RADIUS = 1.3  # samples
_MOST_RADIUS = 40.0


@dataclass(frozen=True)
class Canvas:
    """The samples of a picture and their depth; `SAMPLES` times as wide and high as the picture.

    Attributes:
        colors: (h, w, 3) uint8 RGB.
        depth: (h, w) float32 metres along the camera's axis; infinite where nothing was hit.
    """

    colors: Uint8Array
    depth: Float32Array

    def resolve(self) -> Uint8Array:
        """Return the picture, (H, W, 3) uint8: the mean of the samples of each pixel."""
        total = np.full(
            (self.depth.shape[0] // SAMPLES, self.depth.shape[1] // SAMPLES, 3), SAMPLES, np.uint16
        )
        for row in range(SAMPLES):
            for column in range(SAMPLES):
                total += self.colors[row::SAMPLES, column::SAMPLES]
        return (total // SAMPLES**2).astype(np.uint8)


def empty_canvas(width: int, height: int) -> Canvas:
    """Return an empty canvas for a picture of width x height pixels."""
    shape = (height * SAMPLES, width * SAMPLES)
    return Canvas(np.full((*shape, 3), BACKGROUND, np.uint8), np.full(shape, np.inf, np.float32))


def cast(mesh: QuadMesh, camera: Camera, canvas: Canvas, *, axes: Axes = "left") -> None:
    """Draw a mesh onto a canvas, with light and shadows.

    Args:
        mesh: the mesh.
        camera: the camera.
        canvas: the canvas; it changes where the mesh is nearer than its present content.
        axes: handedness of the data: "left" or "right"; the sun is behind the vehicle on its left
            in both cases.

    Raises:
        DependencyError: Embree is not installed.
    """
    if not len(mesh):
        return
    scene = import_extra("embreex.rtcore_scene", "render").EmbreeScene()
    geometry = import_extra("embreex.mesh_construction", "render").TriangleMesh(
        scene, *mesh.triangles()
    )
    sky = _sky_visibility(scene, mesh)
    suns = _suns(axes)
    extents = np.linalg.norm(mesh.corners[:, [1, 3]] - mesh.corners[:, [0]], axis=2)
    height, width = canvas.depth.shape
    seen = visible_triangles(mesh, camera, width, height)
    band = max(1, _BAND // width)
    for top in range(0, height, band):
        rows = slice(top, min(top + band, height))
        origins, directions = camera.rays(width, height, rows)
        triangle = seen[rows].reshape(-1)
        u, v, depth = hits(mesh.corners, triangle, origins, directions)
        # Each sample of a pixel uses another point of the sun's disc, which gives soft shadows
        # without more rays.
        columns = np.arange(width) % SAMPLES
        which = (
            columns[None, :] * SAMPLES + (np.arange(rows.start, rows.stop) % SAMPLES)[:, None]
        ).reshape(-1)
        facing = np.empty(len(triangle), np.int64)
        count = _aim_at_sun(mesh.normals, triangle, origins, directions, depth, suns, which, facing)
        shadowed = np.zeros(len(triangle), np.bool_)
        if count:
            shadowed[facing[:count]] = (
                scene.run(origins[:count], directions[:count], query="OCCLUDED") >= 0
            )
        _shade(
            extents,
            mesh.normals,
            mesh.colors,
            mesh.openness,
            mesh.edges,
            sky,
            suns,
            which,
            triangle,
            u,
            v,
            depth,
            shadowed,
            np.float32(camera.footprint(height // SAMPLES)),
            camera.orthographic,
            canvas.colors[rows].reshape(-1, 3),
            canvas.depth[rows].reshape(-1),
        )
    del geometry


def _suns(axes: Axes) -> Float32Array:
    """Return (SAMPLES^2, 3) unit vectors to points of the sun's disc, behind the vehicle on its
    left.
    """
    sun = _TO_SUN * (1.0, 1.0 if axes == "left" else -1.0, 1.0)
    spread = 0.02 * np.array(
        [(a, b) for a in np.linspace(-1, 1, SAMPLES) for b in np.linspace(-1, 1, SAMPLES)]
    )
    suns = sun + np.column_stack([spread, np.zeros(len(spread))])
    return (suns / np.linalg.norm(suns, axis=1, keepdims=True)).astype(np.float32)


def _sky_visibility(scene: Any, mesh: QuadMesh) -> Float32Array:
    """Return (Q,) visible share of the sky of each face, by rays from its middle with a cosine
    distribution about its normal.
    """
    number = np.arange(_SKY_RAYS) + 0.5
    radius = np.sqrt(number / _SKY_RAYS)
    angle = number * (np.pi * (3 - np.sqrt(5)))
    local = np.column_stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - number / _SKY_RAYS)]
    )
    helper = np.where(np.abs(mesh.normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    tangent = np.cross(helper, mesh.normals)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    frames = np.stack([tangent, np.cross(mesh.normals, tangent), mesh.normals], axis=1)
    starts = np.ascontiguousarray(mesh.corners.mean(1) + np.float32(1e-3) * mesh.normals)
    visible = np.zeros(len(mesh), np.float32)
    for ray in local:
        directions = np.ascontiguousarray(np.einsum("a,qac->qc", ray, frames), np.float32)
        distances = scene.run(starts, directions, query="DISTANCE")
        visible += np.minimum(distances / _SKY_RANGE_M, 1.0)
    return np.where(mesh.open_sky, np.float32(1), visible / _SKY_RAYS)


@cached(error_model="python")
def _aim_at_sun(  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    normals, triangle, origins, directions, depth, suns, which, facing
):
    """Replace the first rays by rays towards the sun from the points that face it, write the
    samples that they belong to, and return their number.
    """
    count = 0
    for i in range(len(triangle)):
        if triangle[i] < 0:
            continue
        q = triangle[i] >> 1
        s = which[i]
        if normals[q, 0] * suns[s, 0] + normals[q, 1] * suns[s, 1] + normals[q, 2] * suns[s, 2] > 0:
            lift = np.float32(2e-3) + np.float32(2e-5) * depth[i]
            for a in range(3):
                origins[count, a] = (
                    origins[i, a] + depth[i] * directions[i, a] + lift * normals[q, a]
                )
                directions[count, a] = suns[s, a]
            facing[count] = i
            count += 1
    return count


@cached(fastmath=True, error_model="python")
def _shade(  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    extents,
    normals,
    colors,
    openness,
    edges,
    sky,
    suns,
    which,
    triangle,
    u,
    v,
    depth,
    shadowed,
    footprint,
    flat,
    out,
    out_depth,
):
    """Compute the light of each sample that a ray hit, and write it where it is nearer than the
    content of the canvas.
    """
    for i in range(len(triangle)):
        if triangle[i] < 0 or depth[i] >= out_depth[i]:
            continue
        q = triangle[i] >> 1
        # position on the face: s from corner 0 to 1, t from corner 0 to 3
        if triangle[i] & 1 == 0:
            s = u[i] + v[i]
            t = v[i]
        else:
            s = u[i]
            t = u[i] + v[i]
        sun = which[i]
        low = openness[q, 0] * (1 - s) + openness[q, 1] * s
        high = openness[q, 3] * (1 - s) + openness[q, 2] * s
        ambient = sky[q] * (low * (1 - t) + high * t) * (0.86 + 0.14 * normals[q, 2])
        direct = np.float32(0.0)
        if not shadowed[i]:
            facing = (
                normals[q, 0] * suns[sun, 0]
                + normals[q, 1] * suns[sun, 1]
                + normals[q, 2] * suns[sun, 2]
            )
            direct = max(np.float32(0.0), facing)
        light = _AMBIENT * (0.3 + 0.7 * ambient) + _SUN * direct

        pixel = footprint if flat else footprint * depth[i]
        line = np.float32(0.0)
        for e in range(4):
            if not edges[q, e]:
                continue
            if e % 2 == 0:
                other = extents[q, 1]
                distance = (t if e == 0 else 1 - t) * other
            else:
                other = extents[q, 0]
                distance = (s if e == 3 else 1 - s) * other
            wide = other / pixel  # width of the voxel in pixels
            strength = min(np.float32(1.0), max(np.float32(0.0), (wide - 2.5) / 7.5))
            reach = max(0.55 * pixel, 0.022 * other)
            line = max(
                line, strength * min(np.float32(1.0), max(np.float32(0.0), 1.5 - distance / reach))
            )
        light *= 1 - _EDGE_DARKNESS * line
        for c in range(3):
            out[i, c] = np.uint8(min(np.float32(255.0), colors[q, c] * light + np.float32(0.5)))
        out_depth[i] = depth[i]


def splat(
    points: AnyFloatArray,
    colors: Uint8Array,
    camera: Camera,
    canvas: Canvas,
) -> None:
    """Draw points onto a canvas as shaded balls.

    Args:
        points: (N, 3) metres.
        colors: (N, 3) uint8 RGB.
        camera: the camera.
        canvas: the canvas; its content hides points that are farther.
    """
    height, width = canvas.depth.shape
    columns, rows, depths = camera.project(points, width, height)
    pixel = camera.footprint(height) * (
        np.ones_like(depths) if camera.orthographic else np.maximum(depths, 1e-6)
    )
    radii = np.clip(POINT_RADIUS_M / pixel, _LEAST_RADIUS, _MOST_RADIUS)
    seen = (
        (depths > 0.1)
        & (np.abs(columns - width / 2) < width)
        & (np.abs(rows - height / 2) < height)
    )
    drawn = np.zeros((height, width), np.bool_)
    where = columns[seen], rows[seen], depths[seen].astype(np.float32), radii[seen]
    balls = np.ascontiguousarray(colors[seen])
    _draw_balls(*where, balls, canvas.colors, canvas.depth, drawn)
    _darken_behind(canvas.colors, canvas.depth, drawn)


@cached(error_model="python")
def _draw_balls(  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    columns, rows, depths, radii, colors, out, out_depth, drawn
):
    height, width = out_depth.shape
    for i in range(len(columns)):
        radius = radii[i]
        for y in range(max(0, int(rows[i] - radius)), min(height, int(rows[i] + radius) + 1)):
            for x in range(
                max(0, int(columns[i] - radius)), min(width, int(columns[i] + radius) + 1)
            ):
                dx = x + 0.5 - columns[i]
                dy = y + 0.5 - rows[i]
                rim = (dx * dx + dy * dy) / (radius * radius)
                if rim > 1 or depths[i] >= out_depth[y, x]:
                    continue
                light = 0.78 + 0.22 * np.sqrt(1 - rim)
                for c in range(3):
                    out[y, x, c] = np.uint8(colors[i, c] * light)
                out_depth[y, x] = depths[i]
                drawn[y, x] = True


@cached(error_model="python")
def _darken_behind(  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    out, depth, drawn
):
    """Eye-dome lighting: the farther a point is behind its neighbours in the picture, the darker it
    is.
    """
    height, width = depth.shape
    reach = 3
    for y in range(reach, height - reach):
        for x in range(reach, width - reach):
            if not drawn[y, x]:
                continue
            behind = np.float32(0.0)
            for dy in (-reach, 0, reach):
                for dx in (-reach, 0, reach):
                    behind += min(
                        np.float32(1.5),
                        max(
                            np.float32(0.0), depth[y, x] - depth[y + dy, x + dx] - np.float32(0.15)
                        ),
                    )
            light = np.exp(-0.12 * behind)
            for c in range(3):
                out[y, x, c] = np.uint8(out[y, x, c] * light)
