"""The scans that are merged into each frame.

Each scan is read and prepared once for all frames that share it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterator
from collections.abc import Sequence as Sequence_
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from typing import Any
from uuid import uuid4

import numpy as np

from carlasc.core.arrays import (
    AnyArray,
    BoolArray,
    Float32Array,
    FloatArray,
    IntArray,
    LabelArray,
)
from carlasc.core.geometry import invert, moved_back, transform_points
from carlasc.core.grids import GridSpec
from carlasc.core.scans import Scan, check_finite, finite, lengths, sorted_by_origin
from carlasc.errors import FormatError, MissingDataError
from carlasc.groundtruth.from_scans.free_space import FreeSpace
from carlasc.groundtruth.from_scans.merging import Cast, Instant, Merger, PreparedScan
from carlasc.groundtruth.inputs import GridPlan, without_caches
from carlasc.groundtruth.options import FromScans
from carlasc.motion import (
    EvidenceScan,
    Segment,
    StaticPoints,
    Track,
    ground_points,
    is_fast,
    segment_by_boxes,
    segment_by_flow,
    segment_by_instances,
    static_actor_points,
)
from carlasc.motion.tracks import MovingActors
from carlasc.running.spreading import Run
from carlasc.storage import layout
from carlasc.storage.inputs import SequenceFiles, combined, content_digests
from carlasc.storage.protocol import Sequence, SequenceWriter
from carlasc.storage.views import SequenceView

_ACTOR_POINTS = (
    400  # greatest number of points of an actor in one scan, for its motion and its body
)
_SAMPLES = 5  # number of scans that decide whether labels name the ground
# greatest share of ground points with other classes: walls and kerbs give 2 to 4%, labels that are
# often wrong 15%
_OTHERWISE = 0.1
# fields of a scan that are read for its votes, and to find motion
_VOTING = "labels", "origins", "probabilities", "seconds"
_USED = *_VOTING, "flow", "instances"
_STEP_S = 0.005  # points of a scan within this time are seen at one instant: 7 cm at 15 m/s
_LATE_S = 3.0  # no point is farther in time from its frame: see `check_scan`
_PARTS = 30  # with `window_m`, scans are at least this part of it apart


@dataclass(frozen=True)
class ScanMotion:
    """The actors of one scan.

    Attributes:
        frame: frame number.
        segments: actors that may move, with at most `_ACTOR_POINTS` points each; `members` are
            complete.
        static: static points of classes that may move.
    """

    frame: int
    segments: tuple[Segment, ...]
    static: StaticPoints


class WithoutScans(SequenceView):
    """A sequence with some hidden scans. The poses and times of these frames are still known.

    A hidden frame is not among the frames of the fields of scans, and reads as a scan without
    points.

    Args:
        whole: the sequence.
        hidden: numbers of the frames whose scans are hidden.
    """

    def __init__(self, whole: Sequence, hidden: Collection[int]) -> None:
        super().__init__(whole)
        self.hidden = frozenset(hidden)

    def frames(self, field: str) -> IntArray:
        """Return the frames of a field, without hidden ones if it is a field of the scans."""
        frames = self.whole.frames(field)
        return (
            frames[~np.isin(frames, sorted(self.hidden))] if field in layout.SCAN_FIELDS else frames
        )

    def read(self, field: str, frame: int) -> AnyArray:
        """Read one field of one frame; no rows if the frame is hidden."""
        if frame not in self.hidden or field not in layout.SCAN_FIELDS:
            return self.whole.read(field, frame)
        entry = layout.SCAN_FIELDS[field]
        return np.empty(0 if entry.columns is None else (0, entry.columns), entry.dtype)


class ScanFeed:
    """The scans of one sequence for merging, with a cache.

    A feed pickles as the sequence and the options. Its copies in a process share one cache of
    scans. Another feed of the same sequence has its own cache, because files may have changed.

    Attributes:
        sequence: the sequence that the scans are read from.
        options: which scans are merged, and how.
        classes: class table of the labels.
        min_range_m: nearer points are left out, in metres.
        max_range_m: farther points are left out, in metres.
        key: the same for all copies of a feed.
        contents: digest of each scan that was compared.
        pose: returns (4, 4) first_T_sensor of a frame.
        numbered: returns the (M, 3) numbered points of a scan, metres, world, and their (M,)
            numbers; the most recent ones are cached.
        is_growing: whether more scans come: see `use`.
    """

    is_growing = False

    def __init__(self, sequence: Sequence, options: FromScans) -> None:
        self.sequence, self.options = sequence, options
        metadata = sequence.metadata
        self.classes = metadata.classes
        self.min_range_m = (
            options.min_range_m if options.min_range_m is not None else metadata.min_range_m or 0.0
        )
        self.max_range_m = (
            options.max_range_m
            if options.max_range_m is not None
            else metadata.max_range_m or np.inf
        )
        # A window of scans and one more: frames are made in order, and the next one needs all of
        # them but the first.
        first, last = options.window
        kept = lru_cache(last - first + 2)
        self._prepared = kept(self._prepare)
        self.numbered = kept(self._numbered)
        self._merger = Merger(self.read, MovingActors(), self.classes, options.dynamic)
        self._free: FreeSpace | None = None
        self._lock = threading.RLock()  # an executor may be of threads
        self.key = uuid4().hex
        self.contents: dict[int, str] = {}
        self.pose = cache(sequence.read_pose)

    def __reduce__(self) -> tuple[Callable[..., ScanFeed], tuple[Any, ...]]:
        return _restore, (self.key, without_caches(self.sequence), self.options)

    def without(self, hidden: Collection[int]) -> ScanFeed:
        """Return a feed without the scans of some frames: they neither vote nor show motion.

        The space that the recording vehicle drove through does not count as free either.
        """
        return ScanFeed(WithoutScans(self.sequence, hidden), replace(self.options, own_path=False))

    def with_poses_of(self, sequence: Sequence) -> ScanFeed:
        """Return a feed of the same scans under the poses of `sequence`."""
        other = ScanFeed(sequence, self.options)
        other.contents = self.contents
        return other

    def digest(self, writer: SequenceWriter | None, run: Run) -> str:
        """Return the digest of all scans, which identifies derived results of the sequence.

        Args:
            writer: keeps the digest of each scan.
            run: how the reading of scans is spread.
        """
        if missing := [frame for frame in self.frames.tolist() if frame not in self.contents]:
            self.contents |= content_digests(SequenceFiles(self.sequence), missing, writer, run=run)
        return combined(*(self.contents[frame] for frame in self.frames.tolist()))

    def use(self, sequence: Sequence, frames: list[int]) -> None:
        """Read a sequence that has grown, and merge only these frames from now on."""
        if sequence is not self.sequence:
            self.sequence, self.pose = sequence, cache(sequence.read_pose)
        self.is_growing, self.frames = True, np.array(frames, np.int64)
        self.times = {frame: self.time(frame) for frame in frames}

    @cached_property
    def frames(self) -> IntArray:
        """The sequence's frames with points, sorted."""
        return self.sequence.frames("points")

    @cached_property
    def times(self) -> dict[int, float]:
        """Seconds since the first frame, by frame with points."""
        times = self.sequence.times_of(self.frames).tolist()
        return dict(zip(self.frames.tolist(), times, strict=True))

    @property
    def has_labels(self) -> bool:
        """Whether the scans have labels."""
        return "labels" in self.sequence.fields()

    @cached_property
    def must_find_ground(self) -> bool:
        """Whether ground points have to be found: in some scans, no label is of a ground class."""
        if not self.classes.ground:
            return False
        ground = sorted(self.classes.ground)
        return not any(
            np.isin(self.sequence.read("labels", frame), ground).any() for frame in self.sampled
        )

    @cached_property
    def trusts_ground_labels(self) -> bool:
        """Whether labels name the ground: in some scans, few points on the ground have other
        classes.
        """
        scans = (
            [self._voting_points(frame) for frame in self.sampled] if self.classes.ground else []
        )
        on_ground = [_labels(scan)[ground_points(scan.points)] for scan in scans]
        others = sum(
            int(np.count_nonzero(~self.classes.have_role(labels, "ground"))) for labels in on_ground
        )
        return self.has_labels and others <= _OTHERWISE * sum(map(len, on_ground))

    @property
    def sampled(self) -> list[int]:
        """Some frames with labels. Other frames may have none."""
        labelled = self.sequence.frames("labels")
        chosen = (
            np.unique(np.linspace(0, len(labelled) - 1, _SAMPLES).astype(int))
            if len(labelled)
            else labelled
        )
        return labelled[chosen].tolist()

    @cached_property
    def motion(self) -> tuple[str, ...]:
        """The sources of motion: "boxes", "instances" or "flow", and "evidence"; empty if all
        points count as static.

        Raises:
            MissingDataError: the options ask for a field that the sequence does not have.
        """
        asked, fields = self.options.motion.source, self.sequence.fields()
        if self.options.dynamic == "tube" or asked == "none":
            return ()
        if asked == "evidence":
            return ("evidence",)
        usable = [
            name
            for name in ("boxes", "instances", "flow")
            if name in fields and (name == "boxes" or "labels" in fields)
        ]
        if asked == "auto":
            # Boxes may be missing, as outside of the view of a camera. Flow that was made from
            # boxes has the same gaps.
            whole = "flow" in usable and "boxes" not in usable
            return (*usable[:1], *(() if whole else ("evidence",)))
        if asked not in usable:
            raise MissingDataError(
                self.sequence.location,
                expected=f"{asked} in the sequence",
                found=", ".join(usable) or "no field that shows motion",
                advice='use `motion=MotionOptions("evidence")`, which needs points and poses only',
            )
        return (asked,)

    @property
    def needs_actors(self) -> bool:
        """Whether the actors must be found before a frame can be made.

        Flow and classes show moving points without them.
        """
        return self.options.dynamic == "align" if self.motion == ("flow",) else bool(self.motion)

    @property
    def reads_for_actors(self) -> int:
        """Number of scans that are read to find the actors; fields and evidence of motion take a
        pass each.
        """
        if not self.needs_actors:
            return 0
        return len(self.frames) * (
            any(name != "evidence" for name in self.motion) + ("evidence" in self.motion)
        )

    def window_of(self, frame: int) -> list[int]:
        """Return the frames whose scans are merged into a frame, including the frame itself."""
        # Scans are counted from the frame, not from the first one of the sequence: each frame uses
        # its own scan.
        first, last = self.options.window
        near = self.frames[(self.frames >= frame + first) & (self.frames <= frame + last)]
        near = near[(near - frame) % self.options.stride == 0]
        if self.options.window_m is None:
            return [int(f) for f in near]
        return [*self._by_distance(frame, near[near < frame][::-1])][::-1] + [
            frame,
            *self._by_distance(frame, near[near > frame]),
        ]

    def reaching(self, frame: int, spec: GridSpec) -> list[int]:
        """Return the frames of the window whose scans may have points in the frame's grid."""
        # The farthest corner of the grid and the farthest point of the scan, both as spheres: a
        # scan that cannot reach the grid costs as much as one that does.
        here = self.pose(frame)
        across = (
            float(np.linalg.norm(_corners(spec), axis=1).max())
            if spec.coordinates == "cartesian"
            else np.hypot(spec.upper[0], max(abs(spec.lower[2]), abs(spec.upper[2])))
        )
        return [
            other
            for other in self.window_of(frame)
            if np.linalg.norm(self.pose(other)[:3, 3] - here[:3, 3])
            <= across + self.read(other).reach_m
        ]

    def _by_distance(self, frame: int, others: IntArray) -> Iterator[int]:
        """Yield the frames of `others` within `window_m` that are not too close to each other, in
        order of distance from `frame`.
        """
        # The distance is that along the path. A vehicle that waits gives one scan.
        limit = self.options.window_m or np.inf
        driven, last_taken, previous = 0.0, 0.0, self.pose(frame)[:3, 3]
        for other in others:
            place = self.pose(int(other))[:3, 3]
            driven += float(np.linalg.norm(place - previous))
            previous = place
            if driven > limit:
                return
            if driven - last_taken >= limit / _PARTS:
                last_taken = driven
                yield int(other)

    def merger(self, actors: MovingActors, frame: int) -> Merger:
        """Return the merger of scans into a frame, with the actors of its window.

        Its caches are kept from frame to frame.
        """
        with self._lock:
            self._merger.actors = actors
            self._merger.forget_before(frame + self.options.window[0])
            return self._merger

    def free_space(self, plan: GridPlan) -> FreeSpace:
        """Return the maps of free space, which are kept from frame to frame."""
        first, last = self.options.window
        corners = _corners(plan.spec)
        map_T_world = invert(self.pose(int(self.frames[0])))

        @cache
        def corners_of(frame: int) -> FloatArray:
            return transform_points(self.pose(frame), corners)

        def cast_of(frame: int, within_s: float) -> Cast:
            if self.is_growing:  # the grids of later frames are not known
                return self.read(frame).cast(map_T_world, np.full(3, -np.inf), np.full(3, np.inf))
            # of all frames, made or not: counts do not depend on which frames are made
            near = self.frames[(self.frames >= frame - last) & (self.frames <= frame - first)]
            grids = [
                corners_of(other)
                for other in near.tolist()
                if abs(self.times[other] - self.times[frame]) <= within_s
            ]
            around = transform_points(map_T_world, np.concatenate(grids))
            return self.read(frame).cast(map_T_world, around.min(axis=0), around.max(axis=0))

        with self._lock:
            if self._free is None or self._free.plan != plan:
                self._free = FreeSpace(plan, map_T_world, self.options.stride, cast_of)
            return self._free

    def instant(self, frame: int) -> Instant:
        """Return the time and the pose of a frame."""
        return Instant(frame, self.time(frame), self.pose(frame))

    def time(self, frame: int) -> float:
        """Return seconds since the first frame."""
        known = self.times.get(frame)
        return float(self.sequence.times_of([frame])[0]) if known is None else known

    def read(self, frame: int) -> PreparedScan:
        """Read a scan for merging; the most recent ones are cached."""
        with self._lock:
            return self._prepared(frame)

    def _prepare(self, frame: int) -> PreparedScan:
        shows_motion = "flow" in self.motion
        scan = self._voting_points(frame, _USED if shows_motion else _VOTING)
        moving = self.classes.have_role(_labels(scan), "moving")
        if shows_motion and scan.flow is not None:
            moving |= is_fast(scan.flow, self.options.motion.min_speed_m_s)
        return PreparedScan.of(
            frame,
            scan.points,
            _labels(scan),
            self.pose(frame),
            seconds=self.time(frame),
            moving=np.flatnonzero(moving),
            origins=_places(scan),
            probabilities=scan.others.get("probabilities"),
        )

    def _numbered(self, frame: int) -> tuple[Float32Array, IntArray]:
        scan = self.sequence.scan(frame, ("instances",))
        if scan.instances is None:
            return np.empty((0, 3), np.float32), np.empty(0, np.int64)
        own = (scan.instances > 0) & finite(scan.points)
        world = transform_points(self.pose(frame), scan.points[own]).astype(np.float32)
        return world, scan.instances[own].astype(np.int64)

    def static_points(self, frame: int) -> Float32Array:
        """Return the (N, 3) points of a scan of classes that cannot move, metres, sensor frame; all
        points without labels.
        """
        scan = self.sequence.scan(frame, ("labels", "origins"))
        static = self._in_range(scan)
        if scan.labels is not None:
            static &= ~np.isin(scan.labels, sorted(self.classes.movable))
        return np.ascontiguousarray(scan.points[static], np.float32)

    def evidence_scan(self, frame: int, boxes: Sequence_[Track]) -> EvidenceScan:
        """Return a scan for evidence of motion.

        Points of actors that the fields of the sequence show are marked.

        Args:
            frame: frame number.
            boxes: the tracks of the sequence's boxes.
        """
        scan, pose = self._voting_points(frame), self.pose(frame)
        explained = np.zeros(len(scan), np.bool_)
        for segment in self._segments(frame, scan, boxes):
            explained[segment.members] = True
        labels = _labels(scan) if self.has_labels else None
        origins, times = scan.others.get("origins"), scan.others.get("seconds")
        about = self.known_ground(scan), labels, explained, origins, times
        return EvidenceScan(frame, scan.points, pose, self.time(frame), *about)

    def known_ground(self, scan: Scan | PreparedScan) -> BoolArray | None:
        """Return (N,) bool: the points of a scan whose labels are of ground; None if labels do not
        tell.
        """
        if scan.labels is None or not (self.trusts_ground_labels or self.must_find_ground):
            return None
        return self.classes.have_role(scan.labels, "ground")

    def ground(self, scan: PreparedScan) -> BoolArray:
        """Return (N,) bool: the points of a scan on the ground."""
        known = self.known_ground(scan)
        return ground_points(scan.points) if known is None else known

    def segments(self, frame: int, boxes: Sequence_[Track]) -> ScanMotion:
        """Return the actors of a scan that the fields of the sequence show.

        Args:
            frame: frame number.
            boxes: the tracks of the sequence's boxes.
        """
        scan = self._voting_points(frame)
        static = StaticPoints.empty(frame)
        speed = self.options.motion.min_speed_m_s
        if self.motion[:1] == ("flow",):
            static = static_actor_points(
                frame, scan, self.pose(frame), self.classes.movable, min_speed_m_s=speed
            )
        segments = self._segments(frame, scan, boxes)
        return ScanMotion(
            frame, tuple(segment.thinned(_ACTOR_POINTS) for segment in segments), static
        )

    def _segments(self, frame: int, scan: Scan, boxes: Sequence_[Track]) -> list[Segment]:
        """Return the actors of a scan with all their points."""
        pose = self.pose(frame)
        ground = self.classes.ground
        by = [*self.motion, ""][0]
        times, flow = scan.others.get("seconds"), scan.flow
        if times is not None and flow is not None and by in ("flow", "instances"):
            velocity = np.where(is_fast(flow)[:, None], flow, np.float32(0))
            scan = replace(scan, points=moved_back(scan.points, times, velocity))
        if by == "flow":
            return segment_by_flow(
                frame, scan, pose, min_speed_m_s=self.options.motion.min_speed_m_s
            )
        if by == "instances":
            return segment_by_instances(frame, scan, pose, ground=ground)
        return segment_by_boxes(frame, scan, pose, boxes, ground=ground) if by == "boxes" else []

    def _voting_points(self, frame: int, fields: Sequence_[str] = _USED) -> Scan:
        """Read the voting points of a scan: without unlabelled, too near and too far ones.

        Points with one origin follow each other.
        """
        scan = self.sequence.scan(frame, fields)
        check_finite(scan.points, f"{self.sequence.location}: points of frame {frame}")
        labels = scan.labels
        if labels is None:
            labels = np.full(len(scan), self.classes.geometry_id, np.uint32)
        if self.must_find_ground:
            # points without a class on the ground vote as ground
            found = ground_points(scan.points) & (labels == self.classes.geometry_id)
            labels = np.where(found, min(self.classes.ground), labels).astype(np.uint32)
        scan = replace(scan, labels=labels)
        # Checked before points are left out: a wrong id is an error wherever it is.
        self.classes.check(labels, f"{self.sequence.location}: labels of frame {frame}")
        origins, times = scan.others.get("origins"), scan.others.get("seconds")
        voting = (labels > 0) & self._in_range(scan)
        if origins is not None:
            check_finite(origins, f"{self.sequence.location}: origins of frame {frame}")
        if times is not None and not (np.abs(times) <= _LATE_S).all():
            row = int(np.argmin(np.abs(times) <= _LATE_S))
            raise FormatError(
                f"{self.sequence.location}: seconds of frame {frame}",
                expected=f"times within {_LATE_S:g} s of that of the frame",
                found=f"{times[row]} at point {row}",
            )
        places = _places(scan)
        if places is None:
            return scan.select(voting)
        order = sorted_by_origin(places)
        return scan.select(order[voting[order]])

    def _in_range(self, scan: Scan) -> BoolArray:
        """Return (N,) bool: which points are finite, and neither too near to the origins of their
        rays nor too far.
        """
        origins = scan.others.get("origins")
        with np.errstate(invalid="ignore", over="ignore"):
            distance = lengths(scan.points if origins is None else scan.points - origins)
            return (distance >= self.min_range_m) & (distance <= self.max_range_m)


