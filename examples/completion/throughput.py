"""Training samples per second of the loader and of the network: the slower one limits training."""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass
from pathlib import Path

import torch

from completion.config import Config
from completion.data import TrainLoader, open_split, target_of
from completion.networks import build_network
from completion.tasks import task_of


@dataclass(frozen=True)
class Throughput:
    """Samples per second.

    Attributes:
        loader: of the loader only.
        network: of forward pass, loss, backward pass and step on one batch in memory.
    """

    loader: float
    network: float


def measure_throughput(
    source: str | Path, config: Config, device: torch.device, batches: int = 20
) -> Throughput:
    """Measure loader and network separately, with the settings of a run.

    The first batches are not counted, because workers start meanwhile.
    """
    data = open_split(source, config.train, config, training=True)
    loader = TrainLoader(data, config)
    endless = itertools.chain.from_iterable(loader.epoch(number) for number in itertools.count())
    # batches that workers may have prepared before the measurement
    warm = max(2, 2 * config.workers)
    batch = next(itertools.islice(endless, warm, None))
    start = time.perf_counter()
    loaded = sum(len(loaded["frame"]) for loaded in itertools.islice(endless, batches))
    loader_rate = loaded / (time.perf_counter() - start)

    num_classes = max(data.classes.names) + 1
    network = (
        build_network(config.network, num_classes, data.spec, config.history).to(device).train()
    )
    optimizer = torch.optim.Adam(network.parameters())
    task, target = task_of(network), target_of(batch, device)
    weights = torch.ones(num_classes, device=device)
    for step in range(batches + 2):
        if step == 2:
            _wait(device)
            start = time.perf_counter()
        with torch.autocast(device.type, torch.bfloat16, enabled=config.precision == "bf16"):
            prepared = task.prepare(batch, device, torch.Generator().manual_seed(step))
            outputs = network(*task.arguments(prepared))
        sums, totals = task.loss(outputs, prepared, target, weights)
        factors, offset = task.balance(network, sums)
        optimizer.zero_grad(set_to_none=True)
        torch.autograd.backward((factors * sums / totals).sum() + offset)
        optimizer.step()
    _wait(device)
    return Throughput(loader_rate, batches * len(target) / (time.perf_counter() - start))


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
