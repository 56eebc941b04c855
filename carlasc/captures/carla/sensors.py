"""The sensors on the ego vehicle, and how their measurements become recordings."""

from __future__ import annotations

import io
import queue
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.captures.carla.server import SemanticSweep, Server, decode_sweep
from carlasc.captures.raw import SensorRecording
from carlasc.captures.settings import BEV_HEIGHT_M, BEV_QUALITY, BEV_SIZE, Lidar
from carlasc.core.geometry import invert, rotate_vectors
from carlasc.core.scans import Scan
from carlasc.core.tables import CARLA, REMAPS
from carlasc.errors import MissingDataError, import_extra
from carlasc.storage.layout import FRAME_PERIOD_S

RENUMBERED_FROM = (0, 9, 14)
"""First version of CARLA whose class ids differ from the data set's."""

_ROTATIONS_PER_S = round(1 / FRAME_PERIOD_S)  # one rotation per frame


class SensorRig:
    """The semantic LiDARs on the ego vehicle, with the vehicle's orientation, and the camera above it."""

    def __init__(
        self, server: Server, ego: Any, offsets: NDArray[np.float64], lidar: Lidar, bev: bool, seed: int
    ) -> None:
        """Spawn the sensors. They measure from the next tick on.

        Args:
            server: the server.
            ego: CARLA's actor of the ego vehicle.
            offsets: (S, 3) offsets of the LiDARs in the vehicle's frame, metres.
            lidar: model of the LiDARs. CARLA's semantic LiDAR has no noise, so it is added here.
            bev: whether to spawn the camera.
            seed: seed of the noise.

        Raises:
            MissingDataError: the server has no such sensor, or no room for it.
            ServerError: the server does not answer.
        """
        self._server, self._lidar, self._seed = server, lidar, seed
        self._ego_id = int(ego.id)
        self._remap = REMAPS["carla0914_to_carla"] if server.version_numbers >= RENUMBERED_FROM else None
        self._lidars: list[queue.Queue[Any]] = []
        for x, y, z in offsets.tolist():
            attributes = {
                "channels": lidar.channels,
                "range": lidar.range_m,
                "points_per_second": lidar.points * _ROTATIONS_PER_S,
                "rotation_frequency": _ROTATIONS_PER_S,
                "upper_fov": lidar.upper_deg,
                "lower_fov": lidar.lower_deg,
            }
            self._lidars.append(
                self._mount(ego, "sensor.lidar.ray_cast_semantic", attributes, server.transform((x, y, z)))
            )
        self._camera: queue.Queue[Any] | None = None
        if bev:
            above = server.transform((0.0, 0.0, BEV_HEIGHT_M), pitch_deg=-90.0)
            size = {"image_size_x": BEV_SIZE[0], "image_size_y": BEV_SIZE[1]}
            self._camera = self._mount(ego, "sensor.camera.rgb", size, above)

    def measure(
        self, tick: int, frame: int, numbers: ActorNumbers
    ) -> tuple[list[SensorRecording], list[float], bytes | None]:
        """Collect the measurements of a tick.

        Args:
            tick: the server's number of the tick.
            frame: frame number in the capture.
            numbers: the actors' numbers in the capture.

        Returns:
            The recording of each LiDAR, the simulation's time of each in seconds, and the camera's picture as JPEG bytes, or None.

        Raises:
            ServerError: a measurement does not arrive.
            FormatError: a class id is not in the class table, or a measurement is not of CARLA's form.
        """
        sweeps = [
            decode_sweep(self._server.measurement(arrived, tick, f"LiDAR {number}"))
            for number, arrived in enumerate(self._lidars)
        ]
        image = None if self._camera is None else self._server.measurement(self._camera, tick, "the camera")
        recordings = [
            self._to_recording(sweep, numbers, np.random.default_rng((self._seed, frame, sensor)))
            for sensor, sweep in enumerate(sweeps)
        ]
        return recordings, [sweep.elapsed_s for sweep in sweeps], None if image is None else encode_image(image)

    def _mount(self, ego: Any, name: str, attributes: dict[str, Any], transform: Any) -> queue.Queue[Any]:
        """Spawn a sensor on the ego vehicle. Return the queue of its measurements."""
        found = self._server.blueprints(name)
        if not found:
            raise MissingDataError(
                self._server.where,
                expected=f"the sensor {name}",
                found=f"no such sensor in CARLA {self._server.version}",
            )
        blueprint = found[0]
        for key, value in attributes.items():
            blueprint.set_attribute(key, str(value))
        sensor = self._server.spawn(blueprint, transform, parent=ego, before_destroy="stop")
        if sensor is None:
            raise MissingDataError(self._server.where, expected=f"room for {name}", found="none")
        return self._server.listen(sensor)

    def _to_recording(self, sweep: SemanticSweep, numbers: ActorNumbers, rng: np.random.Generator) -> SensorRecording:
        """Remove the points on the ego vehicle, add noise, and convert class ids and actor ids."""
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
        return SensorRecording(Scan(points, labels, instances=numbers.of(seen["actor"])), sweep.world_T_sensor, rows)


class ActorNumbers:
    """Numbers for the server's actors, in the order in which they were spawned: the same in every run. 0 is no actor."""

    def __init__(self, actors: list[int]) -> None:
        """Number actors from 1.

        Args:
            actors: the server's ids of the actors in the order in which they were spawned.
        """
        self._numbers = {0: 0} | {actor: number for number, actor in enumerate(actors, 1)}

    def of(self, actors: NDArray[np.integer]) -> NDArray[np.uint32]:
        """Return the (N,) numbers of actors by their ids, (N,). An actor that is not known yet gets the next number."""
        ids, position = np.unique(actors, return_inverse=True)
        numbers = [self._numbers.setdefault(int(actor), len(self._numbers)) for actor in ids]
        return np.array(numbers, np.uint32)[position.reshape(-1)] if len(ids) else np.empty(0, np.uint32)


def encode_image(image: Any) -> bytes:
    """Return a `carla.Image`, whose pixels are BGRA, as JPEG bytes."""
    pixels = np.frombuffer(bytes(image.raw_data), np.uint8).reshape(int(image.height), int(image.width), 4)
    rgb = np.ascontiguousarray(pixels[..., 2::-1])
    buffer = io.BytesIO()
    import_extra("PIL.Image", "carla").fromarray(rgb).save(buffer, "JPEG", quality=BEV_QUALITY)
    return buffer.getvalue()
