"""Frames of another data set as fields of the layout. Runs in workers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.converting.axes import mirror_boxes, mirror_grid, mirror_points
from carlasc.converting.protocol import FrameContent, FrameHandle
from carlasc.core.classes import ClassTable, Remap
from carlasc.core.grids import GridSpec
from carlasc.errors import CarlascError, FormatError, StorageError
from carlasc.storage import layout
from carlasc.storage.protocol import SequenceWriter

VOXEL_FILES = "voxels_kitti"
"""Folder of a sequence that keeps the other data set's own voxel files unchanged, so that an export gives them back."""

Velocity = tuple[float, float, float]
"""(vx, vy, vz) in m/s over ground, right-handed sensor frame."""

_IDS = np.iinfo(np.uint16).max + 1
_UNKNOWN = np.uint32(np.iinfo(np.uint32).max)
_MAX_LISTED = 8


@dataclass(frozen=True)
class Target:
    """How frames are written.

    Attributes:
        source: class table of the ids that are read.
        remap: maps them to other ids; None keeps them.
        mirrored: whether y is mirrored, from right-handed axes to CarlaSC's left-handed ones.
        allow_unknown: whether ids that the table does not have become unlabelled.
        voxels: geometry of the data set's own voxel grids, right-handed, if they are written; None if not.
    """

    source: ClassTable
    remap: Remap | None
    mirrored: bool
    allow_unknown: bool = False
    voxels: GridSpec | None = None

    @property
    def classes(self) -> ClassTable:
        """Table of the ids that are written."""
        return self.source if self.remap is None else self.remap.target

    def map_labels(self, labels: NDArray[np.unsignedinteger], where: str) -> NDArray[np.uint32]:
        """Return the ids that are written for the ids that were read.

        Raises:
            FormatError: an id is unknown; names it, and how often it occurs. `where` names the labels.
        """
        ids = self.source.names if self.remap is None else self.remap.mapping
        lookup = _lookup_table(tuple(ids), tuple(ids if self.remap is None else self.remap.mapping.values()))
        mapped = lookup[labels if labels.dtype.itemsize <= 2 else np.minimum(labels, _IDS - 1)]
        if mapped.size and int(mapped.max()) == _UNKNOWN:
            unknown = mapped == _UNKNOWN
            if not self.allow_unknown:
                raise FormatError(
                    where,
                    expected=f"class ids of {self.source.name}",
                    found=_list_ids(labels[unknown]),
                    advice="treat them as unlabelled with `allow_unknown=True`",
                )
            mapped[unknown] = 0
        return mapped


@lru_cache(maxsize=8)
def _lookup_table(ids: tuple[int, ...], targets: tuple[int, ...]) -> NDArray[np.uint32]:
    """Return the target of every 16-bit id, `_UNKNOWN` where it has none."""
    lookup = np.full(_IDS, _UNKNOWN, np.uint32)
    lookup[list(ids)] = targets
    return lookup


@dataclass(frozen=True)
class FrameJob:
    """A frame to convert.

    Attributes:
        handle: the frame.
        scan: whether its scan is to be written; False where it exists already.
        velocities: velocity of each moving actor; None where no flow is written.
    """

    handle: FrameHandle
    scan: bool
    velocities: Mapping[int, Velocity] | None = None


@dataclass(frozen=True)
class Block:
    """Several frames that a worker converts in one task, because a task costs more than a frame.

    Attributes:
        jobs: the frames.
        target: how they are written.
        writer: where they are written.
    """

    jobs: tuple[FrameJob, ...]
    target: Target
    writer: SequenceWriter


@dataclass
class BlockResult:
    """The result of a block.

    Attributes:
        block: the block.
        outputs: fields by frame number, where the writer cannot be used in workers.
        failures: (frame number, error message) of the frames that failed.
        without_flow: number of moving points whose actor has no known motion.
    """

    block: Block
    outputs: dict[int, dict[str, NDArray[Any]]] = field(default_factory=dict)
    failures: list[tuple[int, str]] = field(default_factory=list)
    without_flow: int = 0


