"""Small misfits of poses that a lever arm or a delay explains: poses of another point of the vehicle, and poses of other frames.

The motion between two scans is measured from the scans alone (`match`) and compared with that of their poses. A sensor that is mounted away from
the point whose poses are given moves differently only in turns, and poses that are late only while the motion changes: a straight drive at
a steady speed shows neither.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import invert, slerp
from carlasc.inspection.matching import Match, residual

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
