"""The protocol of converters: a converter finds the recordings of another data set and reads their
frames. It uses no store.

Another distribution adds a converter by a class that inherits `Converter` and an entry point:

    [project.entry-points."carlasc.converters"]
    name = "package.module:Class"

A converter returns the data of the other data set in right-handed axes (x forward, y to the left, z
up), with its own class ids. Missing data are None or empty. `carlasc.convert` does the rest, in the
same way for all converters: mirroring, remapping, poses from scans, deskewing, labels and flow from
boxes, and grids.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from carlasc.core.arrays import (
    AnyArray,
    AnyFloatArray,
    BoolArray,
    Float32Array,
    FloatArray,
    LabelArray,
    Uint32Array,
)
from carlasc.core.boxes import Boxes
from carlasc.core.cameras import CameraModel
from carlasc.core.classes import ClassTable, Remap
from carlasc.core.frames import check_seconds
from carlasc.core.geometry import Transform, check_rigid, slerp
from carlasc.core.grids import GridSpec
from carlasc.errors import ConflictError, FormatError

Split = Literal["Train", "Val", "Test"]


@dataclass(frozen=True)
class Sensor:
    """A LiDAR of a recording, and the frame and the state of its points.

    Attributes:
        name: its name in the data set.
        vehicle_T_sensor: (4, 4) float64 pose of the sensor in the frame of the vehicle.
        points_in: "sensor" if its points are given in its own frame, "vehicle" if in that of the
            vehicle.
        deskewed: whether points are already corrected for the motion of the vehicle, to the time of
            the frame. If not, clouds with `seconds` are corrected.
        height_m: height of the sensor above the ground; None if it is not known.
        calibrated: whether `vehicle_T_sensor` is known. If not, it is an assumption: the identity,
            or what `Recording.notes` says.
    """

    name: str = "lidar"
    vehicle_T_sensor: Transform = field(default_factory=lambda: np.eye(4))
    points_in: Literal["sensor", "vehicle"] = "sensor"
    deskewed: bool = True
    height_m: float | None = None
    calibrated: bool = True

    def __post_init__(self) -> None:
        check_rigid(self.vehicle_T_sensor, f"sensor {self.name}")

    @property
    def vehicle_T_points(self) -> Transform:
        """(4, 4) from the frame of the points to that of the vehicle."""
        return self.vehicle_T_sensor if self.points_in == "sensor" else np.eye(4)

    @property
    def origin(self) -> FloatArray:
        """(3,) position of the sensor in the frame of the points, metres."""
        return np.zeros(3) if self.points_in == "sensor" else self.vehicle_T_sensor[:3, 3]


@dataclass(frozen=True)
class Cloud:
    """The points that one sensor took for a frame.

    Attributes:
        points: (N, 4) float32: x, y, z in metres, right-handed, in the frame that the sensor says,
            and remission. (N, 3) points get a remission of 0.
        labels: (N,) class ids of the data set, 0 unlabelled; None if the points have no labels.
        instances: (N,) uint32 number of each point's actor, 0 for none. An actor has the same
            number in all frames of the recording, whether it moves or not, and in its boxes. None
            if the points have no instances.
        seconds: (N,) time of each point after the time of the frame; None if it is unknown.
        origins: (N, 3) float32 origin of the ray of each point, metres, in the frame of the points;
            None: at the sensor.
        others: other fields of the layout with a row per point, by name; vectors right-handed, in
            the frame of the points.
        sensor: index of the sensor in `Recording.sensors`.
    """

    points: Float32Array
    labels: LabelArray | None = None
    instances: Uint32Array | None = None
    seconds: AnyFloatArray | None = None
    origins: Float32Array | None = None
    others: Mapping[str, AnyArray] = field(default_factory=dict)
    sensor: int = 0

    def __post_init__(self) -> None:
        if self.points.ndim == 2 and self.points.shape[1] == 3:
            remission = np.zeros((len(self.points), 1), self.points.dtype)
            object.__setattr__(self, "points", np.concatenate([self.points, remission], axis=1))


@dataclass(frozen=True)
class VoxelContent:
    """A frame's voxel grid in another data set.

    Attributes:
        labels: (X, Y, Z) class ids of the data set.
        known: (X, Y, Z) bool, voxels that take part in an evaluation.
        files: the original files by name. They are kept beside the grid, so that an export can
            write them again.
    """

    labels: LabelArray
    known: BoolArray
    files: Mapping[str, bytes] = field(default_factory=dict)


@dataclass(frozen=True)
class Trajectory:
    """The poses of the vehicle over time.

    Attributes:
        world_T_vehicle: (K, 4, 4) float64, right-handed.
        seconds: (K,) time of each pose, increasing, by the clock of `Recording.times`; None if pose
            i is that of frame i.
        where: the file of the poses, for errors.
        other: (K, 4, 4) the poses if the file has w first in quaternions, which is tried if scans
            do not overlap; None if the order is certain.

    Raises:
        FormatError: shapes do not match, a pose is not rigid, times do not increase, or a time is
            not finite.
    """

    world_T_vehicle: FloatArray
    seconds: FloatArray | None = None
    where: str = "poses"
    other: FloatArray | None = None

    def __post_init__(self) -> None:
        check_rigid(self.world_T_vehicle, self.where)
        if self.seconds is not None and len(self.seconds) != len(self.world_T_vehicle):
            raise FormatError(
                self.where,
                expected=f"a time for each of {len(self.world_T_vehicle)}",
                found=f"{len(self.seconds)} times",
            )
        if self.seconds is not None and not (np.diff(self.seconds) > 0).all():
            row = int(np.argmin(np.diff(self.seconds))) + 1
            raise FormatError(
                self.where, expected="times that increase", found=f"none at pose {row}"
            )
        if self.seconds is not None:
            check_seconds(self.seconds, self.where)

    def at(self, seconds: AnyFloatArray) -> FloatArray:
        """Return (..., 4, 4) world_T_vehicle at some times (...,), by the clock of `seconds`, which
        must be known.

        Between two poses, positions are interpolated linearly and rotations by slerp. Before the
        first and after the last pose, the nearest motion goes on.
        """
        assert self.seconds is not None
        return slerp(self.world_T_vehicle, self.seconds, seconds)


class FrameHandle(ABC):
    """One frame. It holds only paths and numbers, so that a worker can unpickle and read it.

    Attributes:
        number: number of the frame, from 0: its row in the times, and in poses without times.
        location: the file of its points, for errors.
        labelled: whether its points have labels, if the recording has labels at all.
    """

    number: int
    location: str
    labelled: bool = True

    @abstractmethod
    def read(self) -> Sequence[Cloud]:
        """Read the points of each sensor. A conversion reads a frame once.

        Raises:
            MissingDataError: a file does not exist.
            FormatError: a file does not have the format.
        """

    def read_voxels(self) -> VoxelContent | None:
        """Read the frame's voxel grid; None if it has none."""
        return None


