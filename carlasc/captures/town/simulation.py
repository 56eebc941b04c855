"""`simulate`: a drive through the simulated town, written as a raw capture (see the format page, `docs/format.md#raw-capture`)."""

from __future__ import annotations

import dataclasses
import os
from collections import Counter
from dataclasses import dataclass
from functools import partial

import numpy as np

from carlasc.captures.settings import Lidar, TrafficLevel
from carlasc.captures.town.simulated import SimulatedCapture
from carlasc.captures.writing import CaptureWriter, TimesLog
from carlasc.core.tables import CARLA
from carlasc.errors import import_extra
from carlasc.running.processes import run_all
from carlasc.running.spreading import Run
from carlasc.storage.layout import FRAME_PERIOD_S
from carlasc.storage.transport.targets import check_shared

SETTINGS_FILE = "simulation.json"

TOWN_VERSION = 1
"""Goes up whenever the same seed makes another town: frames of both must not be mixed in one capture."""


@dataclass(frozen=True)
class SimulationResult:
    """What a simulation wrote.

    Attributes:
        out: folder of the sequence, which holds raw/, or its URL.
        count: number of the requested frames that exist now.
        written: number of frames that this run wrote; the others existed.
        sensors: number of sensors.
        points: number of points that this run wrote.
        classes: number of these points per class name.
    """

    out: str
    count: int
    written: int
    sensors: int
    points: int
    classes: dict[str, int]


@dataclass(frozen=True)
class _SimulationSettings:
    """The settings of a capture, as simulation.json holds them."""

    seed: int
    traffic: TrafficLevel
    sensors: int
    bev: bool
    lidar: Lidar
    recipe: int = TOWN_VERSION


def simulate(
    out: str | os.PathLike[str],
    *,
    count: int = 20,
    first_frame: int = 0,
    sensors: int = 20,
    seed: int = 0,
    traffic: TrafficLevel = "medium",
    lidar: Lidar | None = None,
    bev: bool = True,
    run: Run = Run(),  # noqa: B008 (frozen)
) -> SimulationResult:
    """Record a drive through a simulated town as a raw capture. The same arguments write the same bytes.

    A second run with the same settings writes the frames that are missing, so it continues an interrupted run or adds frames.

    Args:
        out: folder of the sequence, or its URL in an object store. Files go to `<out>/raw`.
        count: number of frames, 0.1 s apart.
        first_frame: number of the first frame. The drive starts with frame 0, at rest.
        sensors: number of LiDARs. The first is the ego sensor.
        seed: seed of the town, its traffic, the sensors' offsets and the noise.
        traffic: "light", "medium" or "heavy": 25, 50 or 100 moving vehicles, and as many pedestrians.
        lidar: model of the LiDARs. None: the data set's.
        bev: whether to write bird's-eye pictures.
        run: how the work is spread, whether this is only a part of it, and who is told of its progress. The part that finds that no frame
            is missing any more writes the times.

    Returns:
        What was written.

    Raises:
        ArgumentError: an argument is out of its range.
        DependencyError: a package of the extra `simulate` is missing. Nothing is written.
        ConflictError: `out` holds a capture with other settings, or one that `simulate` did not write.
        StorageError: `out` cannot be written to.
        CarlascError: a worker process died.
    """
    drive = SimulatedCapture(
        count=count, first_frame=first_frame, sensors=sensors, seed=seed, traffic=traffic, lidar=lidar, bev=bev
    )
    check_shared(os.fspath(out), run)
    settings = _SimulationSettings(seed, traffic, sensors, bev, lidar or Lidar())
    check_dependencies(bev)
    writer = CaptureWriter(out)
    writer.check_settings(SETTINGS_FILE, dataclasses.asdict(settings), "carlasc simulate")
    writer.write_settings(SETTINGS_FILE, dataclasses.asdict(settings))

    wanted = run.part.take(range(first_frame, first_frame + count))
    missing = [frame for frame in wanted if not writer.has_frame(frame, sensors, bev)]
    complete = set(wanted) - set(missing)
    progress = run.progress or (lambda done, total: None)
    progress(len(complete), len(wanted))
    points: Counter[str] = Counter()
    recorded = run_all(partial(_record_frame, writer, drive), missing, run)
    with TimesLog(writer) as log:

        def note(frame: int) -> None:
            if run.part.count == 1:  # several parts that wrote one file would overwrite each other's lines
                log.add(frame, [frame * FRAME_PERIOD_S] * sensors)

        for frame in sorted(complete - writer.timed_frames(sensors)):  # a run was killed before it wrote their times
            note(frame)
        for done, (frame, points_of_frame) in enumerate(zip(missing, recorded, strict=True), len(complete) + 1):
            points.update(points_of_frame)
            note(frame)
            progress(done, len(wanted))
    if run.part.count > 1:
        _write_times_of_all(writer, range(first_frame, first_frame + count), sensors, bev)
    classes = {name: points[name] for name in CARLA.names.values() if points[name]}
    return SimulationResult(writer.out, len(wanted), len(missing), sensors, points.total(), classes)


def _write_times_of_all(writer: CaptureWriter, frames: range, sensors: int, bev: bool) -> None:
    """Write the times of all frames if all exist."""
    writer.target.tree.refresh()
    if all(writer.has_frame(frame, sensors, bev) for frame in frames):
        with TimesLog(writer) as log:
            for frame in sorted(set(frames) - writer.timed_frames(sensors)):
                log.add(frame, [frame * FRAME_PERIOD_S] * sensors)


def check_dependencies(bev: bool = True) -> None:
    """Check that the packages exist that a simulation needs.

    Args:
        bev: whether bird's-eye pictures are drawn.

    Raises:
        DependencyError: a package of the extra `simulate` is missing.
    """
    modules = ("trimesh.creation", "embreex.rtcore_scene", "embreex.mesh_construction")
    for module in (*modules, "PIL.Image") if bev else modules:
        import_extra(module, "simulate")


def _record_frame(writer: CaptureWriter, drive: SimulatedCapture, frame: int) -> dict[str, int]:
    """Write the recordings of all sensors and the picture of a frame. Return the number of points per class name."""
    points = np.zeros(CARLA.num_channels, np.int64)
    for sensor in drive.sensors:
        recording = drive.read(sensor, frame)
        if recording.scan.labels is not None:
            points += np.bincount(recording.scan.labels, minlength=len(points))
        writer.write(sensor, frame, recording)
    if (picture := drive.read_bev(frame)) is not None:
        writer.write_bev(frame, picture)
    return {CARLA.names[label]: int(number) for label, number in enumerate(points) if number}
