"""The second stage of a conversion, in workers: fields that need the motion of actors are added to
the scans of the first stage.

Scans are read from the output, not from the data set again, if the store can read them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.converting.actors import Velocity
from carlasc.converting.assembling import read_scan
from carlasc.converting.scan_stage import ConvertedFrame, Fields, FrameJob, StageBlock, make_fields
from carlasc.core.axes import mirror_boxes, mirror_points
from carlasc.core.boxes import Boxes
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform, invert, rotate_vectors, transform_points
from carlasc.core.grids import most_frequent
from carlasc.core.scans import Scan
from carlasc.motion import Segment, Track, ground_points, segment_by_boxes

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
    fields: dict[str, NDArray[Any]] = {}
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
    points: NDArray[np.float32],
    segments: list[Segment],
    classes: ClassTable,
    labelled: list[tuple[NDArray[np.float64], NDArray[np.unsignedinteger]]],
) -> NDArray[np.uint32]:
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


def _labelled_nearby(
    job: MotionJob, block: MotionBlock
) -> list[tuple[NDArray[np.float64], NDArray[np.unsignedinteger]]]:
    """Return points, in the frame of the scan of a job, and class ids of the labelled frames around
    it.
    """
    found = []
    for other in job.nearby:
        written = _read_back(other, block, "points", "labels")
        if "labels" in written:
            points = (
                mirror_points(written["points"]) if block.target.mirrored else written["points"]
            )
            scan_T_other = invert(job.first_T_scan) @ other.first_T_scan
            found.append((transform_points(scan_T_other, points[:, :3]), written["labels"]))
    return found


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
    points: NDArray[np.floating],
    ground: NDArray[np.bool_],
    labelled: Sequence[tuple[NDArray[np.floating], NDArray[np.unsignedinteger]]],
    classes: ClassTable,
) -> NDArray[np.uint32]:
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
    found = np.zeros(len(points), np.uint32)
    if not labelled:
        return found
    places = np.concatenate([own for own, _ in labelled])
    labels = np.concatenate([own for _, own in labelled]).astype(np.int64)
    on_ground = np.isin(labels, sorted(classes.ground))
    fixed = (labels > 0) & ~np.isin(labels, sorted(classes.movable | classes.moving)) & ~on_ground
    for own, source, sizes, axes in (
        (ground, on_ground, _GROUND_CELLS_M, 2),
        (~ground, fixed, _CELLS_M, 3),
    ):
        for size in sizes:
            open_ = np.flatnonzero(own & (found == 0))
            if len(open_) and source.any():
                found[open_] = _by_cells(
                    points[open_, :axes], places[source, :axes], labels[source], size
                )
    return found


def _by_cells(
    points: NDArray[np.floating],
    places: NDArray[np.floating],
    labels: NDArray[np.int64],
    size: float,
) -> NDArray[np.uint32]:
    """Return the most frequent label in the cell of each point, the lowest of several; 0 where the
    cell is empty.
    """
    keys, winners = most_frequent(_cells(places, size), labels)
    wanted = _cells(points, size)
    rows = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.where(keys[rows] == wanted, winners[rows], 0).astype(np.uint32)


def _cells(places: NDArray[np.floating], size: float) -> NDArray[np.int64]:
    """Return one number per cell, below 2 ** 45.

    Cells beyond 4 km or more count as the last one.
    """
    index = np.clip(np.floor(places / size), -_HALF, _HALF - 1).astype(np.int64) + _HALF
    return index @ ((2 * _HALF) ** np.arange(index.shape[1]))
