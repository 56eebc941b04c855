"""Captures that a simulator computes when they are read, and `simulate`, which writes one.

See the format page, `docs/format.md#raw-capture`.
"""

from __future__ import annotations

import dataclasses
import os
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, ClassVar

import numpy as np

from carlasc.captures.raw import Capture, SensorRecording
from carlasc.captures.recorders import load_recorder
from carlasc.captures.settings import Lidar, LidarEffects, TrafficLevel, check_at_least
from carlasc.captures.writing import CaptureWriter, TimesLog
from carlasc.core.arrays import FloatArray, IntArray, Uint8Array
from carlasc.core.cameras import CameraModel
from carlasc.core.geometry import Transform
from carlasc.core.tables import CARLA
from carlasc.errors import ArgumentError, MissingDataError, check_choice, check_types
from carlasc.running.processes import run_all
from carlasc.running.spreading import Run, StepCounter, check_shared
from carlasc.storage.camera_files import cameras_to_json
from carlasc.storage.files import AnyPath
from carlasc.storage.layout import CAMERAS, FRAME_PERIOD_S

SETTINGS_FILE = "simulation.json"
TOWN = "town"
"""Name of the recorder of `simulate` unless another is named."""


class Simulator(Capture, ABC):
    """A simulated drive: a capture that is computed when it is read, so that `carlasc.regrid` makes
    ground truth of it without a capture on disk.

    A simulator inherits this class, and is named in the entry-point group `carlasc.recorders`. It
    has `read`, `read_pose` and `read_velocities`; also `read_bev`, `has_bev`, `make_cameras`,
    `image_fields` and `read_images` if it draws pictures. It can be pickled, and returns the same
    values in every process.

    Attributes:
        location: name of the capture in errors.
        classes: class table of the labels.
        seed: seed of all random choices.
        traffic: "light", "medium" or "heavy".
        lidar: model of the LiDARs.
        effects: how the scans of the ego sensor differ from an ideal LiDAR's.
        bev: whether bird's-eye pictures are drawn.
    """

    recipe: ClassVar[int] = 1
    """Version of the simulator. It increases when the same seed gives other data, because their
    frames must not be mixed in one capture.
    """

    is_simulated = True

    def __init__(
        self,
        *,
        count: int = 20,
        first_frame: int = 0,
        sensors: int = 20,
        seed: int = 0,
        traffic: TrafficLevel = "medium",
        lidar: Lidar | None = None,
        bev: bool = True,
        cameras: Sequence[str] = (),
        effects: LidarEffects = LidarEffects(),  # noqa: B008 (frozen)
    ) -> None:
        """Keep the settings of a simulation. The arguments are those of `carlasc.simulate`, and
        `effects`, which only scans have that come with ground truth: a capture is ideal.

        Raises:
            ArgumentError: an argument is out of its range.
        """
        check_at_least(1, count=count, sensors=sensors)
        check_at_least(0, first_frame=first_frame, seed=seed)
        check_choice("traffic", traffic, TrafficLevel)
        self.location = f"the simulated drive of seed {seed}"
        self.classes = CARLA
        self._frames = range(first_frame, first_frame + count)
        self._sensors = sensors
        self.seed = seed
        self.traffic = traffic
        self.lidar = lidar or Lidar()
        self.bev = bev
        self.cameras = {camera.name: camera for camera in self.make_cameras(cameras)}
        if effects != LidarEffects() and type(self).read_scan is Capture.read_scan:
            raise ArgumentError("effects", expected="none: its scans are ideal", found=effects)
        self.effects = effects

    @abstractmethod
    def read(self, sensor: int, frame: int) -> SensorRecording:
        """Simulate the recording of a sensor in a frame."""

    @abstractmethod
    def read_pose(self, sensor: int, frame: int) -> Transform:
        """Return the (4, 4) float64 world_T_sensor of a frame."""

    @abstractmethod
    def read_velocities(self, frame: int) -> dict[int, FloatArray]:
        """Return the (3,) velocity over ground, m/s, world frame, of each actor in a frame."""

    def make_cameras(self, names: Sequence[str]) -> tuple[CameraModel, ...]:
        """Return the cameras with some names, in the frame of the ego sensor.

        Raises:
            ArgumentError: the simulator has no such camera.
        """
        if names:
            raise ArgumentError("cameras", expected="none: it has no cameras", found=names)
        return ()

    def check_packages(self) -> None:
        """Check that the packages for the simulation are installed, before anything is written.

        Raises:
            DependencyError: a package is missing.
        """

    @property
    def settings(self) -> dict[str, Any]:
        """What the data of each frame depend on, as JSON values."""
        return {
            **{"seed": self.seed, "traffic": self.traffic, "sensors": self._sensors},
            **{"bev": self.bev, "lidar": dataclasses.asdict(self.lidar), "recipe": self.recipe},
            **({"cameras": list(self.cameras)} if self.cameras else {}),
            **({"effects": vars(self.effects)} if self.effects != LidarEffects() else {}),
        }

    @cached_property
    def sensors(self) -> tuple[int, ...]:
        """The numbers of the sensors."""
        return tuple(range(self._sensors))

    @cached_property
    def frames(self) -> IntArray:
        """The frame numbers."""
        return np.array(self._frames, np.int64)

    def read_poses(self, sensor: int, frames: Iterable[int]) -> FloatArray:
        """Return (F, 4, 4) world_T_sensor of several frames."""
        return np.stack([self.read_pose(sensor, frame) for frame in frames])

    def read_times(self, sensor: int = 0) -> Mapping[int, float]:
        """Return the simulation time by frame number, seconds."""
        return {frame: frame * FRAME_PERIOD_S for frame in self._frames}

    def read_bev(self, frame: int) -> bytes | None:
        """Return the bird's-eye picture of a frame as JPEG bytes; None without pictures."""
        return None

    def has_bev(self, frame: int) -> bool:
        """Whether a frame has a bird's-eye picture."""
        return False

    def image_fields(self, frame: int) -> tuple[str, ...]:
        """Return the layout names of the images of a frame."""
        return ()

    def read_images(self, frame: int) -> dict[str, Uint8Array]:
        """Return the image files of a frame as bytes, by their layout names."""
        return {}

    def light(self) -> Capture:
        """Return the capture itself, which has only settings."""
        return self

    def check_frame(self, frame: int) -> None:
        """Check that a frame belongs to the drive.

        Raises:
            MissingDataError: it does not.
        """
        if frame not in self._frames:
            others = f"frames {self._frames.start} to {self._frames.stop - 1}"
            raise MissingDataError(self.location, expected=f"frame {frame}", found=others)


