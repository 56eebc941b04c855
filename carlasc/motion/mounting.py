"""Where the sensor is in the frame whose poses are given, and how late these poses are: found by comparing motions.

Poses of an IMU, a camera or the rear axle move differently from those of the sensor in turns, and late poses while the speed or the rate of
turning changes. The motions that the scans show (`joint_alignment`) are explained by one constant transform and one constant delay, by
least squares, and each number gets a standard error. What a drive does not show has a large one: the height of the sensor on a flat road,
every part of the arm on a straight one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import Transform, invert, multiply, rotations_of, slerp, small_motions
from carlasc.motion.solving import solve_positive

_LAGS = (2, 5, 10, 20)  # scans between the ends of the motions that are compared
_ROUNDS = 8
_ROBUST = 4.0  # squared residual, in standard deviations, from which a motion counts less
_SAME = 12.0  # so many motions have about the same errors: those of one scan are in two for each lag, and neighbours are alike
_LEAST = np.array(
    [0.003, 0.003, 0.003, 2e-4, 2e-4, 2e-4]
)  # standard deviation of a motion that scans show, metres and radians
_STEP = np.array([0.05, 0.05, 0.05, 2e-3, 2e-3, 2e-3, 0.01])  # by which derivatives are computed
_DETERMINED = np.array([0.2, 0.2, 0.2, *np.deg2rad([1.0, 1.0, 1.0]), 0.03])  # greatest standard error of a known number
_RELEVANT = np.array([0.15, 0.15, 0.15, *np.deg2rad([0.5, 0.5, 0.5]), 0.02])  # smaller values need no correction
_CERTAIN = 4.0  # nor do values of fewer standard errors
_LIMITS = np.array([10.0, 10.0, 10.0, 0.5, 0.5, 0.5, 2.0])  # of values
_NAMES = ("x", "y", "z", "roll", "pitch", "yaw", "late")


@dataclass(frozen=True)
class Mounting:
    """The pose of the sensor in the frame whose poses are given, and the delay of these poses.

    Attributes:
        values: (7,) x, y, z of the sensor in metres, its rotation vector in radians, and how late the poses are in seconds: a scan has the pose
            that the file gives for a later time. Exact poses of the sensor have zeros.
        errors: (7,) standard errors, infinite where nothing tells.
    """

    values: NDArray[np.float64]
    errors: NDArray[np.float64]

    @property
    def determined(self) -> NDArray[np.bool_]:
        """(7,) which values the drive shows."""
        return np.asarray(self.errors < _DETERMINED)

    @property
    def wrong(self) -> NDArray[np.bool_]:
        """(7,) which values are certainly not zero, and large enough to matter."""
        return self.determined & (np.abs(self.values) > np.maximum(_RELEVANT, _CERTAIN * self.errors))

    def correct(self, poses: NDArray[np.float64], seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (F, 4, 4) poses of the sensor from given ones and their times: by the values that are wrong. The first pose stays."""
        values = np.where(self.wrong, self.values, 0.0)
        moved = slerp(poses, seconds, seconds + values[6]) if values[6] else poses
        sensor = multiply(moved, _transform(values))
        return multiply(poses[0], invert(sensor[0]), sensor)

    def describe(self) -> dict[str, str]:
        """Return each value with its standard error and unit, or "undetermined", by name."""
        scales = (1.0, 1.0, 1.0, *np.rad2deg(np.ones(3)), 1.0)
        units = ("m", "m", "m", "degrees", "degrees", "degrees", "s")
        return {
            name: f"{value * scale:.2f} ± {error * scale:.2f} {unit}" if known else "undetermined"
            for name, value, error, known, scale, unit in zip(
                _NAMES, self.values, self.errors, self.determined, scales, units, strict=True
            )
        }


