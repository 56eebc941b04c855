"""The agreement of poses with scans: how well scans overlap under the poses, and which known
mistake explains a poor overlap.

The structure of a scan, moved by the poses, must overlap the structure of an earlier scan. The
share of its points that do is measured for the poses as they are, and for the poses with each known
mistake corrected. The correction with the highest mean over all pairs of scans is reported, if it
raises the share by more than chance could, and on most of the pairs that it changes: a mirrored y
axis, for instance, changes nothing on a straight road.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeAlias

import numpy as np

from carlasc.core.arrays import AnyArray, AnyFloatArray, BoolArray, FloatArray
from carlasc.core.cells import warped_voxels
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform, choices_of_axes, invert, transform_points, translation
from carlasc.core.grids import GridSpec
from carlasc.errors import CarlascError
from carlasc.inspection.pose_quality import PoseQuality, angles_of, measure_poses
from carlasc.motion.joint_alignment import blocks, spread_of
from carlasc.motion.odometry import measure_drift
from carlasc.motion.solving import principal_axes
from carlasc.storage.protocol import Sequence

MIN_RANGE_M = 3.0
MAX_RANGE_M = 30.0
# nearest points indoors: where half of them are so near
_INDOORS_M = 1.0
_NEAR_M = 5.0
_STANDS_M_S = 0.1  # slower points stand
_COLUMN_M = 0.4
_UPRIGHT_M = 0.6  # points in a column that spans less height are ground
_FOOT_M = 0.3  # lowest part of an upright column, which counts as ground
VOXEL_M = 0.4
"""Size of the cells."""

_SPACE = GridSpec(
    "cartesian",
    (int(2 * MAX_RANGE_M / VOXEL_M),) * 3,
    (-MAX_RANGE_M,) * 3,
    (MAX_RANGE_M,) * 3,
)


def static_structure(sequence: Sequence, frame: int) -> FloatArray:
    """Read the structure of a scan.

    Args:
        sequence: has the field `points`; `labels` and `flow` are used if the sequence has them and
            they fit.
        frame: frame number.

    Returns:
        (M, 3) float64 points, metres, in the frame of the sensor.

    Raises:
        CarlascError: the points cannot be read.
    """
    points = np.asarray(sequence.read("points", frame))[:, :3]
    labels = _per_point(sequence, "labels", frame, len(points))
    flow = _per_point(sequence, "flow", frame, len(points))
    return structure_of(points, labels, flow, sequence.metadata.classes)


def structure_of(
    points: AnyFloatArray,
    labels: AnyArray | None,
    flow: AnyArray | None,
    classes: ClassTable,
) -> FloatArray:
    """Return the structure of a scan.

    Args:
        points: (N, 3) metres, in the frame of the sensor.
        labels: (N,) class ids; None if the scan has none.
        flow: (N, 3) velocity over ground, m/s; None if it is not known.
        classes: table of the ids.

    Returns:
        (M, 3) float64 points, metres, in the frame of the sensor.
    """
    indoors = np.mean(within(points, 0.0, _NEAR_M)) > 0.5
    keep = within(points, _INDOORS_M if indoors else MIN_RANGE_M, MAX_RANGE_M)
    if labels is not None and bool(labels.any()):
        keep &= _static_classes(classes)[
            # packed stores keep labels in uint8
            np.minimum(labels.astype(np.int64), np.iinfo(np.uint16).max)
        ]
    else:
        keep[keep] = _is_upright(points[keep])
    if flow is not None:
        keep &= (np.abs(flow) < _STANDS_M_S).all(axis=1)
    return points[np.flatnonzero(keep)].astype(np.float64)


def within(points: AnyFloatArray, nearest: float, farthest: float) -> BoolArray:
    """Return (N,) which of (N, 3) points are between two distances from the sensor.

    Points that are not finite are not.
    """
    x, y, z = points.T
    with np.errstate(invalid="ignore"):
        distance = np.sqrt(x * x + y * y + z * z)
    return np.asarray((distance > nearest) & (distance < farthest))


def _per_point(sequence: Sequence, field: str, frame: int, count: int) -> AnyArray | None:
    """Return a field of the points; None if it is missing or cannot be read (other checks report
    that).
    """
    if field not in sequence.fields():
        return None
    try:
        array = sequence.read(field, frame)
    except CarlascError:
        return None
    return array if len(array) == count else None


def _static_classes(table: ClassTable) -> BoolArray:
    """Return which ids are static objects above the ground.

    If no class contains only moving objects, all movable classes are left out.
    """
    static = np.zeros(np.iinfo(np.uint16).max + 1, np.bool_)
    static[sorted(set(table.names) - {0} - table.ground - (table.moving or table.movable))] = True
    return static


def _is_upright(points: AnyFloatArray) -> BoolArray:
    """Return (N,) which points are on upright objects, from the range of heights in columns of 0.4
    m.
    """
    columns = np.floor((points[:, :2] + MAX_RANGE_M) / _COLUMN_M).astype(np.int64)
    width = int(2 * MAX_RANGE_M / _COLUMN_M) + 1
    column = columns[:, 0] * width + columns[:, 1]
    lowest = np.full(width * width, np.inf)
    highest = np.full(width * width, -np.inf)
    np.minimum.at(lowest, column, points[:, 2])
    np.maximum.at(highest, column, points[:, 2])
    upright: BoolArray = (highest - lowest)[column] > _UPRIGHT_M
    return upright & (points[:, 2] > lowest[column] + _FOOT_M)


def occupancy(points: FloatArray) -> BoolArray:
    """Return the (C, C, C) cells about the sensor that hold points, (N, 3) metres, sensor frame."""
    occupied = np.zeros(_SPACE.size, np.bool_)
    cells, inside = _SPACE.index(points)
    occupied[tuple(cells[inside].T)] = True
    return occupied


def overlap(occupied: BoolArray, motion: Transform, points: FloatArray) -> float:
    """Return the share of the points of a scan that are in occupied cells of another.

    Args:
        occupied: (C, C, C) cells of the other scan: see `occupancy`.
        motion: (4, 4) other_T_scan.
        points: (N, 3) metres, N > 0.
    """
    (voxels,) = warped_voxels(points, _SPACE, np.pad(motion[None, :3], ((0, 0), (0, 0), (0, 1))))
    return np.count_nonzero(occupied.reshape(-1)[voxels[voxels < occupied.size]]) / len(points)


Poses: TypeAlias = FloatArray

_LEVER_M = 15.0  # motions are compared by how they move a point at this distance
_DIFFERENT_M = 0.3
_MIN_POINTS = 150
_MAX_POINTS = 6000
_OFFSET_POINTS = 1500
_OFFSET_PAIRS = 12
# share of the pairs that must have an offset: the sensor may be at rest for most of a drive
_OFFSET_SHARE = 0.3
_GOOD = 0.75  # no offset is searched for poses with this share of overlap
_STRIDE_M = 2.0  # the scans of a pair are this far apart, or
# turned by this angle: it shows a mistake, and the scans still overlap
_STRIDE_RAD = np.deg2rad(10.0)
_REACH = 10  # the scans of a pair are at most this number of frames apart
_GAIN = 0.02  # a correction must raise the mean share of overlap by this,
_CERTAIN = 4.0  # and by this number of standard errors
_WINS = 0.75  # on this share of the pairs on which it makes a difference,
_JUDGED_M = 0.05  # where the two motions differ by more than this
_SAME_M = 0.002  # motions that are nearer than this are the same
_EXPLAINED = 0.2  # and the mean share must be at least this then
# Vehicles that drive as fast as the ego vehicle look like scans that are all in one frame. In dense
# traffic, without labels, the share grows by a factor of 1.4; it grows by at least 1.8 if the scans
# really are in one frame.
_STANDING = 1.6
_PAIRS = 24  # of scans, which are compared
_RARE = 0.02  # a rare mistake must raise the mean by this more than a common one
_CLEAR_OFFSET = 0.1  # an offset must raise the share by this


@dataclass(frozen=True)
class Correction:
    """A common mistake in poses, and its correction.

    Attributes:
        name: description of poses with this mistake.
        advice: how to correct the file.
        undo: maps (F, 4, 4) poses with the mistake to the poses without it.
        rare: whether it is one of the unusual choices of axes.
        factor: the correction must raise the share of overlap by this factor, also compared with
            other corrections.
    """

    name: str
    advice: str
    undo: Callable[[Poses], Poses]
    rare: bool = False
    factor: float = 1.0


@dataclass(frozen=True)
class PoseDiagnosis:
    """The agreement of poses with scans.

    Attributes:
        share: mean share of a scan's structure that falls on the structure of an earlier scan under
            the poses as they are.
        pairs: number of pairs of scans with enough structure; with 0 there is no result.
        correction: the mistake whose correction clearly raises the share; None without one.
        corrected_share: the share after the correction, over the pairs that it changes.
        share_there: the share of the poses as they are, over the same pairs.
        quality: how well neighbouring scans agree, and whether a lever arm or a delay explains the
            disagreement; None if there is a known mistake.
        offset_m: (x, y, z) median distance of scans from the position where they fit, if nothing
            else explains the overlap; otherwise None.
    """

    share: float
    pairs: int
    correction: Correction | None = None
    corrected_share: float = 0.0
    share_there: float = 0.0
    quality: PoseQuality | None = None
    offset_m: tuple[float, float, float] | None = None


def diagnose_poses(
    structure: Callable[[int], FloatArray],
    poses: Poses,
    *,
    points: Callable[[int], AnyFloatArray] | None = None,
    seconds: FloatArray | None = None,
) -> PoseDiagnosis:
    """Measure the overlap of scans under their poses, and under the poses with each known mistake
    corrected.

    Args:
        structure: returns the (M, 3) structure of the i-th scan, metres, in the frame of the sensor
            (see `static_structure`).
        poses: (F, 4, 4) float64 first_T_sensor of each scan, in order of time; rigid.
        points: returns (N, 3) all points of the i-th scan on static things; None takes its
            structure.
        seconds: (F,) times of the scans, increasing; None for frames at 10 Hz.
    """
    corrections = known_corrections()
    corrected = [poses, *(correction.undo(poses) for correction in corrections)]
    overlaps = []
    shares = []
    judged = []
    chosen = choose_pairs(poses)
    # Pairs are in the order of time, so that a scan is read once although it is in several pairs.
    recent = lru_cache(2 * _REACH)(structure)
    for earlier, later in chosen:
        target = recent(earlier)
        source = recent(later)
        moved = _thin(source, _MAX_POINTS)
        if min(len(target), len(moved)) < _MIN_POINTS:
            continue
        occupied = occupancy(target)
        ends = np.stack([candidate[[earlier, later]] for candidate in corrected])
        motions = invert(ends[:, 0]) @ ends[:, 1]
        distances = _extent(invert(motions) @ motions[0])
        own = overlap(occupied, motions[0], moved)
        overlaps.append((target, _thin(source, _OFFSET_POINTS), motions[0]))
        judged.append(distances > _JUDGED_M)
        shares.append(
            [
                overlap(occupied, motion, moved) if distance > _SAME_M else own
                for motion, distance in zip(motions, distances, strict=True)
            ]
        )
    if not overlaps:
        return PoseDiagnosis(float("nan"), 0)
    own = float(np.mean([row[0] for row in shares]))
    best = _best_correction(np.array(shares), np.array(judged), corrections)
    if best is not None:
        index, share_there, corrected_share = best
        return PoseDiagnosis(
            own, len(overlaps), corrections[index - 1], corrected_share, share_there
        )
    quality = measure_poses(points or structure, poses, seconds)
    explained = quality.mounting is not None and bool(quality.mounting.wrong.any())
    search = not explained and own < _GOOD
    offset = _common_offset(overlaps) if search else None
    return PoseDiagnosis(own, len(overlaps), quality=quality, offset_m=offset)


REACH_M = 3.0
"""Scans within this distance of each other overlap, however much time is between them."""
_LONG_PAIRS = 12
# Scans over this distance overlap by at least a share, or by as much of the share of neighbours:
# where a motion is missing in the poses, they do not.
_LEAST = 0.25
_ALIKE = 0.62
_ENOUGH = 0.5
# surfaces of one scan: size of the cells, least points, thickness, flatness, width
_WALL_M = 1.0
_WALL_POINTS = 12
_THIN_M2 = 0.06**2
_FLAT = 0.02
_WIDE_M2 = 0.02
# A position is determined where scans overlap less if they are moved by these distances: by any
# factor where this share of the surfaces faces the direction, else by a factor; by a larger one
# where the sensor stands, as the rays of a scan then end where those of the scan before ended.
_SHIFTS_M = VOXEL_M * np.array([-4, -3, -2, -1, 1, 2, 3, 4])
_FACING = 0.012
_MOVED = 1.05
_STOOD = 1.25


@dataclass(frozen=True)
class LongOverlap:
    """Whether the poses hold over some metres, however long the sensor takes for them.

    Attributes:
        share: mean share of a scan's structure that falls on that of the last scan within
            `REACH_M`; NaN if no scans have enough structure.
        open_way: (2,) horizontal direction in the frame of the first scan, along which scans
            overlap as well at other positions, as along a tunnel; None if there is none.
    """

    share: float
    open_way: FloatArray | None = None
    drift: tuple[float, bool] = (0.0, True)

    def is_wrong(self, near: float) -> bool:
        """Return whether a motion is missing: `near` is the share of neighbouring scans."""
        return self.share < max(_LEAST, min(_ENOUGH, _ALIKE * near))

    @property
    def why_untested(self) -> str:
        """Why the motion could not be tested; empty if it was."""
        if self.open_way is not None:
            x, y = self.open_way
            return (
                f"scans overlap as well when they are moved along (x, y) = ({x:.1f}, {y:.1f}) in "
                "the frame of the first scan: no surface determines the position there, or the "
                "poses are wrong"
            )
        if self.share >= 0 and not self.drift[1]:
            return "no surface that the scans see determines the height"
        return "" if self.share >= 0 else "scans have too few upright things"


def measure_overlap(
    structure: Callable[[int], FloatArray], points: Callable[[int], AnyFloatArray], poses: Poses
) -> LongOverlap:
    """Measure the overlap of scans that are near each other under their poses but far in time, and
    whether it determines their positions.

    Args:
        structure: returns the (M, 3) structure of the i-th scan.
        points: returns all (N, 3) points of the i-th scan.
        poses: (F, 4, 4) first_T_sensor of each scan, in order of time; rigid.
    """
    pairs = []
    facing = np.zeros((2, 2))
    for first in np.unique(np.linspace(0, len(poses) - 2, _LONG_PAIRS).astype(int)).tolist():
        away = np.linalg.norm(poses[first:, :3, 3] - poses[first, :3, 3], axis=1) > REACH_M
        last = first + int(away.argmax()) if away.any() else len(poses) - 1
        target = structure(first)
        moved = _thin(structure(last), _OFFSET_POINTS)
        if min(len(target), len(moved)) < _MIN_POINTS:
            continue
        here = poses[first : first + 1]
        motion = relative(poses, first, last)
        pairs.append((occupancy(target), motion, moved, here[0, :2, :3]))
        (block,) = blocks([target.astype(np.float32)], here, _WALL_M, shift=0.0)
        _, spread = spread_of(block, here, 1)
        values, vectors = principal_axes(spread[block.sums[:, 0] >= _WALL_POINTS])
        thin, wide, _ = values.T
        flat = (thin < np.minimum(_FLAT * wide, _THIN_M2)) & (wide > _WIDE_M2)
        normals = vectors[flat][:, :2, 0]
        facing += normals.T @ normals
    if not pairs:
        return LongOverlap(math.nan)
    ways, directions = np.linalg.eigh(facing)
    way = directions[:, 0]
    shares = []
    along = []
    for occupied, motion, moved, first_T_here in pairs:
        step = way @ first_T_here
        shares.append(
            [
                overlap(occupied, translation(shift * step) @ motion, moved)
                for shift in (0.0, *_SHIFTS_M)
            ]
        )
        along.append(abs(step @ motion[:3, 3]))
    own, *others = np.mean(shares, axis=0).tolist()
    faced = ways[0] > _FACING * ways.sum()
    needed = 1.0 if faced else _MOVED if np.median(along) > VOXEL_M else _STOOD
    open_way = way if own < needed * max(others) else None
    return LongOverlap(own, open_way, measure_drift(points, poses))


def choose_pairs(poses: Poses) -> list[tuple[int, int]]:
    """Choose pairs of scans some metres apart: half of them spread over the drive, half where the
    sensor turns most.
    """
    if len(poses) < 2:
        return []
    candidates = [(first, _partner(poses, first)) for first in range(len(poses) - 1)]
    spread = {candidates[i] for i in np.linspace(0, len(candidates) - 1, _PAIRS // 2).astype(int)}
    turns = angles_of(np.stack([relative(poses, *pair) for pair in candidates]))
    turning = [candidates[i] for i in np.argsort(turns)[::-1] if candidates[i] not in spread]
    # neighbouring pairs are in the same turn, so only every third of the sharpest is taken
    return sorted(spread | set(turning[: 3 * (_PAIRS // 2) : 3]))


def known_corrections() -> tuple[Correction, ...]:
    """Return the known mistakes, common ones first: if several fit equally well, the first is
    reported.
    """
    mirrored = np.diag([1.0, -1.0, 1.0])
    # x right, y down, z forward, from x forward, y left, z up
    of_kitti = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    cameras = (of_kitti, of_kitti @ mirrored)
    mirrored_cameras = [mirrored @ camera for camera in cameras]
    camera_advice = "convert them to the frame of the LiDAR: inv(Tr) @ P @ Tr, Tr from calib.txt"
    corrections = [
        _of_axes(
            "poses with y mirrored against the scans",
            "give scans and poses the same handedness: mirror y in both (S @ P @ S with S = "
            "diag(1, -1, 1, 1)) or in neither",
            mirrored,
        ),
        Correction(
            "transposed rotations",
            "write R instead of its transpose (the matrices were probably read column by column)",
            _transpose,
        ),
        Correction(
            "inverted transforms (first frame to sensor)",
            "invert the transforms: they must lead from the sensor to the first frame",
            invert,
        ),
    ]
    name = "camera-frame poses (x right, y down, z forward)"
    corrections += [_of_axes(name, camera_advice, camera) for camera in cameras]
    name = "camera-frame poses with y mirrored"
    corrections += [_of_axes(name, camera_advice, camera) for camera in mirrored_cameras]
    known = (np.eye(3), mirrored, *cameras, *mirrored_cameras)
    for names, matrix in choices_of_axes():
        if not any(np.array_equal(matrix, other) for other in known):
            kind = "poses in other axes than the scans"
            advice = "convert them to the axes of the scans"
            if names[-1] == "x":
                kind = "camera-frame poses"
                advice = camera_advice
            name = f"{kind} (x, y, z are {names})"
            corrections.append(replace(_of_axes(name, advice, matrix), rare=True))
    standing = Correction(
        "scans that are all in one frame, with the poses of a moving sensor",
        "move each scan to the frame of its own sensor, or take the poses of this sequence",
        lambda p: np.tile(np.eye(4), (len(p), 1, 1)),
        factor=_STANDING,
    )
    return (*corrections, standing)


def _of_axes(name: str, advice: str, stored_T_sensor: FloatArray) -> Correction:
    """Return the correction of a change of axes: `stored_T_sensor` (3, 3) maps the axes of the
    sensor to those of the stored poses.
    """
    change = np.eye(4)
    change[:3, :3] = stored_T_sensor
    return Correction(name, advice, lambda poses: change.T @ poses @ change)


def relative(poses: Poses, earlier: int, later: int) -> Transform:
    """Return earlier_T_later."""
    return invert(poses[earlier]) @ poses[later]


def _best_correction(
    shares: FloatArray, judged: BoolArray, corrections: tuple[Correction, ...]
) -> tuple[int, float, float] | None:
    """Choose the correction with the best overlap over all pairs.

    Args:
        shares: (P, 1 + C) share of overlap of each pair, in column 0 for the poses as they are,
            then for each correction.
        judged: (P, 1 + C) whether the motion of the pair differs from that of column 0.
        corrections: those of the other columns.

    Returns:
        The column of the best correction, and the mean shares without and with it on the pairs on
        which it makes a difference; None if none is clearly better than the poses as they are.
    """
    gains = shares - shares[:, :1]
    mean = shares.mean(axis=0)
    gain = gains.mean(axis=0)
    error = gains.std(axis=0) / np.sqrt(len(gains))
    factors = np.array([1.0, *(correction.factor for correction in corrections)])
    rare = np.array([False, *(correction.rare for correction in corrections)])
    wins = ((gains > 0) & judged).sum(axis=0) >= _WINS * judged.sum(axis=0)
    clear = (
        wins
        & (gain >= _GAIN)
        & (gain >= _CERTAIN * error)
        & (mean >= np.maximum(_EXPLAINED, mean[0] * factors))
    )
    if not clear.any():
        return None
    best = int(np.where(clear, mean / factors - _RARE * rare, -np.inf).argmax())
    own = shares[judged[:, best], 0]
    corrected = shares[judged[:, best], best]
    return best, float(own.mean()), float(corrected.mean())


def _common_offset(
    overlaps: list[tuple[FloatArray, FloatArray, Transform]],
) -> tuple[float, float, float] | None:
    """Return the median of the offsets at which the later scans of pairs overlap best; None if few
    pairs have a clear one.

    Args:
        overlaps: (M, 3) structure of the earlier scan and (N, 3) some of the later one of each
            pair, and earlier_T_later.
    """
    steps = np.array(list(itertools.product(range(-6, 7), range(-6, 7), (-1, 0, 1)))) * VOXEL_M
    offsets = []
    chosen = overlaps[:: max(1, len(overlaps) // _OFFSET_PAIRS)]
    for target, later, motion in chosen:
        occupied = occupancy(target)
        moved = transform_points(motion, later)
        shares = np.array([overlap(occupied, translation(step), moved) for step in steps])
        if shares.max() > shares[len(steps) // 2] + _CLEAR_OFFSET:
            offsets.append((-steps[shares.argmax()], motion[:3, 3]))
    # an offset that cancels the motion comes from vehicles that drive as fast as the ego vehicle
    offsets = [
        offset
        for offset, way in offsets
        if np.abs(offset).max() > 1.5 * VOXEL_M and np.abs(offset - way).max() > 1.5 * VOXEL_M
    ]
    if len(offsets) < max(1, _OFFSET_SHARE * len(chosen)):
        return None
    x, y, z = np.median(offsets, axis=0).tolist()
    return (x, y, z) if max(abs(x), abs(y), abs(z)) > VOXEL_M else None


def _partner(poses: Poses, first: int) -> int:
    """Return the next scan that is far enough away, or the last within reach; one of the next scans
    if the poses do not move.
    """
    last = min(first + _REACH, len(poses) - 1)
    if _extent(relative(poses, first, last)) < _DIFFERENT_M:
        # the sensor may have moved nevertheless: one frame apart shows a fast motion, four frames
        # apart a slow one
        return min(first + (1, 4)[first % 2], last)
    for second in range(first + 1, last):
        motion = relative(poses, first, second)
        if np.linalg.norm(motion[:3, 3]) >= _STRIDE_M or angles_of(motion) >= _STRIDE_RAD:
            return second
    return last


def _thin(points: FloatArray, count: int) -> FloatArray:
    return points[:: max(1, len(points) // count)]


def _extent(motions: FloatArray) -> FloatArray:
    """Return about how far, in metres, (..., 4, 4) motions move a point that is 15 m away."""
    return np.linalg.norm(motions[..., :3, 3], axis=-1) + _LEVER_M * angles_of(motions)


def _transpose(poses: Poses) -> Poses:
    undone = poses.copy()
    undone[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    return undone
