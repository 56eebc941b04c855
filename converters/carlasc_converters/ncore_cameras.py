"""The cameras of a recording of NCore: https://nvidia.github.io/ncore/data/sensor_models.html."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from carlasc.core import CameraModel
from carlasc.core.arrays import FloatArray, IntArray
from carlasc.core.cameras import Lens
from carlasc.core.geometry import Transform
from carlasc.errors import FormatError
from carlasc_converters.files import opening
from carlasc_converters.image_files import nearest_within
from carlasc_converters.ncore_store import NcoreStore

_ENDINGS = {"jpeg": "jpg", "jpg": "jpg", "png": "png"}
# pixels from the corner of the first pixel, where NCore's coordinates begin, to its centre, where
# those of the layout do
_EDGE = 0.5


@dataclass(frozen=True)
class NcoreCamera:
    """A camera.

    Attributes:
        name: its name, which is that of its frame of coordinates too: x to the right, y down, z
            ahead.
        store: the store of its images.
        group: the group of its images there.
        lens: `camera_model_type`, `camera_model_parameters` and the other values of the component
            "intrinsics".
    """

    name: str
    store: NcoreStore
    group: str
    lens: Mapping[str, Any]

    @property
    def unknown(self) -> str | None:
        """Why its images cannot be projected; None if they can."""
        kind = self.lens.get("camera_model_type")
        given = self.lens.get("camera_model_parameters", {})
        if kind not in ("opencv-pinhole", "opencv-fisheye"):
            return f"the model {kind}"
        if self.lens.get("external_distortion_type") or given.get("external_distortion_parameters"):
            return "a windshield"
        return "thin prisms" if np.any(given.get("thin_prism_coeffs", 0)) else None

    @cached_property
    def spans(self) -> IntArray:
        """(N, 2) microseconds of the start and the end of each image, increasing."""
        with opening(f"{self.store.path}: {self.group}/frames", "the times of images"):
            given = self.store.attributes(f"{self.group}/frames").get("frames_timestamps_us", [])
            return np.array(given, np.int64).reshape(-1, 2)

    def nearest(self, ends: IntArray, within: float) -> list[int | None]:
        """Return the row of the image whose middle is nearest to each of (F,) times, microseconds;
        None if none is near enough.
        """
        return nearest_within(self.spans.mean(axis=1).astype(np.int64), ends, within)

    def model(self, vehicle_T_camera: Transform, times: FloatArray | None) -> CameraModel:
        """Return the camera; `times` are those of the images of each frame, seconds.

        Raises:
            FormatError: numbers are missing, or do not fit the model.
        """
        where = f"{self.store.path}: intrinsics of {self.name}"
        with opening(where, "a camera of NCore"):
            given = self.lens["camera_model_parameters"]
            width, height = (int(size) for size in given["resolution"])
            (fx, fy), (cx, cy) = given["focal_length"], given["principal_point"]
            radial = tuple(given["radial_coeffs"])
            fisheye = self.lens["camera_model_type"] == "opencv-fisheye"
            distortion = (
                radial if fisheye else (*radial[:2], *given["tangential_coeffs"], *radial[2:])
            )
        model: Lens = (
            "fisheye" if fisheye else "radial-tangential" if any(distortion) else "pinhole"
        )
        return CameraModel(
            name=self.name,
            width=width,
            height=height,
            model=model,
            matrix=np.array([[fx, 0, cx - _EDGE], [0, fy, cy - _EDGE], [0, 0, 1]], np.float64),
            distortion=() if model == "pinhole" else distortion,
            sensor_T_camera=vehicle_T_camera,
            times=times,
        )

    def read(self, row: int) -> tuple[str, bytes]:
        """Return the ending and the bytes of the file of an image.

        Raises:
            FormatError: the image is not in a supported format.
        """
        name = f"{self.group}/frames/{self.spans[row, 1]}/image"
        kind = str(self.store.attributes(name).get("format"))
        if kind.lower() not in _ENDINGS:
            raise FormatError(f"{self.store.path}: {name}", expected="a jpeg or png", found=kind)
        return _ENDINGS[kind.lower()], self.store.array(name).tobytes()
