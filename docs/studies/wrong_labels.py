"""What merging scans makes of wrong labels: `python docs/studies/wrong_labels.py` prints the table
of docs/studies/wrong-labels.md.

Drives of 61 frames through the simulated town, each by one LiDAR with 64 channels. Some labels are
made wrong, the middle frame is made from its own scan and from all 61, and each voxel is compared
with the one that the same scans make with the labels of the simulator. The share of right points is
counted over all scans.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import study
from carlasc_recorders import SimulatedCapture

import carlasc
from carlasc.captures import Lidar
from carlasc.core.geometry import transform_points
from carlasc.testing import wrong_labels

SEEDS, FIRST, FRAMES, MIDDLE = {"town": range(5)}, 100, 61, 30  # a drive starts at rest
SPEC = carlasc.GridSpec.published("cartesian").with_resolution(0.2)
CASES = {
    "20% of the points, at random": (0.2, None, False),
    "20%, in clumps of 1 m, others in each scan": (0.2, 1.0, False),
    "20%, in clumps of 1 m, the same in all scans": (0.2, 1.0, True),
    "40% of the points, at random": (0.4, None, False),
    "40%, in clumps of 1 m, others in each scan": (0.4, 1.0, False),
}


def write_predictions(
    drive: Path, out: Path, share: float, clump_m: float | None, *, fixed: bool
) -> float:
    """Write wrong labels for all scans of a drive, and return the share of the labelled points that
    are right.
    """
    (sequence,) = carlasc.open(drive).sequences().values()
    out.mkdir()
    right = total = 0
    for frame in sequence.frames("points").tolist():
        scan = sequence.scan(frame, ["labels"])
        points = transform_points(sequence.read_pose(frame), scan.points)
        labels = study.labels_of(scan)
        made = wrong_labels(labels, points, share, clump_m=clump_m, seed=0 if fixed else frame)
        np.save(out / f"{frame:06d}.npy", made)
        right += int(np.count_nonzero((made == labels) & (labels > 0)))
        total += int(np.count_nonzero(labels))
    return right / total


def merged(drive: Path, out: Path, window: int) -> carlasc.Grid:
    """Return the grid of the middle frame, made from the scans of a window."""
    observe = carlasc.FromScans(window=(-window, window))
    frame = 2 if study.is_tiny() else MIDDLE
    carlasc.regrid(
        drive,
        SPEC,
        out,
        observe=observe,
        frames=(frame, frame + 1),
        name="made",
        run=carlasc.Run(workers=1),
    )
    (sequence,) = carlasc.open(out).sequences().values()
    return sequence.grid("made", frame)


def main() -> None:
    """Print the table."""
    with study.begin(study.options(__doc__, SEEDS)) as given:
        found = compare(given.work, study.few(given.town))
    print(
        "\n| wrong labels | right points | right voxels, one scan | right voxels, 61 scans "
        "|\n|---|---|---|---|"
    )
    for name, drives in found.items():
        print(
            f"| {name} | "
            f"{' | '.join(study.interval(values, '.1%') for values in np.array(drives).T)} |"
        )


def compare(work: Path, seeds: list[int]) -> dict[str, list[list[float]]]:
    """Return the cells of each row, of each drive."""
    rows: dict[str, list[list[float]]] = {name: [] for name in CASES}
    for seed in seeds:
        drive = work / f"Drive{seed}"
        frames, lidar = (5, Lidar(points=5_000)) if study.is_tiny() else (FRAMES, Lidar())
        capture = SimulatedCapture(
            count=frames, first_frame=FIRST, seed=seed, sensors=1, bev=False, lidar=lidar
        )
        carlasc.regrid(capture, SPEC, drive, run=carlasc.Run(workers=1))
        truth = {
            window: merged(drive, work / f"truth{seed}-{window}", window) for window in (0, 30)
        }
        for number, (name, (share, clump_m, fixed)) in enumerate(CASES.items()):
            place = work / f"{seed}-{number}"
            row = [write_predictions(drive, Path(f"{place}-files"), share, clump_m, fixed=fixed)]
            carlasc.label(
                drive,
                Path(f"{place}-labelled"),
                Path(f"{place}-files"),
                by=name,
                run=carlasc.Run(workers=1),
            )
            for window, whole in truth.items():
                made = merged(Path(f"{place}-labelled"), Path(f"{place}-{window}"), window)
                both = (whole.labels > 0) & (made.labels > 0)
                row.append(
                    np.count_nonzero(made.labels[both] == whole.labels[both])
                    / np.count_nonzero(both)
                )
            rows[name].append(row)
            print(seed, name, [f"{value:.3f}" for value in row], flush=True)
    return rows


if __name__ == "__main__":
    main()
