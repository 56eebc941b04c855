"""The sensors on the ego vehicle, and the conversion of their measurements to recordings."""

from __future__ import annotations

import math
import queue
from collections.abc import Sequence
from typing import Any

import numpy as np

from carlasc.captures.raw import SensorRecording
from carlasc.captures.settings import BEV_HEIGHT_M, BEV_QUALITY, BEV_SIZE, Lidar
from carlasc.core.arrays import AnyArray, AnyIntArray, FloatArray, Uint8Array, Uint32Array
from carlasc.core.cameras import CameraModel
from carlasc.core.geometry import invert, rotate_vectors
from carlasc.core.scans import Scan
from carlasc.core.tables import CARLA, REMAPS
from carlasc.errors import MissingDataError
from carlasc.storage.camera_files import encode_image
from carlasc.storage.layout import FRAME_PERIOD_S
from carlasc_recorders.carla.server import SemanticSweep, Server, decode_sweep
from carlasc_recorders.town.photographs import photo_fields

CAMERA_KINDS = {
    "images": "rgb",
    "image_labels": "semantic_segmentation",
    "image_depths": "depth",
}
"""The cameras of CARLA, by the folder of their images."""

_FARTHEST_M = 1000.0
_DEPTH_STEP = 256.0

RENUMBERED_FROM = (0, 9, 14)
"""First version of CARLA whose class ids differ from those of the data set."""

_ROTATIONS_PER_S = round(1 / FRAME_PERIOD_S)  # one rotation per frame


