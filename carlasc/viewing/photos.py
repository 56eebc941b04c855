"""The images of the cameras of a sequence, with the poses of the cameras."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np

from carlasc.core.arrays import AnyArray, FloatArray
from carlasc.core.cameras import CameraModel
from carlasc.core.geometry import Transform, transform_points
from carlasc.storage.camera_files import (
    cameras_of,
    has_image,
    image_bytes,
    opened_image,
    scan_T_camera,
)
from carlasc.storage.protocol import Sequence

# width of an image, and length of the drawn frustum of its camera
_PHOTO_PX = 400
_FRUSTUM_M = 1.0
_QUALITY = (
    70  # of a JPEG: a third of the bytes of 90, and enough for an image of a few hundred pixels
)


@dataclass(frozen=True)
class Photo:
    """The image of a camera.

    Attributes:
        camera: the camera.
        ego_T_camera: (4, 4) its pose when it took the image, in the frame of the scan.
        data: the image as the bytes of a JPEG or PNG.
    """

    camera: CameraModel
    ego_T_camera: Transform
    data: bytes

    @property
    def kind(self) -> str:
        """The format of the image: "jpeg" or "png"."""
        return "png" if self.data.startswith(b"\x89PNG") else "jpeg"

    def frustum(self, depth_m: float) -> FloatArray:
        """Return (8, 2, 3) lines of the frustum of the camera up to a depth, in the frame of the
        scan.
        """
        width = self.camera.width
        height = self.camera.height
        looks = self.camera.unproject([(0, 0), (width, 0), (width, height), (0, height)])
        corners = transform_points(
            self.ego_T_camera, depth_m * looks / np.linalg.norm(looks, axis=1, keepdims=True)
        )
        places = np.broadcast_to(self.ego_T_camera[:3, 3], (4, 3))
        return np.concatenate(
            [np.stack([places, corners], 1), np.stack([corners, np.roll(corners, -1, 0)], 1)]
        )

    def smaller(self, width: int) -> bytes:
        """Return the image as a JPEG of at most `width` pixels.

        Raises:
            FormatError: the image is damaged.
            DependencyError: Pillow is not installed.
        """
        out = io.BytesIO()
        with opened_image(self.data, f"image of {self.camera.name}") as image:
            image.thumbnail((width, self.camera.height))
            image.convert("RGB").save(out, "JPEG", quality=_QUALITY)
        return out.getvalue()


def photos_of(sequence: Sequence, frame: int, mirrored: bool) -> tuple[Photo, ...]:
    """Read the images of a frame; cameras without one are left out.

    Args:
        sequence: the sequence.
        frame: frame number.
        mirrored: whether y is mirrored, as for viewers that are right-handed.

    Raises:
        FormatError: the calibration is damaged.
    """
    photos = []
    mirror = np.diag([1.0, -1.0 if mirrored else 1.0, 1.0, 1.0])
    for camera in cameras_of(sequence).values():
        place = (
            scan_T_camera(sequence, camera, frame) if has_image(sequence, camera, frame) else None
        )
        if place is not None:
            photos.append(Photo(camera, mirror @ place, image_bytes(sequence, camera, frame)[0]))
    return tuple(photos)


def encode_photos(photos: tuple[Photo, ...]) -> dict[str, AnyArray]:
    """Encode the images of a frame for a page: `photos/NAME`, the bytes of a small JPEG, and
    `actors/cameras`, both ends of the lines of their frustums.
    """
    arrays: dict[str, AnyArray] = {
        f"photos/{photo.camera.name}": np.frombuffer(photo.smaller(_PHOTO_PX), np.uint8)
        for photo in photos
    }
    if photos:
        lines = np.concatenate([photo.frustum(_FRUSTUM_M) for photo in photos])
        arrays["actors/cameras"] = lines.astype(np.float32).reshape(-1)
    return arrays
