"""`record`: a drive on a CARLA server among spawned traffic, written as a raw capture (see the
format page, `docs/format.md#raw-capture`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from carlasc.captures.raw import Capture, SensorRecording
from carlasc.captures.settings import (
    TRAFFIC,
    Lidar,
    ServerOptions,
    TrafficLevel,
    check_at_least,
    sensor_offsets,
)
from carlasc.captures.writing import CaptureWriter, TimesLog
from carlasc.errors import (
    ArgumentError,
    ConflictError,
    MissingDataError,
    check_choice,
    check_types,
    import_extra,
)
from carlasc.storage.camera_files import cameras_to_json
from carlasc.storage.files import AnyPath
from carlasc.storage.layout import CAMERAS
from carlasc_recorders.carla.sensors import CAMERA_KINDS, ActorNumbers, SensorRig
from carlasc_recorders.carla.server import Server
from carlasc_recorders.town.photographs import photo_fields, roof_cameras

SETTINGS_FILE = "recording.json"
# maximum distance between the ego sensor positions of the replay and of the recorded drive
_REPLAY_TOLERANCE_M = 0.02


@dataclass(frozen=True)
class RecordResult:
    """Result of `record`.

    Attributes:
        out: folder of the sequence, which holds raw/, or its URL.
        count: number of the requested frames that exist now.
        written: number of frames that this run wrote; other frames existed.
        sensors: number of sensors.
        vehicles: number of vehicles that were spawned, without the ego vehicle.
        walkers: number of pedestrians that were spawned.
        server_version: version of CARLA.
    """

    out: str
    count: int
    written: int
    sensors: int
    vehicles: int
    walkers: int
    server_version: str


@dataclass(frozen=True)
class _ServerSettings:
    """The settings of a capture, as recording.json holds them."""

    town: str
    traffic: TrafficLevel
    sensors: int
    seed: int
    bev: bool
    server_version: str
    lidar: Lidar


def record(
    out: AnyPath,
    *,
    server: ServerOptions = ServerOptions(),  # noqa: B008 (frozen)
    town: str = "Town01",
    count: int = 2000,
    sensors: int = 20,
    seed: int = 0,
    traffic: TrafficLevel = "medium",
    lidar: Lidar | None = None,
    bev: bool = True,
    cameras: Sequence[str] = (),
    carla: Any = None,
    progress: Callable[[int, int], None] | None = None,
) -> RecordResult:
    """Record a drive on a CARLA server as a raw capture.

    At the end, also after an error or Ctrl-C, the spawned actors are destroyed and the settings of
    the server are restored.

    A second run with the same settings replays the drive from its start with the same seed, and
    writes the missing frames. It stops if the replay deviates from the recorded drive.

    Args:
        out: folder of the sequence, or its URL in an object store. Files go to `<out>/raw`.
        server: address and timeout of the CARLA server.
        town: map to drive in, such as "Town01" or "Town10HD".
        count: number of frames, 0.1 s apart.
        sensors: number of LiDARs. The first is the ego sensor.
        seed: seed of positions, traffic, offsets of the sensors, and noise.
        traffic: "light", "medium" or "heavy": 25, 50 or 100 vehicles, and as many pedestrians.
        lidar: model of the LiDARs; None takes the model of the data set.
        bev: whether to write bird's-eye pictures.
        cameras: names of cameras on the vehicle, as in `carlasc.simulate`. Each has images of
            colour, class and depth.
        carla: module of the client; None takes the package `carla`.
        progress: called with (finished frames, number of frames).

    Returns:
        Numbers of the written frames, sensors and actors.

    Raises:
        ArgumentError: an argument is out of its range, or the server has no such town.
        DependencyError: a package of the extra `carla` is missing. Nothing is written.
        ServerError: the server does not answer.
        MissingDataError: the town has no room for the ego vehicle, or the server lacks a sensor.
        ConflictError: `out` holds another capture, or the replay deviates from it.
        StorageError: `out` cannot be written to.
    """
    check_types(record, locals())
    check_at_least(1, count=count, sensors=sensors)
    check_at_least(0, seed=seed)
    check_choice("traffic", traffic, TrafficLevel)
    lidar = lidar or Lidar()
    if lidar.scattered or lidar.elevations_deg:
        raise ArgumentError("lidar", expected="equal angles between channels", found=lidar)
    models = roof_cameras(cameras)
    images = photo_fields(models, CAMERA_KINDS)
    if bev or cameras:
        import_extra("PIL.Image", "carla")
    writer = CaptureWriter(out)
    written = 0
    with Server(server, carla) as connection:
        settings = _ServerSettings(town, traffic, sensors, seed, bev, connection.version, lidar)
        written_settings = dataclasses.asdict(settings) | (
            {"cameras": list(cameras)} if cameras else {}
        )
        writer.check_settings(SETTINGS_FILE, written_settings, "carlasc capture")
        complete = {
            frame for frame in range(count) if writer.has_frame(frame, sensors, bev, images)
        }
        missing = set(range(count)) - (complete & writer.timed_frames(sensors))
        if not missing:
            return RecordResult(writer.out, count, 0, sensors, 0, 0, connection.version)

        rng = np.random.default_rng(seed)
        offsets = sensor_offsets(sensors, rng)
        connection.load_town(town)
        connection.set_up_traffic(server.traffic_port, seed)
        actors = spawn_actors(connection, TRAFFIC[traffic], server.traffic_port, rng)
        rig = SensorRig(connection, actors.ego, offsets, settings.lidar, bev, seed, models)
        spawned = (int(actor.id) for actor in (actors.ego, *actors.vehicles, *actors.walkers))
        numbers = ActorNumbers([*connection.initial_actors, *spawned])
        # only now it is certain that the town exists
        writer.write_settings(SETTINGS_FILE, written_settings)
        if models:
            writer.target.put(CAMERAS, cameras_to_json(models))
        with TimesLog(writer) as log:
            for frame in range(max(missing) + 1):
                recordings, times_s, picture, photos = rig.measure(
                    connection.tick(), frame, numbers
                )
                if frame in missing:
                    _write_frame(writer, frame, recordings, picture)
                    writer.write_images(frame, photos)
                    log.add(frame, times_s)  # last: a frame without times is not complete
                    written += 1
                else:
                    _check_replay(writer, frame, recordings[0])
                if progress is not None:
                    progress(frame + 1, count)
    return RecordResult(
        writer.out,
        count,
        written,
        sensors,
        len(actors.vehicles),
        len(actors.walkers),
        connection.version,
    )


def _write_frame(
    writer: CaptureWriter, frame: int, recordings: list[SensorRecording], picture: bytes | None
) -> None:
    """Write a frame without its times."""
    for sensor, recording in enumerate(recordings):
        writer.write(sensor, frame, recording)
    if picture is not None:
        writer.write_bev(frame, picture)


def _check_replay(writer: CaptureWriter, frame: int, replayed: SensorRecording) -> None:
    """Raise ConflictError if the ego sensor is not at its recorded position."""
    recorded = Capture(writer.target.tree).read_pose(0, frame)
    distance_m = float(np.linalg.norm(recorded[:3, 3] - replayed.world_T_sensor[:3, 3]))
    if distance_m > _REPLAY_TOLERANCE_M:
        raise ConflictError(
            f"{writer.location}: frame {frame}",
            expected="a replay that follows the recorded drive",
            found=f"the ego sensor {distance_m:.2f} m away from it",
            advice="the physics of the server differ between runs: record to another folder",
        )


EGO_BLUEPRINTS = ("vehicle.tesla.model3", "vehicle.lincoln.mkz_2017", "vehicle.lincoln.mkz_2020")
WALKING_MPS = 1.4  # mean speed of the pedestrians
_ATTEMPTS = 4  # attempts per pedestrian, because many positions are occupied or cannot be reached


@dataclass(frozen=True)
class SpawnedActors:
    """The moving actors of CARLA.

    Attributes:
        ego: the vehicle with the sensors.
        vehicles: the other vehicles.
        walkers: the pedestrians.
    """

    ego: Any
    vehicles: tuple[Any, ...]
    walkers: tuple[Any, ...]


def spawn_actors(server: Server, number: int, port: int, rng: np.random.Generator) -> SpawnedActors:
    """Spawn the ego vehicle, other vehicles and pedestrians.

    Args:
        server: the server, with its town loaded.
        number: number of other vehicles, and of pedestrians. Fewer are spawned if the town has too
            little room.
        port: port of the traffic manager.
        rng: source of the random numbers.

    Raises:
        MissingDataError: the town has no vehicles, or no room for the ego vehicle.
        ServerError: the server does not answer.
    """
    spawn_points = server.spawn_points()
    free = [spawn_points[i] for i in rng.permutation(len(spawn_points))]
    blueprints = server.blueprints("vehicle.*")
    by_name = {str(blueprint.id): blueprint for blueprint in blueprints}
    ego_blueprints = [by_name[name] for name in EGO_BLUEPRINTS if name in by_name] or blueprints
    if not ego_blueprints or not free:
        raise MissingDataError(
            server.where,
            expected="vehicles and spawn points",
            found="none",
            advice="try another `town`",
        )

    ego = None
    while ego is None and free:
        ego = _spawn_vehicle(server, ego_blueprints[0], free.pop(), "hero", port)
    vehicles: list[Any] = []
    while free and len(vehicles) < number:
        vehicle = _spawn_vehicle(
            server, blueprints[rng.integers(len(blueprints))], free.pop(), "autopilot", port
        )
        vehicles += [] if vehicle is None else [vehicle]
    if ego is None:
        raise MissingDataError(
            server.where,
            expected="a free spawn point for the ego vehicle",
            found="none",
            advice="try another `town`",
        )
    return SpawnedActors(ego, tuple(vehicles), tuple(_spawn_walkers(server, number, rng)))


def _spawn_vehicle(
    server: Server, blueprint: Any, transform: Any, role: str, port: int
) -> Any | None:
    """Spawn a vehicle on autopilot. Return None if there is no room for it."""
    if blueprint.has_attribute("role_name"):
        blueprint.set_attribute("role_name", role)
    vehicle = server.spawn(blueprint, transform)
    if vehicle is not None:
        vehicle.set_autopilot(True, port)
    return vehicle


def _spawn_walkers(server: Server, number: int, rng: np.random.Generator) -> list[Any]:
    """Spawn pedestrians, each with a controller that walks it to a random destination."""
    blueprints = server.blueprints("walker.pedestrian.*")
    controller_blueprints = server.blueprints("controller.ai.walker")
    walkers: list[Any] = []
    controllers: list[Any] = []
    for _ in range(_ATTEMPTS * number if blueprints and controller_blueprints else 0):
        if len(walkers) == number:
            break
        start = server.random_sidewalk_location()
        walker = None
        if start is not None:
            walker = server.spawn(
                blueprints[rng.integers(len(blueprints))], server.transform_at(start)
            )
        if walker is None:
            continue
        walkers.append(walker)
        controller = server.spawn(
            controller_blueprints[0], server.transform(), parent=walker, before_destroy="stop"
        )
        controllers += [] if controller is None else [controller]
    server.tick()  # a controller can be started only after its first tick
    for controller in controllers:
        controller.start()
        destination = server.random_sidewalk_location()
        if destination is not None:
            controller.go_to_location(destination)
        controller.set_max_speed(float(np.clip(rng.normal(WALKING_MPS, 0.2), 0.8, 2.2)))
    return walkers
