"""What wrong poses cost, and what refining them wins back: `python docs/studies/poses.py [WORK]` prints the tables of docs/studies/poses.md.

Simulated drives are recorded by one LiDAR, and their poses are made wrong in several ways. Grids are made from 61 scans with the drive's exact flow, under
the wrong poses and under the refined ones, and compared with what 40 other sensors saw at the same instant. WORK keeps drives, references and results, and a run
continues there. The default is a temporary folder.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import study
from movers import SEEDS
from movers_drives import GRIDS, Reference, Setting, record, reference
from numpy.typing import NDArray

from carlasc import Grid, Run
from carlasc.core.frames import FrameRange
from carlasc.core.tables import CARLA
from carlasc.groundtruth import FromScans, Voting
from carlasc.groundtruth.from_scans.feed import ScanFeed, WithoutScans
from carlasc.groundtruth.from_scans.frame import merge_frame
from carlasc.groundtruth.from_scans.motion_pass import find_actors, refine_sequence, with_refined_poses
from carlasc.groundtruth.from_scans.sequences import with_estimated_poses
from carlasc.groundtruth.inputs import GridPlan
from carlasc.motion import MotionOptions
from carlasc.motion.tracks import MovingActors
from carlasc.storage.files import write_atomic
from carlasc.testing import wrong_poses

DEGREE = math.radians(1.0)
ROWS = {
    "exact": {},
    "jitter of 3 cm and 0.1 degrees per scan": {"jitter_m": 0.03, "jitter_rad": 0.1 * DEGREE},
    "jitter of 8 cm and 0.3 degrees per scan": {"jitter_m": 0.08, "jitter_rad": 0.3 * DEGREE},
    "drift of 1 cm and 0.05 degrees per scan": {"drift_m": 0.01, "drift_rad": 0.05 * DEGREE},
    "drift of the height alone, 3 cm per scan": {"height_drift_m": 0.03},
    "KISS-ICP": None,
}
MODES = ("never", "auto")
CLASSES = ("Building", "Sidewalk", "Road", "Vehicle", "Pedestrian")
FIGURES = ("occupied", *CLASSES, "Vehicle called free")


@dataclass(frozen=True)
class Task:
    """All grids of one drive under one kind of poses."""

    setting: Setting
    row: str
    grids: tuple[str, ...]
    every: int
    work: Path

    def path(self, mode: str, grid: str) -> Path:
        """Return the file of a result."""
        name = "".join(letter if letter.isalnum() else "_" for letter in f"{self.row} {mode} {grid} {self.every}")
        return self.work / "poses" / str(self.setting) / f"{name}.json"


def run(task: Task) -> None:
    """Make and measure the grids of a task that are missing."""
    if all(task.path(mode, grid).exists() for mode in MODES for grid in task.grids):
        return
    setting = task.setting
    (drive,) = record(setting.kind, setting.seed, [setting.channels], task.work)
    references = reference(setting.kind, setting.seed, task.work)
    whole = drive.sequence
    hidden = [f for f in whole.frames("points").tolist() if task.every > 1 and f % task.every]
    scans = WithoutScans(whole, hidden) if hidden else whole
    mistakes = ROWS[task.row]
    wrong = (
        with_estimated_poses(scans)
        if mistakes is None
        else whole.with_poses(wrong_poses(whole.poses, **mistakes, seed=setting.seed))
    )
    scans = WithoutScans(wrong, hidden) if hidden and mistakes is not None else wrong
    half = 30 - 30 % task.every
    observe = FromScans(window=(-half, half), motion=MotionOptions("flow"))
    feed = ScanFeed(scans, observe)
    for mode in MODES:
        said = ""
        if mode == "auto":
            refined = refine_sequence(feed, run=Run(workers=1))
            before, after = (100 * float(np.nanmean(values)) for values in (refined.before_m, refined.after_m))
            said = f" ({before:.1f} cm, now {after:.1f})"
            if refined.refined.any():
                feed = ScanFeed(with_refined_poses(scans, feed.frames, refined), observe)
        actors = find_actors(feed, Run(workers=1)) if feed.needs_actors else MovingActors()
        for grid in task.grids:
            plan = GridPlan(GRIDS[grid], "grid", observe, Voting(), FrameRange())
            counts = np.zeros((1 + len(CLASSES), 5), np.int64)
            for (name, frame), seen in references.items():
                if name == grid and frame in feed.frames:
                    made = merge_frame(plan, feed, actors, frame, feed.reaching(frame, plan.spec)).grid
                    counts += count(made, seen)
            write_atomic(task.path(mode, grid), json.dumps(counts.tolist()).encode())
            print(f"{setting} {task.row}, {mode}{said}, {grid}: {np.round(figures(counts), 3).tolist()}", flush=True)


def count(grid: Grid, seen: Reference) -> NDArray[np.int64]:
    """Count, for what is occupied and for each class: right, in the reference and in the grid, of what both know; all of the reference, and called free."""
    both = grid.known & seen.judged
    pairs = [(seen.labels > 0, grid.labels > 0)]
    pairs += [(seen.labels == CARLA.id_of(name), grid.labels == CARLA.id_of(name)) for name in CLASSES]
    free = grid.known & (grid.labels == 0)
    rows = [
        [(true & made & both), (true & both), (made & both), (true & seen.judged), (true & seen.judged & free)]
        for true, made in pairs
    ]
    return np.array([[int(cells.sum()) for cells in row] for row in rows])


def figures(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the values of `FIGURES`."""
    right, true, made, everything, free = counts.T
    iou = right / np.maximum(true + made - right, 1)
    vehicle = 1 + CLASSES.index("Vehicle")
    return np.append(iou, free[vehicle] / max(everything[vehicle], 1))


