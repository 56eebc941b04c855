"""The sensors on the ego vehicle, and how a measurement becomes a recording."""

from __future__ import annotations

import io
import queue
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.captures.carla.server import SemanticSweep, Server, decode_sweep
from carlasc.captures.raw import Recording
from carlasc.core.geometry import invert, rotate_vectors
from carlasc.core.scans import Scan
from carlasc.core.tables import CARLA, REMAPS
from carlasc.errors import ArgumentError, MissingDataError, import_extra

BEV_SIZE, BEV_HEIGHT_M = (1920, 1080), 50.0
NEW_TAGS_FROM = (0, 9, 14)  # the version that renumbered the classes
_QUALITY = 88


@dataclass(frozen=True)
class LidarModel:
    """The LiDARs (FORMAT section 1).

    Attributes:
        channels: rays above each other.
        points: rays a scan, all channels together.
        range_m: how far it sees.
        upper_deg: elevation of the topmost channel.
        lower_deg: elevation of the lowest.
        noise_m: greatest error of a coordinate: CARLA's semantic LiDAR has none, so we add it.
    """

    channels: int = 64
    points: int = 130_000
    range_m: float = 50.0
    upper_deg: float = 2.0
    lower_deg: float = -25.0
    noise_m: float = 0.02

    def __post_init__(self) -> None:
        if self.channels < 1 or self.points < self.channels:
            raise ArgumentError(
                "lidar", expected="at least one channel and one point each", found=f"{self.channels} and {self.points}"
            )
        if not 0 < self.range_m < 1000:
            raise ArgumentError("range", expected="0 to 1000 m", found=f"{self.range_m}")


class Rig:
    """Semantic LiDARs on the ego vehicle, with its own orientation, and a camera above it."""

    def __init__(
        self, server: Server, ego: Any, offsets: NDArray[np.float64], lidar: LidarModel, bev: bool, seed: int
    ) -> None:
        """Spawn the sensors; they measure from the next tick on.

        Raises:
            MissingDataError: the server has no such sensor, or no room for one.
        """
        self._server, self._lidar, self._seed = server, lidar, seed
        self._ego_id = int(ego.id)
        self._remap = REMAPS["carla0914_to_carla"] if server.version_numbers >= NEW_TAGS_FROM else None
        self._lidars: list[queue.Queue[Any]] = []
        for offset in offsets:
            attributes = {
                "channels": lidar.channels,
                "range": lidar.range_m,
                "points_per_second": lidar.points * 10,
                "rotation_frequency": 10,  # once around a tick
                "upper_fov": lidar.upper_deg,
                "lower_fov": lidar.lower_deg,
            }
            place = server.transform((float(offset[0]), float(offset[1]), float(offset[2])))
            self._lidars.append(self._mount(ego, "sensor.lidar.ray_cast_semantic", attributes, place))
        self._camera: queue.Queue[Any] | None = None
        if bev:
            above = server.transform((0.0, 0.0, BEV_HEIGHT_M), pitch_deg=-90.0)
            size = {"image_size_x": BEV_SIZE[0], "image_size_y": BEV_SIZE[1]}
            self._camera = self._mount(ego, "sensor.camera.rgb", size, above)

    def measure(
        self, tick: int, frame: int, numbers: ActorNumbers
    ) -> tuple[list[Recording], list[float], bytes | None]:
        """Return what every LiDAR recorded in a tick, each one's seconds, and the camera's picture as JPEG."""
        sweeps = [
            decode_sweep(self._server.measurement(arrived, tick, f"LiDAR {number}"))
            for number, arrived in enumerate(self._lidars)
        ]
        image = None if self._camera is None else self._server.measurement(self._camera, tick, "the camera")
        recordings = [
            self._recording(sweep, numbers, np.random.default_rng((self._seed, frame, sensor)))
            for sensor, sweep in enumerate(sweeps)
        ]
        return recordings, [sweep.elapsed_s for sweep in sweeps], None if image is None else encode_image(image)

    def _mount(self, ego: Any, name: str, attributes: dict[str, Any], place: Any) -> queue.Queue[Any]:
        found = self._server.blueprints(name)
        if not found:
            raise MissingDataError(
                f"CARLA at {self._server.where}",
                expected=f"the sensor {name}",
                found="none",
                advice=f"version {self._server.version}",
            )
        (blueprint, *_) = found
        for key, value in attributes.items():
            blueprint.set_attribute(key, str(value))
        sensor = self._server.spawn(blueprint, place, parent=ego, undo="stop")
        if sensor is None:
            raise MissingDataError(f"CARLA at {self._server.where}", expected=f"room for {name}", found="none")
        return self._server.listen(sensor)

    def _recording(self, sweep: SemanticSweep, numbers: ActorNumbers, rng: np.random.Generator) -> Recording:
        """Drop what hits the ego vehicle, add noise, name classes and actors."""
        seen = sweep.detections[sweep.detections["actor"] != self._ego_id]
        points = np.stack([seen["x"], seen["y"], seen["z"]], axis=1)
        points = (points + rng.uniform(-self._lidar.noise_m, self._lidar.noise_m, points.shape)).astype(np.float32)
        tags = np.ascontiguousarray(seen["tag"])
        where = f"CARLA {self._server.version}, semantic LiDAR"
        if self._remap is not None:
            labels = self._remap(tags, where).astype(np.uint32)
        else:
            CARLA.check(tags, where)
            labels = tags.astype(np.uint32)
        actors = np.unique(seen["actor"][seen["actor"] > 0])
        velocities = rotate_vectors(invert(sweep.world_T_sensor), self._server.velocities(actors))
        rows = np.column_stack([numbers.of(actors).astype(np.float64), velocities])
        return Recording(Scan(points, labels, instances=numbers.of(seen["actor"])), sweep.world_T_sensor, rows)


class ActorNumbers:
    """Small numbers for the server's actors, the same in every run: by when they came. 0 is no actor."""

    def __init__(self, actors: list[int]) -> None:
        self._numbers = {0: 0} | {actor: number for number, actor in enumerate(actors, 1)}

    def of(self, actors: NDArray[np.integer]) -> NDArray[np.uint32]:
        """Return the numbers of (N,) actor ids; one that came later gets the next."""
        ids, place = np.unique(actors, return_inverse=True)
        numbers = [self._numbers.setdefault(int(actor), len(self._numbers)) for actor in ids]
        return np.array(numbers, np.uint32)[place.reshape(-1)] if len(ids) else np.empty(0, np.uint32)


def encode_image(image: Any) -> bytes:
    """Return a `carla.Image` as JPEG: its bytes are BGRA, row by row."""
    pixels = np.frombuffer(bytes(image.raw_data), np.uint8).reshape(int(image.height), int(image.width), 4)
    buffer = io.BytesIO()
    import_extra("PIL.Image", "carla").fromarray(np.ascontiguousarray(pixels[..., 2::-1])).save(
        buffer, "JPEG", quality=_QUALITY
    )
    return buffer.getvalue()
