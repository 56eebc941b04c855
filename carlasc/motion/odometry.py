"""Odometry: the poses of scans, and deskewing.

On a street, KISS-ICP estimates them (Vizzo et al., RA-L 2023), through its Python API. Elsewhere
(indoors, low above the ground, in the air, tilted), its points do not fix the motion: a ring of
points lies where the same ring of the scan before lay. There, scans are aligned to the planes of
the scans before.

The points of a scan are measured one after the other, while the sensor moves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import chain, islice
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyFloatArray, BoolArray, Float32Array, FloatArray, IntArray
from carlasc.core.cells import cells_of, distinct, first_of_cells
from carlasc.core.compiling import cached
from carlasc.core.geometry import (
    Transform,
    invert,
    poses_from,
    quaternions_of,
    slerp,
    transform_points,
)
from carlasc.core.scans import finite, lengths
from carlasc.errors import ArgumentError, import_extra
from carlasc.motion.ground import ground_height, ground_points
from carlasc.motion.joint_alignment import AlignmentPass, align
from carlasc.motion.loops import overlaps
from carlasc.running.spreading import Progress

MIN_POINTS = 100  # scans with fewer points do not determine the motion
_NEAR_M = 8.0  # farther ground is left out
_START = 10  # scans from which the motion at the start is estimated
_PERIOD_S = 0.1  # between scans whose times are not known

# Where scans are far apart, KISS-ICP may find that a vehicle stands that drives from the first scan
# on. Things above the sensor, seen from above, tell: poles, trees and facades, but no cars that
# drive along.
_TRIED = 4  # scans that are compared
_CELL_M, _CELLS = 0.5, 256  # of their images from above
_ABOVE_M = 0.2
_FASTEST_M_S = 40.0
_CLEARLY = 1.1  # so many times the overlap make another start the better one

# A street: most scans at the start show the ground so far below the sensor, and points far away.
_VEHICLE_M, _FAR = (1.2, 4.0), (0.95, 12.0)  # heights; a quantile of distances, and its least value
_VOXELS, _FINE_M, _COARSE_M = 20.0, 0.1, 0.2  # voxels in half of the points' distances; limits
_HELD = 10  # number of scans whose planes hold the next one
_RUNS = 4  # of scans, in which drift is measured
DRIFT_M = 0.03
"""Poses from which scans fit farther away, within ten scans, drift."""
# Of the prediction: metres and radians, as weights. A prior on the change of the motion would hold
# back a carrier that sways or climbs: on stairs, a third of each such change was lost.
_PRIOR = np.array([0.1, np.radians(4.0), np.inf, np.inf]) ** -2.0
_PASSES = (
    AlignmentPass(2.0, 4, 0.35, 0.1, 0.008),
    AlignmentPass(1.0, 4, 0.12, 0.05, 0.008),
    # Together: far walls and ceilings are flat in large cells, the treads of stairs in small ones.
    AlignmentPass(0.5, 0, 0.08, 0.03, 0.008),
    AlignmentPass(0.25, 0, 0.04, 0.1, 0.002),
    AlignmentPass(0.15, 4, 0.03, 0.2, 0.001, joined=2),
)

UsableScan = tuple[AnyFloatArray, AnyFloatArray | None]
"""(N, 3) points that `usable_points` chose, metres, sensor frame, and the (N,) seconds of each
after the time of its frame, or None.
"""


def estimate_poses(
    scans: Iterable[AnyFloatArray],
    *,
    seconds: Iterable[AnyFloatArray] | None = None,
    times: Sequence[float] | AnyFloatArray | None = None,
    max_range_m: float = 100.0,
    min_range_m: float = 0.0,
    voxel_m: float | None = None,
    total: int | None = None,
    progress: Progress | None = None,
) -> FloatArray:
    """Estimate the pose of every scan of a drive from its usable points, with the method of
    `follow_scans`.

    Args:
        scans: (N, 3) points of each scan, metres, sensor frame, right-handed or left-handed; the
            poses are in the same frame.
        seconds: (N,) time of each point of each scan, after the time of its frame.
        times: (F,) seconds, increasing: the time of each frame; None for frames at 10 Hz.
        max_range_m: farther points are not used.
        min_range_m: nearer points are not used.
        voxel_m: as in `follow_scans`.
        total: number of scans, for `progress`.
        progress: called with the number of finished scans and the number of all scans.

    Returns:
        (F, 4, 4) first_T_sensor.

    Raises:
        DependencyError: kiss-icp is not installed.
        ArgumentError: one of several scans has fewer than `MIN_POINTS` points, or not one time for
            each of its points.
    """
    poses: list[Transform] = []
    for pose in follow_scans(
        _usable(scans, seconds),
        times=times,
        max_range_m=max_range_m,
        min_range_m=min_range_m,
        voxel_m=voxel_m,
    ):
        poses.append(pose)
        if progress:
            progress(len(poses), total or len(poses))
    return np.stack(poses) if poses else np.empty((0, 4, 4))


def follow_scans(
    scans: Iterable[UsableScan],
    *,
    times: Sequence[float] | AnyFloatArray | None = None,
    max_range_m: float = 100.0,
    min_range_m: float = 0.0,
    voxel_m: float | None = None,
    note: Callable[[str], object] = lambda line: None,
) -> Iterator[Transform]:
    """Yield the pose of every scan of a drive, in order, as soon as it is known.

    The first one needs ten scans.

    With the times of points, each scan is deskewed to the time of its frame by the motion between
    the two previous scans, and the poses are for the times of the frames. (KISS-ICP's own deskewing
    gives poses at the end of each scan, and is not used.) Without them, scans count as
    instantaneous (CarlaSC) or as deskewed (SemanticKITTI). On simulated scans of a circle of 12 m
    at 8 m/s, 0.1 s each, the error of the position after 15 m is 0.27 m without the times of points
    and 0.05 m with them; on straight drives at a steady speed they do not change the poses.

    Far ground is left out: its rings move with the sensor and hide the motion at the start of a
    drive. For the same reason the first scans are registered forwards, backwards, and forwards
    again with the estimated motion: a drive may start at any speed. At 5 Hz and less, this may
    still find that the vehicle stands, so the motion under which things above the sensor overlap
    most is tried too. On a straight street without structure the driven distance is not determined,
    and the estimate is too short.

    Args:
        scans: the usable points of each scan, sensor frame, right-handed or left-handed; the poses
            are in the same frame.
        times: (F,) seconds, increasing: the time of each frame; None for frames at 10 Hz. A list
            may grow during the run, if it has the time of a scan before the scan is read.
        max_range_m: farther points are not used.
        min_range_m: nearer points are not used.
        voxel_m: size of the voxels in which points are thinned; None: by the distances of points.
        note: called with what was chosen, one line.

    Yields:
        (4, 4) first_T_sensor.

    Raises:
        DependencyError: kiss-icp is not installed.
    """
    pipeline: Any = import_extra("kiss_icp.kiss_icp", "kitti")
    config: Any = import_extra("kiss_icp.config", "kitti").KISSConfig()
    config.data.deskew = False
    config.data.max_range, config.data.min_range = max_range_m, min_range_m
    config.registration.max_num_threads = (
        1  # several threads sum in a different order each time, which changes the last digits
    )
    scans = iter(scans)
    start = list(islice(scans, _START))
    near, reach_m, chosen_m = _look(start)
    chosen_m = voxel_m or (chosen_m if near else max_range_m / 100.0)
    config.mapping.voxel_size = max_range_m / 100.0 if near else chosen_m
    begin: Callable[[], Any] = partial(pipeline.KissICP, config)
    motion = _find_start(start, times, begin, np.eye(4))
    if near:
        begin = partial(_PlaneOdometry, min_range_m, max_range_m, chosen_m)
        motion = _find_start(start, times, begin, motion)
        reach_m = min(reach_m, max_range_m)
        note(f"odometry by planes: points within {reach_m:.0f} m, in voxels of {chosen_m:.2g} m")
    elif voxel_m:
        note(f"odometry: points within {max_range_m:g} m, in voxels of {voxel_m:g} m")
    yield from _follow(begin(), enumerate(chain(start, scans)), times, motion)


def _look(start: Sequence[UsableScan]) -> tuple[bool, float, float]:
    """Return whether the first scans are of no street, how far their points reach, and the size of
    voxels that fits these, metres.
    """
    heights = np.array([-ground_height(points) for points, _ in start])
    away = np.concatenate([np.ones(1), *(lengths(points) for points, _ in start)])
    half, most, reach = np.quantile(away, (0.5, _FAR[0], 0.99)).tolist()
    low = (heights > _VEHICLE_M[0]) & (heights < _VEHICLE_M[1])
    voxel_m = round(min(max(half / _VOXELS, _FINE_M), _COARSE_M), 2)
    return not (most > _FAR[1] and 2 * low.sum() > len(start)), reach, voxel_m


class _PlaneOdometry:
    """Aligns each scan to the planes of the scans before; has what is used of KISS-ICP's API."""

    repeats = 2  # how often a scan is registered: it is deskewed by its own motion

    def __init__(self, min_range_m: float, max_range_m: float, voxel_m: float) -> None:
        self._limits, self._voxel_m = (min_range_m, max_range_m), voxel_m
        self._scans: list[AnyFloatArray] = []
        self._poses: list[Transform] = []
        self.local_map, self.last_pose, self.last_delta = self, np.eye(4), np.eye(4)

    def point_cloud(self) -> Sequence[AnyFloatArray]:
        """Return the scans."""
        return self._scans

    def forget_last(self) -> None:
        """Undo the registration of the last scan, but not what is known of its motion."""
        del self._scans[-1], self._poses[-1]
        self.last_pose = self.last_pose @ invert(self.last_delta)

    def register_frame(self, points: FloatArray, _: FloatArray) -> None:
        """Register (N, 3) points; `last_delta` is the prediction."""
        used = points.astype(np.float32)
        away = lengths(used)
        used = used[(away >= self._limits[0]) & (away <= self._limits[1])]
        self._scans.append(_thinned(used, self._voxel_m))
        before = self.last_pose
        poses = [*self._poses, self.last_pose @ self.last_delta]
        start = np.stack(poses)
        aligned = align(self._scans, start, start, len(self._poses), _PASSES, _PRIOR)[-1:]
        # exactly rigid: errors would double with each scan
        self.last_pose = poses_from(quaternions_of(aligned[:, :3, :3]), aligned[:, :3, 3])[0]
        self.last_delta = invert(before) @ self.last_pose
        self._poses.append(self.last_pose)
        del self._scans[:-_HELD], self._poses[:-_HELD]


