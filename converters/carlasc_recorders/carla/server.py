"""The connection to a CARLA server. Only this module calls the `carla` package.

At the end of the `with` block of a connection, also after an error, all changes on the server are
undone: actors are destroyed in reverse order, and settings are restored.
"""

from __future__ import annotations

import queue
import re
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import numpy as np

from carlasc.captures.settings import ServerOptions
from carlasc.core.arrays import AnyIntArray, FloatArray, RecordArray
from carlasc.core.geometry import Transform
from carlasc.errors import ArgumentError, CarlascError, FormatError, import_extra
from carlasc.storage.layout import FRAME_PERIOD_S

DETECTION = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("cos", "<f4"), ("actor", "<u4"), ("tag", "<u4")]
)
"""One return of the semantic LiDAR of CARLA: position, cosine of the angle of incidence, actor id,
class id.
"""


class ServerError(CarlascError):
    """A CARLA server did not answer, or gave an unexpected answer."""


@dataclass(frozen=True)
class SemanticSweep:
    """The measurement of a semantic LiDAR in one tick.

    Attributes:
        detections: (N,) of type `DETECTION`, sensor frame (x forward, y right, z up).
        world_T_sensor: (4, 4) float64 pose.
        elapsed_s: simulation time, seconds.
    """

    detections: RecordArray
    world_T_sensor: Transform
    elapsed_s: float


