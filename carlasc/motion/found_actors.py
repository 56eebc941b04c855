"""Found actors: moving actors that free space shows, and no box, instance or flow.

They are followed from scan to scan.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from carlasc.core.arrays import BoolArray, FloatArray, Int32Array, IntArray
from carlasc.core.geometry import (
    Transform,
    invert,
    multiply,
    rotation_z,
    thin,
    transform_points,
)
from carlasc.motion.evidence import (
    OWN_CELL_M,
    OWN_CELLS,
    OWN_REACH_M,
    FreeSpaceEvidence,
    MovedCluster,
    cells_around,
)
from carlasc.motion.paths import (
    Path,
    Segment,
    estimate_path,
    in_body,
    is_static,
    length_of,
    middles_of,
    misalignment,
    path_of,
)
from carlasc.motion.planes import nearest_points
from carlasc.motion.solving import best_pairs

_MAX_GAP_S = 1.0  # an actor may be hidden for this long
# maximum gap to the prediction, and maximum speed where there is no prediction
_REACH_M, _MAX_SPEED_M_S = (
    1.0,
    25.0,
)
_GROWS_M = 1.0  # a person does not become higher by so much: something else is there
_FAR_M = 15.0  # fast first test: no actor moves farther between two observations
_HISTORY = 6  # observations that the prediction is made from
_MIN_OBSERVATIONS, _MIN_PATH_M, _MIN_SPEED_M_S = 5, 1.0, 0.5  # an actor needs so much for a track
# Least extent of a path over its length: noise moves back and forth. So do vehicles that manoeuvre,
# but their observations align by this share of their distance without motion.
_STRAIGHT, _MANOEUVRES = 0.35, 0.5
_MAX_JUMP_M_S = 4.0  # greatest median deviation of the observations' steps from the path's
_PARTS_M = 1.0  # parts of one vehicle are closer to each other
_BESIDE_RAD = 0.012  # and no wider gap is between their directions
# Of a bonnet or a boot, scan lines see nothing but its end: the cabin above it is so far away at
# most, and begins below its top by so much at most.
_BONNET_M, _OVERLAP_M = 1.5, 0.1
# So high things that are not longer are a rider or a person, and no part of something else.
_WHOLE_M = (1.4, 2.2, 2.4)
_PERSON_M = (1.5, 2.3)  # actors that are narrower and lower change their shape as they move
_SHIFT_M = (
    0.5  # observations are shifted along their path by so much, to test whether they still align
)
_OBSERVATIONS, _MANY_OBSERVATIONS = 10, 30  # more than the latter do not raise the confidence
_WEIGHTS = (1.0, 1.5, -12.5, 5.0, 1.5, -4.5)  # of 1 and of the terms of `_confidence`
_EXCUSED = 1.5  # static neighbours do not count from a gain of one over this
_LEAST_CONFIDENCE = 0.5  # of an actor
_STAYS_M, _SENSOR_PATH_M = 0.5, 1.0  # points that move with the sensor, while it drives so far
_LINE_SLOPE = 0.004  # a quarter of a degree: the points of one scan line differ by less
# Parts of the recording vehicle: cells around the sensor in which nearly all scans have points,
# often at places that were free at other times; and cells beside them with such points.
_ALWAYS, _FREED, _OFTEN = 0.95, 0.3, 0.3
_BESIDE = 500  # actors, and heights of the ground, that are remembered while scans come
_BESIDE_M = 1.8  # farther beside the way of the sensor, another vehicle may drive along
# What stands on the ground beside the sensor is a rider or a person, who keeps its pace: so near
# above the ground, and so high and not longer. So is what is so high and shifts by so much beside
# the sensor: the median. A delay of at most so long, as of deskewing, moves parts as the speed
# changes.
_FOOT_M, _STANDS_M, _STRETCH_M = 0.6, 1.0, 2.6
_HIGH_M, _SHIFTS_M, _DELAY_S = 0.5, 0.04, 0.1
# A cluster that is no actor moved if this share of its points at free places were free most of the
# time: thin things are invisible from one side.
_PASSED = 0.2
_OWN_SHARE = 0.5  # an actor with so many points in these cells is none
# A cluster is split between chains of so many observations, whose middles are expected so near to
# it, and whose velocities differ by so much. So many points of their last ones stand for them.
_KNOWN, _NEAR_M, _APART_M_S, _MODEL = 3, 0.2, 1.0, 80
# A vehicle that is so long, and turns by so much, may have a joint: then points of its front are
# so far beside its rear half. Shares of points beyond each end, and least number of points.
_LONG_M, _BENDS_RAD, _ASIDE_M, _END, _MIN_PART = 9.0, 0.3, 0.3, 0.02, 10
_KEPT = 400  # points of an observation that are kept
_SAMPLES = 300  # points of an observation that are compared with those of another


class FoundActor(NamedTuple):
    """A moving actor, over time.

    Attributes:
        segments: its points in each scan, in order of frames. If free space shows it, `velocity` is
            estimated, and `instance` is its number.
        rigid: whether it keeps its shape, as vehicles do; None: its class decides.
        confidence: probability that it is real, from 0 to 1: see `_confidence`.
        path: the result of `estimate_path`; None: it is not estimated yet.
    """

    segments: Sequence[Segment]
    rigid: bool | None = None
    confidence: float = 1.0
    path: Path | None = None


class ActorFollower:
    """Follows what moved from scan to scan.

    Attributes:
        moved: (M,) indices of the points that moved, by frame: those of clusters that rays passed
            through, tracked or not.
        own: (6,) lower and upper corners of the parts of the recording vehicle, metres, sensor
            frame; known after `finish`.
        riders: the numbers of the actors that are such parts; known after `finish`.
        replaced: the numbers of actors that were estimated again since: see `again`.
        seen: number of points of all scans so far.
    """

    def __init__(
        self,
        *,
        deformable: Collection[int] = (),
        first_instance: int = 1,
        default_label: int = 0,
    ) -> None:
        """Start before the first scan.

        Args:
            deformable: classes of actors that change their shape as they move. Without labels,
                small actors do.
            first_instance: number of the first actor; others follow in the order of their last
                observations.
            default_label: class of actors without labels.
        """
        self.moved: dict[int, Int32Array] = {}
        self.own: list[FloatArray] = []
        self.riders: set[int] = set()
        self.replaced: set[int] = set()
        self.seen = 0
        # in how many scans each cell has points, and in how many clusters
        self._near, self._freed = np.zeros((2, OWN_CELLS**3), np.int64)
        self._cells: dict[int, list[IntArray]] = {}
        self._beside: list[int] = []
        self._poses: list[Transform] = []
        self._grounds: list[float] = []
        self._close: list[tuple[int, Int32Array, IntArray]] = []
        self._deformable = deformable
        self._label = default_label
        self._number = first_instance
        self._alive: list[_ActorChain] = []

    def add(self, scan: FreeSpaceEvidence) -> list[FoundActor]:
        """Add the evidence of the next scan, and return the actors with enough evidence that ended
        before it.
        """
        passed = (
            cluster.segment.members
            for cluster in scan.clusters
            if cluster.passed >= _PASSED * cluster.freed
        )
        moved = np.sort(np.concatenate([np.empty(0, np.int64), *passed]))
        self.moved[scan.frame] = moved.astype(np.int32)
        self.seen += scan.count
        self._poses.append(scan.world_T_sensor)
        if np.isfinite(scan.ground_m):
            self._grounds.append(scan.ground_m)
        self._near[scan.near] += 1
        sensor_T_world = invert(scan.world_T_sensor)
        for segment, *_ in scan.clusters:
            local = transform_points(sensor_T_world, segment.points)
            cells = cells_around(local)
            self._freed[cells] += 1
            if len(cells) and np.abs(local).max() < OWN_REACH_M:
                self._close.append((scan.frame, segment.members.astype(np.int32), cells))
        before, self._alive = self._alive, []
        ended = list[_ActorChain]()
        for one in before:
            over = scan.seconds - one.last.seconds > _MAX_GAP_S
            (ended if over else self._alive).append(one)
        actors = self._actors(ended)
        _link(scan, self._alive, self._deformable)
        return actors

    def finish(self) -> list[FoundActor]:
        """Return the actors that have not ended, and find the parts of the recording vehicle."""
        actors = self._actors(self._alive)
        self.find_own()
        return [actor for actor in actors if actor.segments[0].instance not in self.riders]

    def again(self, before_s: float, most: int) -> list[FoundActor]:
        """Return some of the actors that have not ended, under new numbers: at most `most` of those
        that began, or were estimated, before a time.
        """
        due = [one for one in self._alive if one.estimated_s < before_s]
        return self._actors(sorted(due, key=lambda one: one.estimated_s)[:most])

    def find_own(self) -> None:
        """Find the parts of the recording vehicle."""
        own = self._own_cells()
        beside = np.zeros_like(own)
        for number in self._beside:
            beside.flat[np.concatenate(self._cells[number])] = True
        own &= ~_widened(beside)
        for number, seen in self._cells.items():
            elsewhere = sum(not len(cells) for cells in seen)
            inside = own.ravel()[np.concatenate(seen)]
            if inside.sum() > _OWN_SHARE * (len(inside) + elsewhere):
                self.riders.add(number)
        lower = (np.argwhere(own) - OWN_CELLS // 2) * OWN_CELL_M
        self.own = list(np.hstack([lower - OWN_CELL_M, lower + 2 * OWN_CELL_M]))
        wide = _widened(own).ravel()
        for frame, members, cells in self._close:
            if wide[cells].all():  # found by their place
                self.moved[frame] = np.setdiff1d(self.moved[frame], members)

    def forget_before(self, frame: int) -> None:
        """Forget observations before a frame, but not those of how the last scans move."""
        self.moved = {scan: moved for scan, moved in self.moved.items() if scan >= frame}
        self._close = [close for close in self._close if close[0] >= frame]
        del self._grounds[:-_BESIDE]
        oldest = self._number - _BESIDE
        self._cells = {n: cells for n, cells in self._cells.items() if n >= oldest}
        self._beside = [number for number in self._beside if number >= oldest]
        for one in self._alive:
            one.links = [
                *(link for link in one.links[:-_HISTORY] if link.segment.frame >= frame),
                *one.links[-_HISTORY:],
            ]

    def _own_cells(self) -> BoolArray:
        """Return the cells of the recording vehicle, as a cube: what stays at one place of the
        sensor frame over the whole drive, and is not static.
        """
        poses = np.array(self._poses).reshape(-1, 4, 4)
        scans = len(self._poses)
        near, freed = (count.reshape((OWN_CELLS,) * 3) for count in (self._near, self._freed))
        steps = np.diff(poses[:, :3, 3], axis=0)
        if np.abs(steps).sum(axis=0).max(initial=0.0) < _SENSOR_PATH_M:
            return np.zeros(near.shape, np.bool_)
        x, y, _ = multiply(invert(poses[:-1])[:, :3, :3], steps[..., None]).sum(axis=0)[:, 0]
        places = (np.arange(OWN_CELLS) - OWN_CELLS // 2) * OWN_CELL_M
        across_m = np.abs(x * places - y * places[:, None]) / max(float(np.hypot(x, y)), 1e-6)
        own = (near >= _ALWAYS * scans) & (freed >= _FREED * scans)
        own &= (across_m < _BESIDE_M)[..., None]
        while (more := _widened(own) & ~own & (freed >= _OFTEN * scans)).any():
            own |= more
        return own

    def _actors(self, chains: list[_ActorChain]) -> list[FoundActor]:
        actors, ground_m = [], float(np.median(self._grounds or [np.nan]))
        waiting = chains[::-1]
        for one in chains:
            self.replaced |= one.numbers
            one.numbers.clear()
            one.estimated_s = one.last.seconds
        while waiting:
            one = waiting.pop()
            if actor := one.actor(self._deformable, self._number, self._label):
                actor, ahead = one.split(actor)
                waiting += ahead
                actors.append(actor)
                one.numbers.add(self._number)
                self._cells[self._number] = one.cells()
                self._beside += [self._number] if one.is_beside(ground_m) else []
                self._number += 1
        return actors


@dataclass(frozen=True)
class _Link:
    """One observation of a chain."""

    seconds: float
    segment: Segment
    lower: FloatArray
    upper: FloatArray
    freed: int  # points at places that were free at other times
    around: int  # static points around it
    world_T_sensor: Transform

    @classmethod
    def of(cls, evidence: FreeSpaceEvidence, cluster: MovedCluster) -> _Link:
        segment, freed, _, around = cluster
        lower, upper = segment.points.min(axis=0), segment.points.max(axis=0)
        pose = evidence.world_T_sensor
        return cls(evidence.seconds, segment, lower, upper, freed, around, pose)

    @property
    def middle(self) -> FloatArray:
        return (self.lower + self.upper) / 2

    @property
    def label(self) -> int:
        return self.segment.label

    def part(self, chosen: BoolArray) -> _Link:
        """Return the observation of some of its points."""
        segment = self.segment.part(chosen)
        share = len(segment.members) / len(self.segment.members)
        return replace(
            self,
            segment=segment,
            lower=segment.points.min(axis=0),
            upper=segment.points.max(axis=0),
            freed=round(self.freed * share),
            around=round(self.around * share),
        )

    @property
    def is_small(self) -> bool:
        """Whether it is not larger than a person."""
        return _is_small(self.upper - self.lower)

    @property
    def is_whole(self) -> bool:
        """Whether it has the size of a rider or a person."""
        length, width, height = self.upper - self.lower
        low, high, long = _WHOLE_M
        return bool(low < height < high and np.hypot(length, width) < long)

    def joined(self, other: _Link) -> _Link:
        """Return the two as one observation."""
        return replace(
            self,
            segment=self.segment.joined(other.segment),
            lower=np.minimum(self.lower, other.lower),
            upper=np.maximum(self.upper, other.upper),
            freed=self.freed + other.freed,
            around=self.around + other.around,
        )


class _ActorChain:
    """The observations of one actor in consecutive scans."""

    def __init__(self, links: list[_Link], numbers: set[int]) -> None:
        self.links = links
        self.numbers = numbers  # of its last estimate and of the parts that were split from it
        self.estimated_s = links[0].seconds  # of its last observation then; before: of the first
        self.velocity = np.zeros(3)  # m/s over the last observations; 0 for a single one

    @property
    def last(self) -> _Link:
        return self.links[-1]

    @property
    def seconds(self) -> FloatArray:
        """(F,) times of the observations."""
        return np.array([link.seconds for link in self.links])

    def append(self, link: _Link) -> None:
        """Continue the chain."""
        self.links.append(link)
        recent = self.links[-_HISTORY:]
        seconds = np.array([link.seconds for link in recent])
        # The visible faces change: the velocities of the lower corner, the middle and the upper
        # corner are compared, and the lowest one counts.
        offsets = seconds - seconds.mean()
        lower, upper = _bounds(recent)
        corners = np.stack([lower, (lower + upper) / 2, upper], axis=1)
        slopes = (offsets[:, None, None] * corners).sum(axis=0) / np.square(offsets).sum()
        least = np.take_along_axis(slopes, np.abs(slopes).argmin(axis=0)[None], axis=0)[0]
        self.velocity = np.where(np.abs(slopes).max(axis=0) > 0, (least + slopes[1]) / 2, 0.0)

    def shift(self, seconds: float) -> FloatArray:
        """Return (3,) how far the actor has come at a time since its last observation, metres."""
        return self.velocity * (seconds - self.last.seconds)

    def is_apart(self, other: _ActorChain) -> bool:
        """Whether it cannot be a part of the same actor."""
        if self.last.is_whole and other.last.is_whole:
            return True
        return float(np.hypot(*(self.velocity - other.velocity)[:2])) > _APART_M_S

    def actor(
        self, deformable: Collection[int], instance: int, default_label: int
    ) -> FoundActor | None:
        """Return the actor; None unless its observations align better along a path than without
        motion.
        """
        if len(self.links) < _MIN_OBSERVATIONS:
            return None
        seconds = self.seconds
        segments = [link.segment for link in self.links]
        votes = np.bincount([s.label for s in segments], [len(s.members) for s in segments])
        label = int(votes.argmax()) or default_label
        sizes = np.quantile([link.upper - link.lower for link in self.links], 0.8, axis=0)
        rigid = label not in deformable if votes.argmax() and deformable else not _is_small(sizes)
        path = positions, velocities, _ = path_of(segments, seconds, rigid=rigid)
        segments = [s.at_frame(v) for s, v in zip(segments, velocities, strict=True)]
        samples = [segment.points for segment in segments]
        speeds = np.linalg.norm(velocities[:, :2], axis=1)
        extent = np.ptp(positions[:, :2], axis=0).max()
        if extent < _MIN_PATH_M or np.quantile(speeds, 0.9) < _MIN_SPEED_M_S:
            return None
        length = np.linalg.norm(np.diff(positions[:, :2], axis=0), axis=1).sum()
        if extent < _STRAIGHT * length:
            still, moved = misalignment(samples, path, seconds)
            if not moved < _MANOEUVRES * still:
                return None
        middles = np.stack([link.middle for link in self.links])
        steps = np.linalg.norm(np.diff(middles - positions, axis=0)[:, :2], axis=1) / np.diff(
            seconds
        )
        if np.median(steps) > _MAX_JUMP_M_S or is_static(samples, path, seconds):
            return None
        confidence = self._confidence(samples, path)
        if confidence < _LEAST_CONFIDENCE:
            return None
        parts = [
            replace(segment, label=label, velocity=velocity, instance=instance)
            for segment, velocity in zip(segments, velocities, strict=True)
        ]
        return FoundActor(parts, rigid, confidence, path)

    def split(self, actor: FoundActor) -> tuple[FoundActor, list[_ActorChain]]:
        """Split a vehicle with a joint, of which this is the actor: return what follows the path of
        its rear half, and the chain of what is beside that, if any.
        """
        segments, path = actor.segments, actor.path
        samples = [segment.points for segment in segments]
        if path is None or length_of(samples) < _LONG_M or np.ptp(path[2]) < _BENDS_RAD:
            return actor, []
        along = [points[:, 0] for points in in_body(samples, path[0], path[2])]
        middle = np.quantile(np.concatenate(along), (_END, 1 - _END)).mean()
        rear = [own < middle for own in along]
        halves = [points[own] for points, own in zip(samples, rear, strict=True)]
        behind = estimate_path(halves, self.seconds, rigid=True)
        across = [points[:, 1] for points in in_body(samples, behind[0], behind[2])]
        shown = np.concatenate([y[own] for y, own in zip(across, rear, strict=True)])
        low, high = np.quantile(shown, (_END, 1 - _END))
        beside = [(y < low - _ASIDE_M) | (y > high + _ASIDE_M) for y in across]
        parts = [
            link.part(own)
            for link, own in zip(self.links, beside, strict=True)
            if own.sum() >= _MIN_PART
        ]
        # Two vehicles that were taken for one have scans that show one of them only.
        if len(parts) < _MIN_OBSERVATIONS or any(own.all() for own in beside):
            return actor, []
        left = [segment.part(~own) for segment, own in zip(segments, beside, strict=True)]
        ahead = _ActorChain(parts, self.numbers)
        return actor._replace(segments=left, path=behind), [ahead]

    def _confidence(self, samples: list[FloatArray], path: Path) -> float:
        """Return the probability that the actor is real, from 0 to 1; the arguments are those of
        `misalignment`.

        It is the logistic function of a weighted sum of these terms: the share of its points at
        places that were seen free; the share of static points among all points around it, which
        counts less the better the path is known; the share by which its observations align better
        than shifted along its path; the logarithm of their number; and whether it is a scan line.
        The second and the third term reject pieces of rails, fences and hedges: these have static
        neighbours, and align as well after any shift.
        """
        shifts = (0.0, -_SHIFT_M, _SHIFT_M)
        _, best, *shifted = misalignment(samples, path, self.seconds, shifts)
        counts = np.array(
            [(len(link.segment.members), link.freed, link.around) for link in self.links]
        )
        points, freed, around = counts.sum(axis=0).tolist()
        gain = 1.0 - best / max(min(shifted), 1e-3)
        is_line = self._is_scan_line()
        # who walks along a wall has static neighbours, and aligns at one place only
        aside = 1.0 if is_line else float(np.clip(1.0 - _EXCUSED * gain, 0.0, 1.0))
        support = float(np.log(min(len(self.links), _MANY_OBSERVATIONS) / _OBSERVATIONS))
        terms = (
            1.0,
            freed / points,
            aside * around / (points + around),
            gain,
            support,
            float(is_line),
        )
        return 1.0 / (
            1.0
            + float(
                np.exp(-sum(weight * term for weight, term in zip(_WEIGHTS, terms, strict=True)))
            )
        )

    def cells(self) -> list[IntArray]:
        """Return the cells around the sensor in which each observation has points."""
        return [cells_around(points) for points in self._local()]

    def is_beside(self, ground_m: float) -> bool:
        """Return whether it is a rider or a person beside the sensor, and no part of the recording
        vehicle: it stands on the ground, or is high and does not stay in place in the sensor frame.

        `ground_m` is the height of the ground, metres, sensor frame; NaN if it is unknown.
        """
        local = self._local()
        bounds = [(points.min(axis=0), points.max(axis=0)) for points in local]
        lower, upper = np.median(bounds, axis=0)
        length, width, high = upper - lower
        if (
            lower[2] - ground_m < _FOOT_M
            and np.hypot(length, width) < _STRETCH_M
            and high > _STANDS_M
        ):
            return True
        poses = np.stack([link.world_T_sensor for link in self.links])
        speed = np.gradient(poses[:, :3, 3], self.seconds, axis=0)
        speed = multiply(invert(poses)[:, :3, :3], speed[..., None])[:, :2, 0]
        middles, change = middles_of(local)[:, :2], speed - speed.mean(axis=0)
        delay = (middles * change).sum() / max(np.square(change).sum(), 1e-3)
        left = middles - np.clip(delay, -_DELAY_S, _DELAY_S) * speed
        apart = np.median(np.abs(left - np.median(left, axis=0)), axis=0)
        return bool(np.hypot(*apart) > _SHIFTS_M and high > _HIGH_M)

    def _local(self) -> list[FloatArray]:
        return [
            transform_points(invert(link.world_T_sensor), link.segment.points)
            for link in self.links
        ]

    def _is_scan_line(self) -> bool:
        """Return whether its points are of one scan line and move with the sensor, as where a scan
        line meets a rail.
        """
        local = self._local()
        driven = np.ptp([link.world_T_sensor[:3, 3] for link in self.links], axis=0).max()
        middles = middles_of(local)
        stays = np.median(np.abs(middles - np.median(middles, axis=0)), axis=0).max() < _STAYS_M
        x, y, z = np.concatenate(local).T
        slopes = np.quantile(z / np.maximum(np.hypot(x, y), 1e-3), (0.05, 0.95))
        return bool(stays and driven > _SENSOR_PATH_M and np.ptp(slopes) < _LINE_SLOPE)


def _widened(cells: BoolArray) -> BoolArray:
    """Return the cells of a cube, and those beside them."""
    blocks = np.lib.stride_tricks.sliding_window_view(np.pad(cells, 1), (3, 3, 3))
    return np.asarray(blocks.any(axis=(3, 4, 5)))


def _bounds(links: list[_Link]) -> FloatArray:
    """Return the lower and the upper corners of observations: (2, L, 3)."""
    return np.array([(link.lower, link.upper) for link in links]).reshape(-1, 2, 3).swapaxes(0, 1)


def _is_small(size: FloatArray) -> bool:
    return float(np.hypot(size[0], size[1])) < _PERSON_M[0] and float(size[2]) < _PERSON_M[1]


def _split(links: list[_Link], alive: list[_ActorChain]) -> Iterator[_Link]:
    """Split each cluster in which several actors are expected that move differently, or that are
    riders or people: each point belongs to the nearest of the points that are expected.
    """
    known = [chain for chain in alive if len(chain.links) >= _KNOWN]
    if not (known and links):
        yield from links
        return
    known.sort(key=lambda chain: -len(chain.links))
    moves = [chain.shift(links[0].seconds) for chain in known]
    middles = np.array([one.last.middle + move for one, move in zip(known, moves, strict=True)])
    labels = np.array([chain.last.label for chain in known])
    for link in links:
        near = (middles > link.lower - _NEAR_M) & (middles < link.upper + _NEAR_M)
        inside = list[int]()
        for k in np.flatnonzero(near[:, :2].all(axis=1) & (labels == link.label)):
            if all(known[k].is_apart(known[other]) for other in inside):
                inside.append(int(k))
        if len(inside) < 2:
            yield link
            continue
        models = [thin(known[k].last.segment.points, _MODEL) + moves[k] for k in inside]
        of_chain = np.repeat(np.arange(len(models)), [len(model) for model in models])
        nearest = of_chain[nearest_points(link.segment.points, np.concatenate(models))[0]]
        yield from (link.part(nearest == k) for k in np.unique(nearest))


def _join_parts(links: list[_Link], deformable: Collection[int]) -> list[_Link]:
    """Join clusters of one vehicle.

    Rays that meet a side at a grazing angle are far apart, and split it.
    """
    joined, i = list(links), 0
    lower, upper = _bounds(links)
    while i < len(joined):
        gaps = np.maximum(lower[i] - upper[i + 1 :], lower[i + 1 :] - upper[i])
        near = np.flatnonzero((gaps <= _BONNET_M).all(axis=1)) + i + 1
        parts = (j for j in near.tolist() if _are_parts(joined[i], joined[j], deformable))
        j = next(parts, None)
        if j is None:
            i += 1
            continue
        joined[i] = joined[i].joined(joined.pop(j))
        lower, upper = np.delete(lower, j, axis=0), np.delete(upper, j, axis=0)
        lower[i], upper[i] = joined[i].lower, joined[i].upper
    return joined


def _is_rider(link: _Link, deformable: Collection[int]) -> bool:
    """Return whether an observation is a rider or a person by its size, which counts where no label
    tells them from parts of vehicles.
    """
    return link.is_whole and not (link.label and deformable)


def _are_parts(one: _Link, other: _Link, deformable: Collection[int]) -> bool:
    label = one.label
    if label != other.label or label in deformable:
        return False
    if _is_rider(one, deformable) and _is_rider(other, deformable):
        return False
    if not (label and deformable) and one.is_small and other.is_small:
        return False
    samples = [thin(link.segment.points, _SAMPLES) for link in (one, other)]
    # No ray passes between two parts of one side, however far apart it meets them.
    ahead = samples[0][0] - one.segment.origin
    directions = rotation_z(-float(np.arctan2(ahead[1], ahead[0])))[:2, :2]
    seen = [multiply(points[:, :2] - one.segment.origin[:2], directions.T) for points in samples]
    angles = [np.arctan2(y, x) for x, y in (places.T for places in seen)]
    gap = max(a.min() - b.max() for a, b in (angles, angles[::-1]))
    # Nor does one between a bonnet and the cabin above it, which is not wider.
    (bonnet, below), (cabin, over) = sorted(
        zip((one, other), angles, strict=True), key=lambda part: float(part[0].lower[2])
    )
    wider = max(below.min() - over.min(), over.max() - below.max())
    above = cabin.lower[2] > bonnet.upper[2] - _OVERLAP_M and wider < _BESIDE_RAD
    apart_m = _BONNET_M if above and not cabin.is_small else _PARTS_M
    return bool(gap < _BESIDE_RAD and nearest_points(*samples)[1].min() < apart_m**2)


def _link(
    evidence: FreeSpaceEvidence, alive: list[_ActorChain], deformable: Collection[int]
) -> None:
    """Continue chains with the clusters of a scan, best pairs first; join further parts to them;
    start new chains with the rest.
    """
    clusters = [_Link.of(evidence, cluster) for cluster in evidence.clusters]
    # bounds stay those of all points
    apart = [replace(p, segment=p.segment.thinned(_KEPT)) for p in _split(clusters, alive)]
    links = _join_parts(apart, deformable)
    taken = best_pairs(_costs(links, alive) if alive and links else [])
    main = sorted(taken, key=taken.__getitem__)
    # where the chains are expected
    moved = np.array([alive[taken[k]].shift(evidence.seconds) for k in main]).reshape(-1, 3)
    lower, upper = _bounds([alive[taken[k]].last for k in main]) + moved
    extra = dict[int, int]()
    for i, link in enumerate(links):
        if i not in taken and not _is_rider(link, deformable):
            covers = (link.middle > lower - 0.3) & (link.middle < upper + 0.3)
            for row in np.flatnonzero(covers[:, :2].all(axis=1)).tolist():
                if links[main[row]].label == link.label:
                    extra[i] = main[row]
    for i, k in extra.items():
        links[k] = links[k].joined(links[i])
    for i, j in taken.items():
        alive[j].append(links[i])
    rest = [link for i, link in enumerate(links) if i not in taken and i not in extra]
    alive += [_ActorChain([link], set()) for link in rest]


def _costs(links: list[_Link], alive: list[_ActorChain]) -> list[tuple[float, int, int]]:
    """Return how badly each observation continues each chain that it can continue, with the numbers
    of both.
    """
    ends = [chain.last for chain in alive]
    label = np.array([end.label for end in ends])
    seconds = np.array([end.seconds for end in ends])
    lower, upper = _bounds(ends)
    middle, size = (lower + upper) / 2, upper - lower
    fresh = np.array([len(chain.links) == 1 for chain in alive])
    velocity = np.stack([chain.velocity for chain in alive])
    # (L, A, 3): of each observation and each chain
    low, high = _bounds(links)[:, :, None]
    at = (low + high) / 2
    elapsed = links[0].seconds - seconds
    shift = velocity * elapsed[:, None]
    gap = np.maximum(np.maximum(lower + shift - high, low - upper - shift), 0.0)
    reach = _REACH_M + np.where(fresh, np.minimum(_MAX_SPEED_M_S * elapsed, 4.0), 0.0)
    aside = np.linalg.norm((at - middle - shift)[..., :2], axis=-1)
    can = label == np.array([link.label for link in links])[:, None]
    can &= np.abs(middle - at).max(axis=-1) < _FAR_M
    can &= (np.linalg.norm(gap[..., :2], axis=-1) <= reach) & (gap[..., 2] <= _REACH_M)
    can &= aside <= 3 * reach + 2.0
    small = np.array([end.is_small for end in ends])
    height = (high - low)[..., 2]
    can &= ~(small & (height > _WHOLE_M[1]) & (height - size[:, 2] > _GROWS_M))
    sizes = np.abs((high - low) - size).sum(axis=-1)
    cost = np.linalg.norm(gap, axis=-1) + 0.3 * aside + 0.2 * sizes
    return [(float(cost[i, j]), i, j) for i, j in np.argwhere(can).tolist()]
