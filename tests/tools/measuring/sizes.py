"""How much is measured, and how two versions are compared: by turns, so that both meet the same
machine.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Size:
    """How often things are measured.

    Attributes:
        repeats: number of turns of what takes milliseconds.
        slow_repeats: number of turns of what takes seconds.
        runs: number of times that a file of benchmarks is run in which two versions are compared.
        threads: for which numbers of threads networks are measured.
        networks: the networks that are compiled and measured, NAME:T.
    """

    repeats: int
    slow_repeats: int
    runs: int
    threads: tuple[int, ...]
    networks: tuple[str, ...]


SIZES = {
    "tiny": Size(1, 1, 1, (1,), ("sscnet_full:1",)),
    "quick": Size(
        10,
        3,
        2,
        (1, 2),
        ("motionsc:1", "lmscnet_ss:1", "sscnet_full:1", "motionsc:5", "baseline:5"),
    ),
    "full": Size(
        40,
        10,
        5,
        (1, 2),
        ("motionsc:1", "lmscnet_ss:1", "sscnet_full:1", "motionsc:5", "baseline:5"),
    ),
}


def by_turns(
    calls: Mapping[str, Callable[[], object]],
    repeats: int,
    clock: Callable[[], float] = time.process_time,
) -> dict[str, float]:
    """Return the least time of each call, in seconds. The calls take turns.

    Args:
        calls: the calls by name; each was made once before, so that it is compiled and its files
            are in memory.
        repeats: number of turns.
        clock: processor time of this process, which hardly depends on what else the machine does;
            or `time.perf_counter`.
    """
    least: dict[str, float] = {}
    for _ in range(repeats):
        for name, call in calls.items():
            start = clock()
            call()
            least[name] = min(least.get(name, float("inf")), clock() - start)
    return least