def _thinned(points: Float32Array, voxel_m: float) -> Float32Array:
    """Return one of the (N, 3) points in each voxel."""
    return points[first_of_cells(cells_of(points, voxel_m))]


def measure_drift(points: Callable[[int], AnyFloatArray], poses: FloatArray) -> tuple[float, bool]:
    """Return how far scans that are of no street fit from their poses within ten scans, metres, and
    whether they determine their height; (0, True) on a street and for fewer scans.

    Some runs of scans are aligned from poses that rise too much: where nothing determines the
    height, they stay there.

    Args:
        points: returns the (N, 3) points of the i-th scan, metres, sensor frame.
        poses: (F, 4, 4) first_T_sensor of each scan, in order of time; rigid.
    """
    if len(poses) < _START:
        return 0.0, True
    runs = np.unique(np.linspace(0, len(poses) - _START, _RUNS).astype(int)).tolist()
    risen, drift_m, held = np.zeros((_START, 3)), 0.0, True
    risen[:, 2] = np.linspace(0.0, 2 * DRIFT_M, _START)
    for first in runs:
        read = [points(row) for row in range(first, first + _START)]
        used = [scan[usable_points(scan), :3] for scan in read]
        near, _, voxel_m = _look([(scan, None) for scan in used])
        if not near:
            break
        given = poses[first : first + _START]
        start = given.copy()
        start[:, :3, 3] += risen
        scans = [_thinned(scan.astype(np.float32), voxel_m) for scan in used]
        off = (align(scans, start, start, 1, _PASSES, _PRIOR) - given)[:, :3, 3]
        far, left = (float(np.linalg.norm(way, axis=1).max()) for way in (off, off - risen))
        if DRIFT_M < far < 2.5 * DRIFT_M and left < far:  # about where they were put
            held = False
        else:
            drift_m = max(drift_m, far)
    return drift_m, held


