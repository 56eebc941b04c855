"""What merging scans makes of wrong labels: `python docs/studies/wrong_labels.py` prints the table of docs/studies/wrong-labels.md.

Drives of 61 frames through the simulated town, each by one LiDAR with 64 channels. Some labels are made wrong, the middle frame is made from its own scan and from
all 61, and each voxel is compared with the one that the same scans make with the labels of the simulator. The share of right points is counted over all scans.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

import carlasc
from carlasc.core.geometry import transform_points
from carlasc.testing import wrong_labels

SEEDS, FIRST, FRAMES, MIDDLE = (0, 1, 2), 100, 61, 30  # a drive starts at rest
SPEC = carlasc.GridSpec.published("cartesian").with_resolution(0.2)
CASES = {
    "20 % of the points, at random": (0.2, None, False),
    "20 %, in clumps of 1 m, others in each scan": (0.2, 1.0, False),
    "20 %, in clumps of 1 m, the same in all scans": (0.2, 1.0, True),
    "40 % of the points, at random": (0.4, None, False),
    "40 %, in clumps of 1 m, others in each scan": (0.4, 1.0, False),
}


def write_predictions(drive: Path, out: Path, share: float, clump_m: float | None, *, fixed: bool) -> float:
    """Write wrong labels for all scans of a drive, and return the share of the labelled points that are right."""
    (sequence,) = carlasc.open(drive).sequences().values()
    out.mkdir()
    right = total = 0
    for frame in sequence.frames("points").tolist():
        scan = sequence.scan(frame, ["labels"])
        points = transform_points(sequence.read_pose(frame), scan.points)
        made = wrong_labels(scan.labels, points, share, clump_m=clump_m, seed=0 if fixed else frame)
        np.save(out / f"{frame:06d}.npy", made)
        right += np.count_nonzero((made == scan.labels) & (scan.labels > 0))
        total += np.count_nonzero(scan.labels)
    return right / total


def merged(drive: Path, out: Path, window: int) -> carlasc.Grid:
    """Return the grid of the middle frame, made from the scans of a window."""
    observe = carlasc.FromScans(window=(-window, window))
    carlasc.regrid(
        drive, SPEC, out, observe=observe, frames=(MIDDLE, MIDDLE + 1), name="made", run=carlasc.Run(workers=1)
    )
    (sequence,) = carlasc.open(out).sequences().values()
    return sequence.grid("made", MIDDLE)


def main(work: Path) -> None:
    """Print the table."""
    rows: dict[str, list[list[float]]] = {name: [] for name in CASES}
    for seed in SEEDS:
        drive = work / f"Drive{seed}"
        capture = carlasc.captures.SimulatedCapture(count=FRAMES, first_frame=FIRST, seed=seed, sensors=1, bev=False)
        carlasc.regrid(capture, SPEC, drive)
        truth = {window: merged(drive, work / f"truth{seed}-{window}", window) for window in (0, 30)}
        for number, (name, (share, clump_m, fixed)) in enumerate(CASES.items()):
            place = work / f"{seed}-{number}"
            row = [write_predictions(drive, Path(f"{place}-files"), share, clump_m, fixed=fixed)]
            carlasc.label(drive, Path(f"{place}-labelled"), Path(f"{place}-files"), by=name)
            for window, whole in truth.items():
                made = merged(Path(f"{place}-labelled"), Path(f"{place}-{window}"), window)
                both = (whole.labels > 0) & (made.labels > 0)
                row.append(np.count_nonzero(made.labels[both] == whole.labels[both]) / np.count_nonzero(both))
            rows[name].append(row)
            print(seed, name, [f"{value:.3f}" for value in row], flush=True)
    print("\n| wrong labels | right points | right voxels, one scan | right voxels, 61 scans |\n|---|---|---|---|")
    for name, found in rows.items():
        print(f"| {name} | {' | '.join(f'{value:.1%}' for value in np.mean(found, axis=0))} |")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as temporary:
        main(Path(temporary))
