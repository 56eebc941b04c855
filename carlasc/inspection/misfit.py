"""Small misfits of poses that a lever arm or a delay explains: poses of another point of the vehicle, and poses of other frames.

The motion between two scans is measured from the scans alone (`match`): the structure of the earlier one is summarized by a normal distribution in each
cell of a grid (the normal distributions transform of Biber and Strasser, IROS 2003), and the later one is moved so that its points are likely under these
distributions: flat ones, of walls, pull across the wall only. The information of the result says which directions the structure determines. It is compared with that of their poses. A sensor that is mounted away from
the point whose poses are given moves differently only in turns, and poses that are late only while the motion changes: a straight drive at
a steady speed shows neither.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlasc.core.compiling import cached
from carlasc.core.geometry import Transform, invert, slerp, transform_points

_FITS = ((2.0, 8), (1.0, 16))  # from a coarse fit to a fine one: the size of cells in metres, and the most iterations
_CELL_POINTS = 6  # cells with fewer points have no distribution
_POINT_M = 0.05  # error of a point
_OUTLIER = 9.0  # squared distance, in standard deviations, from which points count less
_POINTS = 2000
_INDEPENDENT = 300  # number of points with independent errors
_STILL = 1e-4


@dataclass(frozen=True)
class Match:
    """The motion that was measured between two scans.

    Attributes:
        motion: (4, 4) earlier_T_later.
        information: (6, 6) of the errors of the motion: three of the translation in metres, then three of the rotation in radians, on the
            axes of the earlier scan about its origin.
    """

    motion: Transform
    information: NDArray[np.float64]


def match(earlier: NDArray[np.float64], later: NDArray[np.float64], start: Transform) -> Match:
    """Measure the motion between two scans, near a first estimate.

    Args:
        earlier: (M, 3) structure of the earlier scan, metres, in its frame.
        later: (N, 3) structure of the later scan, metres, in its frame.
        start: (4, 4) earlier_T_later, right within about a metre and some degrees.
    """
    points = later[:: max(1, len(later) // _POINTS)]
    motion, information = start.copy(), np.zeros((6, 6))
    for cell_m, iterations in _FITS:
        cells = _NormalCells(earlier, cell_m)
        for _ in range(iterations):
            moved = transform_points(motion, points)
            information, pull = cells.pull(moved)
            step = np.asarray(np.linalg.solve(information + 1e-6 * np.eye(6), pull), np.float64)
            motion = _exp(step) @ motion
            if np.abs(step).max() < _STILL:
                break
    return Match(motion, information)


def residual(measured: Transform, motion: Transform) -> NDArray[np.float64]:
    """Return (6,) the small motion from `motion` to `measured`, both earlier_T_later: translation, and rotation vector."""
    between = measured @ invert(motion)
    turn = between[:3, :3]
    vector = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    return np.concatenate([between[:3, 3], vector])


class _NormalCells:
    """The normal distributions of points in cells."""

    def __init__(self, points: NDArray[np.float64], cell_m: float) -> None:
        self.cell_m = cell_m
        columns = points.T.copy()  # the bounds of rows take NumPy a tenth of the time of those of columns
        self.lower = np.floor(columns.min(axis=1) / cell_m) - 1
        self.size = (np.floor(columns.max(axis=1) / cell_m) - self.lower + 2).astype(np.int64)
        flat = self._flat(points)
        counts = np.bincount(flat, minlength=int(self.size.prod()))
        cells = np.flatnonzero(counts)
        counts, self.row = counts[cells], np.full(len(counts), -1)
        self.row[cells] = np.arange(len(cells))
        row, spread = self.row[flat], np.zeros((len(cells), 3, 3))
        means = np.stack([np.bincount(row, column) for column in columns], axis=1) / counts[:, None]
        add_squares(points, row, means, spread)
        spread[:, [1, 2, 2], [0, 0, 1]] = spread[:, [0, 0, 1], [1, 2, 2]]
        spread = spread / counts[:, None, None] + _POINT_M**2 * np.eye(3)
        good = counts >= _CELL_POINTS
        self.means, self.inverse = means[good], np.linalg.inv(spread[good])
        self.row[cells] = np.where(good, np.cumsum(good) - 1, -1)

    def pull(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (6, 6) the information, and (6,) the pull, of the motion of points (N, 3) towards the distributions of their cells."""
        cells = np.floor(points / self.cell_m) - self.lower
        within = np.all((cells >= 0) & (cells < self.size), axis=1)
        row = np.full(len(points), -1)
        row[within] = self.row[self._flat(points[within])]
        points, row = points[row >= 0], row[row >= 0]
        off, inverse = self.means[row] - points, self.inverse[row]
        scaled = (inverse @ off[:, :, None])[:, :, 0]
        squared = (off * scaled).sum(axis=1)
        weight = 1 / (1 + squared / _OUTLIER) ** 2
        weight *= min(1.0, _INDEPENDENT / max(len(points), 1))
        slope = np.zeros((len(points), 3, 6))
        slope[:, range(3), range(3)] = 1.0
        x, y, z = points.T
        slope[:, 0, 4], slope[:, 0, 5] = z, -y
        slope[:, 1, 3], slope[:, 1, 5] = -z, x
        slope[:, 2, 3], slope[:, 2, 4] = y, -x
        rows, columns = slope.reshape(-1, 6), (weight[:, None, None] * (inverse @ slope)).reshape(-1, 6)
        return rows.T @ columns, rows.T @ (weight[:, None] * scaled).reshape(-1)

    def _flat(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        return flat_cells(points, self.cell_m, self.lower, self.size)


@cached(error_model="python")
def flat_cells(
    points: NDArray[np.float64], cell_m: float, lower: NDArray[np.float64], size: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return (N,) the number of the cell of each of (N, 3) points that are inside of a grid.

    Args:
        points: metres.
        cell_m: size of a cell.
        lower: (3,) the first cell of the grid, counted from the origin.
        size: (3,) number of cells.
    """
    flat = np.empty(len(points), np.int64)
    for i in range(len(points)):
        number = 0
        for a in range(3):
            number = number * size[a] + int(np.floor(points[i, a] / cell_m) - lower[a])
        flat[i] = number
    return flat


@cached(error_model="python")
def add_squares(
    points: NDArray[np.float64], row: NDArray[np.int64], means: NDArray[np.float64], squares: NDArray[np.float64]
) -> None:
    """Add the products of the offsets of points from the mean of their cell.

    Args:
        points: (N, 3) metres.
        row: (N,) the cell of each of them.
        means: (R, 3) of the points of each cell.
        squares: (R, 3, 3) the sums. Is changed.
    """
    for i in range(len(points)):
        r = row[i]
        x, y, z = points[i, 0] - means[r, 0], points[i, 1] - means[r, 1], points[i, 2] - means[r, 2]
        for a, b, product in ((0, 0, x * x), (0, 1, x * y), (0, 2, x * z), (1, 1, y * y), (1, 2, y * z), (2, 2, z * z)):
            squares[r, a, b] += product


def _exp(step: NDArray[np.float64]) -> Transform:
    """Return the motion of a small translation and rotation vector, about the origin."""
    angle = float(np.linalg.norm(step[3:]))
    x, y, z = step[3:]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    motion = np.eye(4)
    if angle > 0:
        motion[:3, :3] += np.sin(angle) / angle * cross + (1 - np.cos(angle)) / angle**2 * cross @ cross
    motion[:3, 3] = step[:3]
    return motion


# Error of a measured motion beside that of its points, metres and radians. The rings of a LiDAR on walls move with the sensor, so that the
# height, the roll and the pitch are less certain than the points tell.
_FLOOR = np.array([0.02, 0.02, 0.3, 0.03, 0.03, 0.002])
_ROBUST = 9.0  # squared misfit, in standard deviations, from which a pair counts less
_MIN_PAIRS = 8
_EXPLAINED = 0.6  # the misfit that is left, as a share of the misfit of the poses as they are
_LEAST_MISFIT = 1.0  # squared, in standard deviations, mean of all pairs: smaller ones need no explanation
_CERTAIN, _LIKELY = 5.0, 2.0  # an arm is so many standard errors long along one axis, and along each that is reported
_ARM_M, _YAW_RAD = 0.25, np.deg2rad(1.0)  # smaller ones are not reported
_LONGEST_M = 10.0
_FRAMES = np.arange(-4.0, 4.01, 0.25)
_DELAY = 0.75  # frames; a smaller delay is one of time stamps within a scan
_ROUNDS = 10


@dataclass(frozen=True)
class LeverArm:
    """Where the sensor is, seen from the point whose poses are given.

    Its height is not known: turns about the vertical axis do not show it.

    Attributes:
        arm_m: (x, y) of the sensor, metres; 0 along an axis along which the drive does not show it.
        yaw_rad: its heading.
    """

    arm_m: tuple[float, float]
    yaw_rad: float


@dataclass(frozen=True)
class Misfit:
    """What explains the difference between measured motions and poses.

    Attributes:
        arm: the poses are those of another point.
        late_frames: the poses are late by so many frames; early if negative. 0 if they are not.
    """

    arm: LeverArm | None = None
    late_frames: int = 0


def explain_misfit(poses: NDArray[np.float64], pairs: list[tuple[int, int]], matches: list[Match]) -> Misfit | None:
    """Find what explains small differences between poses and the motions measured from scans; None if nothing does, or there are none.

    Args:
        poses: (F, 4, 4) float64 first_T_sensor of each scan, in order of time; rigid.
        pairs: the scans (earlier, later) whose motion was measured.
        matches: the motion of each pair.
    """
    if len(pairs) < _MIN_PAIRS:
        return None
    weights = _weights(matches)
    as_is = _cost(poses, 0.0, pairs, matches, weights)
    arm, left = _find_arm(poses, pairs, matches, weights)
    costs = np.array([_cost(poses, late, pairs, matches, weights) for late in _FRAMES])
    late, least = float(_FRAMES[costs.argmin()]), float(costs.min())
    if as_is < _LEAST_MISFIT or min(left if arm else np.inf, least) > _EXPLAINED * as_is:
        return None
    if abs(late) >= _DELAY and least < left:
        return Misfit(late_frames=round(late))
    return Misfit(arm) if arm is not None and left < _EXPLAINED * as_is else None


def describe_misfit(misfit: Misfit) -> tuple[str, str]:
    """Return what was found and what to do, for a message."""
    if misfit.arm is None:
        lines, when = abs(misfit.late_frames), "late" if misfit.late_frames > 0 else "early"
        frames = f"{lines} frame{'s' if lines > 1 else ''}"
        return (
            f"poses that are {frames} {when}",
            f"give each scan the pose {frames} {'later' if when == 'late' else 'earlier'} in the file, and compare the time stamps of both",
        )
    x, y = misfit.arm.arm_m
    place = f"x = {x:.1f} m, y = {y:.1f} m"
    turned = f", turned by {np.rad2deg(misfit.arm.yaw_rad):.1f} degrees" if misfit.arm.yaw_rad else ""
    found = (
        f"poses that look like those of another point of the vehicle, which have the sensor at about {place}{turned}"
    )
    advice = "write the poses of the sensor: inv(T) @ P @ T, with T the sensor's pose in the frame of the poses (take it from the calibration: turns do not show its height)"
    return found, advice


def _weights(matches: list[Match]) -> NDArray[np.float64]:
    """Return (P, 6, 6) the information of each measured motion, with the error that does not come from its points."""
    errors = [np.linalg.inv(match.information + 1e-6 * np.eye(6)) + np.diag(_FLOOR**2) for match in matches]
    return np.linalg.inv(np.stack(errors))


def _cost(
    poses: NDArray[np.float64],
    late: float,
    pairs: list[tuple[int, int]],
    matches: list[Match],
    weights: NDArray[np.float64],
) -> float:
    """Return the mean misfit of the poses of scans that are `late` frames later in the file."""
    numbers = np.arange(len(poses), dtype=np.float64)
    at = slerp(poses, numbers, np.array(pairs, np.float64) + late)
    off = np.stack([residual(m.motion, invert(one) @ two) for m, (one, two) in zip(matches, at, strict=True)])
    return float(np.mean(_robust(np.einsum("pi,pij,pj->p", off, weights, off))))


def _robust(squared: NDArray[np.float64]) -> NDArray[np.float64]:
    return _ROBUST * np.log1p(squared / _ROBUST)


def _find_arm(
    poses: NDArray[np.float64], pairs: list[tuple[int, int]], matches: list[Match], weights: NDArray[np.float64]
) -> tuple[LeverArm | None, float]:
    """Return the lever arm that fits best, None if none is certain, and the misfit that is left with it.

    With the pose of the sensor (I + [0, 0, yaw]x, arm) in the frame of the poses, a motion (R, t) of the poses is for the sensor, to first
    order, a motion by t + (R - I) arm - yaw * (z x t). Height and arm along z are left out.
    """
    motions = np.stack([invert(poses[earlier]) @ poses[later] for earlier, later in pairs])
    measured = np.stack([match.motion for match in matches])
    off = measured[:, :3, 3] - motions[:, :3, 3]
    slope = np.zeros((len(pairs), 3, 3))
    slope[:, :, :2] = motions[:, :3, :2] - np.eye(3)[:, :2]
    slope[:, 0, 2], slope[:, 1, 2] = motions[:, 1, 3], -motions[:, 0, 3]
    of_turn = np.stack([residual(m, a)[3:] for m, a in zip(measured, motions, strict=True)])
    precision = np.linalg.inv(np.linalg.inv(weights)[:, :3, :3])
    found, robust = np.zeros(3), np.ones(len(pairs))
    for _ in range(_ROUNDS):
        information = np.einsum("pia,pij,pjb,p->ab", slope, precision, slope, robust) + 1e-3 * np.eye(3)
        found = np.linalg.solve(information, np.einsum("pia,pij,pj,p->a", slope, precision, off, robust))
        left = off - slope @ found
        squared = np.einsum("pi,pij,pj->p", left, precision, left)
        robust = 1 / (1 + squared / _ROBUST)
    rest = np.concatenate([left, of_turn], axis=1)
    cost = float(np.mean(_robust(np.einsum("pi,pij,pj->p", rest, weights, rest))))
    scale = max(1.0, float((robust * squared).sum() / max(robust.sum() * 3 - 3, 1)))
    errors = np.sqrt(scale * np.diag(np.linalg.inv(information)))
    arm = np.where(np.abs(found[:2]) > _LIKELY * errors[:2], found[:2], 0.0)
    yaw = float(found[2]) if abs(found[2]) > max(_CERTAIN * errors[2], _YAW_RAD) else 0.0
    certain = (
        bool((np.abs(found[:2]) > _CERTAIN * errors[:2]).any()) and _ARM_M < float(np.linalg.norm(arm)) < _LONGEST_M
    )
    if not (certain or yaw):
        return None, cost
    return LeverArm((float(arm[0]), float(arm[1])), yaw), cost
