"""One or more training processes, and their communication."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor


@dataclass(frozen=True)
class Processes:
    """The processes of a run, and which of them this one is.

    Attributes:
        rank: number of this process.
        world: number of processes.
        device: the device of this process.
    """

    rank: int
    world: int
    device: torch.device

    @property
    def first(self) -> bool:
        """Whether this is the process that writes files and prints."""
        return self.rank == 0

    def sum(self, value: Tensor) -> Tensor:
        """Return the sum of the tensors of all processes."""
        if self.world > 1:
            value = value.clone()
            dist.all_reduce(value)
        return value

    def share(self, tensors: Iterable[Tensor]) -> None:
        """Copy the tensors of the first process to all others: the statistics of batch norms
        differ, because each process has other batches.
        """
        if self.world > 1:
            for tensor in tensors:
                dist.broadcast(tensor, 0)

    def wait(self) -> None:
        """Wait until every process has reached this call."""
        if self.world > 1:
            dist.barrier()


@contextmanager
def join_processes(device: str = "auto") -> Iterator[Processes]:
    """Join the processes that `torchrun` started; without it, this is the only process.

    Args:
        device: "cuda", "cpu", or "auto": a GPU if one is available. Under torchrun, each process
            uses its own GPU.
    """
    name = ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device
    world, local = int(os.environ.get("WORLD_SIZE", "1")), int(os.environ.get("LOCAL_RANK", "0"))
    if world == 1:
        yield Processes(0, 1, torch.device(name))
        return
    own = torch.device(name, local) if name == "cuda" else torch.device(name)
    if own.type == "cuda":
        torch.cuda.set_device(own)
    options: dict[str, Any] = {"device_id": own} if own.type == "cuda" else {}
    dist.init_process_group("nccl" if own.type == "cuda" else "gloo", **options)
    try:
        yield Processes(dist.get_rank(), dist.get_world_size(), own)
    finally:
        dist.destroy_process_group()
