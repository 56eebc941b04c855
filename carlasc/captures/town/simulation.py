"""A drive through the simulated town: a capture that is computed on reading, and `simulate`, which
writes it.

See the format page, `docs/format.md#raw-capture`.
"""

from __future__ import annotations

import dataclasses
import io
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from carlasc.captures.raw import Capture, SensorRecording
from carlasc.captures.settings import (
    BEV_HEIGHT_M,
    BEV_QUALITY,
    BEV_SIZE,
    Lidar,
    TrafficLevel,
    check_at_least,
)
from carlasc.captures.town.drive import Snapshot, TownDrive
from carlasc.captures.town.photographs import photo_fields, photograph, town_cameras
from carlasc.captures.writing import CaptureWriter, TimesLog
from carlasc.core.geometry import Transform, rotate_vectors
from carlasc.core.tables import CARLA
from carlasc.errors import MissingDataError, check_choice, import_extra
from carlasc.running.processes import run_all
from carlasc.running.spreading import Run, StepCounter
from carlasc.storage.camera_files import cameras_to_json
from carlasc.storage.layout import CAMERAS, FRAME_PERIOD_S
from carlasc.storage.transport.targets import check_shared

_SUN = np.array([0.35, -0.45, 0.82])  # direction towards the sun
_BACKGROUND = (255, 255, 255)
_REDUCTION = (
    2  # rays are cast for every second row and column of pixels; the picture is enlarged afterwards
)


def render_birdseye(snapshot: Snapshot) -> bytes:
    """Return the bird's-eye picture as JPEG bytes: 1920 x 1080 pixels, 90 degrees wide, with its
    upper edge ahead of the vehicle.

    Raises:
        DependencyError: a package of the extra `simulate` is missing.
    """
    pixels = _render(snapshot, snapshot.world_T_ego, (0.0, 0.0, BEV_HEIGHT_M), _downward_rays())
    image = import_extra("PIL.Image", "simulate")
    picture = image.fromarray(pixels).resize(BEV_SIZE, image.Resampling.BICUBIC)
    buffer = io.BytesIO()
    picture.save(buffer, "JPEG", quality=BEV_QUALITY)
    return buffer.getvalue()


def _render(
    snapshot: Snapshot,
    world_T_view: Transform,
    origin: tuple[float, float, float],
    directions: NDArray[np.float64],
) -> NDArray[np.uint8]:
    """Return a picture of the surfaces that rays hit.

    Args:
        snapshot: the town.
        world_T_view: (4, 4) from the frame of `origin` and `directions` to the world frame.
        origin: (3,) start of the rays, metres.
        directions: (H, W, 3) unit vectors, one per pixel.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    height, width, _ = directions.shape
    rays = rotate_vectors(world_T_view, directions.reshape(-1, 3))
    eye = world_T_view[:3, :3] @ np.array(origin) + world_T_view[:3, 3]
    hit, triangles, _ = snapshot.scene.cast(eye, rays, 1000.0)
    normals = snapshot.scene.normals(triangles)
    normals *= -np.sign(np.einsum("ri,ri->r", normals, rays[hit]))[:, None]  # towards the camera
    light = 0.55 + 0.45 * np.clip(normals @ (_SUN / np.linalg.norm(_SUN)), 0, 1)
    pixels = np.full((height * width, 3), _BACKGROUND, np.uint8)
    pixels[hit] = CARLA.palette[snapshot.mesh.labels[triangles]] * light[:, None]
    return pixels.reshape(height, width, 3)


def _downward_rays() -> NDArray[np.float64]:
    """Return (H, W, 3) rays of a camera that looks down.

    Its upper edge is ahead, its right edge on the right.
    """
    width, height = BEV_SIZE[0] // _REDUCTION, BEV_SIZE[1] // _REDUCTION
    right = (np.arange(width) + 0.5 - width / 2) / (width / 2)
    ahead = -(np.arange(height) + 0.5 - height / 2) / (width / 2)
    rays = np.stack(np.broadcast_arrays(ahead[:, None], right[None, :], -1.0), axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


class SimulatedCapture(Capture):
    """A drive through the simulated town, to make ground truth with `carlasc.regrid` without a
    capture on disk.

    Its data are equal to the output of `carlasc.simulate` with the same settings. It can be
    pickled.

    Attributes:
        location: name of the capture in errors.
        classes: class table of the labels.
    """

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
    ) -> None:
        """Keep the settings of a simulation. The arguments are those of `carlasc.simulate`.

        Raises:
            ArgumentError: an argument is out of its range.
        """
        check_at_least(1, count=count, sensors=sensors)
        check_at_least(0, first_frame=first_frame, seed=seed)
        check_choice("traffic", traffic, TrafficLevel)
        self.location, self.classes = f"the simulated town of seed {seed}", CARLA
        self._frames, self._count = range(first_frame, first_frame + count), sensors
        self._drive_of, self._bev = (seed, traffic, lidar or Lidar()), bev
        self.cameras = {camera.name: camera for camera in town_cameras(cameras)}

    @cached_property
    def sensors(self) -> tuple[int, ...]:
        """The numbers of the sensors."""
        return tuple(range(self._count))

    @cached_property
    def frames(self) -> NDArray[np.int64]:
        """The frame numbers."""
        return np.array(self._frames, np.int64)

    def read(self, sensor: int, frame: int) -> SensorRecording:
        """Simulate the recording of a sensor in a frame."""
        self._check(frame)
        return self._drive.record(frame, sensor)

    def read_velocities(self, frame: int) -> dict[int, NDArray[np.float64]]:
        """Return the (3,) velocity over ground, m/s, world frame, of each actor of the town in a
        frame.
        """
        self._check(frame)
        return {actor.id: actor.velocity for actor in self._drive.actors(frame)}

    def read_pose(self, sensor: int, frame: int) -> Transform:
        """Return the (4, 4) float64 world_T_sensor of a frame."""
        self._check(frame)
        return self._drive.sensor_poses(frame, sensor + 1)[sensor]

    def read_poses(self, sensor: int, frames: Iterable[int]) -> NDArray[np.float64]:
        """Return (F, 4, 4) world_T_sensor of several frames."""
        return np.stack([self.read_pose(sensor, frame) for frame in frames])

    def read_times(self, sensor: int = 0) -> Mapping[int, float]:
        """Return the simulation time by frame number, seconds."""
        return {frame: frame * FRAME_PERIOD_S for frame in self._frames}

    def read_bev(self, frame: int) -> bytes | None:
        """Return the bird's-eye picture of a frame as JPEG bytes; None without `bev`."""
        self._check(frame)
        return render_birdseye(self._drive.snapshot(frame)) if self._bev else None

    def has_bev(self, frame: int) -> bool:
        """Whether a frame has a bird's-eye picture."""
        return self._bev and frame in self._frames

    def image_fields(self, frame: int) -> tuple[str, ...]:
        """Return the layout names of the images of a frame."""
        return photo_fields(self.cameras.values())

    def read_images(self, frame: int) -> dict[str, NDArray[np.uint8]]:
        """Return the image files of a frame as bytes, by their layout names."""
        if not self.cameras:
            return {}
        return photograph(
            self._drive.snapshot(frame), tuple(self.cameras.values()), self.read_pose(0, frame)
        )

    def light(self) -> Capture:
        """Return the capture itself, which has only settings."""
        return self

    @property
    def _drive(self) -> TownDrive:
        return _cached_drive(*self._drive_of)

    def _check(self, frame: int) -> None:
        if frame not in self._frames:
            found = f"frames {self._frames.start} to {self._frames.stop - 1}"
            raise MissingDataError(self.location, expected=f"frame {frame}", found=found)


