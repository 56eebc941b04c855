"""Which scans are merged into a frame, read and prepared once for all the frames that share them."""

from __future__ import annotations

import copy
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
from carlasc.errors import ArgumentError, FormatError
from carlasc.groundtruth.from_scans.merging import DYNAMICS, Dynamic, Merger, PreparedScan
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

BLOCK = 25  # frames that share their tracks; blocks have fixed bounds, so a grid does not depend on which frames a run makes
_PARTS = 30  # scans picked by distance are at least this part of `window_m` apart


@dataclass(frozen=True)
class Merging:
    """Which scans are merged into a frame, and what becomes of moving points.

    Attributes:
        window: first and last scan, in frames around the current one.
        window_m: of those, only scans within this distance driven, metres, and not two from nearly the same place.
        stride: every so manyth scan, counted from the current one.
        dynamic: "align", "current", "drop" or "tube".
        min_range_m: nearer points are left out; None: as carlasc.json says, else 0.
        max_range_m: farther points are left out; None: as carlasc.json says, else no limit.
        min_speed_m_s: slower actors stand still.

    Raises:
        ArgumentError: a value makes no sense.
    """

    window: tuple[int, int] = (-30, 30)
    window_m: float | None = None
    stride: int = 1
    dynamic: Dynamic = "align"
    min_range_m: float | None = None
    max_range_m: float | None = None
    min_speed_m_s: float = 0.3

    def __post_init__(self) -> None:
        first, last = self.window
        if first > 0 or last < 0:
            raise ArgumentError("window", expected="a range around 0 such as -30:30", found=f"{first}:{last}")
        if self.stride < 1:
            raise ArgumentError("stride", expected="at least 1", found=f"{self.stride}")
        if self.window_m is not None and not self.window_m > 0:
            raise ArgumentError("window in metres", expected="a positive number", found=f"{self.window_m}")
        if self.dynamic not in DYNAMICS:
            raise ArgumentError("dynamic", expected=f"one of {', '.join(DYNAMICS)}", found=f"{self.dynamic!r}")
        low, high = self.min_range_m or 0.0, np.inf if self.max_range_m is None else self.max_range_m
        if not 0 <= low < high:
            raise ArgumentError("ranges", expected="0 <= minimum < maximum metres", found=f"{low} and {high}")
        if not self.min_speed_m_s > 0:
            raise ArgumentError("speed threshold", expected="a positive number of m/s", found=f"{self.min_speed_m_s}")


@dataclass(frozen=True)
class _Read:
    """A scan: prepared for voting, the indices of its moving points, its actors, and who might be one but stands."""

    prepared: PreparedScan
    moving: NDArray[np.int64]
    segments: tuple[Segment, ...]
    standing: Standing