def find_mounting(
    poses: NDArray[np.float64], seconds: NDArray[np.float64], runs: Sequence[tuple[int, NDArray[np.float64]]]
) -> Mounting | None:
    """Find what explains the motions that scans show; None if there are too few.

    Args:
        poses: (F, 4, 4) given poses of all scans.
        seconds: (F,) their times, increasing.
        runs: the poses that scans show, in any frame: the row of the first scan, and (K, 4, 4) the poses of this scan and those after it.
    """
    parts = [_Motions.of(poses, seconds, first, found) for first, found in runs]
    if sum(len(part.given) for part in parts) < 2 * len(_LEAST) * len(_LAGS):
        return None
    values = np.zeros(7)
    for _ in range(_ROUNDS):
        off = _residuals(parts, values)
        scale = np.maximum(1.4826 * np.median(np.abs(off), axis=0), _LEAST)
        slope = np.stack([(_residuals(parts, values + step) - off) / step.sum() for step in np.diag(_STEP)], axis=2)
        scaled, slope = off / scale, slope / scale[:, None]
        weights = 1.0 / (1.0 + np.square(scaled) / _ROBUST)
        information = (weights[:, :, None, None] * slope[:, :, :, None] * slope[:, :, None, :]).sum(axis=(0, 1))
        information += np.diag((10.0 * _DETERMINED) ** -2.0)  # what nothing tells stays zero
        right = -(weights[:, :, None] * slope * scaled[:, :, None]).sum(axis=(0, 1))
        step = solve_positive(information.copy(), right)
        values = np.clip(values + step, -_LIMITS, _LIMITS)
    inverse = np.stack([solve_positive(information.copy(), row) for row in np.eye(7)])
    return Mounting(values, np.sqrt(_SAME * np.diag(inverse)))


@dataclass(frozen=True)
class _Motions:
    """The given motions between scans of a run, and the poses that these scans show.

    Attributes:
        given: (P, 4, 4) motions.
        found: (K, 4, 4) poses that the scans show.
        seconds: (K,) times of these scans.
        at: (P, 2) times of the ends of the motions.
    """

    given: NDArray[np.float64]
    found: NDArray[np.float64]
    seconds: NDArray[np.float64]
    at: NDArray[np.float64]

    @classmethod
    def of(
        cls, poses: NDArray[np.float64], seconds: NDArray[np.float64], first: int, found: NDArray[np.float64]
    ) -> _Motions:
        """Pair the scans of a run."""
        rows = np.concatenate(
            [
                np.stack([np.arange(len(found) - lag), np.arange(lag, len(found))], axis=1)
                for lag in _LAGS
                if lag < len(found)
            ]
            or [np.empty((0, 2), np.int64)]
        )
        given, own = poses[first + rows], seconds[first : first + len(found)]
        return cls(multiply(invert(given[:, 0]), given[:, 1]), found, own, own[rows])


def _residuals(parts: Sequence[_Motions], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (P, 6) the small motions from those that are expected of the sensor to those that scans show: metres, and rotation vectors.

    What scans show is taken at the times of the given poses, and not the other way around: it is smooth, and errors of the given poses
    would become smaller between two of them.
    """
    mounted, between = _transform(values), []
    for part in parts:
        one, other = (slerp(part.found, part.seconds, part.at[:, end] - values[6]) for end in (0, 1))
        between.append(multiply(invert(multiply(invert(mounted), part.given, mounted)), invert(one), other))
    return small_motions(np.concatenate(between))


def _transform(values: NDArray[np.float64]) -> Transform:
    """Return the (4, 4) pose of the sensor that the first six values give."""
    mounted = np.eye(4)
    x, y, z = values[3:6]
    angle = float(np.sqrt(x * x + y * y + z * z))
    half = np.sin(angle / 2) / angle if angle > 1e-9 else 0.5
    mounted[:3, :3] = rotations_of(np.array([[np.cos(angle / 2), half * x, half * y, half * z]]))[0]
    mounted[:3, 3] = values[:3]
    return mounted
