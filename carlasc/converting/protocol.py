"""The protocol of converters: a converter finds the recordings of another data set and reads their frames. It uses no store.

Another distribution adds a converter by a class that inherits `Converter` and an entry point:

    [project.entry-points."carlasc.converters"]
    name = "package.module:Class"

A converter gives everything as the other data set has it: in right-handed axes (y to the left) and with its class ids. Mirroring,
remapping, poses from scans, flow and grids are the same for all converters, and `carlasc.convert` does them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from carlasc import storage
from carlasc.core.boxes import Boxes
from carlasc.core.classes import ClassTable, Remap
from carlasc.core.grids import GridSpec

Split = Literal["Train", "Val", "Test"]


@dataclass(frozen=True)
class FrameContent:
    """The content of one frame of another data set.

    Attributes:
        points: (N, 4) float32: x, y, z in metres, right-handed sensor frame, and remission.
        labels: (N,) class ids of the data set, 0 unlabelled; None if the frame has no labels.
        instances: (N,) uint32 number of each point's actor, 0 for none. An actor has the same number in all frames of the
            recording, whether it moves or not. None if the frame has no instances.
        others: further fields of the layout with a row per point, by name; vectors right-handed. They are written as they are.
        boxes: tracked boxes with class ids of the data set, right-handed sensor frame; tracks have the numbers of `instances` where
            the frame has both. None if the frame was not annotated.
    """

    points: NDArray[np.float32]
    labels: NDArray[np.unsignedinteger] | None = None
    instances: NDArray[np.uint32] | None = None
    others: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    boxes: Boxes | None = None


@dataclass(frozen=True)
class VoxelContent:
    """A frame's voxel grid in another data set.

    Attributes:
        labels: (X, Y, Z) class ids of the data set.
        known: (X, Y, Z) bool, voxels that take part in an evaluation.
        files: the original files by name. They are kept beside the grid, so that an export gives them back.
    """

    labels: NDArray[np.unsignedinteger]
    known: NDArray[np.bool_]
    files: Mapping[str, bytes]


class FrameHandle(ABC):
    """One frame. It holds paths and numbers only, so that it can be pickled into a worker and read there.

    Attributes:
        number: the frame's number, from 0. Line `number` of poses and times belongs to this frame.
        location: the name of the frame in error messages: the file of its points.
    """

    number: int
    location: str

    @abstractmethod
    def read(self) -> FrameContent:
        """Read points, labels and instances.

        Raises:
            MissingDataError: a file does not exist.
            FormatError: a file does not hold what it must.
        """

    def read_labels(self) -> tuple[NDArray[np.unsignedinteger] | None, NDArray[np.uint32] | None]:
        """Read only labels and instances. Override it where they have files of their own, which is faster."""
        content = self.read()
        return content.labels, content.instances

    def read_voxels(self) -> VoxelContent | None:
        """Read the frame's voxel grid; None if it has none."""
        return None


class Recording(ABC):
    """One sequence of another data set.

    Attributes:
        name: name of the sequence in the layout, such as "KITTI_00".
        split: the split that it belongs to.
        location: its name in error messages.
        frames: its frames, by increasing number.
        has_labels: whether frames have labels and instances.
    """

    name: str
    split: Split
    location: str
    frames: Sequence[FrameHandle]
    has_labels: bool

    @abstractmethod
    def poses(self, *, force: bool = False) -> NDArray[np.float64] | None:
        """Return (F, 4, 4) world_T_sensor by frame number, right-handed; None if the recording has no poses.

        Args:
            force: continue without a calibration that the poses need.

        Raises:
            FormatError: a file does not hold what it must.
            MissingDataError: a file without which the poses cannot be used does not exist.
        """

    def times(self) -> NDArray[np.float64] | None:
        """Return (F,) seconds by frame number; None if the recording has no times."""
        return None

    def problems(self) -> list[tuple[int, str]]:
        """Return (frame number, message in one line) of frames that should exist and do not."""
        return []


class Exporter(ABC):
    """Makes another data set's files from a sequence of the layout. It returns their bytes, and `carlasc.export` writes them."""

    @abstractmethod
    def folders(self, names: Sequence[str]) -> dict[str, str]:
        """Return the folder of each sequence, by the sequence's name, relative to the root of the data set."""

    @abstractmethod
    def documents(self, sequence: storage.Sequence) -> dict[str, bytes]:
        """Return the files that a sequence has once, by their path in its folder."""

    @abstractmethod
    def frame_files(self, sequence: storage.Sequence, frame: int) -> tuple[str, ...]:
        """Return the paths of the files that `make_frame` gives."""

    @abstractmethod
    def make_frame(self, sequence: storage.Sequence, frame: int) -> dict[str, bytes | memoryview]:
        """Return a frame's files, by their path in the sequence's folder.

        Raises:
            CarlascError: the frame cannot be read, or cannot be expressed in the other format.
        """


class Converter(ABC):
    """Finds the recordings of one kind of data set.

    Attributes:
        source: folder of the data set, or of one of its sequences.
        title: what it reads, in a few words.
        classes: the data set's class table.
        to_carla: maps its ids to CarlaSC's.
        sensor: the sensor that took the scans.
        min_range_m: nearer points are left out of grids: they belong to the vehicle that carries the sensor.
        max_range_m: farther points are left out of grids: they are too sparse to tell free space from occupied space.
        voxels: geometry of the data set's own voxel grids, right-handed; None if it has none.
    """

    title: ClassVar[str]
    classes: ClassVar[ClassTable]
    to_carla: ClassVar[Remap]
    sensor: ClassVar[str | None] = None
    min_range_m: ClassVar[float | None] = None
    max_range_m: ClassVar[float | None] = None
    voxels: ClassVar[GridSpec | None] = None

    def __init__(self, source: Path) -> None:
        """Remember where the data set is."""
        self.source = source

    @abstractmethod
    def sequences(self) -> list[Recording]:
        """Return the recordings.

        Raises:
            MissingDataError: none exists; says what was looked for.
        """

    @classmethod
    def exporter(cls, **options: Any) -> Exporter | None:
        """Return the exporter that writes the data set's own format; None if it can only be read."""
        return None
