"""The score of a network on a split."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from carlasc.metrics import ConfusionMatrix, Uncertainty
from completion.data import target_of
from completion.losses import IGNORE
from completion.processes import Processes
from completion.tasks import Batch, task_of


@torch.no_grad()
def score_with_certainty(
    network: nn.Module,
    loader: DataLoader[Mapping[str, Any]],
    num_classes: int,
    processes: Processes,
) -> tuple[ConfusionMatrix, Uncertainty]:
    """Return the confusion matrix of a network over the known voxels of a split, and the
    calibration of its probabilities.
    """
    network.eval()
    task, matrix, certainty = (
        task_of(network),
        ConfusionMatrix(num_classes),
        Uncertainty(num_classes),
    )
    for batch in loader:
        target = target_of(batch, processes.device)
        outputs = network(*task.arguments(task.prepare(batch, processes.device)))
        logits = task.logits(outputs).float()
        matrix.update(logits.argmax(-1), target, target != IGNORE)
        for probabilities, truth in zip(logits.softmax(-1).cpu(), target.cpu(), strict=True):
            certainty.update(probabilities, truth, truth != IGNORE)
    for name in ("sums", "nll", "ece"):
        total = processes.sum(torch.from_numpy(getattr(certainty, name)).to(processes.device))
        setattr(certainty, name, total.cpu().numpy())
    counts = processes.sum(torch.from_numpy(matrix.counts).to(processes.device))
    return ConfusionMatrix(num_classes, counts=counts.cpu().numpy().astype(np.int64)), certainty


@torch.no_grad()
def score(
    network: nn.Module,
    loader: DataLoader[Mapping[str, Any]],
    num_classes: int,
    processes: Processes,
    bf16: bool = False,
) -> ConfusionMatrix:
    """Return the confusion matrix of a network over the known voxels of a split, summed over all
    processes.
    """
    network.eval()
    matrix = ConfusionMatrix(num_classes)
    for batch in loader:
        target = target_of(batch, processes.device)
        matrix.update(predict(network, batch, processes.device, bf16), target, target != IGNORE)
    counts = processes.sum(torch.from_numpy(matrix.counts).to(processes.device))
    return ConfusionMatrix(num_classes, counts=counts.cpu().numpy().astype(np.int64))


def predict(network: nn.Module, batch: Batch, device: torch.device, bf16: bool = False) -> Tensor:
    """Return (B, X, Y, Z) class ids for a batch of samples."""
    task = task_of(network)
    inputs = task.arguments(task.prepare(batch, device))
    with torch.autocast(device.type, torch.bfloat16, enabled=bf16):
        return task.labels(network(*inputs))
