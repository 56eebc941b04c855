"""Loading a sample from plain files, warm, in one process, against the plain NumPy loader.

`pytest tests/benchmarks/test_bench_dataset.py --benchmark-enable` measures scans of 125,000 points
on the published grid; without that every case runs once on small scans.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.datasets.drives import write_drive
from helpers.references.plain_loader import LOADERS, PlainLoader
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
@pytest.mark.parametrize("loader", ["carlasc", *LOADERS])
def test_bench_loading(benchmark, street, history, order, what, loader):
    if loader in LOADERS:
        dataset = LOADERS[loader](street, history, density=what == "density")
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
    # with float32, points at the edge of a voxel may be in its neighbour
    wrong = 0 if loader in ("carlasc", "plain") else 2e-5
    assert (sample[what] != truth[what]).mean() <= wrong
    assert (sample["labels"] == truth["labels"]).all()


def _read(folder: Path, frame: int, history: int) -> None:
    """Read the bytes of a sample and do nothing with them."""
    for past in range(frame - history + 1, frame + 1):
        (folder / "velodyne" / f"{past:06d}.bin").read_bytes()
    for suffix in (".label", ".bin"):
        (folder / "evaluation" / f"{frame:06d}{suffix}").read_bytes()
