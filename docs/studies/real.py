"""Do grids of a real drive hold ghost trails, and which of its actors are found?

`python docs/studies/real.py --archive FOLDER` prints the tables.

FOLDER is an unpacked part of KITTI's tracking benchmark: frames 20 to 104 of sequence 0000, with
boxes in the camera's view and without poses. Frames with whole windows (every fifth of 50 to 74;
`--every 1` takes all) are made from scans of a window of 30 frames, with labels by the boxes and
without any label, and measured by `real_measures.py`. Nothing is left on the disk.

Without labels, the actors that free space shows are compared with the boxes too: recall is the
share of the points in boxes of moving actors that move by `carlasc label --from motion`, false
motion the share of those in boxes of parked ones. People without boxes walk there, so precision
cannot be measured. At last, maps are made: see `real_maps.py`.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import reduce
from operator import add
from pathlib import Path

import numpy as np
import study
from numpy.typing import NDArray
from real_drive import find_poses, label_points, read_boxes, read_scans, write_drive
from real_maps import rows
from real_measures import GROW_M, Judge, Measures, Share

import carlasc
from carlasc import GridSpec, Run
from carlasc.core import transform_points
from carlasc.core.frames import FrameRange
from carlasc.groundtruth import FromScans, Voting
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.frame import merge_frame
from carlasc.groundtruth.from_scans.merging import BodyRegions
from carlasc.groundtruth.from_scans.motion_pass import find_actors
from carlasc.groundtruth.inputs import GridPlan
from carlasc.motion import BODY_MARGIN_M, MotionOptions
from carlasc.storage import Sequence

WINDOW = (-30, 30)
FRAMES = range(50, 75)
MOVES_M_S = 0.5
SPEC = GridSpec.published().with_resolution(0.2)
RULES = {  # name -> whether labels and boxes are given, what observes
    "tube": (True, FromScans(window=WINDOW, dynamic="tube")),
    "align, boxes": (True, FromScans(window=WINDOW, motion=MotionOptions("boxes"), own_path=False)),
    "align, boxes and free space": (True, FromScans(window=WINDOW, own_path=False)),
    "tube, unlabelled": (False, FromScans(window=WINDOW, dynamic="tube")),
    "align, free space, unlabelled": (False, FromScans(window=WINDOW, own_path=False)),
}


def main() -> None:
    """Write the drive twice, make the grids of each rule, and print what is wrong in them; then,
    what is found of actors.
    """
    parser = study.options(__doc__)
    parser.add_argument("--archive", type=Path, required=True)
    parser.add_argument("--every", type=int, default=5)
    with study.begin(parser) as given:
        every = given.every
        frames = [30] if study.is_tiny() else list(FRAMES)[::every]
        drives = {
            labelled: given.work / ("labels" if labelled else "geometry")
            for labelled in (True, False)
        }
        poses = find_poses(read_scans(given.archive))
        for labelled, folder in drives.items():
            write_drive(given.archive, folder, labelled=labelled, poses=poses)
        (drive,) = carlasc.open(drives[True]).sequences().values()
        judge, clock = Judge.of(drive, WINDOW), study.Clock()
        print(
            f"{len(frames)} frames from {frames[0]}; {len(judge.movers)} labelled movers; in "
            f"percent"
        )
        print(f"| rule | {' | '.join(vars(Measures()))} | s per frame |")
        print("|---" * (len(vars(Measures())) + 2) + "|")
        for name, (labelled, observe) in list(RULES.items())[-1 if study.is_tiny() else 0 :]:
            began = time.perf_counter()
            measures = measure_rule(judge, drives[labelled], name, frames, every, observe)
            cells = [f"{share.percent:.2f}" for share in vars(measures).values()]
            elapsed_s = (time.perf_counter() - began) / len(frames)
            print(f"| {name} | {' | '.join(cells)} | {elapsed_s:.1f} |", flush=True)
            clock(name)
        carlasc.label_motion(drives[False], given.work / "moving", run=Run(workers=1))
        (found,) = carlasc.open(given.work / "moving").sequences().values()
        print("\n| labelled object | points | of them moving |\n|---|---:|---:|")
        for track, (moving, points) in found_of(given.archive, found).items():
            print(f"| track {track} | {points} | {moving / points:.1%} |")
        print("\n| labelled object | BEV IoU | at least 0.5 | voxels | outside of its box |")
        print("|---|---:|---:|---:|---:|")
        for line in bodies_of(judge, drives[False], frames):
            print(line)
        print()
        for line in rows(read_scans(given.archive), judge, given.work):
            print(line, flush=True)


def bodies_of(judge: Judge, folder: Path, frames: list[int]) -> Iterator[str]:
    """Yield a row for each labelled mover: how well the body that is found without labels overlaps
    its box, seen from above, and how many of its voxels are farther than 0.3 m outside of the box.
    """
    (drive,) = carlasc.open(folder).sequences().values()
    feed = ScanFeed(drive, FromScans(window=WINDOW, own_path=False))
    actors = find_actors(feed)
    plan = GridPlan(SPEC, "bodies", feed.options, Voting(), FrameRange())
    windows = {frame: feed.reaching(frame, SPEC) for frame in frames}
    grids = {
        frame: merge_frame(plan, feed, actors, frame, near).grid for frame, near in windows.items()
    }
    centers = SPEC.centers().reshape(-1, 3)
    for body in judge.movers:
        overlaps, own, outside = [], 0, 0
        for frame, pose in body.poses.items():
            present = {
                number: found
                for number, track in actors.tracks.items()
                if (found := track.pose(frame)) is not None
            }
            number = min(
                present, key=lambda n: float(np.linalg.norm((present[n] - pose)[:2, 3])), default=-1
            )
            if number < 0:
                overlaps.append(0.0)
                continue
            track = actors.tracks[number]
            sizes = track.size - 2 * BODY_MARGIN_M, body.upper - body.lower
            overlaps.append(study.overlap_above(present[number], pose, *sizes))
            if frame not in grids:
                continue
            now = feed.instant(frame)
            regions = BodyRegions.at(feed.merger(actors, frame), now, windows[frame], SPEC)
            region = next((r for r, actor in regions.actors.items() if actor == number), -1)
            chosen = (regions.of_voxel == region) & (grids[frame].labels.reshape(-1) > 0)
            places = transform_points(now.world_T_grid, centers[chosen])
            own += len(places)
            outside += int((~body.contains([frame], places, GROW_M)).sum())
        good = np.mean(np.array(overlaps) >= 0.5)
        share = Share(outside, own).percent
        yield f"| {body.name} | {np.median(overlaps):.2f} | {good:.0%} | {own} | {share:.1f}% |"


def found_of(archive: Path, found: Sequence) -> dict[int, NDArray[np.int64]]:
    """Return how many points are in the boxes of each track, those that move by their velocity
    first.
    """
    counts: dict[int, NDArray[np.int64]] = {}
    boxes = read_boxes(archive)
    for frame, scan in read_scans(archive).items():
        moves = np.linalg.norm(found.read("flow", frame), axis=1) > MOVES_M_S
        _, tracks = label_points(scan[:, :3], boxes[frame])
        for track in np.unique(tracks[tracks > 0]).tolist():
            own = moves[tracks == track]
            counts[track] = counts.get(track, np.zeros(2, np.int64)) + (own.sum(), len(own))
    return counts


def measure_rule(
    judge: Judge, folder: Path, name: str, frames: list[int], every: int, observe: FromScans
) -> Measures:
    """Make the grids of a rule in a drive's folder, and return their measures, added up."""
    grid = "".join(letter if letter.isalnum() else "_" for letter in name)
    ranges = (
        [(frames[0], frames[-1] + 1)] if every == 1 else [(frame, frame + 1) for frame in frames]
    )
    for chosen in ranges:
        result = carlasc.regrid(
            folder, SPEC, name=grid, frames=chosen, observe=observe, run=Run(workers=1)
        )
        if result.failures:
            raise SystemExit("\n".join(map(str, result.failures)))
    (sequence,) = carlasc.open(folder).sequences().values()
    return reduce(add, [judge.measure(sequence.grid(grid, frame), frame) for frame in frames])


if __name__ == "__main__":
    main()
