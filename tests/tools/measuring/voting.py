"""Votes of an instant seen by 20 LiDARs, beside plain NumPy; and whole runs of `regrid`, with and
without syncing.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from benchmarks import test_bench_voting as bench
from helpers.references.plain_voting import plain_grid, plain_votes

from carlasc import Run, simulate
from carlasc.core.grids import GridSpec
from carlasc.groundtruth import regrid
from carlasc.storage.files import DURABLE
from measuring.figures import Figure, ratio, within
from measuring.sizes import Size, by_turns

_KEYS = {
    "128x128x8": "coarse",
    "256x256x16": "fine",
    "512x512x30": "finest",
    "cylindrical": "cylindrical",
    "every sample": "every_sample",
}
_FRAMES = 24
_PEAK = """
import re, resource, sys
from pathlib import Path
import numpy as np
from carlasc.core.grids import GridSpec
from carlasc.groundtruth.voting.ballot import count_votes
from carlasc.groundtruth.voting.ballot import Observation

held = np.load(sys.argv[1])
parts = ("points", "labels", "pose")
scans = [Observation(*(held[f"{p}{n}"] for p in parts)) for n in range(len(held) // 3)]
spec = GridSpec.published(sys.argv[2] if sys.argv[2] == "fine" else "coarse")
count_votes(scans, spec.with_resolution(0.1) if sys.argv[2] == "finest" else spec).to_grid()
# where there is none: getrusage, which counts what the parent held when it started this process
status = Path("/proc/self/status")
kilobytes = re.search("VmHWM:[^0-9]*([0-9]+)", status.read_text())[1] if status.exists() else 0
print(int(kilobytes) / 1e3 or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6)
"""


def measure_voting(size: Size, folder: Path) -> Iterator[tuple[str, Figure]]:
    """Yield processor times of the votes of one frame, and the peak memory of a process that makes
    them.
    """
    observations = bench.frame(True)
    ratios = []
    for case, name in _KEYS.items():
        spec, rule = bench.CASES[case]
        text = f"votes of 20 LiDARs, {case}, rule {rule}: least processor time of one thread"
        bench.vote(observations, spec, rule)
        times = by_turns(
            {"carlasc": lambda s=spec, r=rule: bench.vote(observations, s, r)}, size.repeats
        )
        if case != "512x512x30":  # in plain NumPy it would need tens of gigabytes
            for _ in range(min(size.slow_repeats, 2)):
                both = {
                    "plain": lambda s=spec, r=rule: plain_grid(
                        plain_votes(observations, s, rule=r), s
                    ),
                    "carlasc": lambda s=spec, r=rule: bench.vote(observations, s, r),
                }
                found = by_turns(both, 1)
                times = {
                    way: min(time, times.get(way, time)) for way, time in (times | found).items()
                }
        figures = {
            way: Figure(1e3 * seconds, "ms", f"{text}, {way}") for way, seconds in times.items()
        }
        if "plain" in figures:
            figures["ratio"] = ratio(
                figures["plain"], figures["carlasc"], f"{text}, plain / carlasc"
            )
            ratios.append(figures["ratio"])
        yield from ((f"votes.{name}.{way}", figure) for way, figure in figures.items())
    yield (
        "votes.ratio",
        within(ratios, "votes of 20 LiDARs: plain / carlasc, all grids but the finest"),
    )
    merged, coarse = (observations * 3)[:60], GridSpec.published()
    times = by_turns({"merged": lambda: bench.vote(merged, coarse, "sensor")}, size.slow_repeats)
    yield (
        "votes.merged",
        Figure(1e3 * times["merged"], "ms", "votes of 60 scans on 128 x 128 x 8: processor time"),
    )
    scans = {}
    for n, one in enumerate(observations):
        scans |= {f"points{n}": one.points, f"labels{n}": one.labels, f"pose{n}": one.grid_T_sensor}
    np.savez(folder / "scans.npz", **scans)
    for name in ("coarse", "fine", "finest"):
        arguments = [sys.executable, "-c", _PEAK, str(folder / "scans.npz"), name]
        ran = subprocess.run(arguments, check=True, stdout=subprocess.PIPE, text=True)
        text = f"peak memory of a process that reads the 20 scans and votes once, {name} grid"
        yield f"votes.{name}.memory", Figure(float(ran.stdout), "MB", text)


def measure_regrid(size: Size, folder: Path) -> Iterator[tuple[str, Figure]]:
    """Yield the wall time of a frame of `regrid` of a capture of 20 sensors: workers, stores,
    syncing.
    """
    simulate(folder / "capture", count=_FRAMES, bev=False)
    spec, out = GridSpec.published("cartesian"), folder / "out"

    def run(kind: str, durable: str, workers: int) -> None:
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        os.environ[DURABLE] = durable
        assert not regrid(
            folder / "capture", spec, out / f"a{kind}", run=Run(workers=workers)
        ).failures

    cases = {
        "regrid.folder": ("", "yes", 1),
        "regrid.folder.not_synced": ("", "no", 1),
        "regrid.zarr": (".zarr", "yes", 1),
        "regrid.zarr.not_synced": (".zarr", "no", 1),
        "regrid.folder.two_workers": ("", "yes", 2),
    }
    calls = {name: lambda c=case: run(*c) for name, case in cases.items()}
    calls["regrid.folder"](), calls["regrid.zarr"]()
    times = by_turns(calls, size.slow_repeats, time.perf_counter)
    figures = {
        name: Figure(
            1e3 * times[name] / _FRAMES,
            "ms",
            f"wall time per frame of regrid into {kind or 'a folder'}, durable {durable}, "
            f"{workers} workers",
        )
        for name, (kind, durable, workers) in cases.items()
    }
    yield from figures.items()
    for kind in ("folder", "zarr"):
        more = 100 * (
            figures[f"regrid.{kind}"].value / figures[f"regrid.{kind}.not_synced"].value - 1
        )
        yield (
            f"regrid.{kind}.syncing",
            Figure(
                max(more, 0.0),
                "%",
                f"what syncing adds to the time of regrid into a {kind}; 0 where nothing can be "
                f"seen",
            ),
        )
