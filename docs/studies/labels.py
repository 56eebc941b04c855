"""What wrong labels do to ground truth from scans: `python docs/studies/labels.py [WORK]` prints
the tables of docs/studies/wrong-labels.md as rows finish.

The labels of the drives of `movers.py` are made wrong in several ways, and their grids are compared
with what 40 other sensors saw at the same instant. The last row has right labels, but voxels with
returns of the frame's own scan may be free: it says what the rule of own returns costs. WORK keeps
drives and references, as that of `movers.py` does. `--hint evidence` takes nothing but free space
for what moves, instead of the exact flow.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from unittest.mock import patch

import numpy as np
import study
from movers import SEEDS
from movers_drives import GRIDS, Recorded, Reference, record, reference
from movers_rows import EVIDENCE, FLOW, Changed
from numpy.typing import NDArray

from carlasc import FromScans, Grid
from carlasc.core.frames import FrameRange
from carlasc.core.geometry import transform_points
from carlasc.core.tables import CARLA
from carlasc.groundtruth import Voting
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.frame import _FrameSteps, merge_frame
from carlasc.groundtruth.from_scans.motion_pass import find_actors
from carlasc.groundtruth.inputs import GridPlan
from carlasc.groundtruth.voting.certainty import class_shares
from carlasc.storage import Sequence
from carlasc.testing import wrong_labels

NAMES = ("Vehicle", "Pedestrian", "Pole", "Road", "Sidewalk", "Building", "Vegetation")
CONFUSED = {
    "Road": "Sidewalk",
    "Sidewalk": "Road",
    "Vegetation": "Terrain",
    "Terrain": "Vegetation",
    "Building": "Wall",
}
Labels = NDArray[np.unsignedinteger]


def at_random(labels: Labels, points: NDArray[np.float64], frame: int) -> Labels:
    """A fifth of the points, each for itself."""
    return wrong_labels(labels, points, 0.2, seed=frame)


def in_clumps(labels: Labels, points: NDArray[np.float64], frame: int) -> Labels:
    """A quarter of the points, in cubes of 1 m that are others in each scan."""
    return wrong_labels(labels, points, 0.25, clump_m=1.0, seed=frame)


def confused(labels: Labels, points: NDArray[np.float64], frame: int) -> Labels:
    """A fifth of the points of some classes, which are taken for one other class."""
    rng, made = np.random.default_rng(frame), labels.copy()
    for name, other in CONFUSED.items():
        made[(labels == CARLA.id_of(name)) & (rng.random(len(labels)) < 0.2)] = CARLA.id_of(other)
    return made


RIGHT, MAY_BE_FREE = "right", "right, and own returns may be free"
CASES: dict[str, Callable[[Labels, NDArray[np.float64], int], Labels] | None] = {
    RIGHT: None,
    "20% wrong, at random": at_random,
    "25% wrong, in clumps of 1 m": in_clumps,
    "20% confused with one other class": confused,
    MAY_BE_FREE: None,
}


class Score:
    """What is counted of grids beside references, and the figures of it."""

    def __init__(self) -> None:
        self.classes = np.zeros((len(NAMES), 3))
        self.right, self.occupied = np.zeros(2), np.zeros(3)
        self.returns = np.zeros((2, 2))
        self.shares: list[NDArray[np.float64]] = []
        self.grids: dict[int, Grid] = {}

    def add(
        self, grid: Grid, seen: Reference, shares: NDArray[np.void], drive: Recorded, frame: int
    ) -> None:
        """Count a frame."""
        self.grids[frame] = grid
        made, truth, both = grid.labels, seen.labels, seen.judged & grid.known
        for index, name in enumerate(NAMES):
            own, found = both & (truth == CARLA.id_of(name)), both & (made == CARLA.id_of(name))
            self.classes[index] += (own & found).sum(), own.sum(), found.sum()
        there, full = both & (truth > 0), both & (made > 0)
        self.occupied += (there & full).sum(), there.sum(), full.sum()
        self.right += (there & full & (truth == made)).sum(), (there & full).sum()
        top = np.zeros(grid.spec.num_voxels)
        np.maximum.at(top, shares["voxel"], shares["votes"] / 65535)
        judged = (there & full).reshape(-1)
        self.shares.append(np.stack([top[judged], (truth == made).reshape(-1)[judged]]))
        scan = drive.sequence.scan(frame, ("labels",))
        classes = study.labels_of(scan)
        voxels = grid.spec.flat_index(scan.points)
        solid = (voxels >= 0) & (classes > 0) & ~np.isin(classes, sorted(CARLA.ground))
        for index, own in enumerate((solid, solid & (classes == CARLA.id_of("Vehicle")))):
            self.returns[index] += (made.reshape(-1)[voxels[own]] > 0).sum(), own.sum()

    def figures(self) -> dict[str, float]:
        """Return IoUs, the share of occupied voxels of the right class, the calibration error of
        the class, and the share of own returns that are occupied.
        """
        hit, own, found = self.classes.T
        likely, right = np.concatenate(self.shares, axis=1)
        bins = np.array_split(np.argsort(likely, kind="stable"), 15)
        error = sum(abs(float((likely[b] - right[b]).sum())) for b in bins) / len(likely)
        values = dict(zip(NAMES, hit / (own + found - hit), strict=True))
        both, there, full = self.occupied
        return {
            "occupied": both / (there + full - both),
            "class right": self.right[0] / self.right[1],
            "ECE of the class": error,
            **values,
            "own returns": self.returns[0, 0] / self.returns[0, 1],
            "of vehicles": self.returns[1, 0] / self.returns[1, 1],
        }


def with_labels(drive: Recorded, case: str) -> Sequence:
    """Return a drive with wrong labels."""
    change = CASES[case]
    if change is None:
        return drive.sequence

    def labels(frame: int) -> Labels:
        points = transform_points(
            drive.sequence.read_pose(frame), drive.sequence.scan(frame, ()).points
        )
        return change(drive.sequence.read("labels", frame), points, frame)

    return Changed(drive.sequence, labels=labels)


def judge(
    drive: Recorded, references: dict[int, Reference], case: str, observe: FromScans
) -> Score:
    """Make and count the judged frames of a drive."""
    plan = GridPlan(GRIDS["coarse"], "grid", observe, Voting(keep_evidence=True), FrameRange())
    feed, score = ScanFeed(with_labels(drive, case), observe), Score()
    actors = find_actors(feed)
    for frame, seen in references.items():
        with patch.object(_FrameSteps, "keep_returns") if case == MAY_BE_FREE else nullcontext():
            merged = merge_frame(plan, feed, actors, frame, feed.reaching(frame, plan.spec))
        assert merged.votes is not None
        shares = (
            merged.evidence.classes
            if merged.evidence
            else class_shares(merged.votes.occupied, CARLA)
        )
        score.add(merged.grid, seen, shares, drive, frame)
    return score


def kept(scores: dict[str, Score], references: dict[int, Reference]) -> NDArray[np.int64]:
    """Count the judged voxels that only the rule of own returns makes occupied, and those of them
    that other sensors call free.
    """
    counts = np.zeros(2, np.int64)
    for frame, seen in references.items():
        full, may_be_free = (scores[case].grids[frame].labels > 0 for case in (RIGHT, MAY_BE_FREE))
        by_rule = seen.judged & full & ~may_be_free
        counts += by_rule.sum(), (by_rule & (seen.labels == 0)).sum()
    return counts


def main() -> None:
    """Print the rows of each drive, and the means."""
    parser = study.options(__doc__, SEEDS)
    parser.add_argument("--hint", choices=("flow", "evidence"), default="flow")
    found: dict[str, list[dict[str, float]]] = {case: [] for case in CASES}
    by_rule = np.zeros(2, np.int64)
    with study.begin(parser) as given:
        observe = FLOW if given.hint == "flow" else EVIDENCE
        for kind, seed in study.drives(given, SEEDS):
            (drive,) = record(kind, seed, [32], given.work)
            seen = {
                frame: one
                for (grid, frame), one in reference(kind, seed, given.work).items()
                if grid == "coarse"
            }
            scores = {case: judge(drive, seen, case, observe) for case in CASES}
            by_rule += kept(scores, seen)
            for case, score in scores.items():
                found[case].append(score.figures())
                print(
                    kind,
                    seed,
                    case,
                    " ".join(f"{k} {v:.3f}" for k, v in found[case][-1].items()),
                    flush=True,
                )
    names = list(found[RIGHT][0])
    print(f"\n| labels | {' | '.join(names)} |\n|---|{'---:|' * len(names)}")
    for case, rows in found.items():
        print(
            f"| {case} | "
            f"{' | '.join(f'{np.mean([row[name] for row in rows]):.3f}' for name in names)} |"
        )
    voxels, free = by_rule.tolist()
    print(
        f"\nVoxels that only the rule of own returns makes occupied: {voxels}; other sensors call "
        f"{free / max(voxels, 1):.0%} of them free."
    )


if __name__ == "__main__":
    main()
