"""What a scan, its times, a mount, poses and a motion can be in the physical world: the checks that
every recording passes after it is read and before it is written.

What is certainly wrong is an error. What is probably wrong is a warning, which the record of the
sequence keeps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from carlasc.core.arrays import AnyFloatArray, BoolArray, Float32Array, FloatArray
from carlasc.core.geometry import Transform, axes_named
from carlasc.errors import FormatError
from carlasc.inspection.findings import Finding, Severity
from carlasc.motion.ground import ground_plane

_SAMPLE = 4000  # points of a scan that say how far away they are
# no LiDAR on a carrier sees half of its points, or all of them, so far away
_FARTHEST_M, _ALL_FAR_M = 2000.0, 250.0
_LONGEST_S = 3.0  # points are taken within this time of their frame

POSE_S = 0.25
"""Scans this near in time to the first or the last pose get a pose."""
_GAP_S, _USUAL_GAPS = 1.0, 5.0  # poses are interpolated over this time, or so many usual intervals

# Up in the axes of the sensor, the most likely first, and the axes that it belongs to.
_UPS = (("+z", "flu"), ("-z", "frd"), ("-y", "rdf"), ("+y", "rub"), ("+x", "ulb"), ("-x", "dlf"))
_LEVEL, _STEEP = 0.25, 0.8  # slopes of the ground of an upright sensor, and of a tilted one
_LEAST_M = 0.2  # ground must be at least this far below the sensor
# Ground in an unusual direction reaches beyond this distance, in this share of all directions, and
# at most this share of the points is below it: so do no walls and ceilings.
_WIDE_M, _WIDE, _BELOW_M, _BELOW = 8.0, 0.2, 0.5, 0.03
_SECTORS, _ON_GROUND_M = 36, 0.1
_TILTED, _FALLEN = 5.0, 14.0  # degrees: grids, and the ground below the sensor, need less

_CENTRE_M, _STANDING = 3.0, 0.2  # a scan that moves so far cannot belong to a sensor that stands
_NEARER = 1.3  # factor by which the distance of the nearest points then changes


def check_scan(points: Float32Array, seconds: AnyFloatArray | None, where: str) -> None:
    """Check that the points of a scan are near the sensor, and were taken during the scan.

    Args:
        points: (N, 4) metres, in the frame of the scan.
        seconds: (N,) times after the time of the frame; None if they are not known.
        where: the frame, for errors.

    Raises:
        FormatError: half of the points are farther away than a sensor sees, or their times are
            seconds away from that of the frame.
    """
    sample = points[:: max(1, len(points) // _SAMPLE), :3].astype(np.float64)
    distance = np.sort(np.sqrt(np.square(sample).sum(axis=1)))
    distance = distance[np.isfinite(distance)]
    if len(distance):
        nearest, half = distance[len(distance) // 100], distance[len(distance) // 2]
        if half > _FARTHEST_M or nearest > _ALL_FAR_M:
            raise FormatError(
                where,
                expected="points in the frame of the sensor, in metres",
                found=f"half of them more than {half:,.0f} m away, the nearest {nearest:,.0f} m",
                advice="they are in the world frame (such as UTM), or in millimetres: transform "
                "them by the inverse of the pose of each scan",
            )
    if seconds is not None and len(seconds):
        first, last = float(seconds.min()), float(seconds.max())
        if first < -_LONGEST_S or last > _LONGEST_S:
            raise FormatError(
                f"{where}: times of points",
                expected=f"times within {_LONGEST_S:.0f} s of the time of the scan",
                found=f"{first:.6g} to {last:.6g} s after it",
            )


def are_posed(seconds: FloatArray, poses_at: FloatArray) -> BoolArray:
    """Return (N,) whether there are poses around each of (N,) times, or near to it.

    Args:
        seconds: the times.
        poses_at: (K,) increasing times of poses, by the same clock.
    """
    after = np.searchsorted(poses_at, seconds)
    earlier = poses_at[(after - 1).clip(0)]
    later = poses_at[after.clip(max=len(poses_at) - 1)]
    usual = float(np.median(np.diff(poses_at))) if len(poses_at) > 1 else 0.0
    near = np.minimum(np.abs(seconds - earlier), np.abs(later - seconds)) <= POSE_S
    between = (earlier <= seconds) & (seconds <= later)
    return np.asarray(near | between & (later - earlier <= max(_GAP_S, _USUAL_GAPS * usual)))


@dataclass(frozen=True)
class Mount:
    """How a sensor is mounted, by the ground around it.

    Attributes:
        up: the direction away from the ground, by the nearest axis of the sensor: "+z".
        axes: the axes that have this direction: "flu".
        degrees: the tilt of the ground against this direction.
        height_m: height of the sensor above the ground.
        level_T_scan: (4, 4) rotation that makes the ground level.
    """

    up: str
    axes: str
    degrees: float
    height_m: float
    level_T_scan: Transform

    def __str__(self) -> str:
        tilt = f", tilted by {self.degrees:.1f} degrees" if self.degrees >= _TILTED else ""
        axes = "" if self.up == "+z" else f", as in the axes {self.axes}"
        return f"ground {self.height_m:.2f} m from the sensor, where up is {self.up}{axes}{tilt}"


def find_mount(scans: Sequence[AnyFloatArray]) -> Mount | None:
    """Return how the sensor of some scans is mounted; None if most of them show no ground.

    Args:
        scans: (N, 3 or more) points, metres, in the frame of the sensor.
    """
    for ups in (_UPS[:2], _UPS[2:]):
        for steepest in (_LEVEL, _STEEP):
            for up, axes in ups:
                turn = axes_named(axes)
                unusual = up != "+z" or steepest > _LEVEL
                planes = [
                    plane
                    for points in scans
                    if (plane := _ground(points[:, :3] @ turn[:3, :3].T, steepest, unusual))
                    is not None
                ]
                if 2 * len(planes) <= len(scans):
                    continue
                # whole tenths of a degree, so that other scans give the same rotation
                slope = np.median(planes, axis=0)
                normal = np.array([-slope[0], -slope[1], 1.0]) / np.hypot(1, np.hypot(*slope[:2]))
                degrees = round(float(np.rad2deg(np.arccos(normal[2]))), 1)
                return Mount(
                    up, axes, degrees, -float(slope[2] * normal[2]), _level(normal, degrees) @ turn
                )
    return None


def _ground(points: AnyFloatArray, steepest: float, unusual: bool) -> FloatArray | None:
    """Return the plane of the ground, as `ground_plane` does; None if it cannot be ground."""
    plane = ground_plane(points, steepest)
    if plane is None or plane[2] > -_LEAST_M:
        return None
    if unusual:
        x, y, z = points.T
        above = z - plane[0] * x - plane[1] * y - plane[2]
        far = (np.abs(above) < _ON_GROUND_M) & (np.hypot(x, y) > _WIDE_M)
        sectors = np.unique(np.arctan2(y, x)[far] // (2 * np.pi / _SECTORS))
        if len(sectors) < _WIDE * _SECTORS or np.mean(above < -_BELOW_M) > _BELOW:
            return None
    return plane


def _level(normal: FloatArray, degrees: float) -> Transform:
    """Return the smallest (4, 4) rotation of an upward direction to z, by this angle."""
    turn, flat, angle = np.eye(4), np.hypot(normal[0], normal[1]), np.deg2rad(degrees)
    if degrees:
        x, y = normal[:2] / flat
        axis = np.array([[0, 0, -x], [0, 0, -y], [x, y, 0.0]])
        turn[:3, :3] += np.sin(angle) * axis + (1 - np.cos(angle)) * axis @ axis
    return turn


def check_mount(mount: Mount | None, where: str, *, force: bool) -> list[Finding]:
    """Return a finding if the sensor is not upright, so that grids do not hold the ground: an error
    if its ground is not found, unless `force` accepts that.
    """
    if mount is None or (mount.up == "+z" and mount.degrees < _TILTED):
        return []
    expected = "scans of a sensor that is upright"
    advice = "turn the scans upright, by the ground in them, with `level=True`"
    fallen = not force and (mount.up != "+z" or mount.degrees > _FALLEN)
    advice += ", or accept them with `force=True`" if fallen else ""
    severity: Severity = "error" if fallen else "warning"
    return [Finding(severity, "mount", where, expected, str(mount), advice)]


@dataclass
class ScanCentres:
    """Where the points of the scans are, which shows whether a sensor moves."""

    _centres: list[tuple[float, float, float]] = field(default_factory=list)

    def add(self, points: AnyFloatArray) -> None:
        """Add (N, 3) points of the next scan, N > 0."""
        sample = points[:: max(1, len(points) // _SAMPLE)]
        x, y = np.median(sample[:, :2], axis=0)
        nearest = np.percentile(np.hypot(sample[:, 0], sample[:, 1]), 1)
        self._centres.append((float(x), float(y), float(nearest)))

    def check(self, poses: FloatArray, where: str) -> None:
        """Check the (F, 4, 4) poses that odometry found of these scans.

        Raises:
            FormatError: the sensor stands, although its scans are taken from other and other
                places.
        """
        centres, places = np.array(self._centres), poses[:, :2, 3]
        part = max(1, len(centres) // 5)
        first, last = np.median(centres[:part], axis=0), np.median(centres[-part:], axis=0)
        moved = float(np.hypot(*(last - first)[:2]))
        way = float(np.hypot(*(places - places[0]).T).max())
        nearest = np.array([np.min(centres[:, 2]), np.max(centres[:, 2])]) + 1e-3
        if moved > _CENTRE_M and way < _STANDING * moved and nearest[1] > _NEARER * nearest[0]:
            raise FormatError(
                where,
                expected="scans in the frame of the sensor",
                found=f"scans that stay where they are, while their centres move by {moved:.1f} m: "
                f"they are in the world frame",
                advice="transform them by the inverse of the pose of each scan, and give these "
                "poses; or accept them with `force=True`",
            )
