"""Samples of 16 scans from a zarr store behind an HTTP server on this machine, with read-ahead,
against the same store on disk in the same order.

`python tests/benchmarks/test_bench_reading_ahead.py` measures scans of 120,000 points and prints
the table of docs/studies/scale.md. In pytest every case runs once on small scans, to see that it
works.
"""

from __future__ import annotations

import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the table: pytest has it already
from helpers.datasets.drives import write_drive
from helpers.scenes.lidar_frames import street_frame

import carlasc
from carlasc.dataset import Dataset, ShardSampler
from carlasc.storage.packing import pack
from carlasc.storage.transport.remote_tree import RemoteTree

pytestmark = pytest.mark.slow

HISTORY, BATCH, PIECE = 16, 4, 4 << 20
DELAY_S = 0.05  # of each answer of the slow server
# the data set must be several times as long as what is mixed and fetched ahead
SHARD, WINDOW, AHEAD = (
    32,
    2,
    2,
)


def write_store(root: Path, sequences: int, frames: int, full: bool) -> Path:
    """Write drives, each frame with its own noise, and pack them; the files are removed."""
    channels, columns = (64, 1963) if full else (8, 64)
    with np.errstate(invalid="ignore"):
        points = street_frame(1, channels, columns)[0].points
    rng = np.random.default_rng(0)
    for number in range(sequences):
        noise = (rng.uniform(-0.02, 0.02, points.shape).astype(np.float32) for _ in range(frames))
        scans = [
            np.column_stack([points + shift, np.zeros(len(points), np.float32)]) for shift in noise
        ]
        write_drive(
            root / "files" / "Train" / f"Town{number:02d}_Light" / "cartesian",
            range(frames),
            scans=scans,
        )
    store = pack(root / "files", root / "served" / "carlasc.zarr").out
    shutil.rmtree(root / "files")
    return store


@contextmanager
def served(folder: Path, delay_s: float = 0.0) -> Iterator[str]:
    """Serve a folder from a process of its own, which waits before each answer; yield its URL."""
    command = [
        sys.executable,
        str(Path(__file__).parents[1] / "helpers" / "servers" / "range_server.py"),
        str(folder),
        str(delay_s),
    ]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as server:
        assert server.stdout is not None and server.stdin is not None
        try:
            yield server.stdout.readline().strip()
        finally:
            server.stdin.close()


def samples_per_s(source: Any, workers: int, cache_size: int = 0) -> tuple[float, int]:
    """Load an epoch; return its rate with everything from opening the store on, and the number of
    samples.
    """
    torch = pytest.importorskip("torch")
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        cache = carlasc.Cache(folder, cache_size) if cache_size else None
        dataset = Dataset(carlasc.open(source, cache=cache), "train", history=HISTORY)
        sampler = ShardSampler(dataset, shard=SHARD, window=WINDOW, read_ahead=AHEAD)
        loader = torch.utils.data.DataLoader(dataset, BATCH, sampler=sampler, num_workers=workers)
        count = sum(len(batch["frame"]) for batch in loader)
        elapsed_s = time.perf_counter() - start
        kept = sum(path.stat().st_size for path in Path(folder).glob("??/*"))
        assert kept <= cache_size
    return count / elapsed_s, count


def needed(store: Path) -> set[str]:
    """Return the files that the samples are read from."""
    fields = ("points", "evaluation/labels", "evaluation/counts")
    sequences = carlasc.open(store).sequences().values()
    return {
        path
        for s in sequences
        for field in fields
        for path in s.files_of(field, s.frames(field).tolist())
    }


def bytes_per_s(url: str, store: Path) -> float:
    """Return the rate of the server alone: files of the store, one after another, in four ranges at
    a time.
    """
    tree = RemoteTree(url)
    paths = [path for path in store.rglob("*") if path.is_file() and path.stat().st_size > PIECE]
    start = time.perf_counter()
    for path in paths:
        size, name = path.stat().st_size, path.relative_to(store).as_posix()
        tree.read_ranges(
            [(name, first, min(first + PIECE, size)) for first in range(0, size, PIECE)]
        )
    return sum(path.stat().st_size for path in paths) / (time.perf_counter() - start)


def test_bench_reading_ahead(tmp_path):
    store = write_store(tmp_path, 2, 32, full=False)
    with served(store.parent) as url:
        for workers in (0, 2):
            rate, count = samples_per_s(f"{url}/{store.name}", workers, 1 << 24)
            assert rate > 0 and count == 64


def print_table(repeats: int = 3) -> None:
    """Print the table of docs/studies/scale.md."""
    with tempfile.TemporaryDirectory() as temporary:
        store = write_store(Path(temporary), 2, 128, full=True)
        size = sum((store / path).stat().st_size for path in needed(store))
        cache_size = size * 3 // 4
        with served(store.parent) as url, served(store.parent, DELAY_S) as slow_url:
            places = {
                "on disk": str(store),
                "server": f"{url}/{store.name}",
                "slow": f"{slow_url}/{store.name}",
            }
            raw = bytes_per_s(places["server"], store) / 1e6
            print(
                f"{size / 1e6:.0f} MB of files, cache of {cache_size / 1e6:.0f} MB, server alone "
                f"{raw:.0f} MB/s\n"
            )
            print(
                "| workers | on disk | server | share | server, 50 ms late | share "
                "|\n|---:|---:|---:|---:|---:|---:|"
            )
            for workers in (0, 2):
                rates: dict[str, list[float]] = {name: [] for name in places}
                for _ in range(repeats):
                    for name, place in places.items():
                        size_of_cache = 0 if name == "on disk" else cache_size
                        rates[name].append(samples_per_s(place, workers, size_of_cache)[0])
                disk, server, slow = (statistics.median(found) for found in rates.values())
                cells = (
                    f"{disk:.1f}/s",
                    f"{server:.1f}/s",
                    f"{server / disk:.2f}",
                    f"{slow:.1f}/s",
                    f"{slow / disk:.2f}",
                )
                print(f"| {workers} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    print_table()