class SensorRig:
    """The semantic LiDARs on the ego vehicle, with the orientation of the vehicle, and the camera
    above it.
    """

    def __init__(
        self,
        server: Server,
        ego: Any,
        offsets: FloatArray,
        lidar: Lidar,
        bev: bool,
        seed: int,
        cameras: Sequence[CameraModel] = (),
    ) -> None:
        """Spawn the sensors. They measure from the next tick on.

        Args:
            server: the server.
            ego: actor of the ego vehicle in CARLA.
            offsets: (S, 3) offsets of the LiDARs in the vehicle frame, metres.
            lidar: model of the LiDARs. The semantic LiDAR of CARLA has no noise, so noise is added.
            bev: whether to spawn the camera above the vehicle.
            seed: seed of the noise.
            cameras: level cameras on the vehicle, without distortion. Their poses are relative to
                the first LiDAR.

        Raises:
            MissingDataError: the server has no such sensor, or no room for it.
            ServerError: the server does not answer.
        """
        self._server = server
        self._lidar = lidar
        self._seed = seed
        self._ego_id = int(ego.id)
        self._remap = (
            REMAPS["carla0914_to_carla"] if server.version_numbers >= RENUMBERED_FROM else None
        )
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
                self._mount(
                    ego, "sensor.lidar.ray_cast_semantic", attributes, server.transform((x, y, z))
                )
            )
        self._camera: queue.Queue[Any] | None = None
        if bev:
            above = server.transform((0.0, 0.0, BEV_HEIGHT_M), pitch_deg=-90.0)
            size = {"image_size_x": BEV_SIZE[0], "image_size_y": BEV_SIZE[1]}
            self._camera = self._mount(ego, "sensor.camera.rgb", size, above)
        self._photos = {
            field: self._mount_camera(ego, camera, offsets[0], kind)
            for camera in cameras
            for field, kind in zip(
                photo_fields([camera], CAMERA_KINDS), CAMERA_KINDS.values(), strict=True
            )
        }

    def measure(
        self, tick: int, frame: int, numbers: ActorNumbers
    ) -> tuple[list[SensorRecording], list[float], bytes | None, dict[str, Uint8Array]]:
        """Collect the measurements of a tick.

        Args:
            tick: number of the tick on the server.
            frame: frame number in the capture.
            numbers: numbers of the actors in the capture.

        Returns:
            The recording of each LiDAR, its simulation time in seconds, the bird's-eye picture as
            JPEG bytes or None, and the images of the cameras on the vehicle as bytes of files, by
            field.

        Raises:
            ServerError: a measurement does not arrive.
            FormatError: a class id is not in the class table, or a measurement does not have the
                format of CARLA.
        """
        sweeps = [
            decode_sweep(self._server.measurement(arrived, tick, f"LiDAR {number}"))
            for number, arrived in enumerate(self._lidars)
        ]
        image = (
            None
            if self._camera is None
            else self._server.measurement(self._camera, tick, "the camera")
        )
        recordings = [
            self._to_recording(sweep, numbers, np.random.default_rng((self._seed, frame, sensor)))
            for sensor, sweep in enumerate(sweeps)
        ]
        photos = {
            field: self._to_file(
                field, self._server.measurement(arrived, tick, f"the camera of {field}")
            )
            for field, arrived in self._photos.items()
        }
        picture = None if image is None else encode_bev(image)
        return recordings, [sweep.elapsed_s for sweep in sweeps], picture, photos

    def _mount_camera(
        self, ego: Any, camera: CameraModel, ego_lidar: FloatArray, kind: str
    ) -> queue.Queue[Any]:
        """Spawn a camera of CARLA at the pose of a camera model, and return the queue of its
        images.
        """
        place = camera.sensor_T_camera
        x, y, z = (place[:3, 3] + ego_lidar).tolist()
        yaw_deg = math.degrees(math.atan2(place[1, 2], place[0, 2]))
        width_deg = math.degrees(2 * math.atan(camera.width / 2 / camera.matrix[0, 0]))
        attributes = {"image_size_x": camera.width, "image_size_y": camera.height, "fov": width_deg}
        where = self._server.transform((x, y, z), yaw_deg=yaw_deg)
        return self._mount(ego, f"sensor.camera.{kind}", attributes, where)

    def _to_file(self, field: str, image: Any) -> Uint8Array:
        """Return an image as the bytes of a file: colours, class ids, or depths, which CARLA
        encodes in three channels.
        """
        pixels = _rgb(image)
        folder = field.partition(".")[0]
        if folder == "images":
            return encode_image(pixels, "JPEG")
        if folder == "image_labels":
            labels = self._classes_of(pixels[..., 0], "semantic camera")
            return encode_image(labels.astype(np.uint8), "PNG")
        shares = (pixels @ np.array([1.0, 256.0, 65536.0])) / (256**3 - 1)
        return encode_image(
            np.rint(shares * _FARTHEST_M * _DEPTH_STEP).clip(1, 65535).astype(np.uint16), "PNG"
        )

    def _classes_of(self, tags: AnyArray, sensor: str) -> AnyArray:
        """Return the class ids of the data set for those of the server."""
        where = f"CARLA {self._server.version}, {sensor}"
        if self._remap is not None:
            return self._remap(tags, where)
        CARLA.check(tags, where)
        return tags

    def _mount(
        self, ego: Any, name: str, attributes: dict[str, Any], transform: Any
    ) -> queue.Queue[Any]:
        """Spawn a sensor on the ego vehicle, and return the queue of its measurements."""
        blueprints = self._server.blueprints(name)
        if not blueprints:
            raise MissingDataError(
                self._server.where,
                expected=f"the sensor {name}",
                found=f"no such sensor in CARLA {self._server.version}",
            )
        blueprint = blueprints[0]
        for key, value in attributes.items():
            blueprint.set_attribute(key, str(value))
        sensor = self._server.spawn(blueprint, transform, parent=ego, before_destroy="stop")
        if sensor is None:
            raise MissingDataError(self._server.where, expected=f"room for {name}", found="none")
        return self._server.listen(sensor)

    def _to_recording(
        self, sweep: SemanticSweep, numbers: ActorNumbers, rng: np.random.Generator
    ) -> SensorRecording:
        """Remove the points on the ego vehicle, add noise, and convert class ids and actor ids."""
        seen = sweep.detections[sweep.detections["actor"] != self._ego_id]
        points = np.stack([seen["x"], seen["y"], seen["z"]], axis=1)
        points = (
            points + rng.uniform(-self._lidar.noise_m, self._lidar.noise_m, points.shape)
        ).astype(np.float32)
        tags = np.ascontiguousarray(seen["tag"])
        labels = self._classes_of(tags, "semantic LiDAR").astype(np.uint32)
        actors = np.unique(seen["actor"][seen["actor"] > 0])
        velocities = rotate_vectors(invert(sweep.world_T_sensor), self._server.velocities(actors))
        rows = np.column_stack([numbers.of(actors).astype(np.float64), velocities])
        return SensorRecording(
            Scan(points, labels, instances=numbers.of(seen["actor"])), sweep.world_T_sensor, rows
        )


class ActorNumbers:
    """Numbers for the actors of the server, in the order of spawning, equal in every run. 0 is no
    actor.
    """

    def __init__(self, actors: list[int]) -> None:
        """Number actors from 1.

        Args:
            actors: ids of the actors on the server, in the order of spawning.
        """
        self._numbers = {0: 0} | {actor: number for number, actor in enumerate(actors, 1)}

    def of(self, actors: AnyIntArray) -> Uint32Array:
        """Return (N,) numbers for (N,) ids of actors. A new actor gets the next number."""
        ids, position = np.unique(actors, return_inverse=True)
        numbers = [self._numbers.setdefault(int(actor), len(self._numbers)) for actor in ids]
        return (
            np.array(numbers, np.uint32)[position.reshape(-1)]
            if len(ids)
            else np.empty(0, np.uint32)
        )


def encode_bev(image: Any) -> bytes:
    """Return a `carla.Image` as JPEG bytes."""
    return encode_image(_rgb(image), "JPEG", BEV_QUALITY).tobytes()


def _rgb(image: Any) -> Uint8Array:
    """Return the (H, W, 3) pixels of a `carla.Image`, which are BGRA."""
    pixels = np.frombuffer(bytes(image.raw_data), np.uint8).reshape(
        int(image.height), int(image.width), 4
    )
    return np.ascontiguousarray(pixels[..., 2::-1])
