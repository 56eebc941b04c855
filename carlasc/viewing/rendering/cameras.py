"""Cameras: the viewpoints of pictures.

All coordinates are in the frame of the data. Only the camera depends on the handedness of that
frame: in CarlaSC's left-handed frame (y right) the camera's right is `up x forward`, in a
right-handed one (y left) it is `forward x up`. In both, the left of the vehicle is on the left of
the picture, and no geometry is mirrored.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from carlasc.core.arrays import Float32Array, FloatArray
from carlasc.core.choices import Axes, ViewName
from carlasc.core.compiling import cached
from carlasc.core.geometry import Transform, rotate_vectors, transform_points
from carlasc.errors import ArgumentError, check_choice, check_types

Floats = FloatArray

DEFAULT_ELEVATION_RAD = np.deg2rad(42.0)
DEFAULT_FOV_RAD = np.deg2rad(32.0)

View = Literal["perspective", "bev"]
VIEWS: tuple[View, ...] = get_args(View)

_NEAREST_M = 1.0


@dataclass(frozen=True)
class Viewpoint:
    """The viewpoint of a perspective view.

    Values that are None are chosen so that the whole drawing is in the picture.

    Attributes:
        azimuth_rad: direction from the target to the camera: 0 is behind the ego vehicle, positive
            is towards its right.
        elevation_rad: angle of the camera above the horizon, seen from the target.
        distance_m: distance from the target; None takes the least distance from which everything is
            visible.
        target: (3,) point that the camera looks at, metres; None takes the middle of the drawing.
        position: (3,) position of the camera, metres; azimuth, elevation and distance are then
            ignored.
        fov_rad: vertical field of view.

    Raises:
        ArgumentError: a number that is not finite, or out of range.
    """

    azimuth_rad: float = 0.0
    elevation_rad: float = DEFAULT_ELEVATION_RAD
    distance_m: float | None = None
    target: tuple[float, float, float] | None = None
    position: tuple[float, float, float] | None = None
    fov_rad: float = DEFAULT_FOV_RAD

    def __post_init__(self) -> None:
        angles = [self.azimuth_rad, self.elevation_rad, self.fov_rad]
        numbers = [*angles, self.distance_m or 0.0, *(self.target or ()), *(self.position or ())]
        field_deg, elevation_deg = np.rad2deg([self.fov_rad, self.elevation_rad])
        for valid, expected, found in (
            (np.isfinite(numbers).all(), "finite numbers", str(self)),
            (
                0 < self.fov_rad < np.pi,
                "a field of view between 0 and 180 degrees",
                f"{field_deg:g}",
            ),
            (
                abs(self.elevation_rad) <= np.pi / 2,
                "an elevation of -90 to 90 degrees",
                f"{elevation_deg:g}",
            ),
            (
                self.distance_m is None or self.distance_m > 0,
                "a distance above 0 m",
                f"{self.distance_m}",
            ),
        ):
            if not valid:
                raise ArgumentError("viewpoint", expected=expected, found=found)

    @classmethod
    def parse(cls, text: str) -> Viewpoint:
        """Read "azimuth=30 elevation=20": words `key=value`, separated by spaces.

        Keys are azimuth, elevation and fov (degrees), distance (metres), position and target (x,y,z
        in metres).

        Raises:
            ArgumentError: an unknown key, or a value that is not a number.
        """
        names = {
            "azimuth": "azimuth_rad",
            "elevation": "elevation_rad",
            "fov": "fov_rad",
            "distance": "distance_m",
        }
        values: dict[str, Any] = {}
        for word in text.replace(";", " ").split():
            key, _, value = word.partition("=")
            try:
                numbers = [float(number) for number in value.split(",")]
            except ValueError:
                numbers = []
            if key in ("position", "target") and len(numbers) == 3:
                values[key] = tuple(numbers)
            elif key in names and len(numbers) == 1:
                values[names[key]] = (
                    numbers[0] if key == "distance" else float(np.deg2rad(numbers[0]))
                )
            else:
                raise ArgumentError(
                    "viewpoint",
                    expected="azimuth=DEG, elevation=DEG, fov=DEG, distance=M, position=X,Y,Z or "
                    "target=X,Y,Z",
                    found=repr(word),
                )
        return cls(**values)

    def turned(self, angle_rad: float) -> Viewpoint:
        """Return the viewpoint turned around the target by an angle, positive towards the vehicle's
        right.

        Raises:
            ArgumentError: the viewpoint has a fixed position.
        """
        if self.position is not None:
            raise ArgumentError(
                "viewpoint", expected="an azimuth for an orbit", found="a fixed position"
            )
        return replace(self, azimuth_rad=self.azimuth_rad + angle_rad)


@dataclass(frozen=True)
class CameraOptions:
    """The camera of the pictures of a scene.

    Without `still`, the camera moves with the ego vehicle.

    Attributes:
        view: "perspective": from behind and above; "bev": from straight above (bird's-eye view);
            "both", side by side.
        viewpoint: where perspective views are taken from; the default is a point behind and above
            the ego vehicle.
        orbit: circle the scene once: while the frames follow each other, or around a single frame.
        still: do not move the camera with the ego vehicle; needs poses.

    Raises:
        ArgumentError: an unknown view.
    """

    view: ViewName = "perspective"
    viewpoint: Viewpoint = Viewpoint()
    orbit: bool = False
    still: bool = False

    def __post_init__(self) -> None:
        check_types(CameraOptions, vars(self))
        check_choice("view", self.view, ViewName)

    @property
    def views(self) -> tuple[View, ...]:
        """The views that are side by side."""
        return VIEWS if self.view == "both" else (self.view,)


@dataclass(frozen=True)
class Camera:
    """A pinhole or an orthographic camera.

    Attributes:
        position: (3,) metres.
        axes: (3, 3) rows right, up, forward: unit vectors in the data's frame.
        half_height: tangent of half the vertical field of view; for an orthographic camera half the
            visible height, metres.
        orthographic: whether rays are parallel.
    """

    position: Floats
    axes: Floats
    half_height: float
    orthographic: bool = False

    def rays(self, width: int, height: int, rows: slice) -> tuple[Float32Array, Float32Array]:
        """Return origins and directions, (n, 3) float32 each, of the rays through the pixels of
        some rows, row by row.

        Directions have length 1 along the camera's forward axis, so that the distance along a ray
        is the depth.
        """
        origins, directions = np.empty((2, (rows.stop - rows.start) * width, 3), np.float32)
        step = self.footprint(height)
        _write_rays(
            self.position,
            self.axes,
            step,
            self.orthographic,
            width,
            height,
            rows.start,
            origins,
            directions,
        )
        return origins, directions

    def project(self, points: ArrayLike, width: int, height: int) -> tuple[Floats, Floats, Floats]:
        """Return pixel column, row and depth of (N, 3) points; a pinhole camera shows only points
        with a depth above 0.
        """
        x, y, depth = self.axes @ (np.asarray(points, np.float64) - self.position).T
        scale = height / (2 * self.half_height)
        with np.errstate(divide="ignore", invalid="ignore"):  # points with depth 0
            zoom = scale if self.orthographic else scale / depth
            return width / 2 + x * zoom, height / 2 - y * zoom, depth

    def footprint(self, height: int) -> float:
        """Return the width of a pixel in metres, at depth 1 (pinhole) or at any depth
        (orthographic).
        """
        return 2 * self.half_height / height

    def moved(self, dst_T_src: Transform) -> Camera:
        """Return the same camera in another frame."""
        return replace(
            self,
            position=transform_points(dst_T_src, self.position),
            axes=rotate_vectors(dst_T_src, self.axes),
        )


def perspective_camera(
    extent: Floats,
    viewpoint: Viewpoint,
    aspect: float,
    *,
    axes: Axes = "left",
    margin: float = 0.02,
) -> Camera:
    """Return the camera of a viewpoint; values that are not given are fitted to the extent.

    Args:
        extent: (N, 3) points that should be in the picture, metres.
        viewpoint: what is given.
        aspect: width over height of the picture.
        axes: handedness of the data: "left" (y to the right) or "right" (y to the left).
        margin: share of the picture that is left free on each side.

    Raises:
        ArgumentError: position and target of the viewpoint are equal.
    """
    tan_y = float(np.tan(viewpoint.fov_rad / 2))
    target = np.asarray(
        viewpoint.target if viewpoint.target is not None else (extent.min(0) + extent.max(0)) / 2
    )
    if viewpoint.position is not None:
        position = np.asarray(viewpoint.position, np.float64)
        if np.allclose(position, target):
            raise ArgumentError(
                "viewpoint",
                expected="a target away from the position",
                found=f"both at {target.tolist()}",
            )
        return Camera(position, _upright(target - position, axes), tan_y)

    side = 1.0 if axes == "left" else -1.0
    azimuth = viewpoint.azimuth_rad
    elevation = viewpoint.elevation_rad
    forward = np.array(
        [
            np.cos(azimuth) * np.cos(elevation),
            -side * np.sin(azimuth) * np.cos(elevation),
            -np.sin(elevation),
        ]
    )
    rows = _upright(forward, axes, azimuth)
    if viewpoint.distance_m is not None:
        return Camera(target - viewpoint.distance_m * rows[2], rows, tan_y)
    seen = 1 - 2 * margin
    if viewpoint.target is None:
        distance, shift = _fit(extent - target, rows, tan_y * aspect * seen, tan_y * seen)
        target = target + shift[0] * rows[0] + shift[1] * rows[1]
    else:
        distance = max(_fit(extent - target, rows, tan_y * aspect * seen, tan_y * seen)[0], 1.0)
    return Camera(target - distance * rows[2], rows, tan_y)


def birdseye_camera(extent: Floats, aspect: float, *, axes: Axes = "left") -> Camera:
    """Return an orthographic camera above the extent: x points up in the picture, the vehicle's
    right is on the right.
    """
    lower = extent.min(0)
    upper = extent.max(0)
    size = np.maximum(upper - lower, 1e-3)
    rows = np.array(
        [[0.0, 1.0 if axes == "left" else -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]
    )
    half_height = max(size[0], size[1] / aspect) / 2 / 0.98  # leaves a margin
    middle = (lower + upper) / 2
    return Camera(
        np.array([middle[0], middle[1], upper[2] + 10.0]),
        rows,
        float(half_height),
        orthographic=True,
    )


def _upright(forward: Floats, axes: Axes, azimuth: float = 0.0) -> Floats:
    """Return rows right, up, forward of an upright camera; if it looks straight down, its top
    points along `azimuth`.
    """
    forward = forward / np.linalg.norm(forward)
    side = 1.0 if axes == "left" else -1.0
    right = side * np.cross((0.0, 0.0, 1.0), forward)
    if np.linalg.norm(right) < 1e-6:
        right = np.array([np.sin(azimuth), side * np.cos(azimuth), 0.0])
    right = right / np.linalg.norm(right)
    return np.array([right, side * np.cross(forward, right), forward])


def _fit(
    points: Floats, axes: Floats, tan_x: float, tan_y: float
) -> tuple[float, tuple[float, float]]:
    """Return the least distance, and the shift along right and up, from which all points are inside
    the picture.

    No point is nearer than `_NEAREST_M`: with a very wide field of view the camera would otherwise
    be at a corner of the points. A point at (x, y, z) along right, up and forward is inside if |y -
    shift| <= tan_y (distance + z): two lines per axis.
    """
    x, y, z = axes @ points.T
    distances = []
    shifts = []
    for across, tangent in ((x, tan_x), (y, tan_y)):
        above = (across - tangent * z).max()
        below = (-across - tangent * z).max()
        distances.append((above + below) / (2 * tangent))
        shifts.append((above - below) / 2)
    return float(max(*distances, _NEAREST_M - z.min())), (float(shifts[0]), float(shifts[1]))


@cached(error_model="python")
def _write_rays(  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    position, axes, step, flat, width, height, first, origins, directions
):
    for row in range(first, first + len(origins) // width):
        y = (height / 2 - row - 0.5) * step
        for column in range(width):
            x = (column + 0.5 - width / 2) * step
            i = (row - first) * width + column
            for a in range(3):
                offset = x * axes[0, a] + y * axes[1, a]
                origins[i, a] = position[a] + offset if flat else position[a]
                directions[i, a] = axes[2, a] if flat else offset + axes[2, a]