def convert_block(block: Block) -> BlockResult:
    """Convert several frames, and write them if the writer can be used in workers."""
    result = BlockResult(block)
    for job in block.jobs:
        try:
            outputs: dict[str, NDArray[Any]] = {}
            if job.scan:
                content = job.handle.read()
                outputs, without_flow = make_fields(content, job, block.target)
                result.without_flow += without_flow
            if block.target.voxels is not None:
                grid = layout.grid_folder(block.target.voxels)
                outputs |= _voxel_fields(job.handle, grid, block.target, block.writer)
        except StorageError:
            raise  # every other frame would fail in the same way
        except (CarlascError, OSError) as error:
            result.failures.append((job.handle.number, str(error)))
            continue
        if block.writer.concurrent:
            write_fields(block.writer, job.handle.number, outputs)
        else:
            result.outputs[job.handle.number] = outputs
    return result


def write_fields(writer: SequenceWriter, frame: int, fields: Mapping[str, NDArray[Any]]) -> None:
    """Write a frame's fields in their order."""
    for name, array in fields.items():
        writer.write(name, frame, array)


def make_fields(content: FrameContent, job: FrameJob, target: Target) -> tuple[dict[str, NDArray[Any]], int]:
    """Return the fields of a scan, points last, and the number of moving points whose velocity is unknown.

    Every point is kept, in its order.
    """
    fields: dict[str, NDArray[Any]] = {}
    without_flow = 0
    if content.labels is not None:
        fields["labels"] = target.map_labels(content.labels, f"labels of {job.handle.location}")
    if content.instances is not None:
        fields["instances"] = content.instances
        if job.velocities is not None:
            flow = _make_flow(content.instances, job.velocities)
            fields["flow"] = mirror_points(flow) if target.mirrored else flow
            moving = np.isin(np.asarray(content.labels), sorted(target.source.moving))
            without_flow = int(np.count_nonzero(moving & ~np.isin(content.instances, sorted(job.velocities))))
    for name, array in content.others.items():
        mirrored = target.mirrored and layout.field_named(name).kind == "vector"
        fields[name] = mirror_points(array) if mirrored else array
    if content.boxes is not None:
        boxes = replace(
            content.boxes, labels=target.map_labels(content.boxes.labels, f"boxes of {job.handle.location}")
        )
        fields["boxes"] = (mirror_boxes(boxes) if target.mirrored else boxes).to_table()
    fields["points"] = mirror_points(content.points) if target.mirrored else content.points
    return fields, without_flow


def scan_fields(*, labelled: bool, flow: bool) -> tuple[str, ...]:
    """Return the names of the fields that `make_fields` gives."""
    return ("labels", "instances", *(("flow",) if flow else ()), "points") if labelled else ("points",)


def _make_flow(instances: NDArray[np.uint32], velocities: Mapping[int, Velocity]) -> NDArray[np.float32]:
    """Return (N, 3) m/s: the velocity of each point's actor, zero for all other points."""
    flow = np.zeros((len(instances), 3), np.float32)
    if velocities:
        numbered = np.flatnonzero(instances)
        for actor, velocity in velocities.items():
            flow[numbered[instances[numbered] == actor]] = velocity
    return flow


def _voxel_fields(handle: FrameHandle, grid: str, target: Target, writer: SequenceWriter) -> dict[str, NDArray[Any]]:
    """Return the fields of the frame's own voxel grid, and keep its files; empty if it has none, or if it is written already."""
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


def _list_ids(labels: NDArray[np.unsignedinteger]) -> str:
    ids, counts = np.unique(labels, return_counts=True)
    named = [f"{i} ({n} times)" for i, n in zip(ids.tolist(), counts.tolist(), strict=True)]
    more = f" and {len(named) - _MAX_LISTED} more" if len(named) > _MAX_LISTED else ""
    return ", ".join(named[:_MAX_LISTED]) + more
