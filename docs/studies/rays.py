"""What following each ray once, into cells, changes: `python docs/studies/rays.py [WORK] [--before
FILE]`.

Some drives of `movers.py` are merged in several ways and compared with what other sensors saw at
the same instant. The scores are written to WORK/rays.json. FILE has those of another version of
carlasc: with it, the differences are printed, in points. WORK keeps drives, references and actors.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import movers_drives
import numpy as np
import study
from movers import BY_NAME, WINDOW, ActorStore
from movers_drives import Recorded, Reference, record, reference
from movers_rows import EVIDENCE, Changed, Row
from movers_scores import count, figures
from numpy.typing import NDArray

from carlasc import Grid, GridSpec, Voting
from carlasc.core.frames import FrameRange
from carlasc.core.geometry import transform_points
from carlasc.core.tables import CARLA
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.frame import merge_frame
from carlasc.groundtruth.inputs import GridPlan
from carlasc.storage import Sequence
from carlasc.testing import wrong_labels

SEEDS = {"town": range(61, 63), "street": range(261, 263)}
GRIDS = {
    "0.4 m": GridSpec.published(),
    "0.2 m": GridSpec.published().with_resolution(0.2),
    "0.8 m": GridSpec.published().with_resolution(0.8),
    "0.1 m": GridSpec.published().with_resolution(0.1),
    "cylindrical": GridSpec.published("cylindrical"),
}
CLASSES = ("Vehicle", "Pedestrian", "Pole", "Road", "Building", "Sidewalk", "Vegetation")
WARM, TIMED = 2, 10  # numbers of consecutive frames: before the clock starts, and with it
movers_drives.POINTS[128] = 260_000


@dataclass(frozen=True)
class WrongLabels:
    """Other classes for a share of the points of each scan, in clumps or at random."""

    share: float
    clump_m: float | None

    def __call__(self, drive: Recorded, frame: int) -> Sequence:
        """Return the sequence with wrong labels."""
        sequence = drive.sequence

        def labels(number: int) -> NDArray[np.unsignedinteger]:
            scan = sequence.scan(number, ["labels"])
            points = transform_points(sequence.read_pose(number), scan.points)
            right = study.labels_of(scan)
            return wrong_labels(right, points, self.share, clump_m=self.clump_m, seed=number)

        return Changed(sequence, labels=labels)


@dataclass(frozen=True)
class Case:
    """A way in which drives are recorded and merged."""

    grid: str = "0.4 m"
    channels: int = 64
    row: Row = BY_NAME["align, free space"]


CASES = {
    "0.4 m": Case(),
    "0.2 m": Case("0.2 m"),
    "16 channels": Case(channels=16),
    "32 channels": Case(channels=32),
    "128 channels": Case(channels=128),
    "0.2 m, 16 channels": Case("0.2 m", 16),
    "0.8 m": Case("0.8 m"),
    "0.1 m": Case("0.1 m"),
    "cylindrical": Case("cylindrical"),
    "poses 5 cm off": Case(row=BY_NAME["free space, poses 5 cm"]),
    "poses 20 cm off": Case(row=BY_NAME["free space, poses 20 cm"]),
    "poses 0.5 degrees off": Case(row=BY_NAME["free space, poses 0.5 degrees"]),
    "20% wrong labels, in clumps": Case(row=Row("clumps", EVIDENCE, WrongLabels(0.2, 1.0))),
    "40% wrong labels": Case(row=Row("wrong", EVIDENCE, WrongLabels(0.4, None))),
    "flow": Case(row=BY_NAME["align, flow"]),
    "boxes": Case(row=BY_NAME["align, exact boxes"]),
}


def main() -> None:
    """Score each case on each drive, and print the scores, or what differs."""
    parser = study.options(__doc__, SEEDS)
    parser.add_argument("--before", type=Path, help="scores of another version")
    parser.add_argument("--case", choices=CASES, action="append", help="only this; may be repeated")
    with study.begin(parser) as given:
        found: dict[str, dict[str, dict[str, float]]] = {}
        for name in given.case or study.few(CASES):
            for kind, seed in study.drives(given, SEEDS):
                scores = score(CASES[name], kind, seed, given.work)
                found.setdefault(name, {})[f"{kind} {seed}"] = scores
                print(f"{name}, {kind} {seed}: {scores}", flush=True)
        (given.work / "rays.json").write_text(json.dumps(found))
        if given.before:
            print(differences(json.loads(given.before.read_text()), found))


def score(case: Case, kind: str, seed: int, work: Path) -> dict[str, float]:
    """Return the scores of a case on a drive, in per cent, and the CPU time of a frame, seconds."""
    (drive,) = record(kind, seed, [case.channels], work)
    grids = {case.grid: GRIDS[case.grid]}
    references = {at[1]: seen for at, seen in reference(kind, seed, work, grids).items()}
    feed = ScanFeed(case.row.change(drive, 0), case.row.observe)
    store = ActorStore(work / "scores" / str(drive.setting) / "actors")
    store.folder.mkdir(parents=True, exist_ok=True)
    actors = store.of(case.row, feed)
    voting = Voting(keep_evidence=True)
    plan = GridPlan(GRIDS[case.grid], "grid", case.row.observe, voting, FrameRange())
    shares, counted = np.zeros((len(CLASSES) + 2, 2)), []
    for frame, seen in references.items():
        merged = merge_frame(plan, feed, actors, frame, feed.reaching(frame, plan.spec))
        assert merged.evidence is not None
        shares += overlaps(merged.grid, seen)
        sides, likely = drive.sides(frame, WINDOW), merged.evidence.occupied
        counted.append(count(merged.grid, seen, sides, likely))
    names = [*(f"IoU of {name}" for name in (*CLASSES, "occupied")), "called free"]
    with np.errstate(invalid="ignore"):
        scores = dict(zip(names, (100 * shares[:, 0] / shares[:, 1]).tolist(), strict=True))
    scores["ECE"] = 100 * figures(sum(counted[1:], counted[0]))["ECE"]
    plan, times = GridPlan(plan.spec, "grid", plan.observe, Voting(), FrameRange()), []
    for frame in feed.frames[feed.frames >= min(references)][: WARM + TIMED].tolist():
        start = time.process_time()
        merge_frame(plan, feed, actors, frame, feed.reaching(frame, plan.spec))
        times.append(time.process_time() - start)
    return scores | {"seconds": float(np.median(times[WARM:]))}


def overlaps(grid: Grid, seen: Reference) -> NDArray[np.float64]:
    """Return intersection and union of each class and of what is occupied, and how many of the
    occupied voxels are called free.
    """
    both = seen.judged & grid.known
    made, truth = grid.labels[both], seen.labels[both]
    pairs = [(made == number, truth == number) for number in map(CARLA.id_of, CLASSES)]
    pairs.append((made > 0, truth > 0))
    rows = [[(a & b).sum(), (a | b).sum()] for a, b in pairs]
    return np.array([*rows, [((made == 0) & (truth > 0)).sum(), (truth > 0).sum()]], np.float64)


def differences(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """Return a table of what differs: mean and range over the drives."""
    names = [name for one in after.values() for drive in one.values() for name in drive]
    columns = list(dict.fromkeys(name for name in names if name != "seconds"))
    lines = ["| case | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for case, drives in after.items():
        cells = []
        for column in columns:
            changes = [
                scores[column] - before[case][drive][column]
                for drive, scores in drives.items()
                if drive in before.get(case, {})
            ]
            known = [change for change in changes if np.isfinite(change)]
            ends = f" ({min(known):+.2f} to {max(known):+.2f})" if known else ""
            cells.append(f"{np.mean(known):+.2f}{ends}" if known else "")
        lines.append(f"| {case} | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
