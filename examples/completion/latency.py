"""Latency and memory of a network at batch size 1, measured as in the paper: 100 repetitions after
a warm-up.
"""

from __future__ import annotations

import gc
import resource
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import nn

from carlasc import GridSpec, collate
from completion.inference import Mode, prepare
from completion.networks import KINDS, build_network

_STACKS = 8  # together, they have a million voxels of the published grid


@dataclass(frozen=True)
class Latency:
    """Time and memory of a network for one frame, from occupancy to labels.

    Attributes:
        network: name of the network.
        history: T.
        mode: "eager" or "compile".
        median_ms: median time of the repetitions.
        fastest_ms: shortest time of the repetitions; for ratios, it is more reliable on a busy
            machine.
        memory_mb: peak memory of the GPU, or of the whole process on a CPU.
        speedup: shortest time of the first mode of the same run (eager float32), divided by this
            mode's.
        differing: number of voxels per million whose label differs from the first mode's.
    """

    network: str
    history: int
    mode: Mode
    median_ms: float
    fastest_ms: float
    memory_mb: float
    speedup: float
    differing: float


def measure_network(
    name: str,
    history: int,
    device: torch.device,
    *,
    spec: GridSpec,
    num_classes: int = 11,
    repetitions: int = 100,
    modes: Sequence[Mode] = ("eager", "compile"),
) -> list[Latency]:
    """Measure a network in several modes.

    Speed and labels are compared with those of the first mode.

    Weights are random, because they do not change the time. The inputs are `_STACKS` examples of
    the network's task: occupancy as dense as that of a scan, or a scan of 120,000 points. Networks
    whose inputs have no fixed shapes are measured in the first mode only.
    """
    rng = np.random.default_rng(0)
    task = KINDS[name].task
    samples = [task.example(spec, history, rng) for _ in range(_STACKS)]
    inputs = [
        task.arguments(task.prepare(collate([sample]), device), torch.uint8) for sample in samples
    ]
    modes = modes if task.fixed_shapes else modes[:1]
    results: list[Latency] = []
    reference: torch.Tensor | None = None
    for mode in modes:
        torch.manual_seed(0)
        run = prepare(randomise(build_network(name, num_classes, spec, history)), device, mode)
        if device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(device)
        labels = torch.cat([run(*given).clone() for given in inputs])
        reference = labels if reference is None else reference
        times_ms = np.array([_time_ms(run, inputs[0], device) for _ in range(repetitions)])
        baseline = results[0].fastest_ms if results else times_ms.min()
        results.append(
            Latency(
                name,
                history,
                mode,
                float(np.median(times_ms)),
                float(times_ms.min()),
                _peak_mb(device),
                float(baseline / times_ms.min()),
                float(1e6 * (labels != reference).double().mean()),
            )
        )
        del run
        gc.collect()
    return results


def randomise(network: nn.Module) -> nn.Module:
    """Give batch norms the statistics of random features, so that logits differ and no two classes
    are equal.
    """
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d | nn.BatchNorm3d):
            for tensor, spread in ((module.running_mean, 0.1), (module.running_var, 0.3)):
                if tensor is not None:
                    tensor.add_(spread * torch.rand_like(tensor))
    return network


def _time_ms(
    run: Callable[..., torch.Tensor], inputs: tuple[Any, ...], device: torch.device
) -> float:
    """Return the time of a call.

    With one thread on a CPU it is CPU time, which does not depend on other work on the machine.
    """
    clock = (
        time.process_time
        if device.type == "cpu" and torch.get_num_threads() == 1
        else time.perf_counter
    )
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    start = clock()
    run(*inputs)
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return 1000 * (clock() - start)


def _peak_mb(device: torch.device) -> float:
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
