"""Recording a drive: every sensor's scan of every frame, written as a raw capture (FORMAT section 3)."""

from __future__ import annotations

import dataclasses
import os
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from carlasc.captures.raw import TRAFFIC, Capture, CaptureWriter, Recording
from carlasc.captures.town.birdseye import render_birdseye
from carlasc.captures.town.drive import Drive
from carlasc.captures.town.lidar import Lidar
from carlasc.core.tables import CARLA
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.running.processes import run_all
from carlasc.storage.layout import FRAME_PERIOD_S

SETTINGS = "simulation.json"
RECIPE = 1  # goes up whenever the same seed makes another town: old and new frames must not be mixed


@dataclass(frozen=True)
class SimulationResult:
    """What a simulation wrote.

    Attributes:
        capture: the sequence's folder, which holds raw/.
        frames: frames the capture now has of those that were asked for.
        written: how many of them this run made; the others were there.
        sensors: sensors a frame.
        points: points written by this run.
        classes: of these points, how many are of each class, by name.
    """

    capture: Path
    frames: int
    written: int
    sensors: int
    points: int
    classes: dict[str, int]


@dataclass(frozen=True)
class _Settings:
    """What a capture is made from: one capture has one."""

    seed: int
    traffic: str
    sensors: int
    bev: bool
    lidar: Lidar
    recipe: int = RECIPE


def simulate(
    out: str | os.PathLike[str],
    *,
    frames: int = 20,
    sensors: int = 20,
    seed: int = 0,
    traffic: str = "medium",
    channels: int = 64,
    points: int = 130_000,
    max_range_m: float = 50.0,
    bev: bool = True,
    first_frame: int = 0,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> SimulationResult:
    """Record a drive through a simulated town as a raw capture. The same arguments make the same bytes.

    A second run goes on where a first one stopped, or adds frames.

    Args:
        out: the sequence's folder; files go to `<out>/raw`.
        frames: how many frames, 0.1 s apart.
        sensors: how many LiDARs; the first is the ego one.
        seed: town, traffic, sensor placement and noise are drawn from it.
        traffic: "light", "medium" or "heavy".
        channels: of each LiDAR.
        points: rays a scan, all channels together.
        max_range_m: how far a LiDAR sees, metres.
        bev: whether to write the bird's-eye pictures.
        first_frame: number of the first frame; the drive starts, at rest, with frame 0.
        workers: processes side by side, all cores if None.
        executor: does the work instead.
        progress: called with (done, total) frames.

    Returns:
        What was written.

    Raises:
        ArgumentError: a number or a name makes no sense.
        ConflictError: `out` holds a capture made with other settings, or not by us.
        CarlascError: the disk is full, or a worker died.
    """
    if frames < 1:
        raise ArgumentError("frames", expected="at least 1", found=f"{frames}")
    if sensors < 1:
        raise ArgumentError("sensors", expected="at least 1", found=f"{sensors}")
    if first_frame < 0:
        raise ArgumentError("first frame", expected="0 or more", found=f"{first_frame}")
    if seed < 0:
        raise ArgumentError("seed", expected="0 or more", found=f"{seed}")
    if traffic not in TRAFFIC:
        raise ArgumentError("traffic", expected=f"one of {', '.join(TRAFFIC)}", found=f"{traffic!r}")
    settings = _Settings(seed, traffic, sensors, bev, Lidar(channels, points, max_range_m))
    writer = CaptureWriter(out)
    writer.check_settings(SETTINGS, dataclasses.asdict(settings), "carlasc simulate")
    writer.write_settings(SETTINGS, dataclasses.asdict(settings))

    wanted = range(first_frame, first_frame + frames)
    missing = [frame for frame in wanted if not _is_done(writer, settings, frame)]
    for frame in wanted:  # an interrupted run may have recorded a frame without its time
        if frame not in missing and not _is_timed(writer, settings, frame):
            _write_times(writer, settings, frame)
    counts: Counter[str] = Counter()
    if progress is not None:
        progress(frames - len(missing), frames)
    record = partial(_record_frame, writer, settings)
    for done, (frame, found) in enumerate(
        zip(missing, run_all(record, missing, workers=workers, executor=executor), strict=True), 1
    ):
        counts.update(found)
        _write_times(writer, settings, frame)
        if progress is not None:
            progress(frames - len(missing) + done, frames)
    classes = {name: counts[name] for name in CARLA.names.values() if counts[name]}
    return SimulationResult(Path(out), frames, len(missing), sensors, sum(classes.values()), classes)


def _record_frame(writer: CaptureWriter, settings: _Settings, frame: int) -> dict[str, int]:
    """Record all sensors' scans and the picture of a frame; returns how many points are of each class."""
    drive = _drive(settings.seed, settings.traffic, settings.lidar)
    counts = np.zeros(CARLA.num_channels, np.int64)
    for sensor in range(settings.sensors):
        recording = drive.record(frame, sensor)
        counts += np.bincount(_labels(recording), minlength=len(counts))
        writer.write(sensor, frame, recording)
    if settings.bev:
        writer.write_bev(frame, render_birdseye(drive.snapshot(frame)))
    return {CARLA.names[label]: int(count) for label, count in enumerate(counts) if count}


def _labels(recording: Recording) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    labels = recording.scan.labels
    return np.empty(0, np.int64) if labels is None else labels.astype(np.int64)


@lru_cache(maxsize=1)
def _drive(seed: int, traffic: str, lidar: Lidar) -> Drive:
    """A process's drive: the town is built once."""
    return Drive(seed, traffic, lidar)


def _is_done(writer: CaptureWriter, settings: _Settings, frame: int) -> bool:
    pictured = not settings.bev or Capture(writer.raw).has_bev(frame)
    return pictured and all(writer.has(sensor, frame) for sensor in range(settings.sensors))


def _is_timed(writer: CaptureWriter, settings: _Settings, frame: int) -> bool:
    """Whether a frame stands in the times files; the last sensor's is written last."""
    try:
        Capture(writer.raw).read_time(frame, settings.sensors - 1)
    except MissingDataError:
        return False
    return True


def _write_times(writer: CaptureWriter, settings: _Settings, frame: int) -> None:
    for sensor in range(settings.sensors):
        writer.write_time(sensor, frame, frame * FRAME_PERIOD_S)
