"""What following each ray once, into cells, changes: `python docs/studies/rays.py [WORK] [--before
FILE]`.

The drives of `movers.py` are merged and compared with what other sensors saw at the same instant.
The figures are written to WORK/rays.json. FILE has those of another version of carlasc: with it,
the differences are printed, in points. WORK keeps drives, references and actors.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import study
from movers import BY_NAME, SEEDS, ActorStore, judge
from movers_drives import GRIDS, Recorded, record, reference
from movers_rows import Row
from movers_scores import figures

from carlasc import Voting
from carlasc.core.frames import FrameRange
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.frame import merge_frame
from carlasc.groundtruth.inputs import GridPlan

CHANNELS = (64,)
WARM, TIMED = 2, 10  # numbers of consecutive frames: before the clock starts, and with it


def main() -> None:
    """Make the grids of each drive, and print their figures, or what differs."""
    parser = study.options(__doc__, SEEDS)
    parser.add_argument("--before", type=Path, help="figures of another version")
    with study.begin(parser) as given:
        before = json.loads(given.before.read_text()) if given.before else {}
        found: dict[str, dict[str, float]] = {}
        row = BY_NAME["align, free space"]
        for kind, seed in study.drives(given, SEEDS):
            for drive in record(kind, seed, CHANNELS, given.work):
                references = reference(kind, seed, given.work)
                store = ActorStore(given.work / "scores" / str(drive.setting) / "actors")
                store.folder.mkdir(parents=True, exist_ok=True)
                for grid in GRIDS:
                    seen = {f: one for (other, f), one in references.items() if other == grid}
                    scores = figures(judge(drive, row, grid, seen, store))
                    scores["seconds"] = _seconds(drive, row, grid, min(seen), store)
                    name = f"{drive.setting} {grid}"
                    found[name], old = scores, before.get(name, {})
                    shown = (
                        f"{key} {old[key]:.3f} -> {value:.3f}"
                        if key == "seconds" or key.startswith("wrongly")
                        else f"{key} {100 * (value - old[key]):+.2f}"
                        for key, value in scores.items()
                        if key in old
                    )
                    print(name, ", ".join(shown) or scores, flush=True)
        (given.work / "rays.json").write_text(json.dumps(found))


def _seconds(drive: Recorded, row: Row, grid: str, first: int, store: ActorStore) -> float:
    """Return the median CPU time of consecutive frames, in seconds per frame."""
    feed = ScanFeed(drive.sequence, row.observe)
    actors = store.of(row, feed)
    plan = GridPlan(GRIDS[grid], "grid", row.observe, Voting(), FrameRange())
    times = []
    for frame in feed.frames[feed.frames >= first][: WARM + TIMED].tolist():
        start = time.process_time()
        merge_frame(plan, feed, actors, frame, feed.reaching(frame, plan.spec))
        times.append(time.process_time() - start)
    return float(np.median(times[WARM:]))


if __name__ == "__main__":
    main()
