"""The images of the cameras of a sequence, where they were taken."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from carlasc.core.cameras import CameraModel
from carlasc.core.geometry import Transform
from carlasc.storage.camera_files import cameras_of, has_image, image_bytes, scan_T_camera
from carlasc.storage.protocol import Sequence


@dataclass(frozen=True)
class Photo:
    """The image of a camera.

    Attributes:
        camera: the camera.
        ego_T_camera: (4, 4) where it was when it took the image, in the frame of the scan.
        data: the image as the bytes of a JPEG or PNG.
    """

    camera: CameraModel
    ego_T_camera: Transform
    data: bytes

    @property
    def kind(self) -> str:
        """The format of the image: "jpeg" or "png"."""
        return "png" if self.data.startswith(b"\x89PNG") else "jpeg"


def photos_of(sequence: Sequence, frame: int, mirrored: bool) -> tuple[Photo, ...]:
    """Read the images of a frame; of cameras without one, nothing.

    Args:
        sequence: the sequence.
        frame: frame number.
        mirrored: whether y is mirrored, as for viewers that are right-handed.

    Raises:
        FormatError: the calibration is damaged.
    """
    found, mirror = [], np.diag([1.0, -1.0 if mirrored else 1.0, 1.0, 1.0])
    for camera in cameras_of(sequence).values():
        place = scan_T_camera(sequence, camera, frame) if has_image(sequence, camera, frame) else None
        if place is not None:
            found.append(Photo(camera, mirror @ place, image_bytes(sequence, camera, frame)[0]))
    return tuple(found)
