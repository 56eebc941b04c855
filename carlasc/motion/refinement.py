"""Refined poses: the given poses of a drive, changed so that scans within some seconds of each
other agree.

Scans are read in order, and some hundred are kept. A stretch of scans is aligned together
(`joint_alignment`), with the end of the previous stretch, whose poses are final, and the beginning
of the next one. A quarter of the places takes no part in the alignment. There, the distance of each
scan from the surfaces of its neighbours is measured, before and after. A stretch keeps its given
motion unless this distance decreases clearly. Over longer times than a stretch, the given poses
have a weak weight.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice, pairwise
from typing import Self

import numpy as np

from carlasc.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from carlasc.core.cells import cells_of, first_of_cells
from carlasc.core.choices import LoopMode
from carlasc.core.compiling import cached
from carlasc.core.geometry import invert, multiply, small_motions, transform_points
from carlasc.errors import reading
from carlasc.motion.joint_alignment import (
    HALF_BLOCK,
    POINT_M,
    AlignmentPass,
    Clusters,
    align,
    blocks,
    planes,
    spread_of,
    to_plane,
)
from carlasc.motion.loops import Submaps, close_loops
from carlasc.motion.solving import principal_axes
from carlasc.storage.arrays import ArrayFormat, open_npz

MIN_SCANS = 3
"""Fewer scans are not refined."""

_FORMATS = {
    "given": ArrayFormat(("<f8",), (None, 4, 4)),
    "poses": ArrayFormat(("<f8",), (None, 4, 4)),
    "before_m": ArrayFormat(("<f8",), (None,)),
    "after_m": ArrayFormat(("<f8",), (None,)),
    "refined": ArrayFormat(("|b1",), (None,)),
    "fits": ArrayFormat(("|b1",), (None,)),
    "loops": ArrayFormat(("<f8",), (None, 4)),
}
_STRETCH = 2 * HALF_BLOCK  # scans whose poses become final together
_THIN_M = 0.3  # one point per cell of this size is used
_PLACE_M, _PLACES = 2.0, 4  # size of places, and one of so many is measured instead of aligned
_MEASURE = AlignmentPass(1.0, 1, 0.35, 0.1)  # planes of scans that disagree are thick
_FAR_M = 1e5  # farther points are no returns

# The distance must decrease by a factor and a length, or by less if the gain is so many standard
# errors; so many scans share an error.
_BETTER, _NEARER_M = 0.9, 0.003
_SURE, _SURELY_M, _ERRORS, _ALIKE = 0.95, 0.0005, 2.5, 5
# Greatest change of the motion from one scan to the next, and over some scans: poses of another
# drive need more.
_FARTHEST_M, _FARTHEST_RAD = 0.7, np.deg2rad(3.0)
# A drive may return if poses so far from each other, along it, are near each other; estimated poses
# are less near with the distance.
_SPARSE_M, _GONE_M, _AROUND_M, _ASTRAY = 5.0, 60.0, 40.0, 0.02
_SPAN, _OFF_M, _OFF_RAD = 10, 1.0, np.deg2rad(5.0)
# Poses fit if enough walls of single scans are flat together with the points of other scans there.
_WALL_M, _WALL_POINTS = 2.0, 12  # size of the cells, and the fewest points of a wall
_TALL_M2, _WIDE_M2 = 0.08, 0.04  # least variances of a wall upwards, and along its second axis
# with fewer walls per scan, poses fit; and the least share of common walls
_FEW_WALLS, _COMMON = 7, 0.4


@dataclass(frozen=True)
class ThinnedScan:
    """The points of one scan for the refinement of poses.

    Attributes:
        used: (N, 3) float32, metres, sensor frame: points that are aligned.
        measured: (M, 3) float32, metres, sensor frame: points in places that take no part.
    """

    used: Float32Array
    measured: Float32Array

    @classmethod
    def of(cls, points: Float32Array, world_T_sensor: FloatArray) -> Self:
        """Choose from the (N, 3) points of a scan, metres, sensor frame, which should be static."""
        near = points[(np.abs(points) < _FAR_M).all(axis=1)]
        chosen = near[first_of_cells(cells_of(near, _THIN_M))]
        x, y, z = cells_of(transform_points(world_T_sensor, chosen), _PLACE_M).T
        measured = ((x * 73856093) ^ (y * 19349663) ^ (z * 83492791)) % _PLACES == 0
        return cls(chosen[~measured], chosen[measured])


@dataclass(frozen=True)
class RefinedPoses:
    """The poses of a drive after refinement.

    Attributes:
        given: (F, 4, 4) float64 world_T_sensor of each scan before.
        poses: (F, 4, 4) float64 world_T_sensor of each scan.
        before_m: (F,) distance of each scan from the surfaces of its neighbours, under the given
            poses, metres; NaN where it is unknown.
        after_m: (F,) the same under the refined poses.
        refined: (F,) bool, the scans with a changed motion.
        fits: (F,) bool, False where walls of one scan are not flat together with the other scans:
            such poses belong to another drive or to other frames, and are not refined.
        loops: (L, 4) the loops that were closed: the rows of two scans of one place, and the
            distance of the surfaces of the two passes before and after, metres.
    """

    given: FloatArray
    poses: FloatArray
    before_m: FloatArray
    after_m: FloatArray
    refined: BoolArray
    fits: BoolArray
    loops: FloatArray = field(default_factory=partial(np.empty, (0, 4)))

    def changes(self) -> FloatArray:
        """Return the (F - 1, 6) changes of the motions from each scan to the next one: metres, then
        radians, sensor frame.
        """
        return _changes(self.given, self.poses)

    @property
    def disagreements_m(self) -> tuple[float | None, float | None]:
        """The means of `before_m` and `after_m`; None where they are unknown."""
        before, after = (
            None if math.isnan(m := finite_mean(v)) else m for v in (self.before_m, self.after_m)
        )
        return before, after

    def left(self, frames: IntArray) -> tuple[tuple[int, int], ...]:
        """Return the first and the last frame of each stretch that was not refined; `frames` are
        the (F,) numbers of the scans.
        """
        return tuple(
            (int(frames[a]), int(frames[b])) for a, b, changed in self.stretches() if not changed
        )

    def stretches(self) -> Iterator[tuple[int, int, bool]]:
        """Yield (first row, last row, whether refined) of each run of scans."""
        bounds = [0, *(np.flatnonzero(np.diff(self.refined)) + 1).tolist(), len(self.refined)]
        for first, end in pairwise(bounds):
            yield first, end - 1, bool(self.refined[first])

    def to_bytes(self, key: str) -> bytes:
        """Return the content of an `.npz` file with all of it. `key` is a digest of its source."""
        file = io.BytesIO()
        np.savez(file, key=np.frombuffer(key.encode(), np.uint8), **vars(self))
        return file.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes, where: str) -> tuple[Self, str]:
        """Return the poses of a file, and the key of their source.

        Raises:
            FormatError: the file is not valid; the message starts with `where`.
        """
        with open_npz(data, where) as file:
            key = file.read("key", ArrayFormat(("u1",), (None,))).tobytes()
            arrays = {name: file.read(name, expected) for name, expected in _FORMATS.items()}
        with reading(where, "poses refined by carlasc", "remove it"):
            if len({len(array) for name, array in arrays.items() if name != "loops"}) != 1:
                raise ValueError("arrays of different lengths")
            return cls(**arrays), key.decode()


def refine_poses(
    scans: Iterable[ThinnedScan],
    given: FloatArray,
    *,
    always: bool = False,
    loops: LoopMode = "auto",
    steps: Callable[[int], None] | None = None,
    begun: RefinedPoses | None = None,
    keep: Callable[[RefinedPoses], None] | None = None,
) -> RefinedPoses:
    """Refine the poses of a drive.

    In directions that the scans do not determine, as along a tunnel, the given poses hold. Moving
    actors among the points do little harm: their points in a cell form no plane.

    Args:
        scans: the scans, in order of time; read one after the other.
        given: (F, 4, 4) float64 world_T_sensor of the scans.
        always: whether stretches are also refined where scans do not agree better afterwards.
        loops: whether loops are closed: see `carlasc.motion.loops`.
        steps: called with the number of scans that were read since the last call.
        begun: the poses of the first scans, which an earlier call gave to `keep`.
        keep: called with the poses of the first scans, after each stretch but the last one.
    """
    count, poses = len(given), given.copy()
    before, after = np.full((2, count), np.nan)
    refined, fits = np.zeros(count, np.bool_), np.ones(count, np.bool_)
    made = RefinedPoses(given, poses, before, after, refined, fits)
    done = 0 if begun is None else len(begun.poses)
    if begun is not None:
        poses[:done] = begun.poses
        before[:done] = begun.before_m
        after[:done] = begun.after_m
        refined[:done], fits[:done] = begun.refined, begun.fits
    scans, kept, first = iter(scans), list[ThinnedScan](), 0
    begin = 0
    submaps = Submaps() if loops == "auto" and _may_return(given) else None
    while begin < count and count >= MIN_SCANS:
        end = count if count - begin < _STRETCH + HALF_BLOCK else begin + _STRETCH
        start, last = max(0, begin - HALF_BLOCK), min(end + HALF_BLOCK, count)
        del kept[: start - first]
        for scan in islice(scans, last - start - len(kept)):
            kept.append(scan)
            if steps is not None:
                steps(1)
        first = start
        near, rows = slice(start, last), slice(begin - start, end - start)
        if end > done:
            if refined.any():  # start with the correction of the previous scan
                poses[begin:last] = multiply(
                    poses[begin - 1], invert(given[begin - 1]), given[begin:last]
                )
            held = poses[near].copy()
            aligned = align([scan.used for scan in kept], held, given[near], begin - start)
            measured = [scan.measured for scan in kept]
            before[begin:end] = disagreement(measured, given[near])[rows]
            now = disagreement(measured, aligned)[rows]
            fits[begin:end] = _is_near(held, aligned) and _fit(
                [scan.used for scan in kept], aligned
            )
            chosen = fits[begin] and (always or _is_better(before[begin:end], now))
            if chosen:
                poses[begin:end], refined[begin:end] = aligned[rows], True
            after[begin:end] = now if chosen else before[begin:end]
            if keep is not None and end < count:
                measures = before[:end], after[:end], refined[:end], fits[:end]
                keep(RefinedPoses(given[:end], poses[:end], *measures))
        if submaps is not None:
            for row in range(begin, end):
                scan = kept[row - start]
                submaps.add(row, scan.used, scan.measured, poses[row])
        begin = end
    # Beside vehicles that move along, poses may seem not to fit: one such stretch bars no loop.
    if submaps is not None and fits.mean() > 0.5:
        submaps.finish()
        closed, found = close_loops(submaps.done, poses)
        if len(found) and (always or _is_better(found[:, 2], found[:, 3])):
            return replace(made, poses=closed, refined=np.ones_like(refined), loops=found)
    return made


def _may_return(given: FloatArray) -> bool:
    """Return whether a drive may come near a place again that it has left."""
    steps = np.sqrt(np.square(np.diff(given[:, :3, 3], axis=0)).sum(axis=1))
    along = np.append(0.0, np.cumsum(steps))[: len(given)]
    rows = np.flatnonzero(np.diff(along // _SPARSE_M, prepend=-1.0))
    along, places = along[rows], given[rows, :2, 3]
    for i in range(len(rows)):
        gap, off = along[i] - along[:i], places[i] - places[:i]
        near = np.hypot(off[:, 0], off[:, 1]) < _AROUND_M + _ASTRAY * gap
        if (near & (gap > _GONE_M)).any():
            return True
    return False


def _is_better(before: FloatArray, after: FloatArray) -> bool:
    gain = before - after
    both = np.isfinite(gain)
    if not both.any():
        return False
    was, now, gain = float(before[both].mean()), float(after[both].mean()), gain[both]
    error = float(gain.std()) * float(np.sqrt(_ALIKE / len(gain)))
    sure = now < min(_SURE * was, was - _SURELY_M) and was - now > _ERRORS * error
    return sure or now < min(_BETTER * was, was - _NEARER_M)


def _fit(points: Sequence[Float32Array], poses: FloatArray) -> bool:
    """Return whether enough walls of single scans are flat together with the other scans there;
    True if there are few walls.
    """
    walls = common = 0
    for block in blocks(points, poses, _WALL_M, shift=0.0):
        alone = Clusters(np.arange(len(block.scan) + 1), block.scan, block.sums)
        _, spread = spread_of(alone, poses, 1)
        is_wall = (
            (block.sums[:, 0] >= _WALL_POINTS) & _is_flat(spread) & (spread[:, 2, 2] > _TALL_M2)
        )
        shared, together = spread_of(block, poses, MIN_SCANS)
        cell = np.repeat(np.arange(len(block.start) - 1), np.diff(block.start))
        is_wall &= shared[cell]
        walls += int(is_wall.sum())
        common += int((is_wall & _is_flat(together)[cell]).sum())
    return walls < _FEW_WALLS * len(points) or common > _COMMON * walls


def _is_flat(covariances: FloatArray) -> BoolArray:
    values, _ = principal_axes(covariances)
    return np.asarray((values[:, 0] < 0.1 * values[:, 1]) & (values[:, 1] > _WIDE_M2))


def _changes(given: FloatArray, aligned: FloatArray, span: int = 1) -> FloatArray:
    before, after = (multiply(invert(poses[:-span]), poses[span:]) for poses in (given, aligned))
    return small_motions(multiply(invert(before), after))


def _is_near(held: FloatArray, aligned: FloatArray) -> bool:
    """Return whether no motion changed by more than the greatest error of the poses of a drive."""
    off = aligned[:, :3, 3] - held[:, :3, 3]
    for span, most_m, most_rad in ((1, _FARTHEST_M, _FARTHEST_RAD), (_SPAN, _OFF_M, _OFF_RAD)):
        moved = np.sqrt(np.square(off[span:] - off[:-span]).sum(axis=1))  # in the world
        turned = np.sqrt(np.square(_changes(held, aligned, span)[:, 3:]).sum(axis=1))
        if (moved > most_m).any() or (turned > most_rad).any():
            return False
    return True


def finite_mean(values: FloatArray) -> float:
    """Return the mean of the finite values; NaN without any."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else math.nan


