"""Cameras of a recording: projection, pose, and their description in cameras.json.

The camera frame has x to the right, y down and z forward along its axis, in metres. Pixel (0, 0) is
the centre of the upper left pixel, so an image covers -0.5 <= u < width - 0.5.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from carlasc.core.arrays import AnyFloatArray, BoolArray, FloatArray
from carlasc.core.geometry import Transform, check_rigid
from carlasc.errors import FormatError

Lens = Literal["pinhole", "radial-tangential", "fisheye"]
"""Camera models: without distortion; k1, k2, p1, p2, k3 .. k6 of OpenCV; the equidistant fisheye of
OpenCV with k1 .. k4.
"""

_COEFFICIENTS: Mapping[str, tuple[int, ...]] = {
    "pinhole": (0,),
    "radial-tangential": (4, 5, 8),
    "fisheye": (4,),
}
# radius in the plane of `_distort`
_WIDEST = {
    "pinhole": 1e3,
    "radial-tangential": 8.0,
    "fisheye": math.radians(110),
}
# length of the table of radii, and iterations of Newton's method
_STEPS = 4096
_ROUNDS = 8
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_KEYS = (
    "name",
    "width",
    "height",
    "model",
    "matrix",
    "distortion",
    "sensor_T_camera",
    "times",
    "images",
)


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraModel:
    """A camera of a recording: its lens, its pose, and the times of its images.

    Attributes:
        name: letters, digits, "-" and "_". This is also the name of the folder of its images.
        width: columns of an image, pixels.
        height: rows of an image, pixels.
        model: "pinhole", "radial-tangential" or "fisheye" (equidistant).
        matrix: (3, 3) float64 intrinsic matrix, pixels.
        distortion: coefficients in the order of OpenCV: none, four, five or eight (k1, k2, p1, p2,
            k3, ...), or four for a fisheye.
        sensor_T_camera: (4, 4) float64, from the camera frame to the frame of the scans. It is a
            rotation if the axes of the scans are right-handed, otherwise a reflection, because the
            camera frame is right-handed.
        times: (F,) time of the image of each frame, seconds by the clock of times.txt, NaN for no
            image; None for the times of the scans.
        images: path of the image of each frame, relative to the folder of the sequence, "" for no
            image; None for the folder of images.

    Raises:
        FormatError: the model is unknown, the coefficients do not fit it, or a number is out of its
            range.
    """

    name: str
    width: int
    height: int
    matrix: FloatArray
    sensor_T_camera: Transform
    model: Lens = "pinhole"
    distortion: tuple[float, ...] = ()
    times: FloatArray | None = None
    images: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        where = f"camera {self.name}"
        if not isinstance(self.name, str) or not _NAME.fullmatch(self.name):
            raise FormatError(
                "camera",
                expected="a name of letters, digits, - and _, at most 64",
                found=repr(self.name),
            )
        if self.model not in get_args(Lens):
            raise FormatError(
                where,
                expected=f"one of the models {', '.join(get_args(Lens))}",
                found=repr(self.model),
            )
        if len(self.distortion) not in _COEFFICIENTS[self.model]:
            counts = " or ".join(map(str, _COEFFICIENTS[self.model]))
            expected = f"{counts} coefficients of distortion for {self.model}"
            raise FormatError(where, expected=expected, found=len(self.distortion))
        for name in ("width", "height"):
            if type(size := getattr(self, name)) is not int or not 0 < size <= 65536:
                raise FormatError(
                    where, expected=f"a {name} of 1 to 65536 pixels", found=repr(size)
                )
        matrix = np.asarray(self.matrix, np.float64)
        focal = (
            matrix.shape == (3, 3)
            and np.isfinite(matrix).all()
            and matrix[0, 0] > 0
            and matrix[1, 1] > 0
        )
        if not focal or (matrix[2] != (0, 0, 1)).any() or not np.isfinite(self.distortion).all():
            found = np.array2string(matrix, separator=" ").replace("\n", "")
            raise FormatError(
                where,
                expected="a matrix of fx s cx, 0 fy cy, 0 0 1, and finite numbers",
                found=found,
            )
        place = np.asarray(self.sensor_T_camera, np.float64)
        proper = (
            place * np.array([np.sign(np.linalg.det(place[:3, :3])) or 1.0, 1, 1, 1])
            if place.shape == (4, 4)
            else place
        )
        check_rigid(proper, f"{where}: sensor_T_camera")
        for name, value in (("matrix", matrix), ("sensor_T_camera", place), ("times", self.times)):
            object.__setattr__(self, name, None if value is None else np.asarray(value, np.float64))
        object.__setattr__(self, "distortion", tuple(map(float, self.distortion)))

    def project(self, points: AnyFloatArray) -> FloatArray:
        """Return (N, 2) float64 pixel column and row of (N, 3) points in the camera frame, metres.

        NaN for points behind the camera, or too far from its axis for the model. Pixels may be
        outside the image.
        """
        x, y, z = np.asarray(points, np.float64).T
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.model == "fisheye":
                radius = np.hypot(x, y)
                angle = np.arctan2(radius, z)
                scale = np.where(radius > 0, angle / radius, 1.0)
                plane = np.stack([x * scale, y * scale], axis=1)
                outside = angle > self._widest
            else:
                plane = np.stack([x / z, y / z], axis=1)
                outside = ~(z > 0) | (np.square(plane).sum(axis=1) > self._widest**2)
            pixels = self._distort(plane) @ self.matrix[:2, :2].T + self.matrix[:2, 2]
        pixels[outside] = np.nan
        return pixels

    def unproject(self, pixels: ArrayLike) -> FloatArray:
        """Return (N, 3) unit vectors in the camera frame, the viewing directions of (N, 2) pixels;
        NaN where the model is not valid.
        """
        wanted = (np.asarray(pixels, np.float64) - self.matrix[:2, 2]) @ np.linalg.inv(
            self.matrix[:2, :2]
        ).T
        plane = wanted
        if self.distortion:
            radii = np.linspace(0.0, self._widest, _STEPS)
            reached = np.linalg.norm(wanted, axis=1)
            scale = np.interp(reached, radii * self._radial(radii * radii), radii) / np.where(
                reached > 0, reached, 1
            )
            plane = wanted * np.where(reached > 0, scale, 1.0)[:, None]
            for _ in range(_ROUNDS):
                plane = plane - self._newton_step(plane, wanted)
            off = np.abs((self._distort(plane) - wanted) * self.matrix[[0, 1], [0, 1]]).max(axis=1)
            plane = np.where((off < 1e-3)[:, None], plane, np.nan)
        radius = np.linalg.norm(plane, axis=1)
        if self.model != "fisheye":
            rays = np.column_stack([plane, np.ones(len(plane))])
            return rays / np.linalg.norm(rays, axis=1, keepdims=True)
        scale = np.where(radius > 0, np.sin(radius) / np.where(radius > 0, radius, 1), 1.0)
        rays = np.column_stack([plane * scale[:, None], np.cos(radius)])
        rays[~(radius <= self._widest)] = np.nan
        return rays

    def contains(self, pixels: AnyFloatArray) -> BoolArray:
        """Return whether each of (N, 2) pixels is in the image."""
        u, v = pixels.T
        return (u >= -0.5) & (u < self.width - 0.5) & (v >= -0.5) & (v < self.height - 0.5)

    def resized(self, width: int, height: int) -> CameraModel:
        """Return the camera for images of another size, with a scaled intrinsic matrix."""
        scale = np.diag([width / self.width, height / self.height, 1.0])
        # pixel edges instead of pixel centres
        half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
        matrix = np.linalg.inv(half) @ scale @ half @ self.matrix
        return self.replaced(width=width, height=height, matrix=matrix)

    def replaced(self, **changes: Any) -> CameraModel:
        """Return a copy with some attributes replaced."""
        return replace(self, **changes)

    def to_dict(self) -> dict[str, Any]:
        """Return the camera as values for cameras.json."""
        about: dict[str, Any] = {name: getattr(self, name) for name in _KEYS}
        about |= {"matrix": self.matrix.tolist(), "distortion": list(self.distortion)}
        about["sensor_T_camera"] = self.sensor_T_camera.tolist()
        if self.times is not None:
            about["times"] = [None if math.isnan(time) else time for time in self.times.tolist()]
        return {name: value for name, value in about.items() if value is not None}

    @classmethod
    def from_dict(cls, about: Any, where: str) -> CameraModel:
        """Return a camera from its values in cameras.json. `where` is the file named in errors.

        Raises:
            FormatError: a value is missing or not valid.
        """
        needed = set(_KEYS[:7]) - {"distortion"}
        if not isinstance(about, dict) or not needed <= about.keys():
            missing = (
                ", ".join(sorted(needed - set(about))) if isinstance(about, dict) else "everything"
            )
            raise FormatError(
                where,
                expected=f"a camera with {', '.join(sorted(needed))}",
                found=f"a camera without {missing}",
            )
        values = {name: about[name] for name in _KEYS if about.get(name) is not None}
        try:
            for name in ("matrix", "sensor_T_camera", "times"):
                if name in values:
                    values[name] = np.array(values[name], np.float64)
            for name in ("distortion", "images"):
                values |= {name: tuple(values[name])} if name in values else {}
            return cls(**values)
        except FormatError as error:
            raise error.within(where) from error
        except (TypeError, ValueError) as error:
            raise FormatError(where, expected="numbers of a camera", found=error) from error

    @cached_property
    def _widest(self) -> float:
        """Largest radius in the plane for which the distorted radius is monotonic.

        The model is not valid beyond it.
        """
        radii = np.linspace(0.0, _WIDEST[self.model], _STEPS)
        falls = np.flatnonzero(np.diff(radii * self._radial(radii * radii)) <= 0)
        return float(radii[falls[0]] if len(falls) else radii[-1])

    def _radial(self, squared: FloatArray) -> FloatArray:
        """Return the radial scale factor for squared radii in the plane."""
        if not self.distortion:
            return np.ones_like(squared)
        if self.model == "fisheye":
            return np.asarray(np.polynomial.polynomial.polyval(squared, (1.0, *self.distortion)))
        k1, k2, _, _, k3, *rest = (*self.distortion, 0.0)[: max(5, len(self.distortion))]
        above = np.polynomial.polynomial.polyval(squared, (1.0, k1, k2, k3))
        return np.asarray(above / np.polynomial.polynomial.polyval(squared, (1.0, *rest)))

    def _distort(self, plane: FloatArray) -> FloatArray:
        if not self.distortion:
            return plane
        squared = np.square(plane).sum(axis=1)
        bent = plane * self._radial(squared)[:, None]
        if self.model == "radial-tangential":
            (x, y), (p1, p2) = plane.T, self.distortion[2:4]
            bent[:, 0] += 2 * p1 * x * y + p2 * (squared + 2 * x * x)
            bent[:, 1] += p1 * (squared + 2 * y * y) + 2 * p2 * x * y
        return bent

    def _newton_step(self, plane: FloatArray, wanted: FloatArray) -> FloatArray:
        """Return one step of Newton's method towards the undistorted points of the `wanted`
        distorted points.
        """
        off = self._distort(plane) - wanted
        small = 1e-6
        along_x, along_y = (
            (self._distort(plane + shift) - self._distort(plane - shift)) / (2 * small)
            for shift in small * np.eye(2)
        )
        determinant = along_x[:, 0] * along_y[:, 1] - along_y[:, 0] * along_x[:, 1]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            step_x = (off[:, 0] * along_y[:, 1] - off[:, 1] * along_y[:, 0]) / determinant
            step_y = (off[:, 1] * along_x[:, 0] - off[:, 0] * along_x[:, 1]) / determinant
            return np.clip(np.nan_to_num(np.stack([step_x, step_y], axis=1)), -1.0, 1.0)


def optical_axes(forward: tuple[float, float], axes: Literal["left", "right"]) -> Transform:
    """Return the (4, 4) sensor_T_camera without translation of a level camera that looks along a
    horizontal direction.

    Args:
        forward: x and y of the direction, sensor frame.
        axes: handedness of the scans.
    """
    x, y = np.array(forward, np.float64) / math.hypot(*forward)
    turn = np.eye(4)
    right = (y, -x, 0.0) if axes == "right" else (-y, x, 0.0)
    turn[:3, :3] = np.array([right, (0.0, 0.0, -1.0), (x, y, 0.0)]).T
    return turn
