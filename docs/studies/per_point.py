"""Which points move, without labels: `python docs/studies/per_point.py [WORK]` prints the figures of docs/ground-truth.md.

Simulated drives are given as points and poses only, and `carlasc label --from motion` says which points move: those with a velocity above
0.5 m/s. The truth is the flow of the recording. The IoU is over all points of every fifth scan. The worlds are the town and the street of
`movers.py`, and the street with rails, fences and hedges of `railed.py`. WORK keeps the drives; the default is a temporary folder.

    --size tiny     one drive of one world
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from actors import OBSERVE, Bare
from movers_drives import Recorded, record

from carlasc.groundtruth.from_scans.actor_voxels import with_numbers
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.motion_pass import find_actors
from carlasc.groundtruth.labelling_motion import points_of_actors

SEEDS = {"town": range(61, 66), "street": range(261, 266), "railed": range(361, 366)}
MOVES_M_S, EVERY = 0.5, 5


def count(drive: Recorded) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Return how many points move in both, in the recording, and in what was found."""
    feed = ScanFeed(Bare(drive.sequence), OBSERVE)
    actors, found = with_numbers(find_actors(feed), feed), np.zeros(3, np.int64)
    for frame in drive.sequence.frames("points").tolist()[::EVERY]:
        moves = np.linalg.norm(drive.sequence.read("flow", frame), axis=1) > MOVES_M_S
        seen = np.linalg.norm(points_of_actors(feed, actors, frame)[1], axis=1) > MOVES_M_S
        found += (np.count_nonzero(moves & seen), np.count_nonzero(moves), np.count_nonzero(seen))
    return found


def main() -> None:
    """Print a row for each world."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", nargs="?", type=Path)
    parser.add_argument("--size", choices=("tiny", "whole"), default="whole")
    for kind, seeds in SEEDS.items():
        parser.add_argument(f"--{kind}", nargs="*", type=int, default=seeds)
    given = parser.parse_args()
    print("| world | IoU of moving points | precision | recall |\n|---|---:|---:|---:|")
    with tempfile.TemporaryDirectory() as temporary:
        for kind in list(SEEDS)[: 1 if given.size == "tiny" else None]:
            total = np.zeros(3, np.int64)
            for seed in list(getattr(given, kind))[: 1 if given.size == "tiny" else None]:
                (drive,) = record(kind, seed, [32], given.work or Path(temporary))
                total += count(drive)
                both, true, found = total
                row = (both / (true + found - both), both / max(found, 1), both / max(true, 1))
                print(f"| {kind}, to {seed} | {' | '.join(f'{value:.3f}' for value in row)} |", flush=True)


if __name__ == "__main__":
    main()
