"""The motion of actors in a conversion, and the fields of frames that follow from it.

The points of numbered actors are collected while scans are read, then their paths are estimated. A
path is estimated when its actor was not seen for a while, and only its velocities are kept. Except
for the result, memory therefore does not grow with the length of the recording.

Fields are made in workers. Scans are read from the output, not from the data set again, if the
store can read them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from carlasc.converting.assembling import (
    AxesAndClasses,
    Rig,
    VehicleMotion,
    make_fields,
    read_scan,
)
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
from carlasc.core.boxes import Boxes, mirror_boxes
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import (
    Transform,
    invert,
    mirror_points,
    multiply,
    rotate_vectors,
    thin,
    transform_points,
)
from carlasc.core.grids import most_frequent
from carlasc.core.scans import Scan
from carlasc.motion import Segment, Track, ground_points, segment_by_boxes
from carlasc.motion.paths import estimate_path, is_static
from carlasc.running.processes import run_all
from carlasc.running.spreading import Run
from carlasc.storage.protocol import SequenceWriter

Fields = Mapping[str, AnyArray]
"""Arrays of a frame by the names of their fields, in the order in which they are written."""

Velocity = tuple[float, float, float]
"""(vx, vy, vz) in m/s over ground, right-handed sensor frame."""

MAX_GAP = 10
"""Frames for which an actor may be hidden; a new path begins after a longer gap."""
_MAX_OBSERVATIONS = 400  # of one path
_MAX_POINTS = 1000  # of one observation
_FARTHEST_M = 1e4  # points farther than any LiDAR measures are damaged, as infinity and NaN are
_BATCH = 32  # paths that are estimated together
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
class ActorObservation:
    """The points of one actor in one scan.

    Attributes:
        actor: its number.
        label: its most frequent class.
        points: (M, 3) float32, at most some hundreds, metres, right-handed sensor frame.
    """

    actor: int
    label: int
    points: Float32Array


def find_actors(
    points: Float32Array,
    labels: LabelArray,
    instances: Uint32Array,
    classes: ClassTable,
) -> tuple[ActorObservation, ...]:
    """Return the numbered actors of a scan that may move: those of moving classes, or of movable
    classes if the table has no moving ones.

    Args:
        points: (N, 4) x, y, z in metres and remission.
        labels: (N,) class ids.
        instances: (N,) number of each point's actor, 0 for none.
        classes: table of the ids.
    """
    wanted = np.flatnonzero(
        (instances > 0) & np.isin(labels, sorted(classes.moving or classes.movable))
    )
    wanted = wanted[(np.abs(points[wanted, :3]) < _FARTHEST_M).all(axis=1)]
    order = wanted[np.argsort(instances[wanted], kind="stable")]
    groups = np.split(order, np.flatnonzero(np.diff(instances[order])) + 1) if len(order) else []
    return tuple(
        ActorObservation(
            int(instances[own[0]]),
            int(np.bincount(labels[own]).argmax()),
            thin(points[own, :3], _MAX_POINTS),
        )
        for own in groups
    )


@dataclass
class _ObservationChain:
    """The observations of one actor without a long gap."""

    actor: int
    label_counts: dict[int, int] = field(default_factory=dict)
    frames: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    poses: list[Transform] = field(default_factory=list)
    points: list[Float32Array] = field(default_factory=list)

    def size(self) -> int:
        """Return the number of points."""
        return sum(map(len, self.points))

    @property
    def label(self) -> int:
        """The class of most observations, the lowest of several."""
        return max(sorted(self.label_counts), key=self.label_counts.__getitem__)


def _velocities_of(chain: _ObservationChain, classes: ClassTable) -> list[Velocity]:
    """Return the velocity in each frame of a chain, in the sensor frame of that frame."""
    poses = np.stack(chain.poses)
    seconds = np.array(chain.seconds)
    observations = [
        transform_points(pose, points) for pose, points in zip(poses, chain.points, strict=True)
    ]
    rigid = chain.label not in classes.deformable
    path = _, velocities, _ = estimate_path(observations, seconds, rigid=rigid)
    if not classes.moving and is_static(observations, path, seconds):
        velocities = np.zeros_like(velocities)
    own = multiply(invert(poses)[:, :3, :3], velocities[:, :, None])[:, :, 0]
    return [(x, y, z) for x, y, z in own.tolist()]


class ActorMotion:
    """Collects the observations of actors, frame by frame, and estimates their velocities.

    If the class table has no classes of moving actors, static actors get zero.

    Args:
        classes: table of the labels.
        run: how the work is spread.
    """

    def __init__(self, classes: ClassTable, run: Run) -> None:
        self._classes = classes
        self._run_options = run
        self._chains: dict[int, _ObservationChain] = {}
        self._ended: list[_ObservationChain] = []
        self._velocities: dict[int, dict[int, Velocity]] = {}

    def add(
        self,
        frame: int,
        seconds: float,
        first_T_sensor: Transform,
        actors: Iterable[ActorObservation],
    ) -> None:
        """Add the actors of the next frame.

        Args:
            frame: its number.
            seconds: its time.
            first_T_sensor: (4, 4) pose of the sensor.
            actors: what was seen of each actor.
        """
        for observation in actors:
            chain = self._chains.get(observation.actor)
            if (
                chain is None
                or frame - chain.frames[-1] > MAX_GAP
                or len(chain.frames) >= _MAX_OBSERVATIONS
            ):
                self._ended += [] if chain is None else [chain]
                chain = self._chains[observation.actor] = _ObservationChain(observation.actor)
            chain.label_counts[observation.label] = chain.label_counts.get(observation.label, 0) + 1
            chain.frames.append(frame)
            chain.seconds.append(seconds)
            chain.poses.append(first_T_sensor)
            chain.points.append(observation.points)
        for actor in [
            actor for actor, chain in self._chains.items() if frame - chain.frames[-1] > MAX_GAP
        ]:
            self._ended.append(self._chains.pop(actor))
        if len(self._ended) >= _BATCH:
            self._run()

    def finish(self) -> Mapping[int, Mapping[int, Velocity]]:
        """Return the velocity by frame number and actor."""
        self._ended += self._chains.values()
        self._chains = {}
        self._run()
        return self._velocities

    def _run(self) -> None:
        # longest first: no worker ends late
        chains = sorted(self._ended, key=_ObservationChain.size, reverse=True)
        self._ended = []
        estimate = partial(_velocities_of, classes=self._classes)
        with closing(run_all(estimate, chains, self._run_options)) as estimates:
            for chain, velocities in zip(chains, estimates, strict=True):
                for frame, velocity in zip(chain.frames, velocities, strict=True):
                    self._velocities.setdefault(frame, {})[chain.actor] = velocity


@dataclass(frozen=True)
class MotionJob:
    """A frame to finish.

    Attributes:
        handle: the frame.
        motion: the motion of the vehicle around it, if known.
        first_T_scan: (4, 4) its pose.
        velocities: velocity of each moving actor, where actors are numbered.
        tracks: the tracks of boxes at the frame, with classes of the target; None where the data
            set has no boxes.
        boxes: the annotated boxes of the frame, right-handed, in the frame of the scan; None where
            it was not annotated.
        nearby: the labelled frames before and after it, if it has no labels and others have.
        labelled: whether its points have labels in the data set. Those that an interrupted run made
            from boxes are made again.
        own: names of the fields that this run read of it in the data set; None if it read none.
    """

    handle: FrameHandle
    motion: VehicleMotion | None
    first_T_scan: Transform
    velocities: Mapping[int, Velocity] = field(default_factory=dict)
    tracks: tuple[Track, ...] | None = None
    boxes: Boxes | None = None
    nearby: tuple[MotionJob, ...] = ()
    labelled: bool = True
    own: frozenset[str] | None = None


@dataclass(frozen=True)
class MotionStage:
    """Makes the fields that the motion of actors adds to a frame, in a worker.

    Attributes:
        target: the axes and classes of the output.
        writer: the output.
        rig: the sensors.
        flow: whether flow is written.
    """

    target: AxesAndClasses
    writer: SequenceWriter
    rig: Rig
    flow: bool

    def make(self, job: MotionJob, _: object = None) -> Fields:
        """Return the fields to add to a frame."""
        return self._by_instances(job) if job.tracks is None else self._by_boxes(job, job.tracks)

    def _read_back(self, job: MotionJob, *names: str) -> Fields:
        """Return the existing fields of a frame as they were written; labels only if they are from
        the data set.
        """
        number = job.handle.number
        writer = self.writer
        wanted = [
            name
            for name in names
            if (job.labelled or name != "labels") and (not job.own or name in job.own)
        ]
        written = {name: writer.read(name, number) for name in wanted if writer.has(name, number)}
        if writer.has("points", number) and all(array is not None for array in written.values()):
            return {name: array for name, array in written.items() if array is not None}
        scan = read_scan(job.handle, self.rig, job.motion)
        return make_fields(scan, self.target, job.handle.location)

    def _turned(self, vectors: Float32Array) -> Float32Array:
        """Return points or vectors between right-handed axes and those of the output."""
        return mirror_points(vectors) if self.target.mirrored else vectors

    def _by_instances(self, job: MotionJob) -> Fields:
        """Return the flow of a scan whose points have numbers: the velocity of each point's actor,
        zero for all other points.
        """
        written = self._read_back(job, "instances") if self.flow else {}
        if "instances" not in written:
            return {}
        instances = written["instances"]
        flow = np.zeros((len(instances), 3), np.float32)
        numbered = np.flatnonzero(instances)
        for actor, velocity in job.velocities.items():
            flow[numbered[instances[numbered] == actor]] = velocity
        return {"flow": self._turned(flow)}

    def _by_boxes(self, job: MotionJob, tracks: tuple[Track, ...]) -> Fields:
        """Return labels, instances, boxes and flow of a scan whose objects have boxes.

        Labels and instances of the data set are kept.
        """
        written = self._read_back(job, "points", "labels", "instances")
        classes = self.target.classes
        labels = written.get("labels")
        scan = Scan(np.ascontiguousarray(self._turned(written["points"])[:, :3]), labels)
        segments = segment_by_boxes(
            job.handle.number, scan, job.first_T_scan, tracks, ground=classes.ground
        )
        fields: dict[str, AnyArray] = {}
        if labels is None:
            nearby = self._labelled_nearby(job)
            fields["labels"] = _labels_of(scan.points, segments, classes, nearby)
        if "instances" not in written:
            instances = fields["instances"] = np.zeros(len(scan), np.uint32)
            for segment in segments:
                instances[segment.members] = segment.instance
        boxes = _boxes_of(job, tracks)
        fields["boxes"] = (mirror_boxes(boxes) if self.target.mirrored else boxes).to_table()
        if self.flow:
            flow = np.zeros((len(scan), 3), np.float32)
            for segment in segments:
                if segment.velocity is not None:
                    flow[segment.members] = rotate_vectors(
                        invert(job.first_T_scan), segment.velocity
                    )
            fields["flow"] = self._turned(flow)
        return fields

    def _labelled_nearby(self, job: MotionJob) -> list[tuple[FloatArray, LabelArray]]:
        """Return points, in the frame of the scan of a job, and class ids of the labelled frames
        around it.
        """
        neighbours = []
        for other in job.nearby:
            written = self._read_back(other, "points", "labels")
            if "labels" in written:
                scan_T_other = invert(job.first_T_scan) @ other.first_T_scan
                points = transform_points(scan_T_other, self._turned(written["points"])[:, :3])
                neighbours.append((points, written["labels"]))
        return neighbours


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
    kept = [track for track, _ in filled.values()]
    more = Boxes.from_poses(
        np.array(list(filled), np.uint32),
        np.array([track.label for track in kept], np.uint32),
        np.array([pose for _, pose in filled.values()]).reshape(-1, 4, 4),
        np.array([track.extent.upper - track.extent.lower for track in kept]),
        np.zeros(len(kept), np.bool_),
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
