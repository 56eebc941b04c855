"""What refining poses does on a real drive, for `poses.py`: KITTI tracking 0000 with poses by
KISS-ICP, and with errors added to them.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from poses_motions import show, typical_errors
from real_drive import find_poses, read_scans, write_drive
from study import is_tiny

import carlasc
from carlasc import FromScans, GridSpec, Run
from carlasc.groundtruth.from_scans.feed import ScanFeed
from carlasc.groundtruth.from_scans.motion_pass import refine_sequence
from carlasc.inspection import HeldOutScores, holdout
from carlasc.motion.refinement import RefinedPoses
from carlasc.testing import wrong_poses

GRIDS = {"0.4 m": GridSpec.published(), "0.2 m": GridSpec.published().with_resolution(0.2)}
OBSERVE = FromScans(window=(-30, 30))
EVERY, FRAMES = 10, (50, 75)  # three scans, with whole windows
SECOND = 10  # scans
COLUMNS = (
    "rays through anything before their return",
    "through something other than ground",
    "returns in free voxels",
)


def print_tables(archive: Path, work: Path, added: Mapping[str, Mapping[str, float]]) -> None:
    """Print the table of held-out rays, and how well the refined poses agree.

    Args:
        archive: the folder of the unpacked archive.
        work: where the drives are written.
        added: the errors that are added to the poses of KISS-ICP, by their names.
    """
    odometry = find_poses(read_scans(archive))
    rows, notes = [], []
    without_errors: RefinedPoses | None = None
    for number, (name, errors) in enumerate({"KISS-ICP": {}, **added}.items()):
        folder = work / "real" / str(number)
        poses = wrong_poses(odometry, **errors, seed=0) if errors else odometry
        write_drive(archive, folder, labelled=False, poses=poses)
        label = f"KISS-ICP and {name}" if errors else name
        rows += _rows(folder, label)
        (sequence,) = carlasc.open(folder).sequences().values()
        refined = refine_sequence(ScanFeed(sequence, OBSERVE), run=Run(workers=1))
        without_errors = without_errors or refined
        before, after = (
            100 * float(np.nanmean(values)) for values in (refined.before_m, refined.after_m)
        )
        others = show(typical_errors(without_errors.poses, refined.poses, SECOND), 2)
        notes.append(
            f"{label}: scans disagree by {before:.1f} cm, now {after:.1f}; refined motions of 1 s "
            f"are {others} from those of KISS-ICP"
        )
    print(f"\n| poses | {' | '.join(COLUMNS)} | median error |\n|---|---:|---:|---:|---:|")
    print("\n".join([*rows, "", *notes]))


def _rows(folder: Path, name: str) -> list[str]:
    """Return the row of the given poses and that of the refined ones; a cell has the figure of each
    grid.
    """
    given, refined = [], []
    every, frames = (5, None) if is_tiny() else (EVERY, FRAMES)
    for spec in list(GRIDS.values())[: 1 if is_tiny() else None]:
        found = holdout(
            folder, spec, observe=OBSERVE, every=every, frames=frames, run=Run(workers=1)
        )
        (last,) = found.sequences.values()
        (first,) = found.given_poses.values() or [last]
        given.append(_figures(first))
        refined.append(_figures(last))
    cells = [
        [" / ".join(column) for column in zip(*grids, strict=True)] for grids in (given, refined)
    ]
    return [
        f"| {row} | {' | '.join(own)} |"
        for row, own in zip((name, f"{name}, refined"), cells, strict=True)
    ]


def _figures(scores: HeldOutScores) -> list[str]:
    """Return the figures of all rays as texts."""
    rays = scores.all
    return [
        *(f"{share or 0:.1%}" for share in (rays.passed, rays.passed_object)),
        f"{rays.free or 0:.2%}",
        f"{rays.error_median_m} m",
    ]
