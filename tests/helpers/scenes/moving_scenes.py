"""Small scenes for evidence of motion: boxes on flat ground, seen by a LiDAR whose rays are
computed exactly.
"""

import numpy as np

from carlasc.captures.settings import Lidar
from carlasc.core.geometry import rotation_z, transform_points
from carlasc.motion.evidence import EvidenceScan

HEIGHT_M = 1.8
GROUND, WALL, CAR, PERSON = 7, 1, 10, 4
LIDAR = Lidar(channels=32, points=32 * 900, range_m=50.0, noise_m=0.0)


def box(x, y, size, label):
    """Return an upright box that stands on the ground at a place."""
    length, width, height = size
    return (
        np.array([x - length / 2, y - width / 2, 0.0]),
        np.array([x + length / 2, y + width / 2, height]),
        label,
    )


def car(x, y):
    return box(x, y, (4.4, 1.8, 1.5), CAR)


def person(x, y):
    return box(x, y, (0.5, 0.5, 1.7), PERSON)


WALLS = [box(0.0, 15.0, (80.0, 0.4, 4.0), WALL), box(0.0, -15.0, (80.0, 0.4, 4.0), WALL)]


def cast(world_T_sensor, boxes, lidar=LIDAR):
    """Return the (N, 3) points of a scan, sensor frame, and their labels."""
    rays = lidar.directions @ world_T_sensor[:3, :3].T
    origin = world_T_sensor[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        nearest = np.where(rays[:, 2] < 0, -origin[2] / rays[:, 2], np.inf)
        labels = np.full(len(rays), GROUND)
        azimuth = np.arctan2(rays[:, 1], rays[:, 0])
        for lower, upper, label in boxes:
            near = rays_towards(azimuth, lower - origin, upper - origin)
            one, other = (lower - origin) / rays[near], (upper - origin) / rays[near]
            enter, leave = np.fmin(one, other).max(axis=1), np.fmax(one, other).min(axis=1)
            seen = (enter <= leave) & (enter > 0) & (enter < nearest[near])
            nearest[near[seen]], labels[near[seen]] = enter[seen], label
    found = nearest < lidar.range_m
    points = lidar.directions[found] * nearest[found, None]
    return points.astype(np.float32), labels[found].astype(np.uint32)


def rays_towards(azimuth, lower, upper):
    """Return the indices of the rays, of which some may hit a box whose corners are given from
    their origin: others cannot.
    """
    corners = np.arctan2(
        [lower[1], lower[1], upper[1], upper[1]], [lower[0], upper[0], lower[0], upper[0]]
    )
    # behind, where angles jump, or around the sensor
    if lower[0] < 0 and lower[1] <= 0 <= upper[1]:
        return np.arange(len(azimuth))
    return np.flatnonzero((azimuth > corners.min() - 1e-6) & (azimuth < corners.max() + 1e-6))


def film(
    scene,
    frames=40,
    *,
    period_s=0.1,
    ego_m_s=0.0,
    noise_m=0.0,
    noise_deg=0.0,
    labels=False,
    lidar=LIDAR,
):
    """Yield the scans of a scene, a function of time that returns boxes; poses get errors."""
    rng = np.random.default_rng(5)
    for frame in range(frames):
        seconds = frame * period_s
        pose = np.eye(4)
        pose[:3, 3] = ego_m_s * seconds, 0.0, HEIGHT_M
        points, classes = cast(pose, scene(seconds), lidar)
        wrong = rotation_z(np.radians(noise_deg) * rng.normal())
        wrong[:3, 3] = noise_m * rng.normal(size=3)
        known = {"ground": classes == GROUND, "labels": classes} if labels else {}
        yield EvidenceScan(frame, points, pose @ wrong, seconds, **known), classes


def place(scan, indices):
    """Return the (M, 3) world positions of points of a scan."""
    return transform_points(scan.world_T_sensor, scan.points[indices].astype(np.float64))
