"""How the work of a run is spread: the options that all functions share which work in parallel."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass

from carlasc.errors import ArgumentError
from carlasc.running.engines import Engine
from carlasc.running.parts import Part


@dataclass(frozen=True)
class Run:
    """How the work of a run is spread, and who is told of its progress.

    Attributes:
        workers: number of processes; None for one per core. With an executor: the number of its workers.
        executor: runs the work instead of processes of our own; it is not shut down.
        part: does only this part of the work; other commands do the others, at the same time or not.
        progress: called with the number of finished steps and the number of all steps.

    Raises:
        ArgumentError: `workers` is not positive.
    """

    workers: int | None = None
    executor: Engine | None = None
    part: Part = Part()  # noqa: RUF009 (frozen)
    progress: Callable[[int, int], None] | None = None

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise ArgumentError("workers", expected="at least 1", found=str(self.workers))

    @property
    def processes(self) -> int:
        """Number of processes: `workers`, or one per core that this process may use."""
        return count_cores() if self.workers is None else self.workers

    @property
    def is_alone(self) -> bool:
        """Whether all work is done in this process."""
        return self.executor is None and self.processes == 1


def count_cores() -> int:
    """Return the number of cores that this process may use."""
    cores_of = getattr(os, "sched_getaffinity", None)  # macOS does not say which cores a process may use
    return len(cores_of(0)) if cores_of else os.cpu_count() or 1
