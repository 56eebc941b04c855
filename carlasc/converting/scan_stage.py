"""The first stage of a conversion, in workers: each frame is read once, and its scan is written.

Also code that both stages share.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from carlasc.converting.actors import ActorObservation, find_actors
from carlasc.converting.assembling import Assembled, Rig, VehicleMotion, read_scan
from carlasc.converting.layout_options import AxesAndClasses
from carlasc.converting.protocol import FrameHandle
from carlasc.core.axes import mirror_grid, mirror_points
from carlasc.core.grids import GridSpec
from carlasc.errors import CarlascError, StorageError
from carlasc.motion.odometry import usable_points
from carlasc.storage import layout
from carlasc.storage.sinks import SequenceWriter

VOXEL_FILES = "voxels_kitti"
"""Folder of a sequence with the unchanged voxel files of the other data set, so that an export can
write them again.
"""

Fields = Mapping[str, NDArray[Any]]
"""Arrays of a frame by the names of their fields, in the order in which they are written."""

Item = TypeVar("Item")
_FRAMES = 8  # frames per task if each has its own files, because a task costs more than a frame


@dataclass(frozen=True)
class FrameJob:
    """A frame to convert.

    Attributes:
        handle: the frame.
        motion: the motion of the vehicle around it, if known.
    """

    handle: FrameHandle
    motion: VehicleMotion | None = None


@dataclass
class ConvertedFrame:
    """The result of a stage for one frame: its fields were written, or are still to be written, or
    it failed.

    Attributes:
        number: frame number.
        fields: its fields, until they are written.
        failure: error message, if it failed.
        points: (N, 3) float32 points to estimate poses from, right-handed, if they were requested.
        actors: its numbered actors, if they were requested.
        unnumbered: number of its moving points that belong to no numbered actor.
    """

    number: int
    fields: Fields = field(default_factory=dict)
    failure: str | None = None
    points: NDArray[np.float32] | None = None
    actors: tuple[ActorObservation, ...] = ()
    unnumbered: int = 0


Job = TypeVar("Job", bound=FrameJob)


@dataclass(frozen=True)
class StageBlock(ABC, Generic[Job]):
    """Several frames that a worker converts in one task. Each stage has a kind of its own.

    Attributes:
        jobs: the frames.
        target: the axes and classes of the output.
        writer: the output.
        rig: the sensors.
    """

    jobs: tuple[Job, ...]
    target: AxesAndClasses
    writer: SequenceWriter
    rig: Rig

    @abstractmethod
    def make(self, job: Job, frame: ConvertedFrame) -> Fields:
        """Return the fields of a frame to write, and add other requested data to the result."""

    def convert(self) -> list[ConvertedFrame]:
        """Convert the frames, and write them if the writer can be used in workers.

        A frame that cannot be read has failed.

        Raises:
            StorageError: the output cannot be written, so that all other frames would fail, too.
        """
        frames = [ConvertedFrame(job.handle.number) for job in self.jobs]
        for job, frame in zip(self.jobs, frames, strict=True):
            try:
                frame.fields = self.make(job, frame)
            except StorageError:
                raise
            except (CarlascError, OSError) as error:
                frame.failure = str(error)
        if self.writer.concurrent:
            write_frames(self.writer, frames)
        return frames

    def fail(self, message: str) -> list[ConvertedFrame]:
        """Return the frames of a block whose worker failed."""
        return [ConvertedFrame(job.handle.number, failure=message) for job in self.jobs]


def write_frames(writer: SequenceWriter, frames: Iterable[ConvertedFrame]) -> None:
    """Write the fields of some frames, in the order of each frame, and drop them from memory."""
    frames = list(frames)
    if fields := {frame.number: frame.fields for frame in frames if frame.fields}:
        writer.write_frames(fields)
    for frame in frames:
        frame.fields = {}


def in_blocks(
    items: Sequence[Item], number_of: Callable[[Item], int], writer: SequenceWriter
) -> Iterator[Sequence[Item]]:
    """Yield frames in blocks, one per task: frames that are stored together, otherwise a few
    successive ones.

    Args:
        items: the frames, by increasing number.
        number_of: returns the number of a frame.
        writer: says how many frames are stored together.
    """
    if writer.block == 1:
        yield from (items[i : i + _FRAMES] for i in range(0, len(items), _FRAMES))
    else:
        yield from (
            list(block)
            for _, block in groupby(items, key=lambda item: number_of(item) // writer.block)
        )


@dataclass(frozen=True)
class ScanJob(FrameJob):
    """A frame to read; `write` is False if its scan exists already."""

    write: bool = True


@dataclass(frozen=True)
class ScanBlock(StageBlock[ScanJob]):
    """Several frames to read.

    Attributes:
        voxels: geometry of the frames' own voxel grids, right-handed, if they are written.
        for_odometry: whether their points are returned, from which poses are estimated.
        for_actors: whether their actors are returned, whose motion is estimated.
    """

    voxels: GridSpec | None = None
    for_odometry: bool = False
    for_actors: bool = False

    def make(self, job: ScanJob, frame: ConvertedFrame) -> Fields:
        """Read a frame, and return the fields of its scan and of its own voxel grid."""
        fields: dict[str, NDArray[Any]] = {}
        if job.write or self.for_odometry or self.for_actors:
            scan, classes = read_scan(job.handle, self.rig, job.motion), self.target.source
            if self.for_odometry:
                frame.points = scan.points[usable_points(scan.points), :3]
            if self.for_actors and scan.labels is not None and scan.instances is not None:
                frame.actors = find_actors(scan.points, scan.labels, scan.instances, classes)
                moving = np.isin(scan.labels, sorted(classes.moving))
                frame.unnumbered = int(np.count_nonzero(moving & (scan.instances == 0)))
            if job.write:
                fields = make_fields(scan, self.target, job.handle.location)
        if self.voxels is not None:
            fields |= _voxel_fields(job.handle, self.voxels, self.target, self.writer)
        return fields


def make_fields(scan: Assembled, target: AxesAndClasses, where: str) -> dict[str, NDArray[Any]]:
    """Return the fields of a scan in the axes and classes of the target, points last: a frame that
    has points is complete.

    Args:
        scan: the scan, right-handed, with class ids of the data set.
        target: the axes and classes in which it is written.
        where: the frame, for errors.

    Raises:
        FormatError: a class id is unknown.
    """
    fields: dict[str, NDArray[Any]] = {}
    if scan.labels is not None:
        fields["labels"] = target.map_labels(scan.labels, f"labels of {where}")
    if scan.instances is not None:
        fields["instances"] = scan.instances
    for name, array in scan.fields.items():
        mirrored = target.mirrored and layout.field_named(name).kind == "vector"
        fields[name] = mirror_points(array) if mirrored else array
    fields["points"] = mirror_points(scan.points) if target.mirrored else scan.points
    return fields


def _voxel_fields(
    handle: FrameHandle, spec: GridSpec, target: AxesAndClasses, writer: SequenceWriter
) -> dict[str, NDArray[Any]]:
    """Return the fields of the frame's own voxel grid, and keep its files; empty if it has none, or
    if it is written already.
    """
    grid = layout.grid_folder(spec)
    if writer.has(f"{grid}/counts", handle.number):
        return {}
    voxels = handle.read_voxels()
    if voxels is None:
        return {}
    labels = target.map_labels(voxels.labels, f"voxels of {handle.location}")
    # occupied, but its class has no target
    known = voxels.known & ~((labels == 0) & (voxels.labels > 0))
    labels[~known] = 0
    for name, data in voxels.files.items():
        writer.write_document(f"{VOXEL_FILES}/{name}", data)
    counts = known.astype(np.float32)
    if target.mirrored:
        labels, counts = mirror_grid(labels), mirror_grid(counts)
    return {f"{grid}/labels": labels, f"{grid}/counts": counts}
