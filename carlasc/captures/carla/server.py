"""A CARLA server, as much of it as recording needs: the only place that speaks to the `carla` package.

Everything that is changed on the server is undone when the `with` block ends, however it ends: actors are destroyed, the youngest first, and
settings are restored.
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
from numpy.typing import NDArray

from carlasc.core.geometry import Transform
from carlasc.errors import ArgumentError, CarlascError, MissingDataError, import_extra
from carlasc.storage.layout import FRAME_PERIOD_S

DETECTION = np.dtype(  # a semantic LiDAR record (FORMAT section 2)
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("cos", "<f4"), ("actor", "<u4"), ("tag", "<u4")]
)


class ServerError(CarlascError):
    """The server did not answer, or not as expected."""


@dataclass(frozen=True)
class SemanticSweep:
    """What a semantic LiDAR measured in one tick.

    Attributes:
        detections: (N,) of `DETECTION`, in the sensor's frame (x forward, y right, z up).
        world_T_sensor: (4, 4) float64.
        elapsed_s: the simulation's seconds.
    """

    detections: NDArray[np.void]
    world_T_sensor: Transform
    elapsed_s: float


class Server:
    """A connection. Use it in a `with` block: at its end the server is as it was."""

    def __init__(self, host: str, port: int, timeout_s: float, carla: Any = None) -> None:
        """Connect.

        Args:
            host: where the server runs.
            port: its RPC port.
            timeout_s: how long an answer may take, seconds.
            carla: the client's module; None imports the official package.

        Raises:
            DependencyError: the `carla` package is not installed.
            ServerError: no server answers.
        """
        self.carla = carla if carla is not None else import_extra("carla", "carla")
        self.where, self.timeout_s = f"{host}:{port}", timeout_s
        self._stack = ExitStack()
        self._client = self.carla.Client(host, port)
        self._client.set_timeout(timeout_s)
        with self._asking("its version"):
            self.version = str(self._client.get_server_version())
        self._world: Any = None
        self._failures: list[str] = []  # of the clean-up

    @property
    def version_numbers(self) -> tuple[int, ...]:
        """The server's version: (0, 9, 15).

        Raises:
            ServerError: it has none.
        """
        match = re.match(r"v?(\d+)\.(\d+)(?:\.(\d+))?", self.version)
        if match is None:
            raise ServerError(f"CARLA at {self.where}: expected a version such as 0.9.15, found {self.version!r}")
        return tuple(int(part or 0) for part in match.groups())

    def load_town(self, town: str) -> None:
        """Load a town anew, and step it by ourselves, 0.1 s a tick, until the block ends.

        Raises:
            ArgumentError: the server has no such town.
            ServerError: it does not answer.
        """
        with self._asking(f"the town {town}"):
            towns = sorted({str(name).rsplit("/", 1)[-1] for name in self._client.get_available_maps()})
            if town not in towns:
                raise ArgumentError(f"town {town!r}: expected one that the server has: {', '.join(towns)}")
            before = self._client.get_world().get_settings()
            self._stack.callback(
                self._restore, before.synchronous_mode, before.fixed_delta_seconds, before.no_rendering_mode
            )
            self._world = self._client.load_world(town)
            settings = self._world.get_settings()
            settings.synchronous_mode, settings.fixed_delta_seconds = True, FRAME_PERIOD_S
            settings.no_rendering_mode = False
            self._world.apply_settings(settings)
            self.ids_before = sorted(int(actor.id) for actor in self._world.get_actors())

    def steer_traffic(self, port: int, seed: int) -> None:
        """Let the traffic manager drive in step with us, the same way every time."""
        with self._asking("its traffic manager"):
            manager = self._client.get_trafficmanager(port)
            self._stack.callback(self._attempt, lambda: manager.set_synchronous_mode(False))
            manager.set_synchronous_mode(True)
            manager.set_random_device_seed(seed)
            self._world.set_pedestrians_seed(seed)

    def blueprints(self, pattern: str) -> list[Any]:
        """Return the blueprints of a pattern such as "vehicle.*", by name."""
        return sorted(self._world.get_blueprint_library().filter(pattern), key=lambda blueprint: str(blueprint.id))

    def spawn_points(self) -> list[Any]:
        """Return the places where vehicles may start."""
        return list(self._world.get_map().get_spawn_points())

    def walkable_place(self) -> Any | None:
        """Return a random place on a pavement, None where none was found."""
        return self._world.get_random_location_from_navigation()

    def transform(self, xyz: tuple[float, float, float] = (0.0, 0.0, 0.0), pitch_deg: float = 0.0) -> Any:
        """Return CARLA's transform of a place, level but for its pitch."""
        carla = self.carla
        return carla.Transform(carla.Location(*xyz), carla.Rotation(pitch=pitch_deg, yaw=0.0, roll=0.0))

    def at(self, location: Any) -> Any:
        """Return CARLA's transform of a location."""
        return self.carla.Transform(location)

    def spawn(self, blueprint: Any, transform: Any, parent: Any = None, undo: str | None = None) -> Any | None:
        """Spawn an actor that is destroyed when the block ends; None where there is no room for it.

        Args:
            blueprint: what.
            transform: where; from the parent where there is one.
            parent: what it is fixed to.
            undo: name of the method to call before it is destroyed ("stop").
        """
        with self._asking(f"a {blueprint.id}"):
            actor = self._world.try_spawn_actor(blueprint, transform, attach_to=parent)
        if actor is not None:
            self._stack.callback(self._destroy, actor, undo)
        return actor

    def listen(self, sensor: Any) -> queue.Queue[Any]:
        """Return the queue that a sensor's measurements come in."""
        arrived: queue.Queue[Any] = queue.Queue()
        sensor.listen(arrived.put)
        return arrived

    def tick(self) -> int:
        """Go on by 0.1 s; returns the server's number of the frame."""
        with self._asking("the next tick"):
            return int(self._world.tick(self.timeout_s))

    def measurement(self, arrived: queue.Queue[Any], tick: int, sensor: str) -> Any:
        """Return what a sensor measured in a tick.

        Raises:
            ServerError: it does not arrive.
        """
        deadline = time.monotonic() + self.timeout_s
        while True:
            try:
                data = arrived.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                raise ServerError(
                    f"CARLA at {self.where}: expected {sensor} to measure within {self.timeout_s:g} s, found nothing: raise --timeout, or lower --points"
                ) from None
            if data.frame == tick:
                return data
            if data.frame > tick:
                raise ServerError(
                    f"CARLA at {self.where}: expected {sensor}'s frame {tick}, found {data.frame}: does another client tick this server?"
                )

    def velocities(self, actors: NDArray[np.integer]) -> NDArray[np.float64]:
        """Return (K, 3) world velocities of actors, m/s, as of the last tick; zero for one that is gone."""
        snapshot = self._world.get_snapshot()
        found = [snapshot.find(int(actor)) for actor in actors]
        rows = [
            (v.x, v.y, v.z) if (v := None if a is None else a.get_velocity()) is not None else (0.0,) * 3 for a in found
        ]
        return np.array(rows, np.float64).reshape(-1, 3)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()
        if self._failures and error is None:
            raise ServerError(f"CARLA at {self.where}: could not be cleaned up: {self._failures[0]}: restart it")

    def _destroy(self, actor: Any, undo: str | None) -> None:
        """Undo one actor; the others follow whatever happens."""
        if actor.is_alive:
            if undo is not None:
                self._attempt(getattr(actor, undo))
            self._attempt(actor.destroy)

    def _restore(self, synchronous: bool, delta_s: float | None, no_rendering: bool) -> None:
        def restore() -> None:
            world = self._client.get_world()
            settings = world.get_settings()
            settings.synchronous_mode, settings.fixed_delta_seconds = synchronous, delta_s
            settings.no_rendering_mode = no_rendering
            world.apply_settings(settings)

        self._attempt(restore)

    def _attempt(self, action: Callable[[], object]) -> None:
        try:
            action()
        except RuntimeError as error:  # the client's only kind: gone already, or no answer
            self._failures.append(str(error))

    @contextmanager
    def _asking(self, what: str) -> Iterator[None]:
        try:
            yield
        except RuntimeError as error:
            raise ServerError(
                f"CARLA at {self.where}: expected {what} within {self.timeout_s:g} s, found: {error}: is it running? See --host, --port, --timeout"
            ) from error


def decode_sweep(measurement: Any) -> SemanticSweep:
    """Read a `carla.SemanticLidarMeasurement`.

    Raises:
        MissingDataError: its bytes are no whole records.
    """
    data = bytes(measurement.raw_data)
    if len(data) % DETECTION.itemsize:
        raise MissingDataError(
            "semantic LiDAR",
            expected=f"a multiple of {DETECTION.itemsize} bytes",
            found=f"{len(data)}",
            advice="is the server of another version?",
        )
    pose = np.array(measurement.transform.get_matrix(), np.float64)
    return SemanticSweep(np.frombuffer(data, DETECTION), pose, float(measurement.timestamp))