class ScanFeed:
    """The scans of one sequence, as merging needs them.

    It pickles as the sequence and the settings; what it remembers is shared by all its copies in a process. Another feed of the same sequence
    shares nothing with it: its files may have changed in between.

    Attributes:
        sequence: where the scans are.
        merging: what to do with them.
        poses: (F, 4, 4) first_T_sensor by line, if not those of poses.txt.
    """

    def __init__(self, sequence: Sequence, merging: Merging, poses: NDArray[np.float64] | None = None) -> None:
        self.sequence, self.merging = sequence, merging
        if poses is not None:
            sequence.poses = poses
        self._given_poses = poses
        metadata = sequence.metadata
        self.classes = metadata.classes
        self.min_range_m = merging.min_range_m if merging.min_range_m is not None else metadata.min_range_m or 0.0
        self.max_range_m = merging.max_range_m if merging.max_range_m is not None else metadata.max_range_m or np.inf
        self._scans: OrderedDict[int, _Read] = OrderedDict()
        self._merger: tuple[int, Merger] | None = None
        self._lock = threading.RLock()  # an executor may be of threads
        self._name = uuid4().hex

    def __reduce__(self) -> tuple[Callable[..., ScanFeed], tuple[Any, ...]]:
        return _restore, (self._name, bare(self.sequence), self.merging, self._given_poses)

    @cached_property
    def frames(self) -> NDArray[np.int64]:
        """The sequence's frames with points, sorted."""
        return self.sequence.frames("points")

    @cached_property
    def motion_source(self) -> str | None:
        """What tells how things move: "instances", "flow", "labels" (that they move, not how), or None."""
        fields = self.sequence.fields()
        if "labels" not in fields:
            return None
        if "instances" in fields:
            return "instances"
        return "flow" if "flow" in fields else "labels" if self.classes.moving else None

    def window_of(self, frame: int) -> list[int]:
        """Return the frames merged into a frame, itself among them."""
        first, last = self.merging.window
        near = self.frames[(self.frames >= frame + first) & (self.frames <= frame + last)]
        near = near[(near - frame) % self.merging.stride == 0]
        if self.merging.window_m is None:
            return [int(f) for f in near]
        return [*self._by_distance(frame, near[near < frame][::-1])][::-1] + [
            frame,
            *self._by_distance(frame, near[near > frame]),
        ]

    def reaching(self, frame: int, spec: GridSpec) -> list[int]:
        """Return the frames of the window whose scans can reach a frame's grid."""
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
        """Yield the frames, going away from `frame`, that are not too far driven and not too near each other."""
        limit = self.merging.window_m or np.inf
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
        """Return what merges the scans of a frame's block."""
        with self._lock:
            block = frame // BLOCK
            if self._merger is None or self._merger[0] != block:
                self._merger = (block, self._make_merger(block))
            return self._merger[1]

    def _make_merger(self, block: int) -> Merger:
        """Link what moves in the scans that the block's windows reach."""
        first, last = self.merging.window
        near = self.frames[(self.frames >= block * BLOCK + first) & (self.frames < (block + 1) * BLOCK + last)].tolist()
        tracks: list[Track] = []
        moving: dict[int, NDArray[np.int64]] = {}
        if self.merging.dynamic != "tube" and self.motion_source is not None:
            scans = [self.read(frame) for frame in near]
            moving = {frame: scan.moving for frame, scan in zip(near, scans, strict=True)}
            if (
                self.merging.dynamic == "align" or self.motion_source == "instances"
            ):  # only tracks tell which of these move
                segments = [segment for scan in scans for segment in scan.segments]
                times = {frame: self._time(frame) for frame in near}
                standing = {frame: scan.standing for frame, scan in zip(near, scans, strict=True)}
                tracks = link_segments(segments, times, standing, deformable=self.classes.deformable)
        return Merger(_Scans(self), tracks, moving, self.classes, self.merging.dynamic)

    def _time(self, frame: int) -> float:
        if layout.TIMES in self.sequence.documents():
            return self.sequence.read_time(frame)
        return frame * layout.FRAME_PERIOD_S

    def read(self, frame: int) -> _Read:
        """Read a scan and its moving actors; the latest ones are remembered."""
        with self._lock:
            if frame not in self._scans:
                self._scans[frame] = self._read(frame)
                first, last = self.merging.window
                while len(self._scans) > BLOCK + last - first:
                    self._scans.popitem(last=False)
            self._scans.move_to_end(frame)
            return self._scans[frame]

    def _read(self, frame: int) -> _Read:
        scan, pose = self._voting_points(frame), self.pose(frame)
        prepared = PreparedScan.of(frame, scan.points, _labels(scan), pose)
        segments: list[Segment] = []
        standing = Standing.none(frame)
        moving = np.flatnonzero(np.isin(_labels(scan), sorted(self.classes.moving)))
        if self.motion_source == "instances":
            segments = segment_by_instances(frame, scan, pose)
        elif self.motion_source == "flow":
            speed = self.merging.min_speed_m_s
            segments = segment_by_flow(frame, scan, pose, min_speed_m_s=speed)
            moving = np.concatenate([moving, *(segment.members for segment in segments)])
            standing = standing_points(frame, scan, pose, self.classes.movable, min_speed_m_s=speed)
        return _Read(prepared, moving, tuple(segments), standing)

    def _voting_points(self, frame: int) -> Scan:
        """Read a scan without the points that may not vote: unlabelled, too near, too far."""
        scan = self.sequence.scan(frame)
        check_finite(scan.points, f"{self.sequence.location}: points of frame {frame}")
        if scan.labels is None:
            scan = Scan(scan.points, np.full(len(scan), self.classes.geometry_id, np.uint32))
        labels = _labels(scan)
        self.classes.check(labels, f"{self.sequence.location}: labels of frame {frame}")
        distance = np.sqrt(np.square(scan.points).sum(axis=1))
        return scan.select((labels > 0) & (distance >= self.min_range_m) & (distance <= self.max_range_m))


class _Scans(Mapping[int, PreparedScan]):
    """A feed's prepared scans by frame, read as they are asked for."""

    def __init__(self, feed: ScanFeed) -> None:
        self._feed = feed

    def __getitem__(self, frame: int) -> PreparedScan:
        return self._feed.read(frame).prepared

    def __iter__(self) -> Iterator[int]:
        return iter(self._feed.frames.tolist())

    def __len__(self) -> int:
        return len(self._feed.frames)


_FEEDS: dict[str, ScanFeed] = {}  # of this process, by the name of the feed they are copies of: see ScanFeed


def _restore(name: str, sequence: Sequence, merging: Merging, poses: NDArray[np.float64] | None) -> ScanFeed:
    feed = _FEEDS.get(name)
    if feed is None:
        feed = ScanFeed(sequence, merging, poses)
        feed._name = name
        _FEEDS.clear()  # a run goes through its sequences one after the other
        _FEEDS[name] = feed
    return feed


def bare(sequence: Sequence) -> Sequence:
    """Return a copy of a sequence that has forgotten what it looked up: small enough to send with every frame."""
    bare = copy.copy(sequence)
    for name in [n for n in vars(bare) if isinstance(getattr(type(bare), n, None), cached_property)]:
        del vars(bare)[name]
    return bare


def _labels(scan: Scan) -> NDArray[np.unsignedinteger]:
    if scan.labels is None:
        raise FormatError("scan", expected="labels", found="none")
    return scan.labels
