"""Do grids of a real drive hold traces? `python docs/studies/real.py ARCHIVE [EVERY]` prints the table.

ARCHIVE is the folder of an unpacked part of KITTI's tracking benchmark: frames 20 to 104 of sequence 0000, with boxes in the camera's
view and without poses. The frames with whole windows (50 to 74, or every EVERY-th of them) are made from scans of a window of 30
frames, with labels by the boxes and without any label, and measured by `real_measures.py`. Nothing is left on the disk.
"""

from __future__ import annotations

import sys
import tempfile
import time
from functools import reduce
from operator import add
from pathlib import Path

from clock import Clock
from real_drive import find_poses, read_scans, write_drive
from real_measures import Judge, Measures

import carlasc
from carlasc import GridSpec, Run
from carlasc.groundtruth import FromScans
from carlasc.motion import MotionOptions

WINDOW = (-30, 30)
FRAMES = range(50, 75)
SPEC = GridSpec.published().with_resolution(0.2)
RULES = {  # name -> whether labels and boxes are given, what observes
    "tube": (True, FromScans(window=WINDOW, dynamic="tube")),
    "align, boxes": (True, FromScans(window=WINDOW, motion=MotionOptions("boxes"), own_path=False)),
    "align, boxes, and evidence": (True, FromScans(window=WINDOW, own_path=False)),
    "tube, no labels": (False, FromScans(window=WINDOW, dynamic="tube")),
    "align, no labels": (False, FromScans(window=WINDOW, own_path=False)),
}


def main(archive: Path, every: int) -> None:
    """Write the drive twice, make the grids of each rule, and print what is wrong in them."""
    frames = list(FRAMES)[::every]
    with tempfile.TemporaryDirectory() as temporary:
        drives = {labelled: Path(temporary) / ("labels" if labelled else "geometry") for labelled in (True, False)}
        poses = find_poses(read_scans(archive))
        for labelled, folder in drives.items():
            write_drive(archive, folder, labelled=labelled, poses=poses)
        (drive,) = carlasc.open(drives[True]).sequences().values()
        judge, clock = Judge.of(drive, WINDOW), Clock()
        print(
            f"frames {frames[0]} to {frames[-1]}, {len(frames)} of them; {len(judge.movers)} labelled movers; in percent"
        )
        print(f"| rule | {' | '.join(vars(Measures()))} | s per frame |")
        print("|---" * (len(vars(Measures())) + 2) + "|")
        for name, (labelled, observe) in RULES.items():
            began = time.perf_counter()
            measures = measure_rule(judge, drives[labelled], name, frames, every, observe)
            cells = [f"{share.percent:.2f}" for share in vars(measures).values()]
            elapsed_s = (time.perf_counter() - began) / len(frames)
            print(f"| {name} | {' | '.join(cells)} | {elapsed_s:.1f} |", flush=True)
            clock(name)


def measure_rule(judge: Judge, folder: Path, name: str, frames: list[int], every: int, observe: FromScans) -> Measures:
    """Make the grids of a rule in a drive's folder, and return their measures, added up."""
    grid = "".join(letter if letter.isalnum() else "_" for letter in name)
    ranges = [(frames[0], frames[-1] + 1)] if every == 1 else [(frame, frame + 1) for frame in frames]
    for chosen in ranges:
        result = carlasc.regrid(folder, SPEC, name=grid, frames=chosen, observe=observe, run=Run(workers=1))
        if result.failures:
            raise SystemExit("\n".join(map(str, result.failures)))
    (sequence,) = carlasc.open(folder).sequences().values()
    return reduce(add, [judge.measure(sequence.grid(grid, frame), frame) for frame in frames])


if __name__ == "__main__":
    if not 2 <= len(sys.argv) <= 3:
        raise SystemExit(__doc__)
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) == 3 else 1)
