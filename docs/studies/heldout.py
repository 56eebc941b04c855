"""Held-out rays under several rules: `python docs/studies/heldout.py` prints the table of the page
of `carlasc validate`.

Five drives of each world of `movers.py` (town, street and railed; 32 channels), of which every 15th
scan of the frames 30 to 74 is left out. `--drives FOLDER ...` takes other drives: folders of
sequences with scans and poses. The scores of all drives are added. `--res 0.2` makes finer grids.
"""

from __future__ import annotations

from functools import reduce
from pathlib import Path

import study
from movers_drives import SEEDS, record
from movers_rows import EVIDENCE, ROWS

from carlasc import GridSpec, Run
from carlasc.inspection import HeldOutScores, holdout

RULES = {
    row.name: row.observe for row in ROWS if row.name in ("tube", "current", "align, instances")
}
RULES |= {"align, free space": EVIDENCE}


def main() -> None:
    """Print the table."""
    parser = study.options(__doc__, SEEDS)
    parser.add_argument("--drives", nargs="+", type=Path)
    parser.add_argument(
        "--res", type=float, help="size of a voxel, metres; default: the published grid"
    )
    with study.begin(parser) as given:
        spec = (
            GridSpec.published()
            if given.res is None
            else GridSpec.published().with_resolution(given.res)
        )
        drives = given.drives or [
            record(*d, [32], given.work)[0].folder for d in study.drives(given, SEEDS)
        ]
        print(
            "| rule | free | of Vehicle | passed objects | of Vehicle | 90% of errors | swept "
            "|\n|---|---:|---:|---:|---:|---:|---:|"
        )
        every, frames = (3, None) if study.is_tiny() else (15, (30, 75))
        for rule, observe in RULES.items():
            results = [
                holdout(
                    drive, spec, observe=observe, every=every, frames=frames, run=Run(workers=1)
                ).total
                for drive in drives
            ]
            scores = reduce(HeldOutScores.merge, [found for found in results if found])
            print(f"| {rule} | {row(scores)} |", flush=True)
        print(f"{scores.frames} scans of {len(drives)} drives")


def row(scores: HeldOutScores) -> str:
    """Return the cells of a rule."""
    rays = (scores.all, scores.by_class().get("Vehicle"))
    shares = [None if found is None else found.free for found in rays]
    shares += [None if found is None else found.passed_object for found in rays]
    return " | ".join([*map(show, shares), f"{scores.all.error_90_m} m", show(scores.swept_share)])


def show(share: float | None) -> str:
    """Return a share as text."""
    return "" if share is None else f"{share:.1%}"


if __name__ == "__main__":
    main()