def table(tasks: Sequence[Task], grid: str) -> str:
    """Return the means over drives, as a table."""
    lines = [f"| poses | refined | {' | '.join(FIGURES)} | won back |", "|---" * (len(FIGURES) + 3) + "|"]
    exact = math.nan
    for row in dict.fromkeys(task.row for task in tasks):
        own = [task for task in tasks if task.row == row]
        means = {
            mode: np.mean([figures(np.array(json.loads(t.path(mode, grid).read_text()))) for t in own], axis=0)
            for mode in MODES
        }
        exact = means["never"][0] if row == "exact" else exact
        for mode, values in means.items():
            lost = exact - means["never"][0]
            won = f"{(values[0] - means['never'][0]) / lost:.0%}" if mode == "auto" and row != "exact" else ""
            lines.append(f"| {row} | {mode} | {' | '.join(f'{value:.3f}' for value in values)} | {won} |")
    return "\n".join(lines)


def main() -> None:
    """Do all tasks, and print the tables."""
    parser = study.options(__doc__, SEEDS)
    parser.add_argument("--channels", nargs="+", type=int, default=[32], help="LiDARs")
    parser.add_argument("--every", type=int, default=1, help="use every N-th scan: 5 for a LiDAR of 2 Hz")
    parser.add_argument("--fine", action="store_true", help="voxels of 0.2 m too")
    parser.add_argument("--rows", nargs="+", default=list(ROWS), help="some rows only")
    parser.add_argument("--workers", type=int, default=2)
    with study.begin(parser) as given:
        drives, grids = study.drives(given, SEEDS), tuple(GRIDS) if given.fine else ("coarse",)
        make = partial(Task, grids=grids, every=given.every, work=given.work)
        rows = study.few(given.rows, 2)
        tasks = [make(Setting(*d, n), row) for row in rows for n in given.channels for d in drives]
        study.do_all(run, tasks, given.workers)
        for channels in given.channels:
            for grid in grids:
                own = [task for task in tasks if task.setting.channels == channels]
                print(f"\n{channels} channels, {grid}, {len(drives)} drives\n\n{table(own, grid)}")


if __name__ == "__main__":
    main()
