"""Loading a sample, and reading a stack, from every store, warm, in one process.

`pytest tests/benchmarks/test_bench_storage.py --benchmark-enable` measures scans of 125,000 points
on the published grid; without that every case runs once on small scans. `python
tests/benchmarks/test_bench_storage.py` prints the table of docs/storage.md.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the table: pytest has it already
from helpers.datasets.drives import write_drive
from helpers.scenes.lidar_frames import street_frame

import carlasc
from carlasc.dataset.samples import Dataset
from carlasc.storage.packing import pack

pytestmark = pytest.mark.slow

FRAMES, HISTORY = 40, 16
PATH = "Train/Town01_Light/cartesian"
STORES = ("files", "zarr", "zarr --small", "h5", "parquet")


def write_stores(root: Path, full: bool) -> dict[str, Path]:
    """Write a drive of 40 frames, each with its own noise, as files and as every kind of store."""
    channels, columns = (64, 2048) if full else (8, 64)
    with np.errstate(invalid="ignore"):
        points = street_frame(1, channels, columns)[0].points
    rng = np.random.default_rng(0)
    noise = (rng.uniform(-0.02, 0.02, points.shape).astype(np.float32) for _ in range(FRAMES))
    scans = [
        np.column_stack([points + shift, np.zeros(len(points), np.float32)]) for shift in noise
    ]
    write_drive(root / "files" / PATH, range(FRAMES), scans=scans)
    stores = {"files": root / "files"}
    for name in STORES[1:]:
        kind, _, small = name.partition(" ")
        stores[name] = root / f"{'small' if small else 'store'}.{kind}"
        pack(root / "files", stores[name], small=bool(small))
    return stores


@pytest.fixture(scope="module")
def stores(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    return write_stores(
        tmp_path_factory.mktemp("stores"), not request.config.getoption("benchmark_disable")
    )


@pytest.mark.benchmark(group="storage: samples of 16 scans")
@pytest.mark.parametrize("order", ["random", "in order"])
@pytest.mark.parametrize("store", STORES)
def test_bench_samples_from_every_store(benchmark, stores, store, order):
    dataset = Dataset(stores[store], history=HISTORY)
    frames = list(places(order))
    state = {"next": 0}

    def load():
        frame = frames[state["next"] % len(frames)]
        state["next"] += 1
        return frame, dataset[frame]

    frame, sample = benchmark(load)
    truth = Dataset(stores["files"], history=HISTORY)[frame]
    for name in ("occupancy", "labels", "known"):
        assert np.array_equal(sample[name], truth[name])


@pytest.mark.benchmark(group="storage: one field of one frame")
@pytest.mark.parametrize("field", ["points", "evaluation/labels", "evaluation/counts"])
@pytest.mark.parametrize("store", STORES)
def test_bench_one_field_from_every_store(benchmark, stores, store, field):
    sequence = carlasc.open(stores[store]).sequences()[PATH]
    array = benchmark(sequence.read, field, 7)
    assert np.array_equal(array, carlasc.open(stores["files"]).sequences()[PATH].read(field, 7))


def places(order: str) -> list[int]:
    """Return the frames to load: none has padding, and at random few share scans with the one
    before.
    """
    frames = np.arange(HISTORY - 1, FRAMES)
    return (
        frames if order == "in order" else np.random.default_rng(0).permutation(frames)
    ).tolist()


def _milliseconds(loads, repeats):
    """Return each load's mean over frames of the best of several passes; the loads take turns, so
    that all meet the same machine.

    Processor time of all threads: on an idle machine a stack takes that by the number of cores.
    """
    best = {}
    for _ in range(repeats):
        for name, (load, items) in loads.items():
            for place, item in enumerate(items):
                start = time.process_time()
                load(item)
                took = time.process_time() - start
                best[name, place] = min(best.get((name, place), np.inf), took)
    return {
        name: 1e3 * np.mean([best[name, k] for k in range(len(items))])
        for name, (_, items) in loads.items()
    }


def print_table() -> None:
    """Print the table of docs/storage.md."""
    with tempfile.TemporaryDirectory() as temporary:
        stores = write_stores(Path(temporary), full=True)
        rows = {}
        for order in ("random", "in order"):
            loads = {
                name: (Dataset(path, history=HISTORY).__getitem__, places(order))
                for name, path in stores.items()
            }
            rows[f"a sample of 16 scans, {order}"] = _milliseconds(loads, 5)
        for field in ("points", "evaluation/labels", "evaluation/counts"):
            sequences = {
                name: carlasc.open(path).sequences()[PATH] for name, path in stores.items()
            }
            loads = {
                name: (lambda f, s=s, n=field: s.read(n, f).sum(), range(FRAMES))
                for name, s in sequences.items()
            }
            rows[f"`{field}` of a frame, summed"] = _milliseconds(loads, 5)
        print(f"| | {' | '.join(STORES)} |\n|---|{'---:|' * len(STORES)}")
        for what, times in rows.items():
            cells = [
                f"{times[name]:.2f} ms ({times[name] / times['files']:.2f}x)" for name in STORES
            ]
            print(f"| {what} | {' | '.join(cells)} |")


if __name__ == "__main__":
    print_table()
