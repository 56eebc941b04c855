"""What wrong poses cost, and what refining them wins back: `python docs/studies/poses.py [WORK]`
prints the tables of docs/studies/poses.md.

Simulated drives are recorded by one LiDAR, and their poses are made wrong in several ways. Grids
are made from 61 scans with the drive's exact flow, under the wrong poses and under the refined
ones, and compared with what 40 other sensors saw at the same instant. WORK keeps drives, references
and results, and a run continues there. The default is a temporary folder. `--motions` makes no
grids: it prints the errors of motions over three seconds, of several kinds of scans. `--archive
FOLDER` prints the tables of a real drive instead: FOLDER is that of `real.py`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import study
from movers import SEEDS
from movers_drives import GRIDS, Reference, Setting, record, reference
from movers_rows import BARE, Only
from numpy.typing import NDArray
from poses_motions import show, typical_errors
from poses_real import print_tables

from carlasc import Grid, Run
from carlasc.core.frames import FrameRange
from carlasc.core.tables import CARLA
from carlasc.groundtruth import FromScans, Voting
from carlasc.groundtruth.from_scans.feed import ScanFeed, WithoutScans
from carlasc.groundtruth.from_scans.frame import merge_frame
from carlasc.groundtruth.from_scans.motion_pass import (
    find_actors,
    refine_sequence,
    with_refined_poses,
)
from carlasc.groundtruth.from_scans.sequences import with_estimated_poses
from carlasc.groundtruth.inputs import GridPlan
from carlasc.motion import MotionOptions
from carlasc.motion.tracks import MovingActors
from carlasc.storage import Sequence as Drive
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
SCANS = {  # channels, every which scan is used, and whether scans have labels
    "32 channels": (32, 1, True),
    "32 channels, unlabelled": (32, 1, False),
    "16 channels": (16, 1, True),
    "64 channels": (64, 1, True),
    "32 channels at 2 Hz": (32, 5, True),
}
SPAN = 30  # scans of a drive at 10 Hz: three seconds
ADDED = [name for name in ROWS if name.startswith("jitter")]  # on the real drive
MODES = ("never", "auto")
MOTIONS = "errors of motions"  # and how far scans are apart: a result beside those of grids
CLASSES = ("Building", "Sidewalk", "Road", "Vehicle", "Pedestrian")
FIGURES = ("occupied", *CLASSES, "Vehicle called free")


@dataclass(frozen=True)
class Task:
    """All grids of one drive under one kind of poses, and the errors of its motions."""

    setting: Setting
    row: str
    grids: tuple[str, ...]
    every: int
    labelled: bool
    work: Path

    def path(self, mode: str, grid: str) -> Path:
        """Return the file of a result."""
        name = "".join(
            letter if letter.isalnum() else "_"
            for letter in f"{self.row} {mode} {grid} {self.every}"
        )
        name += "" if self.labelled else "_no_labels"
        return self.work / "poses" / str(self.setting) / f"{name}.json"


def run(task: Task) -> None:
    """Make and measure the grids of a task that are missing, and measure its motions."""
    if all(task.path(mode, grid).exists() for mode in MODES for grid in (*task.grids, MOTIONS)):
        return
    setting = task.setting
    (drive,) = record(setting.kind, setting.seed, [setting.channels], task.work)
    references = reference(setting.kind, setting.seed, task.work) if task.grids else {}
    whole = drive.sequence if task.labelled else Only(drive.sequence, BARE)
    hidden = [f for f in whole.frames("points").tolist() if task.every > 1 and f % task.every]
    scans = WithoutScans(whole, hidden) if hidden else whole
    mistakes = ROWS[task.row]
    wrong = (
        with_estimated_poses(scans, FromScans())
        if mistakes is None
        else whole.with_poses(wrong_poses(whole.poses, **mistakes, seed=setting.seed))
    )
    scans = WithoutScans(wrong, hidden) if hidden and mistakes is not None else wrong
    half = 30 - 30 % task.every
    observe = FromScans(window=(-half, half), motion=MotionOptions("flow"))
    feed = ScanFeed(scans, observe)
    refined = refine_sequence(feed, run=Run(workers=1))
    for mode, apart_m in zip(MODES, (refined.before_m, refined.after_m), strict=True):
        if mode == "auto" and refined.refined.any():
            feed = ScanFeed(with_refined_poses(scans, feed.frames, refined), observe)
        poses = np.stack([feed.pose(frame) for frame in feed.frames.tolist()])
        errors = typical_errors(true_poses(whole, feed.frames), poses, SPAN // task.every)
        apart_cm = 100 * float(np.nanmean(apart_m))
        write_atomic(task.path(mode, MOTIONS), json.dumps([*errors, apart_cm]).encode())
        print(
            f"{setting}, every {task.every}, {task.row}, {mode}: {show(errors)}, {apart_cm:.1f} cm "
            f"apart",
            flush=True,
        )
        actors = (
            find_actors(feed, Run(workers=1))
            if task.grids and feed.needs_actors
            else MovingActors()
        )
        for grid in task.grids:
            plan = GridPlan(GRIDS[grid], "grid", observe, Voting(), FrameRange())
            counts = np.zeros((1 + len(CLASSES), 5), np.int64)
            for (name, frame), seen in references.items():
                if name == grid and frame in feed.frames:
                    made = merge_frame(
                        plan, feed, actors, frame, feed.reaching(frame, plan.spec)
                    ).grid
                    counts += count(made, seen)
            write_atomic(task.path(mode, grid), json.dumps(counts.tolist()).encode())
            print(
                f"{setting}, {task.row}, {mode}, {grid}: {np.round(figures(counts), 3).tolist()}",
                flush=True,
            )


def true_poses(drive: Drive, frames: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return (F, 4, 4) world_T_sensor of some frames."""
    return np.stack([drive.read_pose(frame) for frame in frames.tolist()])


