"""What maps of long drives need: `python docs/studies/long_maps.py` prints a row for each length of
a drive: memory, processor time and disk of `carlasc map`.

The drive goes straight on through a street of boxes: houses, poles, parked cars, and cars that come
towards the sensor or overtake it. There is a scan of `CHANNELS` times `COLUMNS` rays per metre.
Scans are bare files: `carlasc map` converts them, estimates poses, refines them, finds what moves
and writes the map, in one process. Memory is the greatest resident set of this process. Disk is
what the map, the cells beside it and the hidden folder take together, without the scans.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

import numpy as np
import study
from numpy.typing import NDArray

SCANS = (500, 10_000)
CHANNELS, COLUMNS = 16, 180
_HEIGHT_M, _FAR_M, _NOISE_M = 1.8, 60.0, 0.02
_HOUSE_M, _POLE_M, _PARKED_M, _TRAFFIC_M = 14.0, 23.0, 17.0, 60.0
_LOOK_S = 2.0


def _rays() -> NDArray[np.float64]:
    """Return (N, 3) directions."""
    up = np.radians(np.linspace(-15.0, 15.0, CHANNELS))[:, None]
    turn = np.arange(COLUMNS) * (2 * np.pi / COLUMNS)
    flat = np.cos(up)
    rays = np.stack([flat * np.cos(turn), flat * np.sin(turn), np.sin(up) + 0 * turn], axis=-1)
    return np.asfortranarray(rays.reshape(-1, 3))


def boxes(at: float, seconds: float) -> NDArray[np.float64]:
    """Return (B, 6) lower and upper corners of what is around a place, metres."""
    found = list[tuple[float, ...]]()
    for kind, step in enumerate((_HOUSE_M, _POLE_M, _PARKED_M)):
        for number in range(int((at - _FAR_M) // step), int((at + _FAR_M) // step) + 1):
            for side in (-1.0, 1.0):
                seed = (kind, number + 100, int(side) + 1)
                one, two, three = np.random.default_rng(seed).uniform(size=3).tolist()
                x, y = (number + 0.3 * one) * step, side * (5.5, 4.5, 3.4)[kind]
                away = side * (8.0, 0.2, 1.7)[kind]
                y += side * (3.0 * two if kind == 0 else 0.2 * two)
                long = (_HOUSE_M * (0.4 + 0.25 * three), 0.2, 3.8 + three)[kind]
                high = (4.0 + 6.0 * two, 6.0, 1.5)[kind]
                if kind < 2 or three < 0.5:
                    found.append((x, min(y, y + away), 0.0, x + long, max(y, y + away), high))
    for speed, y in ((-10.0, 2.2), (13.0, -2.2)):
        first = seconds * speed
        for number in range(
            int((at - _FAR_M - first) // _TRAFFIC_M), int((at + _FAR_M - first) // _TRAFFIC_M) + 1
        ):
            x = first + number * _TRAFFIC_M + 30.0
            found.append((x, y - 0.9, 0.2, x + 4.4, y + 0.9, 1.6))
    return np.array(found)


def scan_of(frame: int, rays: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the (N, 3) points of a scan, metres, sensor frame."""
    origin = np.array([float(frame), -0.5, _HEIGHT_M])
    with np.errstate(divide="ignore", invalid="ignore"):
        to_ground = np.where(rays[:, 2] < 0, -_HEIGHT_M / rays[:, 2], np.inf)
        hits = np.full(len(rays), np.inf)
        for lower, upper in (boxes(origin[0], 0.1 * frame).reshape(-1, 2, 3) - origin).tolist():
            near, far = np.zeros(len(rays)), np.full(len(rays), np.inf)
            for axis in range(3):
                one, other = lower[axis] / rays[:, axis], upper[axis] / rays[:, axis]
                near = np.maximum(near, np.minimum(one, other))
                far = np.minimum(far, np.maximum(one, other))
            hits = np.where((near <= far) & (near > 0), np.minimum(hits, near), hits)
    distance = np.minimum(hits, to_ground)
    distance += np.random.default_rng(frame).normal(0.0, _NOISE_M, len(distance))
    seen = distance < _FAR_M
    return np.asarray(rays[seen] * distance[seen, None], np.float32)


def write(scans: int, folder: Path) -> None:
    """Write the first scans of the drive, unless they exist."""
    folder.mkdir(exist_ok=True)
    rays = _rays()
    for frame in range(scans):
        path = folder / f"{frame:06}.npy"
        if not path.exists():
            np.save(path, scan_of(frame, rays))


def size_of(folder: Path) -> int:
    """Return the bytes of the files in a folder, some of which may vanish meanwhile."""
    total, folders = 0, [folder]
    while folders:
        for path in folders.pop().iterdir():
            with suppress(FileNotFoundError):
                total += 0 if path.is_dir() else path.stat().st_size
            folders += [path] if path.is_dir() else []
    return total


def make(scans: Path, frames: int, folder: Path) -> tuple[float, float, float]:
    """Make a map; return the MB of memory, the seconds of processor time, and the MB of disk."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    call = [sys.executable, "-m", "carlasc", "map", str(scans), str(folder / "map.ply")]
    call += ["--converter", "scans", "--frames", f":{frames}", "--workers", "1"]
    ended, most = threading.Event(), [0]

    def look() -> None:
        while not ended.wait(_LOOK_S):
            most.append(size_of(folder))

    watcher = threading.Thread(target=look)
    watcher.start()
    try:
        process = subprocess.Popen(call, stdout=sys.stderr)
        _, status, used = os.wait4(process.pid, 0)
    finally:
        ended.set()
        watcher.join()
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, call)
    disk = max(*most, size_of(folder))
    return used.ru_maxrss / 1e3, used.ru_utime + used.ru_stime, disk / 1e6


def main() -> None:
    """Print the table."""
    parser = study.options(__doc__)
    parser.add_argument("--scans", nargs="+", type=int, default=[])
    with study.begin(parser) as given:
        counts = given.scans or ([12, 20] if study.is_tiny() else list(SCANS))
        write(max(counts), given.work / "scans")
        print("| scans | memory, MB | more per scan, kB | CPU per scan, s | disk, MB |")
        print("|---:|---:|---:|---:|---:|")
        before = None
        for frames in counts:
            memory, seconds, disk = make(given.work / "scans", frames, given.work / "map")
            more = ""
            if before is not None:
                more = f"{1e3 * (memory - before[1]) / (frames - before[0]):.1f}"
            before = frames, memory
            cells = f"{frames:,}", f"{memory:,.0f}", more, f"{seconds / frames:.3f}", f"{disk:,.0f}"
            print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