class Recording(ABC):
    """One sequence of another data set.

    The frame of its vehicle has x forward, y to the left and z up. A scan in the layout has the
    same axes, with its origin at the first sensor.

    Attributes:
        name: name of the sequence in the layout, such as "KITTI_00".
        split: the split that it belongs to.
        location: its name in errors.
        frames: its frames, by increasing number.
        sensors: its LiDARs; the first is the origin of scans.
        has_labels: whether points of some frames have labels.
        has_instances: whether points of some frames have instances.
        voxels: geometry of its own voxel grids, right-handed, in the frame of scans; None if it has
            none.
        rays: whether the position of the sensor is known for each point, so that the space between
            the two is free. Without rays, no grids are made from the scans.
    """

    name: str
    split: Split
    location: str
    frames: Sequence[FrameHandle]
    sensors: Sequence[Sensor] = (Sensor(),)
    has_labels: bool = False
    has_instances: bool = False
    voxels: GridSpec | None = None
    rays: bool = True

    def poses(self, *, force: bool = False) -> Trajectory | None:
        """Return the poses of the vehicle; None if the recording has none.

        Args:
            force: continue without a calibration that the poses need.

        Raises:
            FormatError: a file does not have the format.
            MissingDataError: a file that the poses need does not exist.
        """
        return None

    def times(self) -> FloatArray | None:
        """Return (F,) seconds by frame number; None if the recording has no times.

        Missing frames may have any time.
        """
        return None

    def boxes(self) -> Mapping[int, Boxes] | None:
        """Return the tracked boxes of each annotated frame, by number, in the frame of the vehicle;
        None if the data set has none.

        Labels are class ids of the data set. A frame without an entry was not annotated. A frame
        with an entry but no boxes was annotated and contains no object.

        Raises:
            FormatError: a file does not have the format.
        """
        return None

    def cameras(self) -> Sequence[CameraModel]:
        """Return the cameras; empty if the recording has none, or if their calibration does not
        exist.

        Their `sensor_T_camera` maps to the frame of the vehicle. `times` are by the clock of
        `times()`, a row per frame number, and `images` are paths.

        Raises:
            FormatError: a file does not have the format.
        """
        return ()

    def image(self, camera: CameraModel, frame: int) -> tuple[str, bytes] | None:
        """Return an image of a camera: the ending of its file, "jpg" or "png", and its bytes; None
        if it does not exist.

        By default, it is the file that `images` of the camera names.
        """
        path = Path(camera.images[frame] if camera.images else "")
        return (
            (path.suffix[1:], path.read_bytes())
            if path.suffix in (".jpg", ".png") and path.is_file()
            else None
        )

    def problems(self) -> list[tuple[int, str]]:
        """Return (frame number, message in one line) of each frame that is missing."""
        return []

    def notes(self) -> list[str]:
        """Return notes for the user, one line each, such as what is missing and what was assumed
        instead.
        """
        return []

    @property
    def frame_numbers(self) -> list[int]:
        """The numbers of the frames, in their order."""
        return [handle.number for handle in self.frames]

    @cached_property
    def vehicle_T_scan(self) -> Transform:
        """(4, 4), from the frame of the scans in the layout to that of the vehicle: the axes are
        the same.
        """
        transform = np.eye(4)
        transform[:3, 3] = self.sensors[0].vehicle_T_sensor[:3, 3]
        return transform