def _corners(spec: GridSpec) -> FloatArray:
    """Return the (8, 3) corners of the box around a grid, metres."""
    lower, upper = list(spec.lower), list(spec.upper)
    if spec.coordinates == "cylindrical":
        lower[:2], upper[:2] = [-upper[0]] * 2, [upper[0]] * 2
    return np.array(np.meshgrid(*zip(lower, upper, strict=True)), np.float64).reshape(3, -1).T


_FEEDS: dict[str, ScanFeed] = {}  # the feed of this process, by the key of its copies: see ScanFeed


def _restore(key: str, sequence: Sequence, options: FromScans) -> ScanFeed:
    feed = _FEEDS.get(key)
    if feed is None:
        feed = ScanFeed(sequence, options)
        feed.key = key
        _FEEDS.clear()  # a run processes its sequences one after the other
        _FEEDS[key] = feed
    return feed


def _places(scan: Scan) -> Float32Array | None:
    """Return (N, 3) origins of rays, metres; with the time of each as a fourth column if the scan
    has times; None if all begin at the sensor, at one time.
    """
    origins, times = scan.others.get("origins"), scan.others.get("seconds")
    if times is None:
        return origins
    steps = np.round(times / _STEP_S).astype(np.float32) * np.float32(_STEP_S)
    return np.column_stack([np.zeros_like(scan.points) if origins is None else origins, steps])


def _labels(scan: Scan) -> LabelArray:
    if scan.labels is None:
        raise FormatError("scan", expected="labels", found="none")
    return scan.labels