def _find_start(
    start: Sequence[UsableScan],
    times: Sequence[float] | AnyFloatArray | None,
    begin: Callable[[], Any],
    motion: Transform,
) -> Transform:
    """Return the motion from the first scan to the next one: `first_T_second`.

    Args:
        start: the first scans.
        times: of the frames.
        begin: makes a new odometry.
        motion: the first guess.
    """
    numbered = list(enumerate(start))
    for back in (False, True):  # forwards and backwards over the first scans
        odometry = begin()
        for _ in _follow(
            odometry, reversed(numbered) if back else numbered, times, motion, back=back
        ):
            pass  # only the last motion counts
        motion = invert(np.array(odometry.last_delta))
    above = [_cells_above(points) for points, _ in start[:_TRIED]]
    if len(above) < _TRIED or not all(map(len, above)):
        return motion
    shift = np.eye(4)
    shift[:2, 3] = _likely_shift(above, _FASTEST_M_S * _elapsed(times, 1))
    overlaps = []
    for guess in (motion, shift):
        *_, first_T_last = _follow(begin(), numbered[:_TRIED], times, guess)
        overlaps.append(_overlap(above[0], start[_TRIED - 1][0], first_T_last))
    return shift if overlaps[1] > _CLEARLY * overlaps[0] else motion


