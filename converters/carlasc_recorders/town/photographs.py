"""Images of cameras on the roof of the ego vehicle: colour, class, depth and instance of every
pixel, at one time.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from types import MappingProxyType

import numpy as np

from carlasc.core.arrays import AnyIntArray, FloatArray, LabelArray, Uint8Array
from carlasc.core.cameras import CameraModel, optical_axes
from carlasc.core.geometry import Transform
from carlasc.core.tables import CARLA
from carlasc.errors import ArgumentError
from carlasc.storage.camera_files import encode_image
from carlasc_recorders.town.actors import EGO_ID
from carlasc_recorders.town.drive import Snapshot
from carlasc_recorders.town.meshes import RayScene, rotate_exactly

CAMERA_YAWS_DEG = MappingProxyType(
    {
        "front": 0,
        "front_left": -60,
        "front_right": 60,
        "left": -90,
        "right": 90,
        "back_left": -120,
        "back_right": 120,
        "back": 180,
    }
)
"""The available cameras of the ego vehicle, and their viewing directions: degrees from x towards y
(to the right).
"""

IMAGE_SIZE = (800, 450)
"""Numbers of columns and rows of the images."""

# horizontal field of view; position of a camera relative to the ego sensor: ahead in its viewing
# direction, and below
_FIELD_DEG = 70.0
_AHEAD_M = 0.4
_BELOW_M = 0.15
_RANGE_M = 255.0
_DEPTH_STEP = 256.0
_SKY = (196, 216, 235)
_SKY_LABEL = 13
_SUN = np.array([0.35, -0.45, 0.82])  # direction towards the sun
PHOTO_SUFFIXES = MappingProxyType(
    {"images": "jpg", "image_labels": "png", "image_instances": "png", "image_depths": "png"}
)


def roof_cameras(names: Sequence[str]) -> tuple[CameraModel, ...]:
    """Return the cameras with some names.

    Raises:
        ArgumentError: a name is unknown, or occurs twice.
    """
    if unknown := [name for name in names if name not in CAMERA_YAWS_DEG]:
        raise ArgumentError(
            "cameras", expected=f"any of {', '.join(CAMERA_YAWS_DEG)}", found=", ".join(unknown)
        )
    if len(set(names)) < len(names):
        raise ArgumentError("cameras", expected="each camera once", found=", ".join(names))
    return tuple(map(_camera, names))


def _camera(name: str) -> CameraModel:
    width, height = IMAGE_SIZE
    focal = width / 2 / math.tan(math.radians(_FIELD_DEG / 2))
    yaw = math.radians(CAMERA_YAWS_DEG[name])
    place = optical_axes((math.cos(yaw), math.sin(yaw)), "left")
    place[:3, 3] = _AHEAD_M * math.cos(yaw), _AHEAD_M * math.sin(yaw), -_BELOW_M
    matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return CameraModel(
        name=name, width=width, height=height, matrix=matrix, sensor_T_camera=place.round(12)
    )


def photo_fields(
    cameras: Iterable[CameraModel], folders: Iterable[str] = tuple(PHOTO_SUFFIXES)
) -> tuple[str, ...]:
    """Return the fields of the layout for the images of cameras, one in each folder."""
    return tuple(
        f"{folder}.{camera.name}.{PHOTO_SUFFIXES[folder]}"
        for camera in cameras
        for folder in folders
    )


def photograph(
    snapshot: Snapshot, cameras: Sequence[CameraModel], world_T_sensor: Transform
) -> dict[str, Uint8Array]:
    """Return the bytes of the images of some cameras by field. The ego vehicle is not in them.

    Args:
        snapshot: the town at one instant.
        cameras: the cameras, with poses relative to the ego sensor.
        world_T_sensor: (4, 4) pose of the ego sensor.

    Raises:
        DependencyError: a package of the extra `simulate` is missing.
    """
    others = snapshot.instances != EGO_ID
    mesh = snapshot.mesh.select(others)
    instances = snapshot.instances[others]
    scene = RayScene(mesh, snapshot.world_T_ego[:3, 3])
    files: dict[str, Uint8Array] = {}
    for camera in cameras:
        world_T_camera = world_T_sensor @ camera.sensor_T_camera
        rows, columns = np.mgrid[: camera.height, : camera.width].reshape(2, -1)
        looks = camera.unproject(np.stack([columns, rows], axis=1))
        rays = rotate_exactly(world_T_camera, looks)
        hit, triangles, distances = scene.cast(world_T_camera[:3, 3], rays, _RANGE_M)
        shape = (camera.height, camera.width)
        labels = mesh.labels[triangles]
        color = np.tile(np.array(_SKY, np.uint8), (len(rays), 1))
        color[hit] = shaded_colors(scene, triangles, labels, rays[hit])
        classes, actors, depths = (
            np.full(len(rays), _SKY_LABEL, np.uint8),
            *np.zeros((2, len(rays)), np.uint16),
        )
        classes[hit] = labels
        actors[hit] = instances[triangles]
        depths[hit] = np.rint(distances * looks[hit, 2] * _DEPTH_STEP).clip(1, 65535)
        layers: tuple[LabelArray, ...] = (
            color.reshape(*shape, 3),
            classes,
            actors,
            depths,
        )
        for (folder, suffix), pixels in zip(PHOTO_SUFFIXES.items(), layers, strict=True):
            image = pixels if folder == "images" else pixels.reshape(shape)
            files[f"{folder}.{camera.name}.{suffix}"] = encode_image(
                image, "JPEG" if suffix == "jpg" else "PNG"
            )
    return files


def shaded_colors(
    scene: RayScene,
    triangles: AnyIntArray,
    labels: Uint8Array,
    rays: FloatArray,
) -> FloatArray:
    """Return (H, 3) colours of the classes of triangles in the light of the sun, 0 to 255.

    Args:
        scene: the scene of the triangles.
        triangles: (H,) the triangle that each ray hits.
        labels: (H,) its class.
        rays: (H, 3) directions of the rays.
    """
    normals = scene.normals(triangles)
    normals *= -np.sign(np.einsum("ri,ri->r", normals, rays))[:, None]  # towards the camera
    light = 0.55 + 0.45 * np.clip(normals @ (_SUN / np.linalg.norm(_SUN)), 0, 1)
    return CARLA.palette[labels] * light[:, None]
