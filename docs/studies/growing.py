"""A growing drive in real time: `python docs/studies/growing.py` prints how far
`convert scans --follow` is behind a sensor, of how many scans grids are made, and the memory.

A simulated drive goes there and back, so that it is as long as is asked for.
"""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

import numpy as np
import psutil
import study
from carlasc_recorders import TownDrive
from carlasc_recorders.town.drive import scan_snapshot

import carlasc
from carlasc.captures import Lidar
from carlasc.converting import follow
from carlasc.groundtruth import FromScans

SEED, CHANNELS, THERE = 61, 32, 151  # the drive, and its scans until it goes back
ROWS = 6  # of the table


def record(folder: Path, rays: int) -> list[Path]:
    """Return the files of the scans of a drive, which are made unless they exist."""
    lidar = Lidar(channels=CHANNELS, points=rays)
    drive, noise = TownDrive(SEED, "heavy", lidar), np.random.default_rng(SEED)
    folder.mkdir(exist_ok=True)
    paths = [folder / f"{frame}.npy" for frame in range(20 if study.is_tiny() else THERE)]
    for frame, path in enumerate(paths):
        if not path.exists():
            pose = drive.sensor_poses(frame, 1)[0]
            points = scan_snapshot(drive.snapshot(frame), pose, lidar, noise).scan.points
            names = np.dtype([(name, "<f4") for name in ("x", "y", "z")])
            np.save(path, np.ascontiguousarray(points, "<f4").view(names)[:, 0])
    return paths


class Sensor(threading.Thread):
    """Writes scans at a rate, and notes when; it notes the memory, too."""

    def __init__(self, paths: list[Path], folder: Path, scans: int, rate_hz: float) -> None:
        super().__init__(daemon=True)
        self.folder, self.period_s = folder, 1 / rate_hz
        back = [*paths, *paths[-2:0:-1]]
        self.paths = [back[scan % len(back)] for scan in range(scans)]
        self.seconds, self.memory = list[float](), list[tuple[int, ...]]()

    def run(self) -> None:
        """Write the scans."""
        start, process = time.monotonic(), psutil.Process()
        for scan, path in enumerate(self.paths):
            time.sleep(max(start + scan * self.period_s - time.monotonic(), 0.0))
            os.link(path, self.folder / f"{scan:06d}.npy")
            os.utime(path)
            self.seconds.append(time.time())
            parts = process, *process.children(recursive=True)
            self.memory.append(tuple(part.memory_info().rss >> 20 for part in parts))


def main() -> None:
    """Feed the drive, and print the tables."""
    parser = study.options(__doc__)
    parser.add_argument("--scans", type=int, default=3000, help="of the whole drive")
    parser.add_argument("--rays", type=int, default=60_000, help="of a scan")
    parser.add_argument("--hz", type=float, default=10.0, help="scans per second")
    with study.begin(parser) as given:
        paths = record(given.work / f"recorded{given.rays}", given.rays)
        place = given.work / f"{given.rays}-{os.getpid()}"
        (place / "scans").mkdir(parents=True)
        count = 40 if study.is_tiny() else given.scans
        sensor = Sensor(paths, place / "scans", count, given.hz)
        sensor.start()
        follow("scans", place / "scans", place / "out", idle_s=10.0, say=print)
        sensor.join()
        (sequence,) = carlasc.open(place / "out").values()
        print(f"\nload {os.getloadavg()[1]:.1f} on {os.cpu_count()} cores\n")
        print("| what | made | of every N-th scan | delay, mean | largest |\n|---|--:|--:|--:|--:|")
        for field, after in {
            "points": 0,
            **{f"{grid}/labels": FromScans().window[1] for grid in sequence.grids},
        }.items():
            made = [int(frame) for frame in sequence.frames(field)]
            files = sequence.files_of(field, made)
            times = [(place / "out" / file).stat().st_mtime for file in files]
            behind = [t - sensor.seconds[n + after] for t, n in zip(times, made, strict=True)]
            every = (made[-1] - made[0]) / max(len(made) - 1, 1)
            print(
                f"| {field} | {len(made)} | {every:.2f} | {np.mean(behind):.1f} s | "
                f"{max(behind):.1f} s |"
            )
        print("\n| scans | MiB of each process |\n|---:|---|")
        for scan in np.linspace(0, count - 1, ROWS + 1).astype(int)[1:].tolist():
            print(f"| {scan + 1} | {', '.join(map(str, sensor.memory[scan]))} |")


if __name__ == "__main__":
    main()
