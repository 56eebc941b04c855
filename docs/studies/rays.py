"""What a part of the rays costs in scores: `python docs/studies/rays.py [WORK] [DRIVE_CHANNELS ...]`, such as `town61_64 street261_16`.

The drives of `movers.py` are merged with all rays and with `rays="enough"`, and both are compared with what other sensors saw at the same instant.
Prints a line for each drive and grid, then the differences of the scores over all drives, in points, and of held-out rays. WORK keeps drives and references.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from dataclasses import replace
from functools import reduce
from operator import add
from pathlib import Path

from movers import BY_NAME, GRIDS, ActorStore, judge
from movers_drives import record, reference
from movers_rows import Row
from movers_scores import Counts, figures

from carlasc import Run
from carlasc.groundtruth.options import Rays
from carlasc.inspection import holdout

DRIVES = tuple(
    f"{kind}{seed}_{channels}"
    for seed in range(1, 6)
    for kind, seed in (("town", 60 + seed), ("street", 260 + seed))
    for channels in (64, 16)
)
WAYS: tuple[Rays, ...] = ("all", "enough")
HELD_OUT = 2  # drives whose held-out rays are followed too


def main(work: Path, drives: tuple[str, ...]) -> None:
    """Make the grids of each drive in both ways, and print what differs."""
    found: dict[tuple[str, str, str], list[Counts]] = defaultdict(list)
    for number, name in enumerate(drives):
        named, channels = name.split("_")
        kind = named.rstrip("0123456789")
        seed = int(named[len(kind) :])
        (drive,) = record(kind, seed, [int(channels)], work)
        references = reference(kind, seed, work)
        store, base = ActorStore(work / "scores" / name / "actors"), BY_NAME["align, evidence"]
        store.folder.mkdir(parents=True, exist_ok=True)
        for grid in GRIDS:
            chosen = {frame: seen for (other, frame), seen in references.items() if other == grid}
            for rays in WAYS:
                row = Row(rays, replace(base.observe, rays=rays))
                found[grid, channels, rays].append(judge(drive, row, grid, chosen, store))
            print(name, grid, _differences(*(found[grid, channels, rays][-1] for rays in WAYS)), flush=True)
        if number < HELD_OUT:
            for rays in WAYS:
                observe = replace(base.observe, rays=rays)
                scores = holdout(drive.folder, observe=observe, every=15, frames=(30, 61), run=Run(workers=1))
                print(name, rays, "held-out rays", scores.to_dict()["total"], flush=True)
    for grid, channels in dict.fromkeys((grid, channels) for grid, channels, _ in found):
        totals = [reduce(add, found[grid, channels, rays]) for rays in WAYS]
        print(f"\n{grid}, {channels} channels, {len(found[grid, channels, 'all'])} drives: {_differences(*totals)}")


def _differences(one: Counts, other: Counts) -> str:
    """Return the differences of all scores, in points, and the ratio of the times."""
    before, after = figures(one), figures(other)
    shown = [
        f"{name} {100 * (after[name] - value):+.2f}"
        for name, value in before.items()
        if not name.startswith(("wrongly", "seconds"))
    ]
    counts = [
        f"{name} {value:.0f} -> {after[name]:.0f}" for name, value in before.items() if name.startswith("wrongly")
    ]
    return ", ".join([*shown, *counts, f"seconds {before['seconds']:.2f} -> {after['seconds']:.2f}"])


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "build/rays"), tuple(sys.argv[2:]) or DRIVES)
