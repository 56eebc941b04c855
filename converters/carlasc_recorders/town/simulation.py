"""A drive through the simulated town, as a capture that is computed when it is read."""

from __future__ import annotations

import io
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from carlasc.captures.raw import SensorRecording
from carlasc.captures.settings import (
    BEV_HEIGHT_M,
    BEV_QUALITY,
    BEV_SIZE,
    Lidar,
    LidarEffects,
    TrafficLevel,
)
from carlasc.captures.simulation import Simulator
from carlasc.core.arrays import FloatArray, Uint8Array
from carlasc.core.cameras import CameraModel
from carlasc.core.geometry import Transform, rotate_vectors
from carlasc.errors import import_extra
from carlasc_recorders.town.drive import Snapshot, TownDrive
from carlasc_recorders.town.photographs import (
    photo_fields,
    photograph,
    roof_cameras,
    shaded_colors,
)

_BACKGROUND = (255, 255, 255)
# rays are cast for every second row and column of pixels; the picture is enlarged afterwards
_REDUCTION = 2


def render_birdseye(snapshot: Snapshot) -> bytes:
    """Return the bird's-eye picture as JPEG bytes: 1920 x 1080 pixels, 90 degrees wide, with its
    upper edge ahead of the vehicle.

    Raises:
        DependencyError: a package of the extra `simulate` is missing.
    """
    image = import_extra("PIL.Image", "simulate")
    directions = _downward_rays()
    world_T_ego = snapshot.world_T_ego
    rays = rotate_vectors(world_T_ego, directions.reshape(-1, 3))
    eye = world_T_ego[:3, :3] @ np.array((0.0, 0.0, BEV_HEIGHT_M)) + world_T_ego[:3, 3]
    hit, triangles, _ = snapshot.scene.cast(eye, rays, 1000.0)
    pixels = np.full(rays.shape, _BACKGROUND, np.uint8)
    labels = snapshot.mesh.labels[triangles]
    pixels[hit] = shaded_colors(snapshot.scene, triangles, labels, rays[hit])
    picture = image.fromarray(pixels.reshape(directions.shape))
    buffer = io.BytesIO()
    picture.resize(BEV_SIZE, image.Resampling.BICUBIC).save(buffer, "JPEG", quality=BEV_QUALITY)
    return buffer.getvalue()


def _downward_rays() -> FloatArray:
    """Return (H, W, 3) rays of a camera that looks down.

    Its upper edge is ahead, its right edge on the right.
    """
    width = BEV_SIZE[0] // _REDUCTION
    height = BEV_SIZE[1] // _REDUCTION
    right = (np.arange(width) + 0.5 - width / 2) / (width / 2)
    ahead = -(np.arange(height) + 0.5 - height / 2) / (width / 2)
    rays = np.stack(np.broadcast_arrays(ahead[:, None], right[None, :], -1.0), axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


class SimulatedCapture(Simulator):
    """A drive through the simulated town, to make ground truth with `carlasc.regrid` without a
    capture on disk.

    Its data are equal to the output of `carlasc.simulate` with the same settings. It can be
    pickled.
    """

    def read(self, sensor: int, frame: int) -> SensorRecording:
        """Simulate the recording of a sensor in a frame."""
        self.check_frame(frame)
        return self._drive.record(frame, sensor)

    def read_scan(self, frame: int) -> SensorRecording:
        """Simulate the scan of the ego sensor with its effects."""
        self.check_frame(frame)
        if self.effects == LidarEffects():
            return self.read(0, frame)
        parts = 20 if self.effects.turning else 1
        return self._drive.sweep(frame, parts=parts, effects=self.effects)

    def read_velocities(self, frame: int) -> dict[int, FloatArray]:
        """Return the (3,) velocity over ground, m/s, world frame, of each actor of the town in a
        frame.
        """
        self.check_frame(frame)
        return {actor.id: actor.velocity for actor in self._drive.actors(frame)}

    def read_pose(self, sensor: int, frame: int) -> Transform:
        """Return the (4, 4) float64 world_T_sensor of a frame."""
        self.check_frame(frame)
        return self._drive.sensor_poses(frame, sensor + 1)[sensor]

    def read_bev(self, frame: int) -> bytes | None:
        """Return the bird's-eye picture of a frame as JPEG bytes; None without `bev`."""
        self.check_frame(frame)
        return render_birdseye(self._drive.snapshot(frame)) if self.bev else None

    def has_bev(self, frame: int) -> bool:
        """Whether a frame has a bird's-eye picture."""
        return self.bev

    def make_cameras(self, names: Sequence[str]) -> tuple[CameraModel, ...]:
        """Return the cameras with some names, on the roof of the vehicle.

        Raises:
            ArgumentError: a name is unknown, or occurs twice.
        """
        return roof_cameras(names)

    def image_fields(self, frame: int) -> tuple[str, ...]:
        """Return the layout names of the images of a frame."""
        return photo_fields(self.cameras.values())

    def read_images(self, frame: int) -> dict[str, Uint8Array]:
        """Return the image files of a frame as bytes, by their layout names."""
        if not self.cameras:
            return {}
        return photograph(
            self._drive.snapshot(frame), tuple(self.cameras.values()), self.read_pose(0, frame)
        )

    def check_packages(self) -> None:
        """Check that the packages for the simulation are installed.

        Raises:
            DependencyError: a package of the extra `simulate` is missing.
        """
        modules = ["trimesh.creation", "embreex.rtcore_scene", "embreex.mesh_construction"]
        for module in [*modules, "PIL.Image"] if self.bev or self.cameras else modules:
            import_extra(module, "simulate")

    @property
    def _drive(self) -> TownDrive:
        return _cached_drive(self.seed, self.traffic, self.lidar)


@lru_cache(maxsize=1)
def _cached_drive(seed: int, traffic: TrafficLevel, lidar: Lidar) -> TownDrive:
    """Return the drive of this process. The town is built once."""
    return TownDrive(seed, traffic, lidar)
