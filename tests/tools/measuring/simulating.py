"""The simulated town: what a frame of twenty LiDARs takes."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from pathlib import Path

from carlasc_recorders.town.drive import TownDrive

from carlasc import Run, simulate
from measuring.figures import Figure
from measuring.sizes import Size, by_turns

_FRAMES = 4


def measure_simulation(size: Size, folder: Path) -> Iterator[tuple[str, Figure]]:
    """Yield the times of a town, of a scan, and of a frame with pictures and files."""
    TownDrive(seed=1, traffic="heavy").record(0)
    times = by_turns({"town": lambda: TownDrive(seed=0, traffic="heavy").town}, size.slow_repeats)
    yield (
        "simulation.town",
        Figure(times["town"], "s", "building a town with heavy traffic: processor time"),
    )
    drive = TownDrive(seed=0, traffic="heavy")
    drive.record(240)  # collects the triangles of the frame
    times = by_turns({"scan": lambda: drive.record(240, 1)}, size.repeats)
    yield (
        "simulation.scan",
        Figure(
            1e3 * times["scan"],
            "ms",
            "one full scan of a frame whose triangles are collected: processor time",
        ),
    )

    def frames(count: int) -> None:
        shutil.rmtree(folder / "capture", ignore_errors=True)
        simulate(folder / "capture", count=count, traffic="heavy", run=Run(workers=1))

    counts = {"one": lambda: frames(1), "more": lambda: frames(1 + _FRAMES)}
    times = by_turns(counts, size.slow_repeats, time.perf_counter)
    frame = (times["more"] - times["one"]) / _FRAMES
    yield (
        "simulation.frame",
        Figure(
            frame,
            "s",
            "a frame of twenty full scans in heavy traffic, with pictures and files, one worker: "
            "wall time",
        ),
    )
