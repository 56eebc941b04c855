"""What is left of movers in maps of a real drive: for `real.py`.

The drive is written as a bag, and some of its scans as bare files: points alone, without poses,
labels and boxes. One call of `carlasc map` makes a map of each, and the trajectory that it writes
places the scans. A point is left if the map has a point within `NEAR_M` of it. The points of movers
are those in their boxes, `FLOOR_M` above the road, or, of two people who have no boxes, around the
mean of their points, which is followed from scan to scan. Structure is `HEIGHT_M` above the ground,
in none of these boxes, and still there a second later or earlier: other people walk there, too.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from real_drive import FLOOR_M
from real_measures import GROW_M, HEIGHT_M, Body, Judge, Share, ground_below
from scipy.spatial import cKDTree
from study import few

import carlasc
from carlasc import MapExtras, Run
from carlasc.core import Transform
from carlasc.core.geometry import invert, poses_from, transform_points, translation

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from helpers.converters.bags import START_NS, Messages, write_bag

NAMES = {"track 1": "van", "track 2": "cyclist", "follower": "car that follows"}
NEAR_M, WIDER_M = 0.05, 0.1
PERIOD_S = 0.1033
FILES = 20  # bare ones, from the middle of the drive
WALKERS = (((3.06, -6.62), 105), ((-7.25, -8.47), 66))
"""Where two people are in the first scan, metres, and the frame until which they are followed."""
_NEAR_M, _LATE = 0.55, 0.2  # points that are followed; share of a new velocity
_LOWER, _UPPER = (-0.35, -0.35, 0.1), (0.35, 0.35, 2.0)  # of a person, metres; feet touch the road
_STAYS, _PLACE_M = 10, 0.2  # structure: scans between those that see it, at such places
_PCD = """VERSION .7
FIELDS x y z intensity
SIZE 4 4 4 4
TYPE F F F F
COUNT 1 1 1 1
WIDTH {0}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {0}
DATA binary
"""


def rows(scans: Mapping[int, NDArray[np.float32]], judge: Judge, work: Path) -> Iterator[str]:
    """Yield the table: what is left of each mover, and of structure, in the map of each recording.

    Args:
        scans: (N, 4) points of each frame.
        judge: of the same frames.
        work: a folder for the recordings and their maps.
    """
    bodies = {body.name: body for body in (*judge.movers, judge.follower)}
    bodies |= {body.name: body for body in walkers(scans, judge)}
    world = {
        frame: transform_points(judge.drive.read_pose(frame), scan[:, :3].astype(np.float64))
        for frame, scan in scans.items()
    }
    stays = places_that_stay(world)
    named = (NAMES.get(name, name) for name in bodies)
    yield f"| recording | {' | '.join(named)} | structure |"
    yield "|---|" + "---:|" * (len(bodies) + 1)
    frames = list(scans)
    middle = frames[(len(frames) - FILES) // 2 :][:FILES]
    recordings = (("bag", bag, frames), ("bare files", files, middle))
    for name, write, chosen in few(recordings):
        source = write({frame: scans[frame] for frame in chosen}, work)
        out, trajectory = work / f"{source.name}.npz", work / f"{source.name}.tum"
        carlasc.map(source, out, extras=MapExtras(trajectory=trajectory), run=Run(workers=1))
        table = np.loadtxt(trajectory)
        poses = poses_from(table[:, [7, 4, 5, 6]], table[:, 1:4])
        tree = cKDTree(np.load(out)["points"].astype(np.float64))
        left, kept = dict.fromkeys(bodies, Share()), Share()
        for frame, pose in zip(chosen, poses, strict=True):
            points = scans[frame][:, :3].astype(np.float64)
            far = np.linalg.norm(points, axis=1) >= judge.min_range_m
            found = np.isfinite(
                tree.query(transform_points(pose, points), distance_upper_bound=NEAR_M)[0]
            )
            structure = far & (points[:, 2] - ground_below(points) > HEIGHT_M)
            structure &= np.isin(_place(world[frame]), stays)
            for one, body in bodies.items():
                own = far & body.contains([frame], world[frame], WIDER_M)
                if own.any():
                    local = transform_points(invert(body.poses[frame]), world[frame])
                    own &= local[:, 2] > body.lower[2] + FLOOR_M
                structure &= ~body.contains([frame], world[frame], GROW_M)
                left[one] += Share(int(found[own].sum()), int(own.sum()))
            kept += Share(int(found[structure].sum()), int(structure.sum()))
        cells = [
            f"{share.percent:.2f}% of {share.whole:,}" if share.whole else ""
            for share in left.values()
        ]
        yield f"| {name}, {len(chosen)} scans | {' | '.join(cells)} | {kept.percent:.2f}% |"


def walkers(scans: Mapping[int, NDArray[np.float32]], judge: Judge) -> Iterator[Body]:
    """Yield the people who are followed."""
    for number, (start, last) in enumerate(WALKERS):
        poses, velocity = dict[int, Transform](), np.zeros(2)
        first, *_ = scans
        center = transform_points(judge.drive.read_pose(first), np.array([*start, 0.0]))[:2]
        for frame in [frame for frame in scans if frame < last]:
            points = scans[frame][:, :3].astype(np.float64)
            world = transform_points(judge.drive.read_pose(frame), points)
            center = center + velocity
            away = np.linalg.norm(world[:, :2] - center, axis=1)
            floor = float(np.quantile(world[away < 2.5, 2], 0.03))
            own = (away < _NEAR_M) & (np.abs(world[:, 2] - floor - 1.1) < 0.9)
            mean = world[own, :2].mean(axis=0) if own.sum() >= 5 else center
            if poses:
                velocity = velocity + _LATE * (mean - center)
            center = mean
            poses[frame] = translation((*center, floor))
        yield Body(f"person {number + 1}", poses, np.array(_LOWER), np.array(_UPPER))


def places_that_stay(world: Mapping[int, NDArray[np.float64]]) -> NDArray[np.int64]:
    """Return the places with points in scans a second apart."""
    seen = [np.unique(_place(points)) for points in world.values()]
    frames = np.repeat(list(world), [len(one) for one in seen])
    places, row = np.unique(np.concatenate(seen), return_inverse=True)
    first, last = np.full(len(places), np.inf), np.full(len(places), -np.inf)
    np.minimum.at(first, row, frames)
    np.maximum.at(last, row, frames)
    return places[last - first >= _STAYS]


def _place(points: NDArray[np.float64]) -> NDArray[np.int64]:
    x, y, z = np.floor(points / _PLACE_M).astype(np.int64).T
    return np.asarray((x << 40) + (y << 20) + z)


def bag(scans: Mapping[int, NDArray[np.float32]], work: Path) -> Path:
    """Write scans as a bag, and return it."""
    store: Any = Messages("mcap")
    kind = np.dtype([(name, np.float32) for name in ("x", "y", "z", "intensity")])
    messages = (
        store.cloud("/points", START_NS + round(row * PERIOD_S * 1e9), scan.view(kind).reshape(-1))
        for row, scan in enumerate(scans.values())
    )
    return write_bag(work, "mcap", messages, store=store)


def files(scans: Mapping[int, NDArray[np.float32]], work: Path) -> Path:
    """Write scans as PCD files, and return their folder."""
    folder = work / "scans"
    folder.mkdir()
    for frame, scan in scans.items():
        (folder / f"{frame:06}.pcd").write_bytes(_PCD.format(len(scan)).encode() + scan.tobytes())
    return folder
