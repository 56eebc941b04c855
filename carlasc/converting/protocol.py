"""What a converter is: it finds the recordings of another data set and reads their frames. It never touches a store.

A third party adds one by a class that inherits `Converter` and an entry point of its own distribution:

    [project.entry-points."carlasc.converters"]
    name = "package.module:Class"

Everything a converter gives is as the other data set has it: its axes (right-handed, y left), its class ids. Mirroring, remapping, poses from
scans, flow and grids are one for all of them: `carlasc.convert`.
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
from carlasc.core.classes import ClassTable, Remap
from carlasc.core.grids import GridSpec

Split = Literal["Train", "Val", "Test"]


@dataclass(frozen=True)
class FrameContent:
    """What one frame of another data set holds.

    Attributes:
        points: (N, 4) float32: x, y, z in metres, right-handed sensor frame, and remission.
        labels: (N,) class ids of the data set, 0 unlabelled; None where there are none.
        instances: (N,) uint32 actor of each point, 0 none, the same number for the same actor all over the recording, whether it
            moves or not; None where there are none.
        others: further fields of the layout with a row per point, by name; vectors right-handed. They are written as they are.
    """

    points: NDArray[np.float32]
    labels: NDArray[np.unsignedinteger] | None = None
    instances: NDArray[np.uint32] | None = None
    others: Mapping[str, NDArray[Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class VoxelContent:
    """A frame's voxel grid in another data set.

    Attributes:
        labels: (X, Y, Z) class ids of the data set.
        known: (X, Y, Z) bool: voxels that count in an evaluation.
        files: the original files by name: kept beside the grid, for the way back.
    """

    labels: NDArray[np.unsignedinteger]
    known: NDArray[np.bool_]
    files: Mapping[str, bytes]


class FrameHandle(ABC):
    """One frame: paths and numbers only, so that it pickles into a worker, which reads it there.

    Attributes:
        number: the frame's number, from 0; line `number` of poses and times is its own.
        location: what to call it in errors: the file of its points.
    """

    number: int
    location: str

    @abstractmethod
    def read(self) -> FrameContent:
        """Read points, labels and instances.

        Raises:
            MissingDataError: a file is not there.
            FormatError: a file does not hold what it must.
        """

    def read_labels(self) -> tuple[NDArray[np.unsignedinteger] | None, NDArray[np.uint32] | None]:
        """Read labels and instances alone; faster where they have files of their own."""
        content = self.read()
        return content.labels, content.instances

    def read_voxels(self) -> VoxelContent | None:
        """Read the frame's voxel grid; None where it has none."""
        return None


class Recording(ABC):
    """One sequence of another data set.

    Attributes:
        name: what it is called in the layout: "KITTI_00".
        split: which split it belongs to.
        location: what to call it in errors.
        frames: its frames, by rising number.
        has_labels: whether frames have labels and instances.
    """

    name: str
    split: Split
    location: str
    frames: Sequence[FrameHandle]
    has_labels: bool

    @abstractmethod
    def poses(self, *, force: bool = False) -> NDArray[np.float64] | None:
        """Return (F, 4, 4) world_T_sensor by frame number, right-handed; None where there are none.

        Args:
            force: go on without a calibration that the poses need.

        Raises:
            FormatError: the files do not hold what they must.
            MissingDataError: a file without which poses mean nothing is not there.
        """

    def times(self) -> NDArray[np.float64] | None:
        """Return (F,) seconds by frame number; None where there are none."""
        return None

    def problems(self) -> list[tuple[int, str]]:
        """Return (frame number, what is wrong in one line) of frames that should be there and are not."""
        return []


class Exporter(ABC):
    """Writes a sequence of the layout as another data set's files. It makes their bytes; writing them is not its business."""

    @abstractmethod
    def folders(self, names: Sequence[str]) -> dict[str, str]:
        """Return the folder of each sequence, by name, relative to the data set's root."""

    @abstractmethod
    def documents(self, sequence: storage.Sequence) -> dict[str, bytes]:
        """Return the files that stand once in a sequence, by their path in its folder."""

    @abstractmethod
    def frame_files(self, sequence: storage.Sequence, frame: int) -> tuple[str, ...]:
        """Return the paths of the files that `make_frame` gives."""

    @abstractmethod
    def make_frame(self, sequence: storage.Sequence, frame: int) -> dict[str, bytes | memoryview]:
        """Return a frame's files.

        Raises:
            CarlascError: the frame cannot be read, or not be said in the other format.
        """


class Converter(ABC):
    """Finds the recordings of one kind of data set.

    Attributes:
        title: what it reads, in a few words.
        classes: the data set's class table.
        to_carla: takes its ids to CarlaSC's.
        sensor: what takes the scans.
        min_range_m: nearer returns are the own car's.
        max_range_m: farther returns are too few to tell free from occupied.
        voxels: geometry of the data set's own voxel grids, right-handed; None where it has none.
    """

    title: ClassVar[str]
    classes: ClassVar[ClassTable]
    to_carla: ClassVar[Remap]
    sensor: ClassVar[str | None] = None
    min_range_m: ClassVar[float | None] = None
    max_range_m: ClassVar[float | None] = None
    voxels: ClassVar[GridSpec | None] = None

    def __init__(self, root: Path) -> None:
        """Remember where the data set is."""
        self.root = root

    @abstractmethod
    def sequences(self) -> list[Recording]:
        """Return the recordings.

        Raises:
            MissingDataError: there is none; says what was looked for.
        """

    @classmethod
    def exporter(cls, **options: Any) -> Exporter | None:
        """Return what writes the data set's own format; None where there is no way back."""
        return None
