"""Is ground truth from scans true where things move?

`python docs/studies/movers.py [WORK]` prints rows as they finish, and writes the tables.

Simulated drives in which everything moves, through a town and along a street, are recorded by one
LiDAR each. Their ground truth is made in many ways and compared with what 40 other sensors saw at
the same instant. WORK keeps drives, references and counts, and a run continues there; the counts of
code that has changed must be removed (WORK/whole/scores). The default is a temporary folder.

The rows with DUFOMap need the extra `study` (Python 3.12 or older). SA, DA and AA of maps, those of
other programs too: `maps.py`.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any

import movers_drives
import numpy as np
import study
from movers_drives import GRIDS, Recorded, Reference, Setting, record_all, reference
from movers_rows import ABLATIONS, BASIC, PARKED, ROWS, TURNING, UNLABELLED, Row
from movers_scores import Counts, count, figures
from movers_tables import Table, write_tables

from carlasc import Grid, Run
from carlasc.core.frames import FrameRange
from carlasc.core.tables import CARLA
from carlasc.groundtruth import Voting
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.frame import merge_frame
from carlasc.groundtruth.from_scans.motion_pass import find_actors
from carlasc.groundtruth.inputs import FrameData, GridPlan
from carlasc.inspection import holdout
from carlasc.motion.tracks import MovingActors
from carlasc.storage.files import write_atomic

SEEDS = {kind: movers_drives.SEEDS[kind] for kind in ("town", "street")}
WINDOW = (-30, 30)  # scans that show the sides of actors
PARTS = ("rules", "lidars", "errors", "held out", "turning")  # of the page
UNCHANGED = ("align, flow", "align, instances", "align, free space")  # beside the ablations
HELD_OUT = ("tube", "current", "align, flow", "align, exact boxes", "align, free space")
BY_NAME = {row.name: row for row in (*ROWS, *ABLATIONS, *TURNING)}
# number of LiDARs that turn, 0: one sees all at one instant; and parts of a turn, 1: the same
TURNS = ((0, 20), (1, 20), (3, 1), (3, 20))


@dataclass(frozen=True)
class Task:
    """Some rows of one drive.

    Attributes:
        setting: the drive and its LiDAR.
        grids: names of the grids.
        rows: names of the rows.
        work: folder that keeps everything.
        held_out: whether held-out rays are followed, instead of a comparison with the reference.
    """

    setting: Setting
    grids: tuple[str, ...]
    rows: tuple[str, ...]
    work: Path
    held_out: bool = False

    def path(self, row: str, grid: str) -> Path:
        """Return the file of a row's result."""
        part = "held out" if self.held_out else grid
        return self.work / "scores" / str(self.setting) / plain(part) / f"{plain(row)}.json"


def tasks_of(given: argparse.Namespace) -> list[Task]:
    """Return what is to be done."""
    work: Path = given.work
    every, basic, ablations, parked, turning = (
        tuple(row.name for row in rows) for rows in (ROWS, BASIC, ABLATIONS, PARKED, TURNING)
    )
    if given.parked:
        return [Task(Setting("parked", seed, 64), tuple(GRIDS), parked, work) for seed in (1, 2, 3)]
    if study.is_tiny():
        some = ("tube", "align, flow", "align, free space", UNLABELLED)
        return [Task(Setting(*study.drives(given, SEEDS)[0], 32), ("coarse",), some, work)]
    by_kind = [[(kind, seed) for seed in getattr(given, kind)] for kind in SEEDS]
    drives: list[tuple[str, int]] = [drive for pair in zip(*by_kind, strict=True) for drive in pair]

    def each(channels: int, grid: str, rows: tuple[str, ...]) -> list[Task]:
        return [Task(Setting(*drive, channels), (grid,), rows, work) for drive in drives]

    parts = {
        "rules": each(32, "coarse", every),
        "lidars": [
            *each(16, "coarse", basic),
            *each(64, "coarse", basic),
            *each(32, "0.2 m", basic),
        ],
        "errors": each(32, "coarse", (*UNCHANGED, *ablations)),
        "turning": [
            Task(Setting(*drive, channels, *turns), ("coarse",), turning, work)
            for channels in given.channels
            for turns in TURNS
            for drive in drives
        ],
        "held out": [replace(task, held_out=True) for task in each(32, "coarse", HELD_OUT)],
    }
    return [task for part in given.part or PARTS for task in parts[part]]


@dataclass(frozen=True)
class ActorStore:
    """Keeps the actors of a drive, which several rows and grids share, in a folder."""

    folder: Path

    def of(self, row: Row, feed: ScanFeed) -> MovingActors:
        """Return the actors of a row; they are found on first use."""
        if not feed.needs_actors:
            return MovingActors()
        path = self.folder / f"{plain(row.finds)}.npz"
        if not path.exists():
            found = find_actors(feed)
            write_atomic(path, found.to_bytes(row.finds))
            return found
        return MovingActors.from_bytes(path.read_bytes(), str(path))[0]


def plain(name: str) -> str:
    """Return a name for a file."""
    return "".join(letter if letter.isalnum() else "_" for letter in name)