def _follow(
    odometry: Any,
    numbered: Iterable[tuple[int, UsableScan]],
    times: Sequence[float] | AnyFloatArray | None,
    motion: Transform,
    *,
    back: bool = False,
) -> Iterator[Transform]:
    """Register scans with their numbers one after the other, and yield `first_T_scan` of each;
    `motion` and `back` are those of `_register`.
    """
    first_T_map: Transform | None = None
    for number, scan in numbered:
        motion = _register(odometry, scan, motion, _elapsed(times, number), back=back)
        pose = np.array(odometry.last_pose)
        first_T_map = invert(pose) if first_T_map is None else first_T_map
        yield first_T_map @ pose


def _cells_above(points: AnyFloatArray) -> IntArray:
    """Return the distinct cells (row, column), seen from above, of things above the sensor."""
    cells = cells_of(points[points[:, 2] > _ABOVE_M, :2], _CELL_M) + _CELLS // 2
    inside = ((cells >= 0) & (cells < _CELLS)).all(axis=1)
    return np.unique(cells[inside], axis=0)


def _likely_shift(above: Sequence[IntArray], reach_m: float) -> FloatArray:
    """Return the (x, y) motion in metres between scans under which their cells overlap most, if all
    move alike without a turn.
    """
    images = np.zeros((len(above), _CELLS, _CELLS))
    for image, cells in zip(images, above, strict=True):
        image[tuple(cells.T)] = 1.0
    shared, shifts = overlaps(images[:-1], images[1:], _CELL_M)
    overlap = shared.sum(axis=0)
    overlap[np.hypot(shifts[:, None], shifts) > reach_m] = -1.0
    x, y = np.unravel_index(np.argmax(overlap), overlap.shape)
    return np.array([shifts[x], shifts[y]])


def _overlap(first: IntArray, last: AnyFloatArray, first_T_last: Transform) -> float:
    """Return the share of the cells of what is above the sensor in the last scan, (N, 3) points,
    that are among those of the first scan.
    """
    cells = _cells_above(transform_points(first_T_last, last[last[:, 2] > _ABOVE_M]))
    both = np.unique(np.concatenate([first, cells]), axis=0)
    return (len(first) + len(cells) - len(both)) / max(len(cells), 1)


def usable_points(points: AnyFloatArray) -> BoolArray:
    """Return (N,) bool, which (N, 3 or more) points of a scan odometry uses: finite ones that are
    not on far ground.
    """
    with np.errstate(invalid="ignore"):
        used = ~ground_points(points) | (np.hypot(points[:, 0], points[:, 1]) < _NEAR_M)
        return used & finite(points[:, :3])


