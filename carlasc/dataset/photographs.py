"""The fields of a sample that come from cameras: images, and the cameras that took them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from carlasc.dataset.fields import Sample, Values
from carlasc.errors import ArgumentError, MissingDataError, import_extra
from carlasc.storage import Sequence, layout
from carlasc.storage.camera_files import cameras_of, has_image, image_fields, read_image, scan_T_camera

OF_CAMERAS = frozenset({"images", "cameras"})
"""The fields of a sample that come from cameras."""


def frames_with_images(scans: Sequence, frames: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return those of some frames of which every camera of a sequence has an image.

    Raises:
        MissingDataError: there are no cameras, or no such frame.
    """
    cameras = cameras_of(scans)
    kept = [all(has_image(scans, camera, frame) for camera in cameras.values()) for frame in frames.tolist()]
    if not cameras or not any(kept):
        found = "no frame that has it" if cameras else f"no {layout.CAMERAS}"
        advice = "convert with --images copy or link"
        raise MissingDataError(scans.location, expected="an image of each camera", found=found, advice=advice)
    return frames[kept]


def stored_images(scans: Sequence) -> dict[tuple[Sequence, str], None]:
    """Return the fields of the images that lie in a sequence, as its frames are chosen by."""
    return {(scans, field): None for field in image_fields(scans).values()}


def read_cameras(scans: Sequence, frame: int) -> Values:
    """Return the images of a frame and the cameras that took them, each where it was then, by name.

    Raises:
        FormatError: an image is damaged, or does not fit its camera.
    """
    cameras = cameras_of(scans)
    images = {name: np.array(read_image(scans, camera, frame)) for name, camera in cameras.items()}
    places = {name: scan_T_camera(scans, camera, frame) for name, camera in cameras.items()}
    there = {
        name: camera.replaced(sensor_T_camera=places[name])
        for name, camera in cameras.items()
        if places[name] is not None
    }
    return {"images": images, "cameras": there}


@dataclass(frozen=True)
class ResizeImages:
    """Gives the images of samples another size, and their cameras the matrices that fit it: a `transform` of a Dataset.

    Attributes:
        width: columns.
        height: rows.

    Raises:
        ArgumentError: a size below 1.
    """

    width: int
    height: int

    def __post_init__(self) -> None:
        if min(self.width, self.height) < 1:
            raise ArgumentError("width", expected="1 or more pixels", found=f"{self.width} x {self.height}")

    def __call__(self, sample: Sample) -> Sample:
        """Return the sample with images of this size. The input is not changed.

        Raises:
            DependencyError: Pillow is not installed.
        """
        made, size = dict(cast(Values, sample)), (self.width, self.height)
        picture = import_extra("PIL.Image", "render")
        if "images" in made:
            images: Mapping[str, NDArray[np.uint8]] = made["images"]
            shrunk = picture.Resampling.BILINEAR  # Pillow averages over all pixels that become one
            made["images"] = {
                name: np.array(picture.fromarray(one).resize(size, shrunk)) for name, one in images.items()
            }
        if "cameras" in made:
            made["cameras"] = {name: camera.resized(*size) for name, camera in made["cameras"].items()}
        return cast(Sample, made)
