"""The first stage of a conversion, in workers: each frame is read once, and its scan is written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.converting.actors import ActorSighting, find_actors
from carlasc.converting.assembling import Assembled, Motion, Rig, assemble
from carlasc.converting.outcomes import Fields, Outcome, written_in_worker
from carlasc.converting.protocol import FrameHandle
from carlasc.converting.target import Target
from carlasc.core.axes import mirror_grid, mirror_points
from carlasc.core.classes import ClassTable
from carlasc.core.grids import GridSpec
from carlasc.motion.odometry import usable_points
from carlasc.storage import layout
from carlasc.storage.sinks import SequenceWriter

VOXEL_FILES = "voxels_kitti"
"""Folder of a sequence that keeps the other data set's own voxel files unchanged, so that an export gives them back."""


@dataclass(frozen=True)
class FrameJob:
    """A frame to read.

    Attributes:
        handle: the frame.
        write: whether its scan is to be written; False where it exists already.
        motion: the motion of the vehicle around the frame, if that is known.
    """

    handle: FrameHandle
    write: bool = True
    motion: Motion | None = None


@dataclass(frozen=True)
class Block:
    """Several frames that a worker reads in one task, because a task costs more than a frame.

    Attributes:
        jobs: the frames.
        target: how they are written.
        writer: where they are written.
        rig: the sensors.
        voxels: geometry of the frames' own voxel grids, right-handed, if they are written.
        for_odometry: whether their points are returned, from which poses are estimated.
        for_actors: whether their actors are returned, whose motion is estimated.
    """

    jobs: tuple[FrameJob, ...]
    target: Target
    writer: SequenceWriter
    rig: Rig
    voxels: GridSpec | None = None
    for_odometry: bool = False
    for_actors: bool = False


@dataclass
class FrameResult(Outcome):
    """What was read of a frame.

    Attributes:
        points: (N, 3) float32 that poses are estimated from, right-handed.
        actors: its numbered actors.
        unnumbered: number of its moving points that belong to no numbered actor.
    """

    points: NDArray[np.float32] | None = None
    actors: tuple[ActorSighting, ...] = ()
    unnumbered: int = 0


def convert_block(block: Block) -> list[FrameResult]:
    """Read several frames, and write them if the writer can be used in workers."""
    return written_in_worker(block.writer, [_convert(job, block) for job in block.jobs])


def fail_block(block: Block, message: str) -> list[FrameResult]:
    """Return the results of a block that no worker could finish."""
    return [FrameResult(job.handle.number, failure=message) for job in block.jobs]


def _convert(job: FrameJob, block: Block) -> FrameResult:
    result = FrameResult(job.handle.number)
    result.take(lambda: _read(job, block, result))
    return result


def _read(job: FrameJob, block: Block, result: FrameResult) -> Fields:
    """Return the fields of a frame that are to be written, and note what else was asked for in the result."""
    fields: dict[str, NDArray[Any]] = {}
    if job.write or block.for_odometry or block.for_actors:
        scan = assemble(job.handle.read(), block.rig, job.motion, job.handle.location)
        if block.for_odometry:
            result.points = scan.points[usable_points(scan.points), :3]
        if block.for_actors:
            result.actors = find_actors(scan.points, scan.labels, scan.instances, block.target.source)
            result.unnumbered = _unnumbered(scan, block.target.source)
        if job.write:
            fields = make_fields(scan, block.target, job.handle.location)
    if block.voxels is not None:
        fields |= _voxel_fields(job.handle, block.voxels, block.target, block.writer)
    return fields


def make_fields(scan: Assembled, target: Target, where: str) -> dict[str, NDArray[Any]]:
    """Return the fields of a scan in the axes and classes of the target, points last: a frame that has points is complete.

    Raises:
        FormatError: a class id is unknown. `where` is the frame.
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


def _unnumbered(scan: Assembled, classes: ClassTable) -> int:
    """Return the number of points of classes that only moving objects have, without the number of an actor."""
    if scan.labels is None or scan.instances is None:
        return 0
    return int(np.count_nonzero(np.isin(scan.labels, sorted(classes.moving)) & (scan.instances == 0)))


def _voxel_fields(
    handle: FrameHandle, spec: GridSpec, target: Target, writer: SequenceWriter
) -> dict[str, NDArray[Any]]:
    """Return the fields of the frame's own voxel grid, and keep its files; empty if it has none, or if it is written already."""
    grid = layout.grid_folder(spec)
    if writer.has(f"{grid}/counts", handle.number):
        return {}
    voxels = handle.read_voxels()
    if voxels is None:
        return {}
    labels = target.map_labels(voxels.labels, f"voxels of {handle.location}")
    known = voxels.known & ~((labels == 0) & (voxels.labels > 0))  # occupied, but of a class that has no target
    labels[~known] = 0
    for name, data in voxels.files.items():
        writer.write_document(f"{VOXEL_FILES}/{name}", data)
    counts = known.astype(np.float32)
    if target.mirrored:
        labels, counts = mirror_grid(labels), mirror_grid(counts)
    return {f"{grid}/labels": labels, f"{grid}/counts": counts}
