"""The two stages of a conversion, in workers: each frame is read once and its scan is written; then
fields that need the motion of actors are added.

The second stage reads scans from the output, not from the data set again, if the store can read
them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Generic, TypeVar

import numpy as np

from carlasc.converting.actors import ActorObservation, Velocity, find_actors
from carlasc.converting.assembling import Assembled, Rig, VehicleMotion, read_scan
from carlasc.converting.layout_options import AxesAndClasses
from carlasc.converting.protocol import FrameHandle
from carlasc.core.arrays import (
    AnyArray,
    AnyFloatArray,
    BoolArray,
    Float32Array,
    FloatArray,
    IntArray,
    LabelArray,
    Uint32Array,
)
from carlasc.core.axes import mirror_boxes, mirror_grid, mirror_points
from carlasc.core.boxes import Boxes
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform, invert, rotate_vectors, transform_points
from carlasc.core.grids import GridSpec, most_frequent
from carlasc.core.scans import Scan
from carlasc.errors import CarlascError, StorageError
from carlasc.motion import Segment, Track, ground_points, segment_by_boxes
from carlasc.motion.odometry import usable_points
from carlasc.storage import layout
from carlasc.storage.sinks import SequenceWriter

VOXEL_FILES = "voxels_kitti"
"""Folder of a sequence with the unchanged voxel files of the other data set, so that an export can
write them again.
"""

Fields = Mapping[str, AnyArray]
"""Arrays of a frame by the names of their fields, in the order in which they are written."""

Item = TypeVar("Item")
_FRAMES = 8  # frames per task if each has its own files, because a task costs more than a frame
_FAR_M = 100.0  # objects farther away than this are not filled in
# cells around labelled points: the smallest cell with labelled points decides
_CELLS_M = (
    0.25,
    0.5,
    1.0,
)
# in the plane: on the ground, the rings of two scans may be metres apart
_GROUND_CELLS_M = (
    0.5,
    1.0,
    2.0,
)
_HALF = 1 << 14  # cells to each side of the origin


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
    points: Float32Array | None = None
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
        fields: dict[str, AnyArray] = {}
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


def make_fields(scan: Assembled, target: AxesAndClasses, where: str) -> dict[str, AnyArray]:
    """Return the fields of a scan in the axes and classes of the target, points last: a frame that
    has points is complete.

    Args:
        scan: the scan, right-handed, with class ids of the data set.
        target: the axes and classes in which it is written.
        where: the frame, for errors.

    Raises:
        FormatError: a class id is unknown.
    """
    fields: dict[str, AnyArray] = {}
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
) -> dict[str, AnyArray]:
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


@dataclass(frozen=True)
class MotionJob(FrameJob):
    """A frame to finish.

    Attributes:
        first_T_scan: (4, 4) its pose.
        velocities: velocity of each moving actor, where actors are numbered.
        tracks: the tracks of boxes at the frame, with classes of the target; None where the data
            set has no boxes.
        boxes: the annotated boxes of the frame, right-handed, in the frame of the scan; None where
            it was not annotated.
        nearby: the labelled frames before and after it, if it has no labels and others have.
        labelled: whether its points have labels in the data set. Those that an interrupted run made
            from boxes are made again.
    """

    first_T_scan: Transform = field(kw_only=True)
    velocities: Mapping[int, Velocity] = field(default_factory=dict)
    tracks: tuple[Track, ...] | None = None
    boxes: Boxes | None = None
    nearby: tuple[MotionJob, ...] = ()
    labelled: bool = True


@dataclass(frozen=True)
class MotionBlock(StageBlock[MotionJob]):
    """Several frames to finish; `flow` says whether flow is written."""

    flow: bool = True

    def make(self, job: MotionJob, frame: ConvertedFrame) -> Fields:
        """Return the fields that the motion of actors adds to a frame."""
        return _by_instances(job, self) if job.tracks is None else _by_boxes(job, self)


def _read_back(job: MotionJob, block: MotionBlock, *names: str) -> Fields:
    """Return the existing fields of a frame as they were written; labels only if they are from the
    data set.
    """
    number, writer = job.handle.number, block.writer
    wanted = [name for name in names if job.labelled or name != "labels"]
    written = {name: writer.read(name, number) for name in wanted if writer.has(name, number)}
    if writer.has("points", number) and all(array is not None for array in written.values()):
        return {name: array for name, array in written.items() if array is not None}
    return make_fields(
        read_scan(job.handle, block.rig, job.motion), block.target, job.handle.location
    )


def _by_instances(job: MotionJob, block: MotionBlock) -> Fields:
    """Return the flow of a scan whose points have numbers: the velocity of each point's actor, zero
    for all other points.
    """
    written = _read_back(job, block, "instances") if block.flow else {}
    if "instances" not in written:
        return {}
    instances = written["instances"]
    flow = np.zeros((len(instances), 3), np.float32)
    numbered = np.flatnonzero(instances)
    for actor, velocity in job.velocities.items():
        flow[numbered[instances[numbered] == actor]] = velocity
    return {"flow": mirror_points(flow) if block.target.mirrored else flow}


def _by_boxes(job: MotionJob, block: MotionBlock) -> Fields:
    """Return labels, instances, boxes and flow of a scan whose objects have boxes.

    Labels and instances of the data set are kept.
    """
    assert job.tracks is not None
    written = _read_back(job, block, "points", "labels", "instances")
    classes, mirrored = block.target.classes, block.target.mirrored
    points = mirror_points(written["points"]) if mirrored else written["points"]
    labels = written.get("labels")
    scan = Scan(np.ascontiguousarray(points[:, :3]), labels)
    segments = segment_by_boxes(
        job.handle.number, scan, job.first_T_scan, job.tracks, ground=classes.ground
    )
    fields: dict[str, AnyArray] = {}
    if labels is None:
        fields["labels"] = _labels_of(scan.points, segments, classes, _labelled_nearby(job, block))
    if "instances" not in written:
        instances = np.zeros(len(scan), np.uint32)
        for segment in segments:
            instances[segment.members] = segment.instance
        fields["instances"] = instances
    boxes = _boxes_of(job, job.tracks)
    fields["boxes"] = (mirror_boxes(boxes) if mirrored else boxes).to_table()
    if block.flow:
        flow = np.zeros((len(scan), 3), np.float32)
        for segment in segments:
            if segment.velocity is not None:
                flow[segment.members] = rotate_vectors(invert(job.first_T_scan), segment.velocity)
        fields["flow"] = mirror_points(flow) if mirrored else flow
    return fields


def _labels_of(
    points: Float32Array,
    segments: list[Segment],
    classes: ClassTable,
    labelled: list[tuple[FloatArray, LabelArray]],
) -> Uint32Array:
    """Return the class of each point: the class of its box, of labelled points nearby, ground, or
    geometry without a class.
    """
    labels = np.full(len(points), classes.geometry_id, np.uint32)
    ground = ground_points(points)
    if classes.ground_id is not None:
        labels[ground] = classes.ground_id
    nearby = labels_nearby(points, ground, labelled, classes)
    labels[nearby > 0] = nearby[nearby > 0]
    for segment in segments:
        labels[segment.members] = segment.label
    return labels


def _labelled_nearby(job: MotionJob, block: MotionBlock) -> list[tuple[FloatArray, LabelArray]]:
    """Return points, in the frame of the scan of a job, and class ids of the labelled frames around
    it.
    """
    neighbours = []
    for other in job.nearby:
        written = _read_back(other, block, "points", "labels")
        if "labels" in written:
            points = (
                mirror_points(written["points"]) if block.target.mirrored else written["points"]
            )
            scan_T_other = invert(job.first_T_scan) @ other.first_T_scan
            neighbours.append((transform_points(scan_T_other, points[:, :3]), written["labels"]))
    return neighbours


def _boxes_of(job: MotionJob, tracks: Sequence[Track]) -> Boxes:
    """Return the annotated boxes of a frame, and boxes of tracks that extend to it without an
    annotation.
    """
    number = job.handle.number
    there = set() if job.boxes is None else set(job.boxes.tracks.tolist())
    scan_T_first = invert(job.first_T_scan)
    filled: dict[int, tuple[Track, Transform]] = {}
    for track in tracks:
        pose = track.pose(number)
        if (
            pose is not None
            and track.instance not in there
            and np.linalg.norm((scan_T_first @ pose)[:3, 3]) < _FAR_M
        ):
            filled.setdefault(track.instance, (track, scan_T_first @ pose))
    more = Boxes.from_poses(
        np.array(list(filled), np.uint32),
        np.array([track.label for track, _ in filled.values()], np.uint32),
        np.array([pose for _, pose in filled.values()]).reshape(-1, 4, 4),
        np.array([track.extent.upper - track.extent.lower for track, _ in filled.values()]).reshape(
            -1, 3
        ),
        np.zeros(len(filled), np.bool_),
    )
    return more if job.boxes is None else job.boxes.joined(more)


def labels_nearby(
    points: AnyFloatArray,
    ground: BoolArray,
    labelled: Sequence[tuple[AnyFloatArray, LabelArray]],
    classes: ClassTable,
) -> Uint32Array:
    """Return the most frequent class of the labelled points near each point.

    Points on the ground get classes of the ground, others get other classes. Classes of actors are
    not copied, because actors may have moved in the meantime.

    Args:
        points: (N, 3) metres, in a frame whose z points up.
        ground: (N,) whether they are on the ground.
        labelled: (M, 3) points in the same frame and (M,) class ids of each labelled scan.
        classes: table of the ids.

    Returns:
        (N,) class ids, 0 where no labelled point is near.
    """
    assigned = np.zeros(len(points), np.uint32)
    if not labelled:
        return assigned
    places = np.concatenate([own for own, _ in labelled])
    labels = np.concatenate([own for _, own in labelled]).astype(np.int64)
    on_ground = np.isin(labels, sorted(classes.ground))
    fixed = (labels > 0) & ~np.isin(labels, sorted(classes.movable | classes.moving)) & ~on_ground
    for own, source, sizes, axes in (
        (ground, on_ground, _GROUND_CELLS_M, 2),
        (~ground, fixed, _CELLS_M, 3),
    ):
        for size in sizes:
            open_ = np.flatnonzero(own & (assigned == 0))
            if len(open_) and source.any():
                assigned[open_] = _by_cells(
                    points[open_, :axes], places[source, :axes], labels[source], size
                )
    return assigned


def _by_cells(
    points: AnyFloatArray,
    places: AnyFloatArray,
    labels: IntArray,
    size: float,
) -> Uint32Array:
    """Return the most frequent label in the cell of each point, the lowest of several; 0 where the
    cell is empty.
    """
    keys, winners = most_frequent(_cells(places, size), labels)
    wanted = _cells(points, size)
    rows = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.where(keys[rows] == wanted, winners[rows], 0).astype(np.uint32)


def _cells(places: AnyFloatArray, size: float) -> IntArray:
    """Return one number per cell, below 2 ** 45.

    Cells beyond 4 km or more count as the last one.
    """
    index = np.clip(np.floor(places / size), -_HALF, _HALF - 1).astype(np.int64) + _HALF
    return index @ ((2 * _HALF) ** np.arange(index.shape[1]))
