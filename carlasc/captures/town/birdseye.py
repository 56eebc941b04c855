"""The bird's-eye picture: the town from 50 m above the ego vehicle, in the classes' colours, lit by a sun."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray

from carlasc.captures.town.drive import Snapshot
from carlasc.core.geometry import Transform, rotate_vectors
from carlasc.core.tables import CARLA
from carlasc.errors import import_extra

SIZE = (1920, 1080)  # width and height, as published
HEIGHT_M = 50.0
SUN = np.array([0.35, -0.45, 0.82])
SKY = (255, 255, 255)
_REDUCTION = 2  # rays are shot for every other pixel a row and a column; the picture is enlarged
_QUALITY = 88


def render_birdseye(snapshot: Snapshot) -> bytes:
    """Return the picture as JPEG: 1920 x 1080, forward is up, right is right, 90 degrees wide."""
    pixels = render_view(snapshot, snapshot.world_T_ego, (0.0, 0.0, HEIGHT_M), _downwards())
    image = import_extra("PIL.Image", "simulate")
    picture = image.fromarray(pixels).resize(SIZE, image.Resampling.BICUBIC)
    buffer = io.BytesIO()
    picture.save(buffer, "JPEG", quality=_QUALITY)
    return buffer.getvalue()


def render_view(
    snapshot: Snapshot,
    world_T_view: Transform,
    origin: tuple[float, float, float],
    directions: NDArray[np.float64],
) -> NDArray[np.uint8]:
    """Return a picture of what rays meet.

    Args:
        snapshot: the town.
        world_T_view: (4, 4) frame of the next two.
        origin: (3,) metres, where the rays start.
        directions: (H, W, 3) unit vectors.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    height, width, _ = directions.shape
    rays = rotate_vectors(world_T_view, directions.reshape(-1, 3))
    eye = world_T_view[:3, :3] @ np.array(origin) + world_T_view[:3, 3]
    hit, triangles, _ = snapshot.scene.cast(eye, rays, 1000.0)
    normals = snapshot.scene.normals(triangles)
    normals *= -np.sign(np.einsum("ri,ri->r", normals, rays[hit]))[:, None]  # the side that is seen
    light = 0.55 + 0.45 * np.clip(normals @ (SUN / np.linalg.norm(SUN)), 0, 1)
    pixels = np.full((height * width, 3), SKY, np.uint8)
    pixels[hit] = CARLA.palette[snapshot.mesh.labels[triangles]] * light[:, None]
    return pixels.reshape(height, width, 3)


def _downwards() -> NDArray[np.float64]:
    """(H, W, 3) rays of a camera that looks down, its upper edge ahead and its right edge to the right."""
    width, height = SIZE[0] // _REDUCTION, SIZE[1] // _REDUCTION
    right = (np.arange(width) + 0.5 - width / 2) / (width / 2)
    ahead = -(np.arange(height) + 0.5 - height / 2) / (width / 2)
    rays = np.stack(np.broadcast_arrays(ahead[:, None], right[None, :], -1.0), axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)
