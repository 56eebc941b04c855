"""Study: how well is the ground found without labels?

`python docs/studies/ground.py` prints the table of docs/studies/ground.md.

The scans are those of simulated towns with heavy traffic, whose labels are the truth: roads,
pavements, markings and terrain are ground. If the package `pypatchworkpp` (BSD-2-Clause) is
installed, the same scans are given to Patchwork++, with its defaults and the height of the sensor.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
import study
from carlasc_recorders import TownDrive
from carlasc_recorders.town.drive import scan_snapshot
from numpy.typing import NDArray

from carlasc.captures import Lidar
from carlasc.core.geometry import Transform, invert, transform_points, translation
from carlasc.core.tables import CARLA
from carlasc.motion.ground import ground_height, ground_points

SEEDS = {"town": range(61, 66)}
FRAMES = (0, 40, 80)
RAYS = {16: 29_000, 32: 65_000, 64: 130_000}  # per scan, by channels
HEIGHT_M = 1.8
_GROUND = np.array(sorted(CARLA.ground), np.uint32)


@dataclass(frozen=True)
class Case:
    """How scans are taken.

    Attributes:
        name: of the row.
        channels: of the LiDAR.
        mounts: x, y and height in metres, roll and pitch in degrees, of each sensor.
        bend: what is added to the heights of points (N, 3), in metres: a slope or a hill.
        below: share of the points that are returns of mirror images, below the ground.
    """

    name: str
    channels: int = 32
    mounts: tuple[tuple[float, float, float, float, float], ...] = (
        (-0.5, 0.0, HEIGHT_M, 0.0, 0.0),
    )
    bend: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None
    below: float = 0.0


CASES = (
    Case("16 channels", 16),
    Case("32 channels"),
    Case("64 channels", 64),
    *(
        Case(f"sensor at {height:g} m", mounts=((2.7, 0.0, height, 0.0, 0.0),))
        for height in (1.0, 1.4, 2.5)
    ),
    Case("rolled by 3 degrees", mounts=((-0.5, 0.0, HEIGHT_M, 3.0, 0.0),)),
    Case("pitched by 3 degrees", mounts=((-0.5, 0.0, HEIGHT_M, 0.0, 3.0),)),
    Case("slope of 8%", bend=lambda p: 0.08 * p[:, 0]),
    Case("top of a hill", bend=lambda p: -0.0015 * p[:, 0] ** 2),
    Case("bottom of a dip", bend=lambda p: 0.0015 * p[:, 0] ** 2),
    Case(
        "three sensors merged",
        mounts=((0, 0, HEIGHT_M, 0, 0), (2.2, 0.9, 0.8, 0, 2), (-2.2, -0.9, 1.2, 3, 0)),
    ),
    Case("0.5% of points below the ground", below=0.005),
)


@dataclass(frozen=True)
class Found:
    """Which points a method took for ground.

    Attributes:
        ground: (N,) bool.
        height_m: z of the ground below the sensor.
        elapsed_s: the time it took.
    """

    ground: NDArray[np.bool_]
    height_m: float
    elapsed_s: float


def scans(case: Case, seed: int) -> Iterator[tuple[NDArray[np.float32], NDArray[np.bool_]]]:
    """Yield (N, 3) points in the frame of the first sensor, and (N,) which of them are ground."""
    lidar = Lidar(case.channels, RAYS[case.channels] // (4 if study.is_tiny() else 1))
    drive = TownDrive(seed, "heavy", lidar)
    for frame in study.few(FRAMES):
        rng = np.random.default_rng([seed, frame, case.channels])
        poses = [drive.ego_pose(frame) @ _mount(*mount) for mount in case.mounts]
        recordings = [scan_snapshot(drive.snapshot(frame), pose, lidar, rng) for pose in poses]
        parts = [
            transform_points(invert(poses[0]) @ pose, r.scan.points)
            for pose, r in zip(poses, recordings, strict=True)
        ]
        points = np.concatenate(parts).astype(np.float64)
        truth = np.isin(np.concatenate([r.scan.labels for r in recordings]), _GROUND)
        if case.bend is not None:
            points[:, 2] += case.bend(points)
        if case.below:
            chosen = rng.random(len(points)) < case.below
            points[chosen, 2] -= rng.uniform(0.5, 3.0, int(chosen.sum()))
            truth &= ~chosen
        yield points.astype(np.float32), truth


def ours(points: NDArray[np.float32], height_m: float) -> Found:
    """Find the ground by `carlasc.motion.ground_points`, which does not know the height of the
    sensor.
    """
    start = time.perf_counter()
    ground = ground_points(points)
    elapsed = time.perf_counter() - start
    return Found(ground, ground_height(points), elapsed)


def patchwork(points: NDArray[np.float32], height_m: float) -> Found:
    """Find the ground by Patchwork++, which is told the height of the sensor."""
    import pypatchworkpp  # noqa: PLC0415 - an optional package

    settings = pypatchworkpp.Parameters()
    settings.verbose, settings.sensor_height = False, height_m
    method = pypatchworkpp.patchworkpp(settings)
    start = time.perf_counter()
    method.estimateGround(np.hstack([points, np.zeros((len(points), 1), np.float32)]))
    ground = np.zeros(len(points), np.bool_)
    ground[method.getGroundIndices()] = True
    return Found(ground, -method.getHeight(), time.perf_counter() - start)


def rate(found: list[Found], truths: list[NDArray[np.bool_]], height_m: float) -> str:
    """Return the columns of a row: precision, recall, the error of the height of the sensor and the
    time of a scan.
    """
    ground, truth = np.concatenate([f.ground for f in found]), np.concatenate(truths)
    both = np.count_nonzero(ground & truth)
    error = np.max(np.abs([f.height_m + height_m for f in found]))
    elapsed = 1e3 * float(np.median([f.elapsed_s for f in found]))
    return (
        f"{both / ground.sum():.1%} | {both / truth.sum():.1%} | {error:.2f} m | {elapsed:.0f} ms"
    )


def main() -> None:
    """Print the table."""
    with study.begin(study.options(__doc__, SEEDS)) as given:
        show(study.few(given.town))


def show(seeds: list[int]) -> None:
    """Print the table of some drives."""
    methods = {"ours": ours} | ({"Patchwork++": patchwork} if find_spec("pypatchworkpp") else {})
    columns = " | ".join(f"{name}: precision | recall | height | time" for name in methods)
    print(f"| scans | {columns} |\n|---|{'---:|' * 4 * len(methods)}", flush=True)
    clock = study.Clock()
    ours(np.zeros((1, 3), np.float32), 0.0)  # compile
    for case in study.few(CASES, 2):
        taken = [scan for seed in seeds for scan in scans(case, seed)]
        height = case.mounts[0][2]
        rows = (
            rate([m(p, height) for p, _ in taken], [truth for _, truth in taken], height)
            for m in methods.values()
        )
        print(f"| {case.name} | {' | '.join(rows)} |", flush=True)
        clock(case.name)


def _mount(x: float, y: float, height: float, roll_deg: float, pitch_deg: float) -> Transform:
    roll, pitch = np.radians([roll_deg, pitch_deg])
    about_x, about_y = np.eye(4), np.eye(4)
    about_x[1:3, 1:3] = [[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]]
    about_y[0, 0] = about_y[2, 2] = np.cos(pitch)
    about_y[0, 2], about_y[2, 0] = np.sin(pitch), -np.sin(pitch)
    mount: Transform = translation((x, y, height)) @ about_y @ about_x
    return mount


if __name__ == "__main__":
    main()
