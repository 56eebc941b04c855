"""How fast an instant seen by 20 LiDARs becomes votes, beside the plain NumPy version.

Small inputs where benchmarks are off.
"""

from __future__ import annotations

import time
from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers.references.plain_voting import plain_grid, plain_votes
from helpers.scenes.lidar_frames import street_frame

from carlasc.core.grids import Grid, GridSpec
from carlasc.groundtruth.voting.ballot import Observation, count_votes

# of one thread, whatever else runs
pytestmark = [
    pytest.mark.slow,
    pytest.mark.benchmark(timer=time.process_time),
]

FINEST = GridSpec.published().with_resolution(0.1)
CASES = {
    "128x128x8": (GridSpec.published("cartesian"), "sensor"),
    "256x256x16": (GridSpec.published("fine"), "sensor"),
    "512x512x30": (FINEST, "sensor"),
    "cylindrical": (GridSpec.published("cylindrical"), "sensor"),
    "every sample": (GridSpec.published("cartesian"), "sample"),
}


@cache
def frame(full: bool) -> list[Observation]:
    return street_frame(distinct=5) if full else street_frame(sensors=2, channels=16, columns=128)


def vote(observations: list[Observation], spec: GridSpec, rule: Any) -> Grid:
    return count_votes(observations, spec, rule=rule).to_grid()


@pytest.mark.parametrize("case", CASES)
def test_votes(benchmark: Any, case: str) -> None:
    spec, rule = CASES[case]
    observations = frame(benchmark.enabled)
    vote(observations[:1], spec, rule)  # compiled and loaded
    grid = benchmark.pedantic(
        vote, args=(observations, spec, rule), rounds=10 if benchmark.enabled else 1
    )
    assert grid.known.any()


@pytest.mark.parametrize("case", [case for case in CASES if case != "512x512x30"])
def test_plain_votes(benchmark: Any, case: str) -> None:
    spec, rule = CASES[case]
    observations = frame(benchmark.enabled)

    def plain() -> tuple[Any, Any]:
        return plain_grid(plain_votes(observations, spec, rule=rule), spec)

    labels, counts = benchmark.pedantic(plain, rounds=2 if benchmark.enabled else 1)
    grid = vote(observations, spec, rule)
    np.testing.assert_array_equal(grid.labels, labels)
    np.testing.assert_array_equal(grid.counts, counts)


def test_merging_60_scans(benchmark: Any) -> None:
    observations = (frame(benchmark.enabled) * 30)[:60]
    spec = GridSpec.published()
    vote(observations[:1], spec, "sensor")
    grid = benchmark.pedantic(
        vote, args=(observations, spec, "sensor"), rounds=3 if benchmark.enabled else 1
    )
    assert grid.known.any()
