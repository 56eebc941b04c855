"""Bird's-eye pictures: the town from 50 m above the ego vehicle, in the colours of the classes, shaded by a sun."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray

from carlasc.captures.settings import BEV_HEIGHT_M, BEV_QUALITY, BEV_SIZE
from carlasc.captures.town.drive import Snapshot
from carlasc.core.geometry import Transform, rotate_vectors
from carlasc.core.tables import CARLA
from carlasc.errors import import_extra

_SUN = np.array([0.35, -0.45, 0.82])  # direction towards the sun
_BACKGROUND = (255, 255, 255)
_REDUCTION = 2  # rays are cast for every second row and column of pixels, and the picture is enlarged


def render_birdseye(snapshot: Snapshot) -> bytes:
    """Return the picture as JPEG bytes: 1920 x 1080 pixels, 90 degrees wide. Its upper edge is ahead of the vehicle.

    Raises:
        DependencyError: a package of the extra `simulate` is missing.
    """
    pixels = _render(snapshot, snapshot.world_T_ego, (0.0, 0.0, BEV_HEIGHT_M), _downward_rays())
    image = import_extra("PIL.Image", "simulate")
    picture = image.fromarray(pixels).resize(BEV_SIZE, image.Resampling.BICUBIC)
    buffer = io.BytesIO()
    picture.save(buffer, "JPEG", quality=BEV_QUALITY)
    return buffer.getvalue()


def _render(
    snapshot: Snapshot,
    world_T_view: Transform,
    origin: tuple[float, float, float],
    directions: NDArray[np.float64],
) -> NDArray[np.uint8]:
    """Return a picture of the surfaces that rays hit.

    Args:
        snapshot: the town.
        world_T_view: (4, 4) frame of `origin` and `directions`.
        origin: (3,) start of the rays, metres.
        directions: (H, W, 3) unit vectors, one per pixel.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    height, width, _ = directions.shape
    rays = rotate_vectors(world_T_view, directions.reshape(-1, 3))
    eye = world_T_view[:3, :3] @ np.array(origin) + world_T_view[:3, 3]
    hit, triangles, _ = snapshot.scene.cast(eye, rays, 1000.0)
    normals = snapshot.scene.normals(triangles)
    normals *= -np.sign(np.einsum("ri,ri->r", normals, rays[hit]))[:, None]  # towards the camera
    light = 0.55 + 0.45 * np.clip(normals @ (_SUN / np.linalg.norm(_SUN)), 0, 1)
    pixels = np.full((height * width, 3), _BACKGROUND, np.uint8)
    pixels[hit] = CARLA.palette[snapshot.mesh.labels[triangles]] * light[:, None]
    return pixels.reshape(height, width, 3)


def _downward_rays() -> NDArray[np.float64]:
    """Return (H, W, 3) rays of a camera that looks down. Its upper edge is ahead, its right edge on the right."""
    width, height = BEV_SIZE[0] // _REDUCTION, BEV_SIZE[1] // _REDUCTION
    right = (np.arange(width) + 0.5 - width / 2) / (width / 2)
    ahead = -(np.arange(height) + 0.5 - height / 2) / (width / 2)
    rays = np.stack(np.broadcast_arrays(ahead[:, None], right[None, :], -1.0), axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)
