"""Drives that return: `python docs/studies/loops.py [WORK]` prints the table of loops of
docs/studies/poses.md.

A vehicle drives through the simulated town and comes back to streets that it has seen. KISS-ICP
estimates its poses, and they are refined, without loops and with them. WORK keeps the drives.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
import study
from numpy.typing import NDArray
from returning import ROUTES, ReturningDrive

from carlasc.captures import Lidar
from carlasc.core.geometry import invert, multiply, small_motions, transform_points
from carlasc.core.tables import CARLA
from carlasc.motion import refinement
from carlasc.motion.joint_alignment import clusters
from carlasc.motion.loops import close_loops
from carlasc.motion.odometry import follow_scans, usable_points
from carlasc.motion.planes import covariances
from carlasc.motion.refinement import ThinnedScan, refine_poses
from carlasc.motion.solving import principal_axes

DRIVES = (
    ("block", 61, 32, 1),
    ("block", 61, 32, 2),
    ("small eight", 63, 64, 4),
    ("other way", 62, 64, 4),
    ("many blocks", 62, 32, 2),
    ("there and back", 62, 16, 1),
    ("there and back", 51, 16, 1),
)
"""Route, seed, channels, and every which channel is used."""
_RAYS = 1000  # per channel
_BEYOND_M, _NEAR_M = 60.0, 6.0  # driven since a place was seen; away from it
_HALF = 15  # scans before and after the place, whose walls are compared
_CELL_M, _POINTS = 1.0, 30


class Recording(NamedTuple):
    """The scans of a drive, and its true poses.

    Attributes:
        points: (N, 3) of each scan.
        walls: (N,) which points are on buildings.
        true: (F, 4, 4) world_T_sensor.
    """

    points: list[NDArray[np.float32]]
    walls: list[NDArray[np.bool_]]
    true: NDArray[np.float64]


def _view(channels: int) -> tuple[float, float, float]:
    """Return the range in metres, and the highest and lowest elevations in degrees."""
    return (80.0, 15.0, -15.0) if channels == 16 else (50.0, 2.0, -25.0)


def thinned(drive: Recording, channels: int, every: int) -> Recording:
    """Return a drive with some of the channels only."""
    _, upper, lower = _view(channels)
    points, walls = list[NDArray[np.float32]](), list[NDArray[np.bool_]]()
    for own, wall in zip(drive.points, drive.walls, strict=True):
        elevation = np.degrees(np.arctan2(own[:, 2], np.hypot(own[:, 0], own[:, 1])))
        kept = np.rint((upper - elevation) / (upper - lower) * (channels - 1)) % every == 0
        points.append(own[kept])
        walls.append(wall[kept])
    return Recording(points, walls, drive.true)


def record(route: str, seed: int, channels: int, work: Path) -> Recording:
    """Return a drive, which WORK keeps."""
    kept = work / f"{route.replace(' ', '_')}_{seed}_{channels}.npz"
    if not kept.exists():
        lidar = Lidar(channels, channels * _RAYS, *_view(channels))
        drive = ReturningDrive(seed, route, lidar)
        frames = study.few(range(0, drive.frames, ROUTES[route].every), 12)
        scans = [drive.record(frame).scan for frame in frames]
        np.savez(
            kept,
            points=np.concatenate([scan.points for scan in scans]),
            walls=np.concatenate(
                [study.labels_of(scan) == CARLA.id_of("Building") for scan in scans]
            ),
            counts=np.array([len(scan.points) for scan in scans]),
            true=np.stack([drive.sensor_poses(frame, 1)[0] for frame in frames]),
        )
    with np.load(kept) as file:
        ends = np.cumsum(file["counts"])[:-1]
        return Recording(
            np.split(file["points"], ends), np.split(file["walls"], ends), file["true"]
        )


def met_again(true: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return the rows of scans of one place, the earlier first, of every tenth that returns."""
    steps = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1)
    along, pairs = np.concatenate([[0.0], np.cumsum(steps)]), []
    for late in range(0, len(true), 10):
        early = np.flatnonzero(along[:late] < along[late] - _BEYOND_M)
        away = np.linalg.norm(true[early, :3, 3] - true[late, :3, 3], axis=1)
        if len(away) and away.min() < _NEAR_M:
            pairs.append((int(early[np.argmin(away)]), late))
    return pairs


