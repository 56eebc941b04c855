"""Loading a sample from plain files, warm, in one process, against the plain NumPy loader.

`pytest tests/benchmarks/test_bench_dataset.py --benchmark-enable` measures scans of 125,000 points
on the published grid; without that every case runs once on small scans. `python
tests/benchmarks/test_bench_dataset.py` prints the table of docs/performance.md.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # for the table: one thread on either side

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the table: pytest has it already
from helpers.datasets.drives import write_drive
from helpers.references.plain_loader import PlainLoader
from helpers.scenes.lidar_frames import street_frame

from carlasc.dataset.samples import Dataset

pytestmark = pytest.mark.slow

FRAMES = 40


def write_street(folder: Path, full: bool) -> Path:
    """Write a drive of 40 frames, three LiDAR scans in turn, each with its own noise."""
    channels, columns = (64, 2048) if full else (8, 64)
    with np.errstate(invalid="ignore"):
        street = street_frame(3, channels, columns)
    rng = np.random.default_rng(0)
    scans = []
    for frame in range(FRAMES):
        points = street[frame % 3].points
        noisy = points + rng.uniform(-0.02, 0.02, points.shape).astype(np.float32)
        scans.append(np.column_stack([noisy, np.zeros(len(points), np.float32)]))
    return write_drive(folder, range(FRAMES), scans=scans)


@pytest.fixture(scope="module")
def street(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    full = not request.config.getoption("benchmark_disable")
    return write_street(
        tmp_path_factory.mktemp("street") / "Train" / "Town01_Light" / "cartesian", full
    )


def places(history: int, in_order: bool) -> np.ndarray:
    """Return the frames to load: none has padding, and at random none shares a scan with the one
    before.
    """
    frames = np.arange(history - 1, FRAMES)
    return frames if in_order else np.random.default_rng(0).permutation(frames)


@pytest.mark.benchmark(group="loading")
@pytest.mark.parametrize("history", [1, 5, 16])
@pytest.mark.parametrize("order", ["random", "in order"])
@pytest.mark.parametrize("what", ["occupancy", "density"])
@pytest.mark.parametrize("loader", ["carlasc", "plain"])
def test_bench_loading(benchmark, street, history, order, what, loader):
    if loader == "plain":
        dataset = PlainLoader(street, history, density=what == "density")
    else:
        dataset = Dataset(street, history=history, fields=(what, "labels", "known"))
    frames = list(places(history, order == "in order"))
    state = {"next": 0}

    def load():
        frame = frames[state["next"] % len(frames)]
        state["next"] += 1
        return frame, dataset[int(frame)]

    frame, sample = benchmark(load)
    truth = PlainLoader(street, history, density=what == "density")[int(frame)]
    assert (sample[what] == truth[what]).all() and (sample["labels"] == truth["labels"]).all()


def _milliseconds(load: Callable[[int], object], frames: np.ndarray, repeats: int) -> float:
    """Return the mean over frames of each one's best time in several passes.

    Processor time: with one thread and warm files it is the time on an idle machine, on a busy one
    too.
    """
    best = np.full(len(frames), np.inf)
    for _ in range(repeats):
        for place, frame in enumerate(frames):
            start = time.process_time()
            load(int(frame))
            best[place] = min(best[place], time.process_time() - start)
    return float(best.mean() * 1e3)


def print_table() -> None:
    """Print the table of docs/performance.md."""
    with tempfile.TemporaryDirectory() as temporary:
        street = write_street(Path(temporary) / "Train" / "Town01_Light" / "cartesian", full=True)
        points = np.mean([path.stat().st_size / 16 for path in (street / "velodyne").iterdir()])
        print(f"{points:.0f} points a scan\n")
        print(
            "| sample | order | plain NumPy | carlasc | ratio | reading alone "
            "|\n|---|---|---|---|---|---|"
        )
        for what in ("occupancy", "density"):
            for history in (1, 5, 16):
                plain = PlainLoader(street, history, density=what == "density")
                for order in ("random", "in order"):
                    frames = places(history, order == "in order")
                    dataset = Dataset(street, history=history, fields=(what, "labels", "known"))
                    dataset[0]
                    ours = _milliseconds(dataset.__getitem__, frames, 10)
                    theirs = _milliseconds(plain.__getitem__, frames[:6], 3)
                    floor = _milliseconds(
                        lambda frame, h=history: _read(street, frame, h), frames, 5
                    )
                    print(
                        f"| {what}, T = {history} | {order} | {theirs:.1f} ms | {ours:.2f} ms | "
                        f"{theirs / ours:.0f}x | {floor:.2f} ms |"
                    )


def _read(folder: Path, frame: int, history: int) -> None:
    """Read the bytes of a sample and do nothing with them."""
    for past in range(frame - history + 1, frame + 1):
        (folder / "velodyne" / f"{past:06d}.bin").read_bytes()
    for suffix in (".label", ".bin"):
        (folder / "evaluation" / f"{frame:06d}{suffix}").read_bytes()


if __name__ == "__main__":
    print_table()
