"""What a part of the rays costs in scores: `python docs/studies/rays.py [WORK]`.

The drives of `movers.py` are merged with all rays and with `rays="enough"`, and both are compared
with what other sensors saw at the same instant. Prints a line for each drive and grid, then the
differences of the scores over all drives, in points, and of held-out rays. WORK keeps drives and
references.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from functools import reduce
from operator import add

import study
from movers import BY_NAME, SEEDS, ActorStore, judge
from movers_drives import GRIDS, record, reference
from movers_rows import Row
from movers_scores import Counts, figures

from carlasc import Run
from carlasc.groundtruth.options import Rays
from carlasc.inspection import holdout

CHANNELS = (64, 16)
WAYS: tuple[Rays, ...] = ("all", "enough")
HELD_OUT = 2  # drives whose held-out rays are followed too


def main() -> None:
    """Make the grids of each drive in both ways, and print what differs."""
    found: dict[tuple[str, int, str], list[Counts]] = defaultdict(list)
    with study.begin(study.options(__doc__, SEEDS)) as given:
        settings = [
            (drive, channels)
            for drive in study.drives(given, SEEDS)
            for channels in study.few(CHANNELS)
        ]
        for number, ((kind, seed), channels) in enumerate(settings):
            (drive,) = record(kind, seed, [channels], given.work)
            references = reference(kind, seed, given.work)
            name = str(drive.setting)
            store, base = (
                ActorStore(given.work / "scores" / name / "actors"),
                BY_NAME["align, free space"],
            )
            store.folder.mkdir(parents=True, exist_ok=True)
            for grid in GRIDS:
                chosen = {
                    frame: seen for (other, frame), seen in references.items() if other == grid
                }
                for rays in WAYS:
                    row = Row(rays, replace(base.observe, rays=rays))
                    found[grid, channels, rays].append(judge(drive, row, grid, chosen, store))
                print(
                    name,
                    grid,
                    _differences(*(found[grid, channels, rays][-1] for rays in WAYS)),
                    flush=True,
                )
            for rays in WAYS if number < HELD_OUT and not study.is_tiny() else ():
                observe = replace(base.observe, rays=rays)
                scores = holdout(
                    drive.folder, observe=observe, every=15, frames=(30, 61), run=Run(workers=1)
                )
                print(name, rays, "held-out rays", scores.to_dict()["total"], flush=True)
    for grid, channels in dict.fromkeys((grid, channels) for grid, channels, _ in found):
        totals = [reduce(add, found[grid, channels, rays]) for rays in WAYS]
        print(
            f"\n{grid}, {channels} channels, {len(found[grid, channels, 'all'])} drives: "
            f"{_differences(*totals)}"
        )


def _differences(one: Counts, other: Counts) -> str:
    """Return the differences of all scores, in points, and the ratio of the times."""
    before, after = figures(one), figures(other)
    shown = [
        f"{name} {100 * (after[name] - value):+.2f}"
        for name, value in before.items()
        if not name.startswith(("wrongly", "seconds"))
    ]
    counts = [
        f"{name} {value:.0f} -> {after[name]:.0f}"
        for name, value in before.items()
        if name.startswith("wrongly")
    ]
    return ", ".join(
        [*shown, *counts, f"seconds {before['seconds']:.2f} -> {after['seconds']:.2f}"]
    )


if __name__ == "__main__":
    main()
