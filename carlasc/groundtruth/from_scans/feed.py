"""The scans that are merged into each frame: which ones, and read and prepared only once for all frames that share them."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import Transform
from carlasc.core.grids import GridSpec
from carlasc.core.scans import Scan, check_finite
from carlasc.errors import FormatError
from carlasc.groundtruth.from_scans.merging import Merger, PreparedScan
from carlasc.groundtruth.inputs import without_caches
from carlasc.groundtruth.options import FromScans
from carlasc.motion import (
    Segment,
    Standing,
    Track,
    link_segments,
    segment_by_flow,
    segment_by_instances,
    standing_points,
)
from carlasc.storage import layout
from carlasc.storage.protocol import Sequence

BLOCK = 25  # frames that share their tracks; blocks have fixed bounds, so a grid does not depend on the range of a run
_PARTS = 30  # with `window_m`, scans are at least this fraction of it apart


@dataclass(frozen=True)
class ScanContent:
    """What merging needs of one scan.

    Attributes:
        prepared: the scan, prepared for voting.
        moving: (M,) indices of its moving points.
        segments: its actors.
        standing: its standing points of classes that may move.
    """

    prepared: PreparedScan
    moving: NDArray[np.int64]
    segments: tuple[Segment, ...]
    standing: Standing


class ScanFeed:
    """The scans of one sequence, as merging needs them.

    A feed pickles as the sequence and the options. Its copies in a process share one cache of scans. Another feed of the same sequence has
    another cache, because files may have changed since.

    Attributes:
        sequence: the sequence that the scans are read from.
        options: which scans are merged, and how.
        classes: class table of the labels.
        min_range_m: nearer points are left out, in metres.
        max_range_m: farther points are left out, in metres.
    """

    def __init__(self, sequence: Sequence, options: FromScans) -> None:
        self.sequence, self.options = sequence, options
        metadata = sequence.metadata
        self.classes = metadata.classes
        self.min_range_m = options.min_range_m if options.min_range_m is not None else metadata.min_range_m or 0.0
        self.max_range_m = options.max_range_m if options.max_range_m is not None else metadata.max_range_m or np.inf
        self._scans: OrderedDict[int, ScanContent] = OrderedDict()
        self._merger: tuple[int, Merger] | None = None
        self._lock = threading.RLock()  # an executor may be of threads
        self._key = uuid4().hex

    def __reduce__(self) -> tuple[Callable[..., ScanFeed], tuple[Any, ...]]:
        return _restore, (self._key, without_caches(self.sequence), self.options)

    @cached_property
    def frames(self) -> NDArray[np.int64]:
        """The sequence's frames with points, sorted."""
        return self.sequence.frames("points")

    @cached_property
    def motion_source(self) -> str | None:
        """The field that motion is estimated from: "instances", "flow", "labels" (what moves, not how), or None."""
        fields = self.sequence.fields()
        if "labels" not in fields:
            return None
        if "instances" in fields:
            return "instances"
        return "flow" if "flow" in fields else "labels" if self.classes.moving else None

    def window_of(self, frame: int) -> list[int]:
        """Return the frames whose scans are merged into a frame, including the frame itself."""
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
        here = self.pose(frame)
        corners = np.array(np.meshgrid(*zip(spec.lower, spec.upper, strict=True))).reshape(3, -1).T
        across = (
            float(np.linalg.norm(corners, axis=1).max())
            if spec.coordinates == "cartesian"
            else np.hypot(spec.upper[0], max(abs(spec.lower[2]), abs(spec.upper[2])))
        )
        return [
            other
            for other in self.window_of(frame)
            if np.linalg.norm(self.pose(other)[:3, 3] - here[:3, 3]) <= across + self.read(other).prepared.reach_m
        ]

    def _by_distance(self, frame: int, others: NDArray[np.int64]) -> Iterator[int]:
        """Yield those of `others`, in order of distance from `frame`, that are within `window_m` and not too close to each other."""
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

    def pose(self, frame: int) -> Transform:
        """Return (4, 4) first_T_sensor."""
        return self.sequence.read_pose(frame)

    def merger(self, frame: int) -> Merger:
        """Return the merger of the block that contains a frame."""
        with self._lock:
            block = frame // BLOCK
            if self._merger is None or self._merger[0] != block:
                self._merger = (block, self._make_merger(block))
            return self._merger[1]

    def _make_merger(self, block: int) -> Merger:
        """Link the moving segments of all scans in the windows of the block's frames."""
        first, last = self.options.window
        near = self.frames[(self.frames >= block * BLOCK + first) & (self.frames < (block + 1) * BLOCK + last)].tolist()
        tracks: list[Track] = []
        moving: dict[int, NDArray[np.int64]] = {}
        if self.options.dynamic != "tube" and self.motion_source is not None:
            scans = [self.read(frame) for frame in near]
            moving = {frame: scan.moving for frame, scan in zip(near, scans, strict=True)}
            if (
                self.options.dynamic == "align" or self.motion_source == "instances"
            ):  # only tracks show which of these move
                segments = [segment for scan in scans for segment in scan.segments]
                times = {frame: self._time(frame) for frame in near}
                standing = {frame: scan.standing for frame, scan in zip(near, scans, strict=True)}
                tracks = link_segments(segments, times, standing, deformable=self.classes.deformable)
        return Merger(_Scans(self), tracks, moving, self.classes, self.options.dynamic)

    def _time(self, frame: int) -> float:
        if layout.TIMES in self.sequence.documents():
            return self.sequence.read_time(frame)
        return frame * layout.FRAME_PERIOD_S

    def read(self, frame: int) -> ScanContent:
        """Read a scan and its moving actors; the most recent ones are cached."""
        with self._lock:
            if frame not in self._scans:
                self._scans[frame] = self._read(frame)
                first, last = self.options.window
                while len(self._scans) > BLOCK + last - first:
                    self._scans.popitem(last=False)
            self._scans.move_to_end(frame)
            return self._scans[frame]

    def _read(self, frame: int) -> ScanContent:
        scan, pose = self._voting_points(frame), self.pose(frame)
        prepared = PreparedScan.of(frame, scan.points, _labels(scan), pose)
        segments: list[Segment] = []
        standing = Standing.empty(frame)
        moving = np.flatnonzero(np.isin(_labels(scan), sorted(self.classes.moving)))
        if self.motion_source == "instances":
            segments = segment_by_instances(frame, scan, pose)
        elif self.motion_source == "flow":
            speed = self.options.min_speed_m_s
            segments = segment_by_flow(frame, scan, pose, min_speed_m_s=speed)
            moving = np.concatenate([moving, *(segment.members for segment in segments)])
            standing = standing_points(frame, scan, pose, self.classes.movable, min_speed_m_s=speed)
        return ScanContent(prepared, moving, tuple(segments), standing)

    def _voting_points(self, frame: int) -> Scan:
        """Read a scan without the points that do not vote: unlabelled, too near or too far."""
        scan = self.sequence.scan(frame)
        check_finite(scan.points, f"{self.sequence.location}: points of frame {frame}")
        if scan.labels is None:
            scan = Scan(scan.points, np.full(len(scan), self.classes.geometry_id, np.uint32))
        labels = _labels(scan)
        self.classes.check(labels, f"{self.sequence.location}: labels of frame {frame}")
        distance = np.sqrt(np.square(scan.points).sum(axis=1))
        return scan.select((labels > 0) & (distance >= self.min_range_m) & (distance <= self.max_range_m))


class _Scans(Mapping[int, PreparedScan]):
    """A feed's prepared scans by frame, read on demand."""

    def __init__(self, feed: ScanFeed) -> None:
        self._feed = feed

    def __getitem__(self, frame: int) -> PreparedScan:
        return self._feed.read(frame).prepared

    def __iter__(self) -> Iterator[int]:
        return iter(self._feed.frames.tolist())

    def __len__(self) -> int:
        return len(self._feed.frames)


_FEEDS: dict[str, ScanFeed] = {}  # the feed of this process, by the key that its copies share: see ScanFeed


def _restore(key: str, sequence: Sequence, options: FromScans) -> ScanFeed:
    feed = _FEEDS.get(key)
    if feed is None:
        feed = ScanFeed(sequence, options)
        feed._key = key
        _FEEDS.clear()  # a run processes its sequences one after the other
        _FEEDS[key] = feed
    return feed


def _labels(scan: Scan) -> NDArray[np.unsignedinteger]:
    if scan.labels is None:
        raise FormatError("scan", expected="labels", found="none")
    return scan.labels
