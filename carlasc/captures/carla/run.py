"""`record`: a drive through a town of a CARLA server, as a raw capture (FORMAT section 3)."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from carlasc.captures.carla.sensors import ActorNumbers, LidarModel, Rig
from carlasc.captures.carla.server import Server
from carlasc.captures.carla.traffic import populate
from carlasc.captures.raw import TRAFFIC, Capture, CaptureWriter, Recording, sensor_offsets
from carlasc.errors import ArgumentError, ConflictError, MissingDataError

SETTINGS = "recording.json"
_SAME_PLACE_M = 0.02  # how far a replayed drive may be from the recorded one


@dataclass(frozen=True)
class RecordResult:
    """What a recording wrote.

    Attributes:
        capture: the sequence's folder, which holds raw/.
        frames: frames the capture now has of those that were asked for.
        written: how many of them this run made; the others were there.
        sensors: sensors a frame.
        vehicles: vehicles that found room, the ego one left out.
        walkers: pedestrians that did.
        server_version: of CARLA.
    """

    capture: Path
    frames: int
    written: int
    sensors: int
    vehicles: int
    walkers: int
    server_version: str


@dataclass(frozen=True)
class _Settings:
    """What a capture is recorded with: one capture has one."""

    town: str
    traffic: str
    sensors: int
    seed: int
    bev: bool
    server_version: str
    lidar: LidarModel


def record(
    out: str | os.PathLike[str],
    *,
    host: str = "127.0.0.1",
    port: int = 2000,
    traffic_port: int = 8000,
    timeout_s: float = 60.0,
    town: str = "Town01",
    traffic: str = "medium",
    frames: int = 2000,
    sensors: int = 20,
    seed: int = 0,
    lidar: LidarModel | None = None,
    bev: bool = True,
    carla: Any = None,
    progress: Callable[[int, int], None] | None = None,
) -> RecordResult:
    """Record a drive on a CARLA server as a raw capture, 0.1 s a frame.

    However it ends (done, an error, Ctrl-C), the actors that it made are destroyed and the server's settings restored. A second
    run replays the drive from its beginning with the same seed and records the frames that are missing; where the replay does not
    follow the recorded drive, it stops.

    Args:
        out: the sequence's folder; files go to `<out>/raw`.
        host: where the server runs.
        port: its RPC port.
        traffic_port: port of the traffic manager.
        timeout_s: how long the server may take for an answer, seconds.
        town: "Town01" to "Town07", "Town10HD": a map that the server has.
        traffic: "light", "medium" or "heavy": 25, 50 or 100 vehicles and as many pedestrians.
        frames: how many.
        sensors: how many LiDARs; the first is the ego one.
        seed: places, traffic and noise are drawn from it.
        lidar: the LiDARs; the data set's if None.
        bev: take the picture from above.
        carla: the client's module; None imports the official package.
        progress: called with (frames done, frames in all).

    Returns:
        What was written.

    Raises:
        ArgumentError: a number or a name makes no sense.
        DependencyError: the `carla` package is missing.
        ServerError: the server does not answer.
        ConflictError: `out` holds another capture, or the replay departs from it.
        StorageError: `out` cannot be written.
    """
    _check(frames, sensors, seed, traffic)
    writer, done = CaptureWriter(out), 0
    with Server(host, port, timeout_s, carla) as server:
        settings = _Settings(town, traffic, sensors, seed, bev, server.version, lidar or LidarModel())
        writer.check_settings(SETTINGS, dataclasses.asdict(settings), "carlasc capture")
        missing = {frame for frame in range(frames) if not _is_there(writer, settings, frame)}
        if not missing:
            return RecordResult(Path(out), frames, 0, sensors, 0, 0, server.version)

        rng = np.random.default_rng(seed)
        offsets = sensor_offsets(sensors, rng)
        server.load_town(town)
        server.steer_traffic(traffic_port, seed)
        moving = populate(server, TRAFFIC[traffic], traffic_port, rng)
        rig = Rig(server, moving.ego, offsets, settings.lidar, bev, seed)
        numbers = ActorNumbers(
            [*server.ids_before, *(int(a.id) for a in (moving.ego, *moving.vehicles, *moving.walkers))]
        )
        writer.write_settings(SETTINGS, dataclasses.asdict(settings))  # not before: a town may have been misspelt
        for frame in range(max(missing) + 1):
            recordings, seconds, picture = rig.measure(server.tick(), frame, numbers)
            if frame in missing:
                _write(writer, frame, recordings, seconds, picture)
                done += 1
            else:
                _check_replay(writer, frame, recordings[0])
            if progress is not None:
                progress(frame + 1, frames)
    return RecordResult(Path(out), frames, done, sensors, len(moving.vehicles), len(moving.walkers), server.version)


def _write(
    writer: CaptureWriter, frame: int, recordings: list[Recording], seconds: list[float], picture: bytes | None
) -> None:
    """Write a frame, its times last: a frame without its times is not there."""
    for sensor, recording in enumerate(recordings):
        writer.write(sensor, frame, recording)
    if picture is not None:
        writer.write_bev(frame, picture)
    for sensor, elapsed_s in enumerate(seconds):
        writer.write_time(sensor, frame, elapsed_s)


def _is_there(writer: CaptureWriter, settings: _Settings, frame: int) -> bool:
    if not all(writer.has(sensor, frame) for sensor in range(settings.sensors)):
        return False
    capture = Capture(writer.raw)
    try:
        capture.read_time(frame, settings.sensors - 1)  # the last that is written
    except MissingDataError:
        return False
    return capture.has_bev(frame) or not settings.bev


def _check_replay(writer: CaptureWriter, frame: int, replayed: Recording) -> None:
    """Raise ConflictError where the ego sensor is elsewhere than when the frame was recorded."""
    recorded = Capture(writer.raw).read_pose(0, frame)
    distance = float(np.linalg.norm(recorded[:3, 3] - replayed.world_T_sensor[:3, 3]))
    if distance > _SAME_PLACE_M:
        raise ConflictError(
            f"{writer.raw}: frame {frame}",
            expected="the replay to follow the recorded drive",
            found=f"it {distance:.2f} m off",
            advice="the server's physics differ from run to run; record to another folder",
        )


def _check(frames: int, sensors: int, seed: int, traffic: str) -> None:
    if frames < 1:
        raise ArgumentError("frames", expected="at least 1", found=f"{frames}")
    if sensors < 1:
        raise ArgumentError("sensors", expected="at least 1", found=f"{sensors}")
    if seed < 0:
        raise ArgumentError("seed", expected="0 or more", found=f"{seed}")
    if traffic not in TRAFFIC:
        raise ArgumentError("traffic", expected=f"one of {', '.join(TRAFFIC)}", found=f"{traffic!r}")
