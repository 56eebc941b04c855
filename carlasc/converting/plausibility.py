"""What a scan, its times, a mount, poses and a motion can be in the physical world: the checks that
every recording passes after it is read and before it is written.

What is certainly wrong is an error. What is probably wrong is a warning, which the record of the
sequence keeps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from carlasc.core.arrays import AnyFloatArray, BoolArray, Float32Array, FloatArray
from carlasc.core.geometry import DIRECTIONS, Transform, poses_from, thin
from carlasc.core.scans import ScanCentres
from carlasc.errors import FormatError
from carlasc.inspection.findings import Finding, Severity
from carlasc.motion.ground import ground_plane

_ENOUGH = 30000  # points of a scan in which the ground is looked for
_SAMPLE = 4000  # points of a scan that say how far away they are
# no LiDAR on a carrier sees half of its points, or all of them, so far away
_FARTHEST_M = 2000.0
_ALL_FAR_M = 250.0
_LONGEST_S = 3.0  # points are taken within this time of their frame; fact: longest-frame

POSE_S = 0.25  # fact: pose-reach
"""Scans this near in time to the first or the last pose get a pose."""
_GAP_S = 1.0  # poses are interpolated over this time; fact: pose-gap
_USUAL_GAPS = 5.0  # or over so many usual intervals

# Up in the axes of the sensor, the most likely first, and the axes that it belongs to.
_UPS = (("+z", "flu"), ("-z", "frd"), ("-y", "rdf"), ("+y", "rub"), ("+x", "ulb"), ("-x", "dlf"))
# slopes of the ground of an upright sensor, and of a tilted one
_LEVEL = 0.25
_STEEP = 0.8
_LEAST_M = 0.2  # ground must be at least this far below the sensor
# Ground in an unusual direction reaches beyond this distance, in this share of all directions, and
# at most this share of the near points is below it: so do no walls and ceilings.
_WIDE_M = 8.0
_WIDE = 0.3
_NEAR_M = 15.0
_BELOW_M = 0.5
_BELOW = 0.02
_SECTORS = 36
_ON_GROUND_M = 0.1
# degrees: grids, and the ground below the sensor, need less
_TILTED = 5.0
_FALLEN = 14.0


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
        nearest = distance[len(distance) // 100]
        half = distance[len(distance) // 2]
        if half > _FARTHEST_M or nearest > _ALL_FAR_M:
            raise FormatError(
                where,
                expected="points in the frame of the sensor, in metres",
                found=f"half of them more than {half:,.0f} m away, the nearest {nearest:,.0f} m",
                advice="they are in the world frame (such as UTM), or in millimetres: transform "
                "them by the inverse of the pose of each scan",
            )
    if seconds is not None and len(seconds):
        first = float(seconds.min())
        last = float(seconds.max())
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
    usual = _mount(scans, *_UPS[0], _LEVEL, certain=False)
    if usual is not None and usual.degrees < _TILTED:
        return usual
    for ups in (_UPS[:2], _UPS[2:]):
        for steepest in (_LEVEL, _STEEP):
            for up, axes in ups:
                if found := _mount(scans, up, axes, steepest, certain=True):
                    return found
    # stairs, or a slope: the sensor is not certainly tilted
    return None if usual is None else replace(usual, degrees=0.0, level_T_scan=np.eye(4))


def _mount(
    scans: Sequence[AnyFloatArray], up: str, axes: str, steepest: float, *, certain: bool
) -> Mount | None:
    """Return the mount of a sensor with these axes; None if most scans show no ground then."""
    turn = np.eye(4)
    turn[:3, :3] = np.transpose([DIRECTIONS[letter] for letter in axes])
    grounds = [
        ground
        for points in scans
        if (ground := _ground(thin(points, _ENOUGH)[:, :3] @ turn[:3, :3].T, steepest, certain))
        is not None
    ]
    if 2 * len(grounds) <= len(scans):
        return None
    x, y, z = np.median(grounds, axis=0)
    slope = float(np.hypot(x, y))
    # whole tenths of a degree, so that other scans give the same rotation
    degrees = round(float(np.rad2deg(np.arctan(slope))), 1)
    half = np.deg2rad(degrees) / 2
    along = np.array([-y, x, 0.0]) / max(slope, 1e-9)  # the axis of the smallest rotation to level
    level = poses_from(np.array([[np.cos(half), *np.sin(half) * along]]), np.zeros((1, 3)))[0]
    return Mount(up, axes, degrees, -float(z / np.hypot(1.0, slope)), level @ turn)


def _ground(points: AnyFloatArray, steepest: float, certain: bool) -> FloatArray | None:
    """Return the plane of the ground, as `ground_plane` does; None if it is not below the sensor,
    or, to be `certain`, if it is not wide, or has points below it.
    """
    plane = ground_plane(points, steepest)
    if plane is None or plane[2] > -_LEAST_M:
        return None
    if certain:
        x, y, z = points.T
        above = z - plane[0] * x - plane[1] * y - plane[2]
        flat = np.hypot(x, y)
        far = (np.abs(above) < _ON_GROUND_M) & (flat > _WIDE_M)
        sectors = np.unique(np.arctan2(y, x)[far] // (2 * np.pi / _SECTORS))
        below = np.mean(above[flat < _NEAR_M] < -_BELOW_M)
        if len(sectors) < _WIDE * _SECTORS or below > _BELOW:
            return None
    return plane


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


def check_standing(centres: ScanCentres, poses: FloatArray, where: str) -> None:
    """Check the (F, 4, 4) poses that odometry found of scans.

    Raises:
        FormatError: the sensor stands, although its scans are taken from other and other places.
    """
    if moved_m := centres.moved_m(poses):
        raise FormatError(
            where,
            expected="scans in the frame of the sensor",
            found=f"scans that stay where they are, while their centres move by {moved_m:.1f} m: "
            f"they are in the world frame",
            advice="transform them by the inverse of the pose of each scan, and give these poses; "
            "or accept them with `force=True`",
        )