def disagreement(points: Sequence[Float32Array], poses: FloatArray) -> FloatArray:
    """Return the (F,) root mean square distances of each scan from the planes of the others,
    metres; NaN where there are none.

    Args:
        points: (N, 3) of each scan, metres, sensor frame.
        poses: (F, 4, 4) world_T_sensor.
    """
    sums = np.zeros((len(points), 2))
    for block in blocks(points, poses, _MEASURE.cell_m, shift=0.0):
        normals, thickness = planes(block, poses, _MEASURE)
        _add_distances(block, poses, normals, thickness, sums)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sqrt(sums[:, 0] / sums[:, 1]))


@cached
def _add_distances(
    block: Clusters,
    poses: FloatArray,
    normals: FloatArray,
    thickness: FloatArray,
    result: FloatArray,
) -> None:
    """Add to `result`, (F, 2), the squared distances of the clusters of each scan from the planes
    of the others, and their number.
    """
    for g in range(len(thickness)):
        if thickness[g] < 0:
            continue
        first, last = block.start[g], block.start[g + 1]
        scan, sums = block.scan[first:last], block.sums[first:last]
        off, weight = to_plane(scan, sums, poses, normals[g], POINT_M * POINT_M + thickness[g])
        total = weight.sum()
        for i in range(len(scan)):
            if total > weight[i]:
                alone = off[i] * total / (total - weight[i])  # from the plane without this scan
                result[scan[i], 0] += alone * alone
                result[scan[i], 1] += 1.0