class Server:
    """A connection to a CARLA server, used in a `with` block.

    At its end, the previous state of the server is restored.

    Attributes:
        carla: module of the client.
        where: name of the server in errors: host and port.
        timeout_s: timeout of answers, seconds.
        version: version of the server.
        initial_actors: sorted ids of the actors of the town before spawning.
    """

    def __init__(self, options: ServerOptions, carla: Any = None) -> None:
        """Connect to a server.

        Args:
            options: address and timeout of the server.
            carla: module of the client; None takes the package `carla`.

        Raises:
            DependencyError: the `carla` package is not installed.
            ServerError: no server answers, or its version cannot be read.
        """
        self.carla = carla if carla is not None else import_extra("carla", "carla")
        self.where = f"CARLA at {options.host}:{options.port}"
        self.timeout_s = options.timeout_s
        self._cleanup = ExitStack()
        self._client = self.carla.Client(options.host, options.port)
        self._client.set_timeout(options.timeout_s)
        with self._waiting_for("its version"):
            self.version = str(self._client.get_server_version())
        self.initial_actors: tuple[int, ...] = ()
        self._world: Any = None
        self._cleanup_errors: list[str] = []

    @property
    def version_numbers(self) -> tuple[int, ...]:
        """The version of the server as numbers, such as (0, 9, 15).

        Raises:
            ServerError: the version does not have this form.
        """
        match = re.match(r"v?(\d+)\.(\d+)(?:\.(\d+))?", self.version)
        if match is None:
            raise ServerError(
                self.where, expected="a version such as 0.9.15", found=repr(self.version)
            )
        return tuple(int(part or 0) for part in match.groups())

    def load_town(self, town: str) -> None:
        """Reload a town in synchronous mode, with 0.1 s per tick, until the block ends.

        Raises:
            ArgumentError: the server has no such town.
            ServerError: the server does not answer.
        """
        with self._waiting_for(f"the town {town}"):
            towns = sorted(
                {str(name).rsplit("/", 1)[-1] for name in self._client.get_available_maps()}
            )
            if town not in towns:
                raise ArgumentError(
                    "town",
                    expected=f"one of the server's towns: {', '.join(towns)}",
                    found=repr(town),
                )
            before = self._client.get_world().get_settings()
            self._cleanup.callback(
                self._restore,
                before.synchronous_mode,
                before.fixed_delta_seconds,
                before.no_rendering_mode,
            )
            self._world = self._client.load_world(town)
            settings = self._world.get_settings()
            settings.synchronous_mode = True
            settings.fixed_delta_seconds = FRAME_PERIOD_S
            settings.no_rendering_mode = False
            self._world.apply_settings(settings)
            self.initial_actors = tuple(sorted(int(actor.id) for actor in self._world.get_actors()))

    def set_up_traffic(self, port: int, seed: int) -> None:
        """Set the traffic manager to synchronous mode, and set its seed and the seed of the
        pedestrians.
        """
        with self._waiting_for("its traffic manager"):
            manager = self._client.get_trafficmanager(port)
            self._cleanup.callback(self._attempt, lambda: manager.set_synchronous_mode(False))
            manager.set_synchronous_mode(True)
            manager.set_random_device_seed(seed)
            self._world.set_pedestrians_seed(seed)

    def blueprints(self, pattern: str) -> list[Any]:
        """Return the blueprints that match a pattern such as "vehicle.*", sorted by name."""
        return sorted(
            self._world.get_blueprint_library().filter(pattern),
            key=lambda blueprint: str(blueprint.id),
        )

    def spawn_points(self) -> list[Any]:
        """Return the transforms at which vehicles may be spawned."""
        return list(self._world.get_map().get_spawn_points())

    def random_sidewalk_location(self) -> Any | None:
        """Return a random location for a pedestrian; None if the server found none."""
        return self._world.get_random_location_from_navigation()

    def transform(
        self,
        xyz: tuple[float, float, float] = (0.0, 0.0, 0.0),
        pitch_deg: float = 0.0,
        yaw_deg: float = 0.0,
    ) -> Any:
        """Return a CARLA transform without roll, from a position in metres, and degrees."""
        carla = self.carla
        return carla.Transform(
            carla.Location(*xyz), carla.Rotation(pitch=pitch_deg, yaw=yaw_deg, roll=0.0)
        )

    def transform_at(self, location: Any) -> Any:
        """Return a CARLA transform from a location, without rotation."""
        return self.carla.Transform(location)

    def spawn(
        self, blueprint: Any, transform: Any, parent: Any = None, before_destroy: str | None = None
    ) -> Any | None:
        """Spawn an actor. It is destroyed at the end of the block.

        Args:
            blueprint: kind of actor.
            transform: pose in the frame of the parent, or in the world frame without a parent.
            parent: actor to attach it to; None for no parent.
            before_destroy: name of the method to call before destroying it, such as "stop".

        Returns:
            The actor, or None if there is no room for it.
        """
        with self._waiting_for(f"a {blueprint.id}"):
            actor = self._world.try_spawn_actor(blueprint, transform, attach_to=parent)
        if actor is not None:
            self._cleanup.callback(self._destroy, actor, before_destroy)
        return actor

    def listen(self, sensor: Any) -> queue.Queue[Any]:
        """Return a queue that receives the measurements of a sensor."""
        arrived: queue.Queue[Any] = queue.Queue()
        sensor.listen(arrived.put)
        return arrived

    def tick(self) -> int:
        """Advance the simulation by 0.1 s, and return the number of the tick on the server."""
        with self._waiting_for("the next tick"):
            return int(self._world.tick(self.timeout_s))

    def measurement(self, arrived: queue.Queue[Any], tick: int, sensor: str) -> Any:
        """Return the measurement of a sensor in a tick.

        Args:
            arrived: queue of the measurements of the sensor.
            tick: number of the tick on the server.
            sensor: name of the sensor in errors.

        Raises:
            ServerError: the measurement does not arrive in time, or a later one arrives.
        """
        deadline = time.monotonic() + self.timeout_s
        while True:
            try:
                data = arrived.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                raise ServerError(
                    self.where,
                    expected=f"a measurement of {sensor} within {self.timeout_s:g} s",
                    found="none",
                    advice="increase `timeout_s`, or reduce `points`",
                ) from None
            if data.frame == tick:
                return data
            if data.frame > tick:
                raise ServerError(
                    self.where,
                    expected=f"tick {tick} of {sensor}",
                    found=f"tick {data.frame}",
                    advice="check that no other client advances this server",
                )

    def velocities(self, actors: AnyIntArray) -> FloatArray:
        """Return (K, 3) velocities of actors after the last tick, m/s, world frame; zero for actors
        that no longer exist.
        """
        snapshot = self._world.get_snapshot()
        velocities = np.zeros((len(actors), 3))
        for row, actor in enumerate(actors):
            actor_snapshot = snapshot.find(int(actor))
            if actor_snapshot is not None:
                velocity = actor_snapshot.get_velocity()
                velocities[row] = velocity.x, velocity.y, velocity.z
        return velocities

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._cleanup.close()
        if self._cleanup_errors and error is None:
            raise ServerError(
                self.where,
                problem=f"could not be cleaned up: {self._cleanup_errors[0]}",
                advice="restart the server",
            )

    def _destroy(self, actor: Any, before: str | None) -> None:
        if actor.is_alive:
            if before is not None:
                self._attempt(getattr(actor, before))
            self._attempt(actor.destroy)

    def _restore(self, synchronous: bool, delta_s: float | None, no_rendering: bool) -> None:
        def restore() -> None:
            world = self._client.get_world()
            settings = world.get_settings()
            settings.synchronous_mode = synchronous
            settings.fixed_delta_seconds = delta_s
            settings.no_rendering_mode = no_rendering
            world.apply_settings(settings)

        self._attempt(restore)

    def _attempt(self, action: Callable[[], object]) -> None:
        """Run one step of the clean-up. An error is recorded, and the other steps follow."""
        try:
            action()
        # the client raises no other errors: the actor no longer exists, or the server does not
        # answer
        except RuntimeError as error:
            self._cleanup_errors.append(str(error))

    @contextmanager
    def _waiting_for(self, what: str) -> Iterator[None]:
        """Raise ServerError if the client reports an error in the block."""
        try:
            yield
        except RuntimeError as error:
            raise ServerError(
                self.where,
                expected=f"{what} within {self.timeout_s:g} s",
                found=str(error),
                advice="check that the server is running, and check `host`, `port` and `timeout_s`",
            ) from error


def decode_sweep(measurement: Any) -> SemanticSweep:
    """Read a `carla.SemanticLidarMeasurement`.

    Raises:
        FormatError: its size is not a multiple of the size of a detection.
    """
    data = bytes(measurement.raw_data)
    if len(data) % DETECTION.itemsize:
        raise FormatError(
            "semantic LiDAR",
            expected=f"a multiple of {DETECTION.itemsize} bytes",
            found=len(data),
            advice="check that client and server have the same version",
        )
    pose = np.array(measurement.transform.get_matrix(), np.float64)
    return SemanticSweep(np.frombuffer(data, DETECTION), pose, float(measurement.timestamp))
