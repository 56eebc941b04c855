"""What a Dask cluster costs beyond the work: `python docs/studies/engine.py` measures the figures
of the page on scale again.

It prints the time per frame of frames without work, in processes of our own and on a cluster of
this machine; the time of all 43,200 frames of CarlaSC, with the memory of the process that holds
the scheduler.
"""

from __future__ import annotations

import os
import time
from typing import Any

import psutil
import study

from carlasc import Run
from carlasc.running import Engine, open_cluster, run_all
from carlasc.running.processes import one_pool

FRAMES_OF_CARLASC = 43_200


def do_nothing(frame: int) -> int:
    """Stand in for a frame."""
    return frame


def measure_overhead(workers: int, frames: int) -> tuple[str, str]:
    """Return the times per frame without work: in processes of our own, and on a cluster."""
    with one_pool(Run(workers=max(workers, 2))) as pool:
        own = _time(pool.executor, workers, frames)
    with open_cluster(f"local:{workers}") as cluster:
        return own, _time(cluster, workers, frames)


def _time(executor: Engine | None, workers: int, frames: int) -> str:
    list(run_all(do_nothing, range(50), run=Run(workers=workers, executor=executor)))
    start, before = time.perf_counter(), _cpu_s()
    assert (
        sum(run_all(do_nothing, range(frames), run=Run(workers=workers, executor=executor)))
        == frames * (frames - 1) // 2
    )
    elapsed, cpu = time.perf_counter() - start, _cpu_s() - before
    return f"{1e3 * elapsed / frames:.2f} ms a frame ({1e3 * cpu / frames:.2f} ms of CPU)"


def _cpu_s() -> float:
    """Return the CPU time of this process and its workers."""
    here = psutil.Process()
    return sum(sum(process.cpu_times()[:2]) for process in (here, *here.children(recursive=True)))


def measure_whole(workers: int, frames: int) -> None:
    """Print the time of many frames, and the memory of this process, which holds the scheduler, on
    the way.
    """
    process, start = psutil.Process(), time.perf_counter()
    with open_cluster(f"local:{workers}") as cluster:
        for done, _ in enumerate(run_all(do_nothing, range(frames), run=Run(executor=cluster))):
            if done % (frames // 8) == 0:
                client: Any = cluster.client  # of distributed, which has more than our protocol
                tasks = len(client.cluster.scheduler.tasks)
                print(
                    f"  {done:6d} frames, {time.perf_counter() - start:6.1f} s, "
                    f"{process.memory_info().rss >> 20} MiB, {tasks} tasks",
                    flush=True,
                )
    print(
        f"  {frames:6d} frames, {time.perf_counter() - start:6.1f} s, "
        f"{process.memory_info().rss >> 20} MiB",
        flush=True,
    )


def main() -> None:
    """Measure everything."""
    with study.begin(study.options(__doc__)):
        print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
        for workers in study.few((1, 2)):
            own, cluster = measure_overhead(workers, 100 if study.is_tiny() else 1000)
            print(
                f"{workers} workers: {own} in processes of our own, {cluster} on a cluster",
                flush=True,
            )
        frames = 80 if study.is_tiny() else FRAMES_OF_CARLASC
        print(f"{frames} frames on 2 workers:")
        measure_whole(2, frames)


if __name__ == "__main__":
    main()
