from __future__ import annotations

import shutil

import numpy as np
import pytest
from helpers.datasets.completion import SPEC, write_split

from carlasc.errors import ArgumentError, DependencyError

pytest.importorskip("torch", reason="needs carlasc[torch]")

import torch
from completion.config import Config
from completion.inference import check_compiler, prepare
from completion.latency import measure_network
from completion.networks import build_network
from completion.throughput import measure_throughput
from helpers.errors import raises

CPU = torch.device("cpu")


def test_eager_latency_is_measured_against_itself():
    (eager, *_) = measure_network("lmscnet_ss", 1, CPU, spec=SPEC, repetitions=2, modes=("eager",))
    assert eager.speedup == 1.0
    assert eager.differing == 0.0
    assert eager.median_ms >= eager.fastest_ms > 0
    assert eager.memory_mb > 50


class Small(torch.nn.Module):
    """A network of one layer: compiling one takes seconds, all of MotionSC a minute."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = torch.nn.Sequential(
            torch.nn.Conv2d(8, 3 * 8, 3, padding=1), torch.nn.BatchNorm2d(24)
        )

    def forward(self, occupancy):
        features = self.layer(occupancy[:, -1].permute(0, 3, 1, 2)).relu()
        return features.unflatten(1, (3, 8)).permute(0, 3, 4, 2, 1)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="torch.compile needs a C++ compiler")
def test_a_compiled_network_gives_the_labels_of_the_eager_one():
    torch.manual_seed(0)
    network = Small()
    occupancy = torch.from_numpy(
        (np.random.default_rng(0).random((1, 1, *SPEC.size)) < 0.1).astype(np.uint8)
    )
    eager = prepare(network, CPU, "eager")(occupancy)
    assert len(eager.unique()) == 3
    compiled = prepare(network, CPU, "compile")
    assert torch.equal(compiled(occupancy), eager)
    assert torch.equal(compiled(1 - occupancy), prepare(network, CPU, "eager")(1 - occupancy))


def test_a_missing_compiler_is_one_line_that_says_what_to_install(monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    with raises(DependencyError, where="torch.compile", expected="C++", advice="apt install g++"):
        check_compiler(CPU)
    with raises(ArgumentError, where="mode"):
        prepare(build_network("sscnet", 11, SPEC), CPU, "fast")


def test_loader_and_network_are_timed_apart(tmp_path):
    write_split(tmp_path, "Train", ["Town01_Light"], frames=4)
    rates = measure_throughput(tmp_path, Config("sscnet", batch_size=2, workers=0), CPU, batches=2)
    assert rates.loader > 0
    assert rates.network > 0