@lru_cache(maxsize=1)
def _cached_drive(seed: int, traffic: TrafficLevel, lidar: Lidar) -> TownDrive:
    """Return the drive of this process. The town is built once."""
    return TownDrive(seed, traffic, lidar)


SETTINGS_FILE = "simulation.json"

TOWN_VERSION = 1
"""Version of the simulation.

It increases when the same seed gives another town, because their frames must not be mixed in one
capture.
"""


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
    cameras: Sequence[str] = (),
    run: Run = Run(),  # noqa: B008 (frozen)
) -> SimulationResult:
    """Record a drive through a simulated town as a raw capture.

    The same arguments write the same bytes.

    A second run with the same settings writes the missing frames. It continues an interrupted run,
    or adds frames.

    Args:
        out: folder of the sequence, or its URL in an object store. Files go to `<out>/raw`.
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
        ArgumentError: an argument is out of its range.
        DependencyError: a package of the extra `simulate` is missing. Nothing is written.
        ConflictError: `out` holds a capture with other settings, or one that `simulate` did not
            write.
        StorageError: `out` cannot be written to.
        CarlascError: a worker process died.
    """
    drive = SimulatedCapture(
        count=count, first_frame=first_frame, sensors=sensors, seed=seed, traffic=traffic, lidar=lidar, bev=bev, cameras=cameras
    )  # fmt: skip
    check_shared(os.fspath(out), run)
    settings = dataclasses.asdict(
        _SimulationSettings(seed, traffic, sensors, bev, lidar or Lidar())
    )
    settings |= {"cameras": list(cameras)} if cameras else {}
    images = photo_fields(drive.cameras.values())
    check_dependencies(bev or bool(cameras))
    writer = CaptureWriter(out)
    writer.check_settings(SETTINGS_FILE, settings, "carlasc simulate")
    writer.write_settings(SETTINGS_FILE, settings)
    if cameras:
        writer.target.put(CAMERAS, cameras_to_json(drive.cameras.values()))

    wanted = run.part.take(range(first_frame, first_frame + count))
    missing = [frame for frame in wanted if not writer.has_frame(frame, sensors, bev, images)]
    complete = set(wanted) - set(missing)
    step = StepCounter(run.progress, len(wanted), len(complete))
    step(0)
    points: Counter[str] = Counter()
    recorded = run_all(partial(_record_frame, writer, drive), missing, run)
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
        frames = range(first_frame, first_frame + count)
        if all(writer.has_frame(frame, sensors, bev, images) for frame in frames):
            timed = writer.timed_frames(sensors)
            writer.write_times(
                {
                    frame: [frame * FRAME_PERIOD_S] * sensors
                    for frame in frames
                    if frame not in timed
                }
            )
    classes = {name: points[name] for name in CARLA.names.values() if points[name]}
    return SimulationResult(writer.out, len(wanted), len(missing), sensors, points.total(), classes)


def check_dependencies(bev: bool = True) -> None:
    """Check that the packages for a simulation are installed.

    Args:
        bev: whether bird's-eye pictures are drawn.

    Raises:
        DependencyError: a package of the extra `simulate` is missing.
    """
    modules = ("trimesh.creation", "embreex.rtcore_scene", "embreex.mesh_construction")
    for module in (*modules, "PIL.Image") if bev else modules:
        import_extra(module, "simulate")


def _record_frame(writer: CaptureWriter, drive: SimulatedCapture, frame: int) -> dict[str, int]:
    """Write the recordings of all sensors and the picture of a frame, and return the number of
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
    if drive.cameras:
        writer.write_images(frame, drive.read_images(frame))
    return {CARLA.names[label]: int(number) for label, number in enumerate(points) if number}
