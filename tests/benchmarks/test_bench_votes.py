"""The file of a frame's votes at 0.1 m: 4.3 million rows, of 20 LiDARs.

A small grid where benchmarks are off.

`numpy` is what it is measured by: `numpy.savez_compressed`, whose file is 3% smaller.
"""

from __future__ import annotations

import io
from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers.scenes.lidar_frames import street_frame
from numpy.typing import NDArray

from carlasc.core.grids import GridSpec
from carlasc.groundtruth.voting.ballot import count_votes
from carlasc.storage import layout

pytestmark = [pytest.mark.slow, pytest.mark.benchmark(group="votes")]

FIELD = layout.field_named("evaluation/votes")


@cache
def street_votes(full: bool) -> NDArray[Any]:
    observations = street_frame(distinct=5) if full else street_frame(2, 16, 128)
    return count_votes(
        observations, GridSpec.published().with_resolution(0.1 if full else 0.4)
    ).to_sparse()


def save(votes: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, voxel=votes["voxel"], label=votes["label"], votes=votes["votes"])
    return buffer.getvalue()


def test_bench_numpy(benchmark: Any) -> None:
    votes = street_votes(benchmark.enabled)
    assert len(FIELD.encode(votes, "x")) < 1.06 * len(benchmark(save, votes))


def test_bench_encode(benchmark: Any) -> None:
    votes = street_votes(benchmark.enabled)
    data = benchmark(FIELD.encode, votes, "x")
    assert np.array_equal(FIELD.decode(data, "x"), votes)


def test_bench_decode(benchmark: Any) -> None:
    votes = street_votes(benchmark.enabled)
    assert np.array_equal(benchmark(FIELD.decode, FIELD.encode(votes, "x"), "x"), votes)
