"""Which points move, without labels: `python docs/studies/per_point.py [WORK]` prints the figures
of docs/ground-truth.md.

Simulated drives are given as points and poses only, and `carlasc label --from motion` says which
points move: those with a velocity above 0.5 m/s. The truth is the flow of the recording. The IoU is
over all points of every fifth scan. The worlds are the town and the street of `movers.py`, and the
street with rails, fences and hedges of `railed.py`. WORK keeps the drives; the default is a
temporary folder.
"""

from __future__ import annotations

import numpy as np
import study
from actors import OBSERVE
from movers_drives import SEEDS, Recorded, record
from movers_rows import BARE, Only

from carlasc.groundtruth.from_scans.actor_voxels import with_numbers
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.motion_pass import find_actors
from carlasc.relabelling.from_motion import points_of_actors

MOVES_M_S, EVERY = 0.5, 5


def count(drive: Recorded) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Return how many points move in both, in the recording, and in what was found."""
    feed = ScanFeed(Only(drive.sequence, BARE), OBSERVE)
    actors, found = with_numbers(find_actors(feed), feed), np.zeros(3, np.int64)
    for frame in drive.sequence.frames("points").tolist()[::EVERY]:
        moves = np.linalg.norm(drive.sequence.read("flow", frame), axis=1) > MOVES_M_S
        seen = np.linalg.norm(points_of_actors(feed, actors, frame)[1], axis=1) > MOVES_M_S
        found += (np.count_nonzero(moves & seen), np.count_nonzero(moves), np.count_nonzero(seen))
    return found


def main() -> None:
    """Print a row for each world, with intervals over its drives."""
    with study.begin(study.options(__doc__, SEEDS)) as given:
        rows: dict[str, list[tuple[float, ...]]] = {}
        for kind, seed in study.drives(given, SEEDS):
            (drive,) = record(kind, seed, [32], given.work)
            both, true, found = count(drive)
            scores = (
                both / (true + found - both),
                both / np.maximum(found, 1),
                both / np.maximum(true, 1),
            )
            rows.setdefault(kind, []).append(scores)
            print(kind, seed, *(f"{value:.3f}" for value in scores), flush=True)
    print(
        "\n| world | drives | IoU of moving points | precision | recall "
        "|\n|---|---:|---:|---:|---:|"
    )
    for kind, drives in rows.items():
        print(
            f"| {kind} | {len(drives)} | "
            f"{' | '.join(study.interval(values) for values in np.array(drives).T)} |"
        )


if __name__ == "__main__":
    main()
