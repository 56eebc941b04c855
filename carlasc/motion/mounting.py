"""Mounting: the pose of the sensor in the frame of the given poses, and the delay of these poses,
estimated from motions.

In turns, poses of an IMU, a camera or the rear axle move differently from those of the sensor. Late
poses differ while the speed or the turn rate changes. One constant transform and one constant delay
are fitted to the motions of the aligned scans (`joint_alignment`) by least squares, with an
interval for each number. It is wide for what a drive does not determine: the height of the sensor
on a flat road, and its whole position on a straight road.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from carlasc.core.arrays import BoolArray, FloatArray, IntArray
from carlasc.core.geometry import Transform, invert, multiply, poses_from, slerp, small_motions
from carlasc.motion.solving import solve_positive, squares_of

_LAGS = (2, 5, 10, 20)  # scans between the start and the end of a compared motion
_ROUNDS = 8
_ROBUST = 4.0  # squared residual, in standard deviations, above which a motion has less weight
# number of motions with about the same errors: a scan is in two per lag, and neighbours are similar
_SAME = 12.0
# least deviation of a motion: metres, radians
_LEAST = np.array([0.003, 0.003, 0.003, 2e-4, 2e-4, 2e-4])
_STEP = np.array([0.05, 0.05, 0.05, 2e-3, 2e-3, 2e-3, 0.01])  # steps of the numerical derivatives
# greatest error of a known value
_DETERMINED = np.array([0.2, 0.2, 0.2, *np.deg2rad([1.0, 1.0, 1.0]), 0.03])
# smaller values need no correction
_RELEVANT = np.array([0.15, 0.15, 0.15, *np.deg2rad([0.5, 0.5, 0.5]), 0.02])
_CERTAIN = 2.5  # values within so many times their error need none either
# least half width of an interval: scans are not corrected for motion exactly, nor interpolated
_SYSTEMATIC = np.array([0.08, 0.08, 0.08, *np.deg2rad([0.1, 0.1, 0.1]), 0.01])
_SHARE = 0.12  # the same as a share of the value: poses whose scale is wrong change all of it
_GROUP, _GROUPS = 30, 3  # most scans whose errors are related, and least groups of them
# Poses drift if what remains grows so many times over seconds, to so many least deviations.
_GROWS, _MUCH = 1.5, 5.0
_EXPLAINED = 3.0  # least variance that a value explains, in variances of what remains
_LIMITS = np.array([10.0, 10.0, 10.0, 0.5, 0.5, 0.5, 2.0])  # greatest values
_NAMES = ("x", "y", "z", "roll", "pitch", "yaw", "late")


@dataclass(frozen=True)
class Mounting:
    """The pose of the sensor in the frame whose poses are given, and the delay of these poses.

    Attributes:
        values: (7,) x, y, z of the sensor in metres, its rotation vector in radians, and the delay
            of the poses in seconds: a scan has the pose that the file gives for a later time. Exact
            poses of the sensor have zeros.
        errors: (7,) half the widths of intervals that hold the true value in 95% of the cases
            (docs/studies/poses.md), infinite where a value is not determined, or where drift,
            jitter or distortion of the poses explain as much.
    """

    values: FloatArray
    errors: FloatArray

    @property
    def determined(self) -> BoolArray:
        """(7,) bool: which values the drive determines."""
        return np.asarray(self.errors <= np.maximum(_DETERMINED, _SHARE * np.abs(self.values)))

    @property
    def wrong(self) -> BoolArray:
        """(7,) bool: which values are certainly not zero, and large enough to matter."""
        return self.determined & (
            np.abs(self.values) > np.maximum(_RELEVANT, _CERTAIN * self.errors)
        )

    def correct(self, poses: FloatArray, seconds: FloatArray) -> FloatArray:
        """Return the (F, 4, 4) poses of the sensor from given poses and their (F,) times: a wrong
        place and a delay are applied. Rotations are not, because they may come from a calibration
        that is right. The first pose stays.
        """
        values = np.where(self.wrong, self.values, 0.0)
        values[3:6] = 0.0
        moved = slerp(poses, seconds, seconds + values[6]) if values[6] else poses
        sensor = multiply(moved, _transform(values))
        return multiply(poses[0], invert(sensor[0]), sensor)

    @property
    def is_moved(self) -> bool:
        """Whether `correct` changes poses."""
        return bool(self.wrong[[0, 1, 2, 6]].any())

    def describe(self) -> dict[str, str]:
        """Return each value with its interval and unit, or "undetermined", by name."""
        scales = (1.0, 1.0, 1.0, *np.rad2deg(np.ones(3)), 1.0)
        units = ("m", "m", "m", "degrees", "degrees", "degrees", "s")
        return {
            name: f"{value * scale:.2f} ± {error * scale:.2f} {unit}" if known else "undetermined"
            for name, value, error, known, scale, unit in zip(
                _NAMES, self.values, self.errors, self.determined, scales, units, strict=True
            )
        }


def find_mounting(
    poses: FloatArray,
    seconds: FloatArray,
    runs: Sequence[tuple[int, FloatArray]],
) -> Mounting | None:
    """Fit the mounting to the motions of aligned scans; None if there are too few motions.

    Args:
        poses: (F, 4, 4) given poses of all scans.
        seconds: (F,) their times, increasing.
        runs: the aligned poses, in any frame: the row of the first scan, and the (K, 4, 4) poses of
            this scan and the following ones.
    """
    related = min(_GROUP, sum(len(aligned) for _, aligned in runs) // _GROUPS)
    parts = [_Motions.of(poses, seconds, first, aligned, related) for first, aligned in runs]
    if sum(len(part.given) for part in parts) < 2 * len(_LEAST) * len(_LAGS):
        return None
    values = np.zeros(7)
    for _ in range(_ROUNDS):
        off = _residuals(parts, values)
        scale = np.maximum(1.4826 * np.median(np.abs(off), axis=0), _LEAST)
        slope = np.stack(
            [(_residuals(parts, values + step) - off) / step.sum() for step in np.diag(_STEP)],
            axis=2,
        )
        scaled, slope = off / scale, slope / scale[:, None]
        weights = 1.0 / (1.0 + np.square(scaled) / _ROBUST)
        information = squares_of(slope.reshape(-1, 7), weights.reshape(-1))
        # values that are not determined stay zero
        information += np.diag((10.0 * _DETERMINED) ** -2.0)
        pulls = weights[:, :, None] * slope * scaled[:, :, None]
        step = solve_positive(information.copy(), -pulls.sum(axis=(0, 1)))
        values = np.clip(values + step, -_LIMITS, _LIMITS)
    inverse = np.stack([solve_positive(information.copy(), row) for row in np.eye(7)])
    # Drift and distortion make errors that motions within some seconds share, so their sums vary
    # more than those of independent ones. Few sums need a wider interval (Student's t).
    pulls = pulls.sum(axis=1)
    shared = np.concatenate([part.groups + 1j * row for row, part in enumerate(parts)])
    sums = np.stack([pulls[shared == group].sum(axis=0) for group in np.unique(shared)])
    more = max(len(sums) - 1, 1)
    spread = inverse @ (sums.T @ sums) @ inverse * (more + 1) / more
    apart = (2.0 + 3.0 / more + 3.0 / more**2) * np.sqrt(np.diag(spread))
    # A value that moves the sensor little against what remains after seconds is not named: drift
    # and distortion explain as much.
    spans = np.concatenate([part.at[:, 1] - part.at[:, 0] for part in parts])
    longest = spans > 0.75 * spans.max()
    left = np.square(1.4826 * np.median(np.abs(scaled[longest]), axis=0))
    explained = (np.square(slope[longest] * values).mean(axis=0) / left[:, None]).max(axis=0)
    least = np.maximum(_SYSTEMATIC, _SHARE * np.abs(values))
    errors = np.maximum(np.maximum(2.0 * np.sqrt(_SAME * np.diag(inverse)), apart), least)
    off_by = np.median(np.sqrt(left) * scale / _LEAST)
    if np.median(left) > _GROWS and off_by > _MUCH:  # drift, of which no interval is known
        errors[:] = np.inf
    unsure = (explained < _EXPLAINED) & (np.abs(values) > errors)
    return Mounting(values, np.where(unsure, np.inf, errors))


@dataclass(frozen=True)
class _Motions:
    """The given motions between scans of a run, and the aligned poses of these scans.

    Attributes:
        given: (P, 4, 4) motions.
        aligned: (K, 4, 4) aligned poses.
        seconds: (K,) times of these scans.
        at: (P, 2) times of the start and the end of each motion.
        groups: (P,) number of the part of the run that each motion is in.
    """

    given: FloatArray
    aligned: FloatArray
    seconds: FloatArray
    at: FloatArray
    groups: IntArray

    @classmethod
    def of(
        cls,
        poses: FloatArray,
        seconds: FloatArray,
        first: int,
        aligned: FloatArray,
        related: int,
    ) -> _Motions:
        """Pair the scans of a run; `related` scans are a group."""
        rows = np.concatenate(
            [
                np.stack([np.arange(len(aligned) - lag), np.arange(lag, len(aligned))], axis=1)
                for lag in _LAGS
                if lag < len(aligned)
            ]
            or [np.empty((0, 2), np.int64)]
        )
        given, own = poses[first + rows], seconds[first : first + len(aligned)]
        motions = multiply(invert(given[:, 0]), given[:, 1])
        return cls(motions, aligned, own, own[rows], rows.sum(axis=1) // (2 * related))


def _residuals(parts: Sequence[_Motions], values: FloatArray) -> FloatArray:
    """Return the (P, 6) differences from the expected motions of the sensor to the aligned ones:
    metres, and rotation vectors.

    The aligned poses are interpolated at the times of the given poses, not the reverse: they are
    smooth, and interpolation would reduce the errors of the given poses.
    """
    mounted, between = _transform(values), []
    for part in parts:
        one, other = (
            slerp(part.aligned, part.seconds, part.at[:, end] - values[6]) for end in (0, 1)
        )
        between.append(
            multiply(invert(multiply(invert(mounted), part.given, mounted)), invert(one), other)
        )
    return small_motions(np.concatenate(between))


def _transform(values: FloatArray) -> Transform:
    """Return the (4, 4) pose of the sensor from the first six values."""
    x, y, z = values[3:6]
    angle = float(np.sqrt(x * x + y * y + z * z))
    half = np.sin(angle / 2) / angle if angle > 1e-9 else 0.5
    turn = np.array([[np.cos(angle / 2), half * x, half * y, half * z]])
    return np.asarray(poses_from(turn, values[None, :3])[0])