def count(grid: Grid, seen: Reference) -> NDArray[np.int64]:
    """Count, for what is occupied and for each class: right, in the reference and in the grid, of
    what both know; all of the reference, and called free.
    """
    both = grid.known & seen.judged
    pairs = [(seen.labels > 0, grid.labels > 0)]
    pairs += [
        (seen.labels == CARLA.id_of(name), grid.labels == CARLA.id_of(name)) for name in CLASSES
    ]
    free = grid.known & (grid.labels == 0)
    rows = [
        [
            (true & made & both),
            (true & both),
            (made & both),
            (true & seen.judged),
            (true & seen.judged & free),
        ]
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
    """Return the means over drives, as a table, with the smallest share of a single drive that is
    recovered.
    """
    lines = [
        f"| poses | refined | {' | '.join(FIGURES)} | recovered |",
        "|---" * (len(FIGURES) + 3) + "|",
    ]
    exact = np.zeros(0)
    for row in dict.fromkeys(task.row for task in tasks):
        own = [task for task in tasks if task.row == row]
        made = {
            mode: np.array(
                [figures(np.array(json.loads(task.path(mode, grid).read_text()))) for task in own]
            )
            for mode in MODES
        }
        exact = made["never"][:, 0] if row == "exact" else exact
        for mode, values in made.items():
            won = ""
            if mode == "auto" and len(exact) and row != "exact":
                back, lost = values[:, 0] - made["never"][:, 0], exact - made["never"][:, 0]
                won = f"{back.mean() / lost.mean():.0%} (at least {(back / lost).min():.0%})"
            lines.append(
                f"| {row} | {mode} | {' | '.join(f'{value:.3f}' for value in values.mean(axis=0))} "
                f"| {won} |"
            )
    return "\n".join(lines)


def motions_table(tasks: Iterable[Task]) -> str:
    """Return what motions over three seconds are off, and how far neighbouring scans are apart,
    given and refined, by the kind of scans.

    Cells are means over drives, in centimetres, with the largest error of a single drive after
    refining.
    """
    found: dict[str, dict[str, list[list[list[float]]]]] = {}
    for task in tasks:
        scans = next(
            name
            for name, own in SCANS.items()
            if own == (task.setting.channels, task.every, task.labelled)
        )
        errors = [json.loads(task.path(mode, MOTIONS).read_text()) for mode in MODES]
        found.setdefault(task.row, {}).setdefault(scans, []).append(errors)
    names = [
        f"{scans}: {what}"
        for scans in next(iter(found.values()))
        for what in ("motions", "scans apart")
    ]
    lines, turned = (
        [f"| errors of the poses | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"],
        0.0,
    )
    for row, own in found.items():
        cells = []
        for drives in own.values():
            (off, _, apart), (off_now, _, apart_now) = np.mean(drives, axis=0).tolist()
            most, degrees, _ = np.max(drives, axis=0)[1].tolist()
            cells += [
                f"{off:.1f}, {off_now:.1f} (at most {most:.1f})",
                f"{apart:.1f}, {apart_now:.1f}",
            ]
            turned = max(turned, degrees)
        lines.append(f"| {row} | {' | '.join(cells)} |")
    return "\n".join(
        [*lines, "", f"Rotations are off by {turned:.2f} degrees at most after refining."]
    )


def main() -> None:
    """Do all tasks, and print the tables."""
    parser = study.options(__doc__, SEEDS)
    parser.add_argument("--channels", nargs="+", type=int, default=[32], help="LiDARs")
    parser.add_argument(
        "--every", type=int, default=1, help="use every N-th scan: 5 for a LiDAR of 2 Hz"
    )
    parser.add_argument("--fine", action="store_true", help="voxels of 0.2 m too")
    parser.add_argument("--rows", nargs="+", default=list(ROWS), help="some rows only")
    parser.add_argument(
        "--motions",
        action="store_true",
        help="no grids: the errors of motions, of several kinds of scans",
    )
    parser.add_argument("--archive", type=Path, help="the unpacked archive of the real drive")
    parser.add_argument("--workers", type=int, default=2)
    with study.begin(parser) as given:
        if given.archive:
            print_tables(
                given.archive, given.work, {name: ROWS[name] or {} for name in study.few(ADDED)}
            )
            return
        drives, rows = study.drives(given, SEEDS), study.few(given.rows, 2)
        grids = () if given.motions else tuple(GRIDS) if given.fine else ("coarse",)
        kinds = (
            list(SCANS.values())
            if given.motions
            else [(n, given.every, True) for n in given.channels]
        )
        make = partial(Task, grids=grids, work=given.work)
        tasks = [
            make(Setting(*d, n), row, every=every, labelled=labelled)
            for row in rows
            for n, every, labelled in study.few(kinds, 2)
            for d in drives
        ]
        study.do_all(run, tasks, given.workers)
        if given.motions:
            print(f"\n{len(drives)} drives\n\n{motions_table(tasks)}")
        for channels in given.channels:
            for grid in grids:
                own = [task for task in tasks if task.setting.channels == channels]
                print(f"\n{channels} channels, {grid}, {len(drives)} drives\n\n{table(own, grid)}")


if __name__ == "__main__":
    main()