@dataclass(frozen=True)
class SimulationResult:
    """Result of `simulate`.

    Attributes:
        out: folder of the sequence, which holds raw/, or its URL.
        count: number of the requested frames that exist now.
        written: number of frames that this run wrote; other frames existed.
        sensors: number of sensors.
        points: number of points that this run wrote.
        classes: number of these points by class name.
    """

    out: str
    count: int
    written: int
    sensors: int
    points: int
    classes: dict[str, int]


def simulate(
    out: AnyPath,
    *,
    simulator: str = TOWN,
    count: int = 20,
    first_frame: int = 0,
    sensors: int = 20,
    seed: int = 0,
    traffic: TrafficLevel = "medium",
    lidar: Lidar | None = None,
    bev: bool = True,
    cameras: Sequence[str] = (),
    run: Run = Run(),  # noqa: B008 (frozen)
) -> SimulationResult:
    """Record a simulated drive as a raw capture.

    The same arguments write the same bytes.

    A second run with the same settings writes the missing frames. It continues an interrupted run,
    or adds frames.

    Args:
        out: folder of the sequence, or its URL in an object store. Files go to `<out>/raw`.
        simulator: name of an installed simulator: "town", or one of another distribution.
        count: number of frames, 0.1 s apart.
        first_frame: number of the first frame. The drive starts at rest in frame 0.
        sensors: number of LiDARs. The first is the ego sensor.
        seed: seed of all random choices: the town, its traffic, the offsets of the sensors, and the
            noise.
        traffic: amount of traffic: "light", "medium" or "heavy", which are 25, 50 or 100 moving
            vehicles, and as many pedestrians.
        lidar: model of the LiDARs. None: the data set's.
        bev: write bird's-eye-view pictures.
        cameras: names of the cameras on the roof of the vehicle, from "front", "front_left",
            "front_right", "left", "right", "back_left", "back_right" and "back". Each has images of
            colour, class, instance and depth; see the format page, `docs/format.md#cameras`.
        run: how the work is distributed, the part of it, and the progress callback. The last part
            to finish writes the times.

    Returns:
        Numbers of the written frames, sensors and points.

    Raises:
        ArgumentError: an argument is out of its range, or no simulator has that name.
        DependencyError: a package that the simulator needs is missing. Nothing is written.
        ConflictError: `out` holds a capture with other settings, or one that `simulate` did not
            write.
        StorageError: `out` cannot be written to.
        CarlascError: a worker process died.
    """
    check_types(simulate, locals())
    drive: Simulator = load_recorder(simulator, Simulator)(
        count=count,
        first_frame=first_frame,
        sensors=sensors,
        seed=seed,
        traffic=traffic,
        lidar=lidar,
        bev=bev,
        cameras=cameras,
    )
    check_shared(os.fspath(out), run)
    settings = drive.settings | ({"simulator": simulator} if simulator != TOWN else {})
    drive.check_packages()
    writer = CaptureWriter(out)
    writer.check_settings(SETTINGS_FILE, settings, "carlasc simulate")
    writer.write_settings(SETTINGS_FILE, settings)
    if cameras:
        writer.target.put(CAMERAS, cameras_to_json(drive.cameras.values()))

    def exists(frame: int) -> bool:
        pictures = drive.has_bev(frame), drive.image_fields(frame)
        return writer.has_frame(frame, sensors, *pictures)

    frames = range(first_frame, first_frame + count)
    wanted = run.part.take(frames)
    missing = [frame for frame in wanted if not exists(frame)]
    complete = set(wanted) - set(missing)
    step = StepCounter(run.progress, len(wanted), len(complete))
    step(0)
    points: Counter[str] = Counter()
    recorded = run_all(partial(_write_frame, writer, drive), missing, run)
    with TimesLog(writer) as log:

        def note(frame: int) -> None:
            if run.part.count == 1:  # several parts would overwrite the lines of each other
                log.add(frame, [frame * FRAME_PERIOD_S] * sensors)

        # frames whose times a killed run did not write
        for frame in sorted(complete - writer.timed_frames(sensors)):
            note(frame)
        for frame, points_of_frame in zip(missing, recorded, strict=True):
            points.update(points_of_frame)
            note(frame)
            step()
    if run.part.count > 1:
        writer.target.tree.refresh()
        if all(map(exists, frames)):
            untimed = set(frames) - writer.timed_frames(sensors)
            writer.write_times({frame: [frame * FRAME_PERIOD_S] * sensors for frame in untimed})
    classes = {name: points[name] for name in CARLA.names.values() if points[name]}
    return SimulationResult(writer.out, len(wanted), len(missing), sensors, points.total(), classes)


def _write_frame(writer: CaptureWriter, drive: Simulator, frame: int) -> dict[str, int]:
    """Write the recordings of all sensors and the pictures of a frame, and return the number of
    points by class name.
    """
    points = np.zeros(CARLA.num_channels, np.int64)
    for sensor in drive.sensors:
        recording = drive.read(sensor, frame)
        if recording.scan.labels is not None:
            points += np.bincount(recording.scan.labels, minlength=len(points))
        writer.write(sensor, frame, recording)
    if (picture := drive.read_bev(frame)) is not None:
        writer.write_bev(frame, picture)
    writer.write_images(frame, drive.read_images(frame))
    return {CARLA.names[label]: int(number) for label, number in enumerate(points) if number}
