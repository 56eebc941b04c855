"""What is found without labels in crowded streets, and does it stay apart?

`python docs/studies/dense.py [WORK]` prints a row for each drive. A LiDAR of 128 channels and about
220,000 points a scan records forty scans of a crowded street (`crowded.py`), and the actors that
free space shows are compared with the simulated ones: of the points of each kind within 25 m, the
share that belongs to actors that were found, and the share that is left out of other scans.
`--channels 64` is cheaper, `--turning` records while everything moves, and `--noisy` gives poses
that are 2 cm and 0.1 degrees off. All constants were chosen on seeds 301 to 305.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

import crowded
import numpy as np
import study
from carlasc_recorders.town.actors import EGO_ID
from movers_drives import GRIDS, Recorded, Setting, owners, record_all
from movers_rows import EVIDENCE, NoisyPoses, Only
from numpy.typing import NDArray
from street import StreetPopulation

from carlasc import Grid
from carlasc.captures.settings import EGO_SENSOR_M
from carlasc.core.frames import FrameRange
from carlasc.core.geometry import invert, transform_points, translation
from carlasc.groundtruth import Voting
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.frame import merge_frame
from carlasc.groundtruth.from_scans.motion_pass import find_actors
from carlasc.groundtruth.inputs import GridPlan
from carlasc.motion.tracks import MovingActors
from carlasc.storage import Sequence

SEEDS = {"crowded": range(361, 366)}
NEAR_M = 25.0
MOVES_M_S = 0.4  # faster actors move
KINDS = ("car", "truck", "rider", "person")
HEADS = (
    "parked | static | trail | actors / truth | found | merged | false | height, width | CPU s | "
    "points"
)
_ABOVE_M = 0.3  # wheels and feet below are beside ground, which is occupied
_FIRST = 8  # scans that are read before the time is measured
_SEEN = 5, 20  # an actor counts with so many points in so many scans


@dataclass
class Counted:
    """Points of a kind, near the sensor.

    Attributes:
        points: all of them.
        tracked: those of actors that were found.
        moved: those that are left out of other scans, as those of an actor or by themselves.
    """

    points: int = 0
    tracked: int = 0
    moved: int = 0

    def add(self, tracked: NDArray[np.bool_], moved: NDArray[np.bool_]) -> None:
        """Add some points."""
        self.points += len(tracked)
        self.tracked += int(tracked.sum())
        self.moved += int((tracked | moved).sum())

    def share(self, name: str) -> float:
        """Return the share of the tracked or moved points, in percent."""
        return 100 * int(getattr(self, name)) / self.points if self.points else np.nan


@dataclass
class Scores:
    """What was found in one drive.

    Attributes:
        counts: the points of each kind that move; those of "parked" and "static" do not.
        truth: scans with enough points of each actor that moves.
        owners: number of points of each simulated actor, 0 for none, by found actor.
        cpu_s: time per scan.
        points: number of points per scan.
        trail: of the ground truth of the middle frame, in percent: see `trail`.
    """

    counts: dict[str, Counted] = field(default_factory=dict)
    truth: Counter[int] = field(default_factory=Counter)
    owners: dict[int, Counter[int]] = field(default_factory=dict)
    cpu_s: float = 0.0
    points: float = 0.0
    trail: float = np.nan


def score(drive: Recorded, actors: MovingActors, kinds: dict[int, str]) -> Scores:
    """Compare found actors with the simulated ones, whose kinds are given by number."""
    found, sequence = Scores(), drive.sequence
    names = np.array([kinds.get(number, "static") for number in range(max(kinds) + 1)])
    frames = sequence.frames("points").tolist()
    for frame in frames:
        points = sequence.read("points", frame)[:, :3]
        number = sequence.read("instances", frame).astype(np.int64)
        fast = np.linalg.norm(sequence.read("flow", frame), axis=1) > MOVES_M_S
        near = np.hypot(points[:, 0], points[:, 1]) < NEAR_M
        tracked, moved = np.zeros((2, len(points)), np.bool_)
        moved[actors.moving.get(frame, [])] = True
        for found_number, track in actors.tracks.items():
            own = track.members.get(frame, np.empty(0, np.int64))
            tracked[own] = True
            found.owners.setdefault(found_number, Counter()).update(number[own].tolist())
        kind = np.where(number > 0, names[number], "static")
        kind[kind == "starts"] = "rider"
        kind[(kind != "parked") & ~fast] = "static"
        for name in (*KINDS, "parked", "static"):
            own = near & (kind == name)
            found.counts.setdefault(name, Counted()).add(tracked[own], moved[own])
        seen, count = np.unique(number[near & fast], return_counts=True)
        found.truth.update(seen[count >= _SEEN[1]].tolist())
        found.points += len(points) / len(frames)
    return found


def trail(
    grid: Grid,
    drive: Recorded,
    frame: int,
    population: StreetPopulation,
    numbers: Collection[int] | None = None,
) -> tuple[int, int]:
    """Return how many voxels of the ground truth of a frame are occupied, of those that movers
    passed at other times and that are empty in the frame, and how many these are; `numbers` are
    those of the movers, None for all.
    """
    spec, sequence = grid.spec, drive.sequence
    world_T_grid, passed, held = sequence.read_pose(frame), set[int](), set[int]()
    for other in sequence.frames("points").tolist():
        points = sequence.read("points", other)[:, :3]
        fast = np.linalg.norm(sequence.read("flow", other), axis=1) > MOVES_M_S
        there = transform_points(invert(world_T_grid) @ sequence.read_pose(other), points)
        voxels = spec.flat_index(there)
        above = there[:, 2] > _ABOVE_M - EGO_SENSOR_M[2]
        if other != frame:
            own = fast & above
            if numbers is not None:
                own &= np.isin(sequence.read("instances", other), list(numbers))
            passed.update(voxels[own].tolist())
        held.update(voxels[~fast | (other == frame)].tolist())
    ego = population.ego_pose(frame) @ translation(EGO_SENSOR_M)
    here = [actor for actor in population.at(frame) if np.hypot(*actor.world_T_actor[:2, 3]) < 200]
    held.update(np.flatnonzero(owners(here, invert(ego), spec)).tolist())
    empty = np.array(sorted(passed - held - {-1}), np.int64)
    return int((grid.labels.reshape(-1)[empty] != 0).sum()), len(empty)


def make_grid(feed: ScanFeed, actors: MovingActors, frame: int) -> Grid:
    """Return the ground truth of a frame, with voxels of 0.2 m."""
    spec = GRIDS["0.2 m"]
    plan = GridPlan(spec, "grid", feed.options, Voting(keep_evidence=True), FrameRange())
    return merge_frame(plan, feed, actors, frame, feed.reaching(frame, spec)).grid


def row(name: str, scores: Scores, actors: MovingActors) -> str:
    """Return the row of a drive."""
    truth = {number for number, scans in scores.truth.items() if scans >= _SEEN[0]}
    owners = [count for count in scores.owners.values() if count]
    merged = sum(len([n for n, k in o.items() if n and k > 0.2 * o.total()]) > 1 for o in owners)
    best = [max(o, key=o.__getitem__) for o in owners]
    sizes = np.array([t.size for t in actors.tracks.values()]).reshape(-1, 3)
    tall, wide = sizes[:, 2].max(initial=0.0), sizes[:, 1].max(initial=0.0)
    moving = [scores.counts[kind] for kind in KINDS]
    left = sum(c.points - c.moved for c in moving) / max(sum(c.points for c in moving), 1)
    cells = [
        name,
        *(f"{c.share('tracked'):.1f} / {c.share('moved'):.1f}" for c in moving),
        f"{scores.counts['parked'].share('tracked'):.1f}",
        f"{scores.counts['static'].share('tracked'):.2f}",
        f"{100 * left:.1f}, {scores.trail:.1f}",
        f"{len(owners)} / {len(truth)}",
        f"{len(truth & set(best))}",
        f"{merged}",
        f"{sum(number == 0 for number in best)}",
        f"{tall:.1f}, {wide:.1f}",
        f"{scores.cpu_s:.2f}",
        f"{scores.points / 1000:.0f}k",
    ]
    return f"| {' | '.join(cells)} |"


def measure(setting: Setting, work: Path, *, noisy: bool = False) -> str:
    """Return the row of a drive, which is recorded unless it was."""
    (drive,) = record_all([setting], work)
    bare: Sequence = Only(drive.sequence, ("points", "seconds", "origins"))
    if noisy:
        bare = bare.with_poses(NoisyPoses(0.02, 0.1)(drive, 0).poses)
    feed = ScanFeed(bare, EVIDENCE)
    find_actors(feed.without(feed.frames.tolist()[_FIRST:]))  # loops are compiled
    start = time.process_time()
    actors = find_actors(feed)
    cpu_s = (time.process_time() - start) / len(feed.frames)
    crowd = crowded.CrowdedDrive(setting.seed).crowd
    kinds = {EGO_ID + k: user.kind for k, user in enumerate(crowd.movers)}
    scores = score(drive, actors, kinds)
    frame = 4 if study.is_tiny() else crowded.FRAMES // 2
    occupied, empty = trail(make_grid(feed, actors, frame), drive, frame, crowd)
    scores.cpu_s, scores.trail = cpu_s, 100 * occupied / max(empty, 1)
    return row(str(setting), scores, actors)


def main() -> None:
    """Measure all drives."""
    parser = study.options(__doc__, SEEDS)
    parser.add_argument("--channels", type=int, choices=(32, 64, 128), default=128)
    parser.add_argument("--turning", action="store_true")
    parser.add_argument("--noisy", action="store_true")
    with study.begin(parser) as given:
        kinds = " | ".join(KINDS)
        print(f"| drive | {kinds} | {HEADS} |\n|{'---|' * (2 + len(KINDS) + HEADS.count('|'))}")
        for seed in study.few(given.crowded):
            channels = 32 if study.is_tiny() else given.channels
            setting = Setting("crowded", seed, channels, int(given.turning))
            print(measure(setting, given.work, noisy=given.noisy), flush=True)


if __name__ == "__main__":
    main()