def run(task: Task) -> None:
    """Do a task, and print a line for each row that was made; rows that were made before are left
    out.
    """
    missing = [
        (BY_NAME[row], grid)
        for row in task.rows
        for grid in task.grids
        if not task.path(row, grid).exists()
    ]
    if not missing:
        return
    setting = task.setting
    (drive,) = record_all([setting], task.work)
    actors = ActorStore(task.work / "scores" / str(setting) / "actors")
    for row, grid in missing:
        start = time.perf_counter()
        if task.held_out:
            scores = holdout(
                drive.folder,
                GRIDS[grid],
                observe=row.observe,
                every=15,
                frames=(30, 61),
                run=Run(workers=1),
            )
            result = scores.to_dict()["total"]
            line = f"{setting} {grid} {row.name}: held-out rays"
        else:
            references = reference(setting.kind, setting.seed, task.work)
            chosen = {frame: seen for (name, frame), seen in references.items() if name == grid}
            counts = judge(drive, row, grid, chosen, actors)
            result = counts.to_json()
            line = f"{setting} {grid} {row.name}: {summary(counts)}"
        path = task.path(row.name, grid)
        write_atomic(path, json.dumps(result).encode())
        print(f"{line}; {time.perf_counter() - start:.0f} s", flush=True)


def summary(counts: Counts) -> str:
    """Return some figures in a line."""
    found = figures(counts)
    shown = (
        "Vehicle IoU",
        "Pedestrian IoU",
        "Vehicle found",
        "Vehicle free",
        "Road IoU",
        "Building IoU",
        "seconds",
    )
    values = ", ".join(f"{name} {found[name]:.3f}" for name in shown)
    return f"{values}, wrongly Vehicle {found['wrongly Vehicle']:.0f}"


def judge(
    drive: Recorded, row: Row, grid: str, references: dict[int, Reference], store: ActorStore
) -> Counts:
    """Make the judged frames of a drive in one way, and count what is right."""
    total = []
    for frame, merged, seconds in make(drive, row, grid, references, store):
        posterior = None if merged.evidence is None else merged.evidence.occupied
        grid_made = (
            as_seen(merged.grid, references[frame]) if row.name == UNLABELLED else merged.grid
        )
        total.append(
            count(grid_made, references[frame], drive.sides(frame, WINDOW), posterior, seconds)
        )
    return reduce(add, total)


def as_seen(grid: Grid, seen: Reference) -> Grid:
    """Return a grid without classes with those of the reference: only what is occupied is judged
    then.
    """
    classes = np.where(seen.labels > 0, seen.labels, CARLA.geometry_id)
    return Grid(grid.spec, np.where(grid.labels > 0, classes, 0), grid.counts)


def make(
    drive: Recorded, row: Row, grid: str, frames: Iterable[int], store: ActorStore
) -> Iterator[tuple[int, FrameData, float]]:
    """Yield the frames of a drive that are made in one way, each with the time that it took in
    seconds.
    """
    plan = GridPlan(
        GRIDS[grid],
        "grid",
        row.observe,
        Voting(keep_evidence=row.observe.dynamic != "tube"),
        FrameRange(),
    )
    feed = None
    for frame in frames:
        if feed is None or row.by_frame:
            feed = ScanFeed(row.change(drive, frame), row.observe)
        actors = store.of(row, feed)
        start = time.perf_counter()
        merged = merge_frame(plan, feed, actors, frame, feed.reaching(frame, plan.spec))
        yield frame, merged, time.perf_counter() - start


def tables(tasks: Iterable[Task]) -> list[Table]:
    """Return the tables of what was made so far."""
    found: dict[tuple[object, ...], Table] = {}
    for task in (task for task in tasks if not task.held_out):
        for grid in task.grids:
            lidar = task.setting.channels, task.setting.lidars, task.setting.parts
            title = f"{task.setting.channels} channels, {grid}"
            if task.setting.lidars:
                title += f", {task.setting.lidars} x {task.setting.parts} parts of a turn"
            table = found.setdefault((grid, lidar, task.rows), Table(title, {}))
            for row in task.rows:
                path = task.path(row, grid)
                if path.exists():
                    counts = Counts.from_json(json.loads(path.read_text()))
                    table.rows.setdefault(row, {})[task.setting.drive] = counts
    return [table for table in found.values() if table.rows]


def held_out(tasks: Iterable[Task]) -> dict[str, list[dict[str, Any]]]:
    """Return the scores of held-out rays by row, one of each drive."""
    found: dict[str, list[dict[str, Any]]] = {}
    for task in (task for task in tasks if task.held_out):
        for row in task.rows:
            path = task.path(row, task.grids[0])
            if path.exists():
                found.setdefault(row, []).append(json.loads(path.read_text()))
    return found


def main() -> None:
    """Do all tasks, and write the tables."""
    parser = study.options(__doc__, SEEDS)
    parser.add_argument(
        "--parked", action="store_true", help="seeds 1 to 3 with parked cars, which are judged too"
    )
    parser.add_argument(
        "--part", choices=PARTS, action="append", help="only this part of the page; may be repeated"
    )
    parser.add_argument(
        "--channels", nargs="*", type=int, choices=(16, 32, 64), default=[32], help="that turn"
    )
    parser.add_argument(
        "--tables", action="store_true", help="only write the tables of what WORK has"
    )
    parser.add_argument("--workers", type=int, default=2)
    with study.begin(parser) as given:
        tasks = tasks_of(given)
        if not given.tables:
            study.do_all(run, tasks, given.workers)
        print(
            write_tables(
                tables(tasks),
                held_out(tasks),
                given.work / ("parked" if given.parked else "movers"),
            )
        )


if __name__ == "__main__":
    main()
