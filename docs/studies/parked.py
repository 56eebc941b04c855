"""Are vehicles that park in one pass of a street, and are gone in another, in neither map? `python
docs/studies/parked.py [WORK]` prints the table of docs/commands/map.md.

A vehicle drives through the simulated town, and comes back to the street where it began; every
other parked vehicle has left until then. Only these two passes are mapped, without labels.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import study
from returning import ReturningDrive
from scipy.spatial import cKDTree

import carlasc
from carlasc import Run
from carlasc.captures import Lidar
from carlasc.core.geometry import relative_to, transform_points
from carlasc.motion import PoseOptions
from carlasc.storage import FolderSink, Metadata, layout
from carlasc.storage.layout import FRAME_PERIOD_S

SEEDS = {"block": (61, 62, 63)}
CHANNELS, RAYS = 32, 800  # per channel
FRAMES = 110  # of each pass
NEAR_M, RANGE_M = 0.05, 20.0


def measure(seed: int, folder: Path) -> list[float]:
    """Return the number of parked vehicles that left, that are seen, and the shares of their
    points, of those of parked ones that stay, and of other static points that are in the map.
    """
    frames = len(study.few(range(FRAMES), 6))
    drive = ReturningDrive(seed, "block", Lidar(CHANNELS, CHANNELS * RAYS, 50.0, 2.0, -25.0))
    chosen = [*range(frames), *range(drive.frames - frames, drive.frames)]
    parked = sorted(drive.leave_from(drive.frames // 2))
    poses = np.stack([drive.sensor_poses(frame, 1)[0] for frame in range(drive.frames)])
    poses = relative_to(poses[0], poses)
    scans = {frame: drive.record(frame).scan for frame in chosen}
    times = np.array([frame * FRAME_PERIOD_S for frame in range(drive.frames)])
    with FolderSink(folder).sequence("cartesian") as writer:
        writer.write_document(layout.POSES, layout.encode_poses(poses))
        writer.write_document(layout.TIMES, layout.encode_times(times))
        writer.write_document(layout.METADATA, Metadata("right", source="town").to_json())
        for frame, scan in scans.items():
            rows = np.column_stack([scan.points[:, :3], np.zeros(len(scan.points))])
            writer.write("points", frame, rows.astype(np.float32))
    out = folder / "map.npz"
    given = PoseOptions("file", "never")
    result = carlasc.map(folder, out, poses=given, overwrite=True, run=Run(workers=1))
    print(f"seed {seed}: {result.parked} left out", flush=True)
    tree = cKDTree(np.load(out)["points"].astype(np.float64))
    seen, left = set[int](), {kind: [0, 0] for kind in ("gone", "stays", "static")}
    for frame, scan in scans.items():
        away = np.linalg.norm(scan.points[:, :2], axis=1)
        own = scan.points[away < RANGE_M, :3].astype(np.float64)
        assert scan.instances is not None
        number = scan.instances[away < RANGE_M]
        kept = np.isfinite(
            tree.query(transform_points(poses[frame], own), distance_upper_bound=NEAR_M)[0]
        )
        is_gone = np.isin(number, parked[::2])
        seen |= set(np.unique(number[is_gone]).tolist())
        kinds = {"gone": is_gone, "stays": np.isin(number, parked[1::2]), "static": number == 0}
        for kind, rows in kinds.items():
            left[kind][0] += int(kept[rows].sum())
            left[kind][1] += int(rows.sum())
    return [len(seen), *(100 * part / max(1, whole) for part, whole in left.values())]


def main() -> None:
    """Print the table."""
    with study.begin(study.options(__doc__, SEEDS)) as given:
        print("| drive | left | of their points in the map | of those that stay | structure |")
        print("|---|---:|---:|---:|---:|")
        for seed in study.few(given.block):
            number, gone, stays, static = measure(seed, given.work / f"parked_{seed}")
            print(f"| {seed} | {number:.0f} | {gone:.1f}% | {stays:.1f}% | {static:.2f}% |")


if __name__ == "__main__":
    main()
