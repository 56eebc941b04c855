"""A model of large runs: `python docs/studies/scale.py` prints the table of docs/studies/scale.md:
time and cost of making grids on a cluster.

The model takes figures that were measured on one machine (`Measured`) and prices (`Prices`), and
assumes that

- workers are as fast as the measured core, and do not slow each other down;
- the object store answers any number of workers up to its limit of requests, and its transfer rate
  per worker is that of `Measured`;
- the pass that finds the actors of a sequence runs before its grids, is shared by the workers of
  the sequence, and keeps `PASS_WORKERS` of them busy at most;
- a block of frames is read, made and written by one worker, one step after the other.

It leaves out the time until machines start, and the time that people wait in a queue.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import study

PASS_WORKERS = 8
WORKERS = (2, 16, 100, 1000)
RAYS, FIGURE_RAYS = 120_000, 57_600  # of a scan, here and in the figures


def _figure(name: str) -> float:
    figures = json.loads((Path(__file__).parents[1] / "figures.json").read_text())["figures"]
    return float(figures[name]["value"])


@dataclass(frozen=True)
class Measured:
    """What one core does: from docs/figures.json, in proportion to the rays, and from the sections
    before the model.

    Attributes:
        frame_s: processor time of a frame: scans of 120,000 points, merged with 30 scans before and
            30 after it into voxels of 0.2 m.
        pass_s: processor time of a frame in the pass that finds the actors.
        engine_s: time of the scheduler for a task.
        start_s: loading the compiled code in a worker.
        read_bytes: bytes of one frame's scan, with labels and flow.
        write_bytes: bytes of one frame's grid.
        transfer_bytes_s: bytes per second between the object store and a worker.
    """

    frame_s: float = 0.001 * _figure("merging.fine.grid") * 61 / 31 * RAYS / FIGURE_RAYS
    pass_s: float = 0.001 * _figure("merging.pass") * RAYS / FIGURE_RAYS
    engine_s: float = 0.003
    start_s: float = 10.0
    read_bytes: int = 990_000
    write_bytes: int = 60_000
    transfer_bytes_s: float = 50e6


@dataclass(frozen=True)
class Prices:
    """What is paid, in US dollars.

    Attributes:
        core_hour: one core and 4 GB of memory for an hour.
        get: one request that reads.
        put: one request that writes.
        gigabyte_month: storage.
    """

    core_hour: float = 0.05
    get: float = 0.4e-6
    put: float = 5e-6
    gigabyte_month: float = 0.023


@dataclass(frozen=True)
class Job:
    """A run over a data set.

    Attributes:
        frames: number of frames.
        frames_per_sequence: length of a sequence.
        block: frames that one object of each column holds.
        window: scans around a frame that are merged with it.
        columns_read: objects of a block that are read: xyz, labels, index and palette of flow, and
            the counts of each field.
        columns_written: objects of a block that are written: labels and counts of the grid, each
            with its counts.
        requests_s: requests that the object store answers per second.
    """

    frames: int = 43_200
    frames_per_sequence: int = 1_800
    block: int = 16
    window: int = 60
    columns_read: int = 8
    columns_written: int = 4
    requests_s: float = 5_500.0


@dataclass(frozen=True)
class Estimate:
    """What a run takes.

    Attributes:
        hours: duration.
        limit: what the duration is limited by.
        core_hours: processor time of all workers, waiting included.
        gets: requests that read.
        puts: requests that write.
        dollars: for cores and requests.
        monthly: for storing scans and grids, each month.
    """

    hours: float
    limit: str
    core_hours: float
    gets: int
    puts: int
    dollars: float
    monthly: float


def estimate(
    job: Job, workers: int, measured: Measured = Measured(), prices: Prices = Prices()
) -> Estimate:
    """Return what a run takes with a number of workers, each one core."""
    blocks = math.ceil(job.frames / job.block)
    # of each column, that hold the scans of a block and of its window
    shards = 1 + math.ceil(job.window / job.block)
    # the pass reads a block once; each object takes its index and its chunks
    gets = blocks * (shards + 1) * job.columns_read * 2
    puts = blocks * job.columns_written
    moved = (
        blocks * (shards + 1) * job.block * measured.read_bytes + job.frames * measured.write_bytes
    )
    busy = job.frames * (measured.frame_s + measured.pass_s) + moved / measured.transfer_bytes_s
    sequence = job.frames_per_sequence * measured.pass_s / min(PASS_WORKERS, workers)
    limits = {
        "cores": busy / workers,
        "requests": (gets + puts) / job.requests_s,
        "the scheduler": blocks * measured.engine_s * 2,
        "one sequence": sequence + job.block * measured.frame_s,
    }
    limit = max(limits, key=lambda name: limits[name])
    seconds = (
        limits[limit]
        + measured.start_s
        + (0 if limit == "one sequence" else sequence if workers > blocks else 0)
    )
    core_hours = seconds * workers / 3600
    dollars = core_hours * prices.core_hour + gets * prices.get + puts * prices.put
    monthly = (
        job.frames * (measured.read_bytes + measured.write_bytes) / 1e9 * prices.gigabyte_month
    )
    return Estimate(seconds / 3600, limit, core_hours, gets, puts, dollars, monthly)


def table() -> str:
    """Return the table of the documentation, as Markdown."""
    rows = [
        "| frames | workers | time | limited by | core hours | cores and requests | storage a "
        "month |"
    ]
    rows.append("|---:|---:|---:|---|---:|---:|---:|")
    for frames in (43_200, 432_000):
        for workers in WORKERS:
            found = estimate(replace(Job(), frames=frames), workers)
            hours = f"{found.hours:.1f} h" if found.hours >= 1 else f"{found.hours * 60:.0f} min"
            rows.append(
                f"| {frames:,} | {workers:,} | {hours} | {found.limit} | {found.core_hours:.0f} | "
                f"${found.dollars:.2f} | ${found.monthly:.2f} |"
            )
    return "\n".join(rows)


def main() -> None:
    """Print the table."""
    with study.begin(study.options(__doc__)):
        print(table())


if __name__ == "__main__":
    main()