def _usable(
    scans: Iterable[AnyFloatArray], seconds: Iterable[AnyFloatArray] | None
) -> Iterator[UsableScan]:
    """Yield the used points of each scan, and their seconds."""
    per_point = None if seconds is None else iter(seconds)
    sizes: list[int] = []
    for number, points in enumerate(scans):
        sizes.append(len(points))
        if number and min(sizes) < MIN_POINTS:  # a single scan needs no points
            raise ArgumentError(
                "scans",
                expected=f"at least {MIN_POINTS} points in every scan",
                found=f"{min(sizes)} in scan {sizes.index(min(sizes))}",
                advice="leave it out",
            )
        own = None if per_point is None else next(per_point, np.empty(0))
        if own is not None and len(own) != len(points):
            raise ArgumentError(
                "seconds",
                expected=f"{len(points)} of scan {number}, one per point",
                found=len(own),
            )
        used = usable_points(points)
        yield points[used, :3], None if own is None else np.asarray(own)[used]


def _register(
    odometry: Any, scan: UsableScan, motion: Transform, elapsed_s: float, *, back: bool = False
) -> Transform:
    """Register a scan; the previous motion is the prediction.

    Args:
        odometry: the pipeline.
        scan: points, and seconds.
        motion: before_T_scan of the previous scan.
        elapsed_s: seconds between two scans.
        back: whether scans are registered in reverse order, with `motion` from later points to
            earlier ones.

    Returns:
        before_T_scan of this scan.
    """
    points, seconds = scan
    if not len(odometry.local_map.point_cloud()):
        odometry.last_pose = invert(motion)  # so that the first scan is at the origin
    for repeat in range(1 if seconds is None else getattr(odometry, "repeats", 1)):
        if repeat:
            odometry.forget_last()
        points = scan[0]
        if seconds is not None:
            at, tick_of = ticks_of(-seconds if back else seconds)
            moved = slerp(
                np.stack([invert(motion), np.eye(4), motion]),
                np.array([-1.0, 0.0, 1.0]) * elapsed_s,
                at,
            )
            points = move_each(points, moved, tick_of)
        odometry.last_delta = motion
        odometry.register_frame(np.ascontiguousarray(points, np.float64), np.zeros(0))
        motion = np.array(odometry.last_delta)
    return motion


def _elapsed(times: Sequence[float] | AnyFloatArray | None, number: int) -> float:
    """Return the seconds from the frame before; for the first frame, to the next one."""
    if times is None or len(times) < 2:
        return _PERIOD_S
    number = max(1, min(number, len(times) - 1))
    return float(times[number] - times[number - 1])


_TICK_S = 1e-4  # points within this time share a pose: 3 mm at 30 m/s


def ticks_of(seconds: AnyFloatArray) -> tuple[FloatArray, IntArray]:
    """Return the (T,) distinct rounded times of (N,) points, seconds, increasing, and the (N,)
    index of the time of each point.
    """
    ticks, tick_of = distinct(np.round(np.asarray(seconds, np.float64) / _TICK_S).astype(np.int64))
    return np.asarray(ticks * _TICK_S, np.float64), tick_of


@cached
def move_each(points: AnyFloatArray, dst_T_then: FloatArray, tick_of: IntArray) -> FloatArray:
    """Move each point by the transform of its time.

    Args:
        points: (N, 3 or more) metres, in the frame of the sensor at the time of each point.
        dst_T_then: (T, 4, 4) transforms.
        tick_of: (N,) index of the transform of each point.

    Returns:
        (N, 3) metres.
    """
    moved = np.empty((len(points), 3))
    for i in range(len(points)):
        pose = dst_T_then[tick_of[i]]
        for a in range(3):
            moved[i, a] = (
                pose[a, 0] * points[i, 0]
                + pose[a, 1] * points[i, 1]
                + pose[a, 2] * points[i, 2]
                + pose[a, 3]
            )
    return moved
