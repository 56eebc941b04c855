"""A drive through the simulated town as a capture that is never written: recordings and bird's-eye pictures are computed when they are read."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from carlasc.captures.raw import Capture, SensorRecording
from carlasc.captures.settings import (
    BEV_HEIGHT_M,
    BEV_QUALITY,
    BEV_SIZE,
    Lidar,
    TrafficLevel,
    check_at_least,
)
from carlasc.captures.town.drive import Snapshot, TownDrive
from carlasc.core.geometry import Transform, rotate_vectors
from carlasc.core.tables import CARLA
from carlasc.errors import MissingDataError, check_choice, import_extra
from carlasc.storage.layout import FRAME_PERIOD_S

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


class SimulatedCapture(Capture):
    """A drive through the simulated town, for `carlasc.regrid`: ground truth without a capture on disk.

    What it returns is equal to what `carlasc.simulate` writes with the same settings. It can be pickled.

    Attributes:
        location: what to call it in errors.
        classes: class table of the labels.
    """

    def __init__(
        self,
        *,
        count: int = 20,
        first_frame: int = 0,
        sensors: int = 20,
        seed: int = 0,
        traffic: TrafficLevel = "medium",
        lidar: Lidar | None = None,
        bev: bool = True,
    ) -> None:
        """Take the settings of a simulation; the arguments are those of `carlasc.simulate`.

        Raises:
            ArgumentError: an argument is out of its range.
        """
        check_at_least(1, count=count, sensors=sensors)
        check_at_least(0, first_frame=first_frame, seed=seed)
        check_choice("traffic", traffic, TrafficLevel)
        self.location, self.classes = f"the simulated town of seed {seed}", CARLA
        self._frames, self._count = range(first_frame, first_frame + count), sensors
        self._drive_of, self._bev = (seed, traffic, lidar or Lidar()), bev

    @cached_property
    def sensors(self) -> tuple[int, ...]:
        """The sensors' numbers."""
        return tuple(range(self._count))

    @cached_property
    def frames(self) -> NDArray[np.int64]:
        """The frame numbers."""
        return np.array(self._frames, np.int64)

    def read(self, sensor: int, frame: int) -> SensorRecording:
        """Simulate what a sensor records in a frame."""
        self._check(frame)
        return self._drive.record(frame, sensor)

    def read_pose(self, sensor: int, frame: int) -> Transform:
        """Return the (4, 4) float64 world_T_sensor of a frame."""
        self._check(frame)
        return self._drive.sensor_poses(frame, sensor + 1)[sensor]

    def read_poses(self, sensor: int, frames: Iterable[int]) -> NDArray[np.float64]:
        """Return (F, 4, 4) world_T_sensor of several frames."""
        return np.stack([self.read_pose(sensor, frame) for frame in frames])

    def read_times(self, sensor: int = 0) -> Mapping[int, float]:
        """Return the simulation's time in seconds per frame number."""
        return {frame: frame * FRAME_PERIOD_S for frame in self._frames}

    def read_bev(self, frame: int) -> bytes | None:
        """Draw a frame's bird's-eye picture: JPEG bytes; None if the simulation has none."""
        self._check(frame)
        return render_birdseye(self._drive.snapshot(frame)) if self._bev else None

    def has_bev(self, frame: int) -> bool:
        """Whether a frame has a bird's-eye picture."""
        return self._bev and frame in self._frames

    def light(self) -> Capture:
        """Return the capture: it holds settings only."""
        return self

    @property
    def _drive(self) -> TownDrive:
        return _cached_drive(*self._drive_of)

    def _check(self, frame: int) -> None:
        if frame not in self._frames:
            found = f"frames {self._frames.start} to {self._frames.stop - 1}"
            raise MissingDataError(self.location, expected=f"frame {frame}", found=found)


@lru_cache(maxsize=1)
def _cached_drive(seed: int, traffic: TrafficLevel, lidar: Lidar) -> TownDrive:
    """Return the drive of this process: the town is built once."""
    return TownDrive(seed, traffic, lidar)