class Converter(ABC):
    """Finds the recordings of one kind of data set.

    Options are keyword parameters of the constructor, each with its type, its default and its help:
    `sweeps: Annotated[bool, "Read all scans, not only key frames."] = True`. `carlasc convert NAME
    --help` shows them.

    All attributes except `title` and `endings` may be set in the constructor, if they depend on
    options.

    Attributes:
        source: folder of the data set, or of one of its sequences.
        title: what it reads, in a few words.
        endings: of the names of files that are a recording; empty if recordings are folders.
        classes: the data set's class table.
        to_carla: maps its ids to CarlaSC's; None if no map exists, or if they are CarlaSC's
            already. Sequences then keep their ids.
        keeps_classes: whether sequences keep the data set's ids by default.
        sensor: the sensor that took the scans.
        min_range_m: nearer points are left out of grids, because they belong to the recording
            vehicle.
        max_range_m: farther points are left out of grids, because they are too sparse.
        license: licence of the data and of what is made from them, such as "CC BY-NC-SA 4.0"; None
            if it is not known.
        citation: the publication to cite, in one line; None if it is not known.
        simulated: whether the data were recorded in a simulator.
    """

    title: ClassVar[str]
    endings: ClassVar[tuple[str, ...]] = ()
    classes: ClassTable
    to_carla: Remap | None
    keeps_classes: bool = False
    sensor: str | None = None
    min_range_m: float | None = None
    max_range_m: float | None = None
    license: str | None = None
    citation: str | None = None
    simulated: bool = False

    def __init__(self, source: Path) -> None:
        self.source = source

    @abstractmethod
    def sequences(self) -> list[Recording]:
        """Return the recordings.

        Raises:
            MissingDataError: none exists; the message names the expected files.
        """


@dataclass(frozen=True)
class Failure:
    """A frame that could not be converted or exported.

    Attributes:
        sequence: location of its sequence in the source.
        frame: its number.
        message: the error, in one line.
        waits: whether it only waits for another frame, which failed.
    """

    sequence: str
    frame: int
    message: str
    waits: bool = False


def check_outside(out: Path, source: str) -> None:
    """Check that a folder to write to is neither the source nor inside it.

    A URL is never the same place.

    Raises:
        ConflictError: the folder is the source, or inside it.
    """
    if out.resolve().is_relative_to(Path(source).resolve()):
        raise ConflictError(
            out,
            expected=f"a place outside {source}",
            found="one inside it",
            advice="choose another place, because the source is never written to",
        )
