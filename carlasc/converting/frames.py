"""One frame after another: from a handle of the other data set to the fields of the layout, in workers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.converting.protocol import FrameContent, FrameHandle
from carlasc.core.classes import ClassTable, Remap
from carlasc.errors import CarlascError, FormatError, StorageError
from carlasc.storage import layout
from carlasc.storage.protocol import SequenceWriter

VOXEL_FILES = "voxels_kitti"  # the other data set's own voxel files, as they were: for the way back
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
_IDS = np.iinfo(np.uint16).max + 1

Velocities = Mapping[int, tuple[float, float, float]]
"""m/s over ground by actor, right-handed sensor frame."""


@dataclass(frozen=True)
class Target:
    """How frames are to be written.

    Attributes:
        source: class table of the ids that are read.
        remap: takes them to others; None keeps them.
        mirrored: whether y is mirrored: from right-handed to CarlaSC's frame.
        allow_unknown: whether ids that the table does not know become unlabelled.
        grid: folder for the data set's own voxel grids; None leaves them.
    """

    source: ClassTable
    remap: Remap | None
    mirrored: bool
    allow_unknown: bool = False
    grid: str | None = None

    @property
    def classes(self) -> ClassTable:
        """Table of the ids that are written."""
        return self.source if self.remap is None else self.remap.target

    def labels(self, labels: NDArray[np.unsignedinteger], where: str) -> NDArray[np.uint32]:
        """Take class ids to the target's.

        Raises:
            FormatError: an id is unknown; names it, and how often it stands.
        """
        lookup = self._lookup()
        mapped = lookup[labels if labels.dtype.itemsize <= 2 else np.minimum(labels, _IDS - 1)]
        if mapped.size and int(mapped.max()) == _UNKNOWN:
            unknown = mapped == _UNKNOWN
            if not self.allow_unknown:
                raise FormatError(f"{where}: expected class ids of {self.source.name}, {_describe(labels[unknown])}")
            mapped[unknown] = 0
        return mapped

    def _lookup(self) -> NDArray[np.uint32]:
        mapping = {i: i for i in self.source.names} if self.remap is None else self.remap.mapping
        key = tuple(mapping.items())
        if key not in _LOOKUPS:
            lookup = np.full(_IDS, _UNKNOWN, np.uint32)
            lookup[list(mapping)] = list(mapping.values())
            _LOOKUPS[key] = lookup
        return _LOOKUPS[key]


@dataclass(frozen=True)
class FrameJob:
    """A frame to convert.

    Attributes:
        handle: the frame.
        scan: whether its scan is to be written: it is not there yet.
        velocities: of its moving actors; None where flow is not written.
    """

    handle: FrameHandle
    scan: bool
    velocities: Velocities | None = None


@dataclass(frozen=True)
class Block:
    """Some frames that a worker converts in one go: a task of its own for each would cost more than the work."""

    jobs: tuple[FrameJob, ...]
    target: Target
    writer: SequenceWriter


@dataclass
class BlockResult:
    """What became of a block.

    Attributes:
        block: what was to do.
        outputs: fields by frame, where the writer cannot write in workers.
        failures: (frame, what is wrong).
        without_flow: moving points whose actor has no known motion.
    """

    block: Block
    outputs: dict[int, dict[str, NDArray[Any]]] = field(default_factory=dict)
    failures: list[tuple[int, str]] = field(default_factory=list)
    without_flow: int = 0


def convert_block(block: Block) -> BlockResult:
    """Convert some frames, and write them where the writer can be written to from here."""
    result = BlockResult(block)
    for job in block.jobs:
        try:
            outputs: dict[str, NDArray[Any]] = {}
            if job.scan:
                content = job.handle.read()
                outputs, without = make_fields(content, job, block.target)
                result.without_flow += without
            if block.target.grid is not None:
                outputs |= _voxel_fields(job.handle, block.target, block.writer)
        except StorageError:
            raise  # every other frame would meet the same
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
    """Return the fields of a scan, points last, and how many moving points have no known velocity.

    Points are never dropped or put in another order.
    """
    where = job.handle.location
    fields: dict[str, NDArray[Any]] = {}
    without = 0
    if content.labels is not None:
        fields["labels"] = target.labels(content.labels, f"labels of {where}")
    if content.instances is not None:
        fields["instances"] = content.instances
        if job.velocities is not None:
            flow = _flow(content.instances, job.velocities)
            fields["flow"] = flow * _MIRROR_VECTOR if target.mirrored else flow
            moving = np.isin(np.asarray(content.labels), sorted(target.source.moving))
            without = int(np.count_nonzero(moving & ~np.isin(content.instances, sorted(job.velocities))))
    for name, array in content.others.items():
        mirrored = target.mirrored and layout.field_named(name).kind == "vector"
        fields[name] = array * _MIRROR_VECTOR if mirrored else array
    points = content.points
    if target.mirrored:
        points = points * _MIRROR_POINT
    fields["points"] = points
    return fields, without


def scan_fields(*, labelled: bool, flow: bool) -> tuple[str, ...]:
    """Return the names of the fields that `make_fields` gives."""
    return ("labels", "instances", *(("flow",) if flow else ()), "points") if labelled else ("points",)


def _flow(instances: NDArray[np.uint32], velocities: Velocities) -> NDArray[np.float32]:
    flow = np.zeros((len(instances), 3), np.float32)
    if velocities:
        numbered = np.flatnonzero(instances)
        for actor, velocity in velocities.items():
            flow[numbered[instances[numbered] == actor]] = velocity
    return flow


def _voxel_fields(handle: FrameHandle, target: Target, writer: SequenceWriter) -> dict[str, NDArray[Any]]:
    """Return the frame's own grid, and keep its files; nothing where it has none, or it is there."""
    if writer.has(f"{target.grid}/counts", handle.number):
        return {}
    voxels = handle.read_voxels()
    if voxels is None:
        return {}
    labels = target.labels(voxels.labels, f"voxels of {handle.location}")
    known = voxels.known & ~((labels == 0) & (voxels.labels > 0))  # something is there, and nobody knows what
    labels[~known] = 0
    for name, data in voxels.files.items():
        writer.write_document(f"{VOXEL_FILES}/{name}", data)
    axes = (slice(None), slice(None, None, -1)) if target.mirrored else ()
    return {f"{target.grid}/labels": labels[axes], f"{target.grid}/counts": known[axes].astype(np.float32)}


def _describe(labels: NDArray[np.unsignedinteger]) -> str:
    ids, counts = np.unique(labels, return_counts=True)
    named = [f"{i} ({n} times)" for i, n in zip(ids.tolist(), counts.tolist(), strict=True)]
    more = f" and {len(named) - 8} more" if len(named) > 8 else ""
    return f"found {', '.join(named[:8])}{more}: take them for unlabelled with --allow-unknown"


_MIRROR_VECTOR = np.array([1, -1, 1], np.float32)
_MIRROR_POINT = np.array([1, -1, 1, 1], np.float32)
_UNKNOWN = np.uint32(np.iinfo(np.uint32).max)
_LOOKUPS: dict[tuple[tuple[int, int], ...], NDArray[np.uint32]] = {}