def off_at(
    poses: NDArray[np.float64], true: NDArray[np.float64], pairs: list[tuple[int, int]]
) -> tuple[float, float]:
    """Return the greatest error of the motions between pairs of scans, metres and degrees."""
    early, late = np.array(pairs).T
    motions = [multiply(invert(own[early]), own[late]) for own in (true, poses)]
    off = small_motions(multiply(invert(motions[0]), motions[1]))
    away, turned = np.linalg.norm(off[:, :3], axis=1), np.linalg.norm(off[:, 3:], axis=1)
    return float(away.max()), float(np.degrees(turned.max()))


def thicker(drive: Recording, poses: NDArray[np.float64], pairs: list[tuple[int, int]]) -> float:
    """Return how much thicker walls are in the points of both passes than in those of the first
    one: a mean over places.
    """
    found = []
    for early, late in pairs[::3]:
        passes = []
        for row in (early, late):
            rows = range(max(row - _HALF, 0), min(row + _HALF, len(poses)))
            own = [transform_points(poses[k], drive.points[k][drive.walls[k]]) for k in rows]
            near = (np.concatenate(own) - poses[early, :3, 3]).astype(np.float32)
            passes.append(clusters(near, np.eye(4), _CELL_M, 0.0))
        (keys, one), (others, two) = passes
        _, a, b = np.intersect1d(keys, others, return_indices=True)
        enough = (one[a, 0] >= _POINTS) & (two[b, 0] >= _POINTS)
        one, both = one[a[enough]], one[a[enough]] + two[b[enough]]
        alone, axes = principal_axes(covariances(one))
        flat = (alone[:, 0] < 0.1 * alone[:, 1]) & (np.abs(axes[:, 2, 0]) < 0.3)
        together, _ = principal_axes(covariances(both))
        if flat.any():
            found.append(np.median(np.sqrt(together[flat, 0] / alone[flat, 0])))
    return float(np.mean(found)) if found else float("nan")


def main() -> None:
    """Print the table."""
    parser = study.options(__doc__)
    parser.add_argument("--drives", nargs="+", default=[], help="ROUTE:SEED:CHANNELS:EVERY")
    with study.begin(parser) as given:
        asked = [tuple(one.split(":")) for one in given.drives] or study.few(DRIVES)
        print(
            "| drive | loops | KISS-ICP | refined | with loops | walls before, after |\n|---|"
            + "---:|" * 5
        )
        for route, *numbers in asked:
            seed, channels, every = map(int, numbers)
            drive = thinned(record(route, seed, channels, given.work), channels, every)
            usable = ((one[usable_points(one)], None) for one in drive.points)
            start = np.stack(list(follow_scans(usable, max_range_m=80.0)))
            with patch.object(refinement, "close_loops", wraps=close_loops) as closing:
                made = refine_poses(map(ThinnedScan.of, drive.points, start), start)
            open_at_loops = closing.call_args.args[1] if closing.called else made.poses
            pairs = met_again(drive.true) or [(0, len(start) - 1)]
            refined = (open_at_loops, made.poses)
            off = [
                "{:.2f} m, {:.2f}°".format(*off_at(poses, drive.true, pairs))
                for poses in (start, *refined)
            ]
            walls = [f"{thicker(drive, poses, pairs):.2f}" for poses in refined]
            length = np.linalg.norm(np.diff(drive.true[:, :3, 3], axis=0), axis=1).sum()
            about = f"{route}, {length:.0f} m, {channels // every} channels"
            cells = [about, len(made.loops), *off, ", ".join(walls)]
            print("| " + " | ".join(map(str, cells)) + " |", flush=True)


if __name__ == "__main__":
    main()
