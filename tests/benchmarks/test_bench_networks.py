"""A frame through each example network, eagerly: the baseline of docs/performance.md, `python
examples/latency.py` has the rest.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the examples need carlasc[torch]")
sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

from completion.inference import prepare  # noqa: E402
from completion.networks import build_network  # noqa: E402

from carlasc import GridSpec  # noqa: E402

pytestmark = pytest.mark.slow

SPEC = GridSpec.published().with_size((32, 32, 8))


@pytest.mark.benchmark(group="networks, 32 x 32 x 8, eager")
@pytest.mark.parametrize(
    ("name", "history"), [("motionsc", 1), ("motionsc", 5), ("lmscnet_ss", 1), ("sscnet_full", 1)]
)
def test_bench_network(benchmark, name, history):
    occupancy = torch.from_numpy(
        (np.random.default_rng(0).random((1, history, *SPEC.size)) < 0.05).astype(np.uint8)
    )
    run = prepare(build_network(name, 11, SPEC, history), torch.device("cpu"), "eager")
    labels = benchmark(run, occupancy)
    assert labels.shape == (1, *SPEC.size)
    assert int(labels.max()) < 11
