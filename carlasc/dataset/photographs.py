"""The fields of a sample from cameras: images and camera models."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np

from carlasc.core.arrays import IntArray, Uint8Array
from carlasc.dataset.fields import Sample, Values
from carlasc.errors import ArgumentError, MissingDataError, import_extra
from carlasc.storage import Sequence, layout
from carlasc.storage.camera_files import (
    cameras_of,
    has_image,
    read_image,
    scan_T_camera,
)

OF_CAMERAS = frozenset({"images", "cameras"})
"""The fields of a sample that come from cameras."""


def frames_with_images(scans: Sequence, frames: IntArray) -> IntArray:
    """Return the frames for which every camera of a sequence has an image.

    Raises:
        MissingDataError: the sequence has no cameras, or no frame has all images.
    """
    cameras = cameras_of(scans)
    kept = [
        all(has_image(scans, camera, frame) for camera in cameras.values())
        for frame in frames.tolist()
    ]
    if not cameras or not any(kept):
        found = "no frame with all images" if cameras else f"no {layout.CAMERAS}"
        advice = "convert with --images copy or link"
        raise MissingDataError(
            scans.location, expected="an image of each camera", found=found, advice=advice
        )
    return frames[kept]


def read_cameras(scans: Sequence, frame: int) -> Values:
    """Return the images of a frame, and the camera models with their poses at the time of the
    images, both by camera name.

    Raises:
        FormatError: an image is damaged, or does not fit its camera.
    """
    cameras = cameras_of(scans)
    images = {name: np.array(read_image(scans, camera, frame)) for name, camera in cameras.items()}
    posed = {
        name: camera.replaced(sensor_T_camera=place)
        for name, camera in cameras.items()
        if (place := scan_T_camera(scans, camera, frame)) is not None
    }
    return {"images": images, "cameras": posed}


@dataclass(frozen=True)
class ResizeImages:
    """Resizes the images of samples, and scales the camera matrices.

    It is a `transform` of a Dataset.

    Attributes:
        width: number of columns, pixels.
        height: number of rows, pixels.

    Raises:
        ArgumentError: a size below 1.
    """

    width: int
    height: int

    def __post_init__(self) -> None:
        if min(self.width, self.height) < 1:
            raise ArgumentError(
                "width", expected="1 or more pixels", found=f"{self.width} x {self.height}"
            )

    def __call__(self, sample: Sample) -> Sample:
        """Return the sample with resized images. The input is not changed.

        Raises:
            DependencyError: Pillow is not installed.
        """
        made = dict(cast(Values, sample))
        size = (self.width, self.height)
        picture = import_extra("PIL.Image", "render")
        if "images" in made:
            images: Mapping[str, Uint8Array] = made["images"]
            # when shrinking, Pillow averages over all source pixels
            shrunk = picture.Resampling.BILINEAR
            made["images"] = {
                name: np.array(picture.fromarray(one).resize(size, shrunk))
                for name, one in images.items()
            }
        if "cameras" in made:
            made["cameras"] = {
                name: camera.resized(*size) for name, camera in made["cameras"].items()
            }
        return cast(Sample, made)
