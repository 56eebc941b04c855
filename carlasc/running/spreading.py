"""How the work of a run is spread: the options that all functions share which work in parallel, what does the work, and which part.

Nothing of Dask is loaded here, which commands on one machine need not wait for.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, Self, TypeVar

from carlasc.errors import ArgumentError


class DaskClient(Protocol):
    """What is used of a `distributed.Client`."""

    id: str
    status: str

    def map(self, func: Any, *iterables: Any, **kwargs: Any) -> Any:
        """Start tasks."""

    def gather(self, futures: Any) -> Any:
        """Return the results of tasks."""

    def nthreads(self) -> Any:
        """Return the number of threads of each worker."""


class LazyClient:
    """A client that connects when it is first used: a cluster starts no jobs for a run that has nothing to do, or wrong arguments.

    Args:
        connect: returns the client.
    """

    def __init__(self, connect: Callable[[], DaskClient]) -> None:
        self._connect = connect

    @cached_property
    def client(self) -> DaskClient:
        """The client of Dask."""
        return self._connect()


Engine = Executor | DaskClient | LazyClient
"""What does work in parallel: any `concurrent.futures.Executor`, a `distributed.Client` of Dask, or what `open_cluster` yields."""


Item = TypeVar("Item")


@dataclass(frozen=True)
class Part:
    """One of several parts of a run. Together, the parts do each item exactly once, whatever order they run in.

    Attributes:
        number: number of this part, from 1.
        count: number of parts.

    Raises:
        ArgumentError: the number is not between 1 and the count.
    """

    number: int = 1
    count: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.count:
            raise ArgumentError("part", expected="I/N with I from 1 to N, such as 2/4", found=str(self))

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read "2/4".

        Raises:
            ArgumentError: the text is not of this form, or the number is not between 1 and the count.
        """
        match = re.fullmatch(r"([0-9]+)/([0-9]+)", text.strip())
        if match is None:
            raise ArgumentError("part", expected="I/N with I from 1 to N, such as 2/4", found=text)
        return cls(int(match[1]), int(match[2]))

    def take(self, items: Sequence[Item]) -> Sequence[Item]:
        """Return the items of this part: a stretch of them, so that what neighbours share is read by few parts."""
        begin, end = (len(items) * number // self.count for number in (self.number - 1, self.number))
        return items[begin:end]

    def refuse(self, overwrite: bool) -> None:
        """Refuse to replace what exists, where other parts may have made it.

        Raises:
            ArgumentError: something is to be replaced, and there are several parts.
        """
        if self.count > 1 and overwrite:
            raise ArgumentError(
                "overwrite",
                expected="nothing with `part`, because parts would remove what other parts make",
                found="True",
                advice="remove what exists first",
            )

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"


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
    part: Part = Part()
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


class StepCounter:
    """Counts the steps of a run for its progress callback. A stage adds its steps when it knows their number."""

    def __init__(self, progress: Callable[[int, int], None] | None, total: int = 0, done: int = 0) -> None:
        self._progress, self._done, self._total = progress, done, total

    def expect(self, more: int) -> None:
        """Add steps to the total."""
        self._total += more

    def __call__(self, steps: int = 1) -> None:
        """Count finished steps, and report them; none of them reports the total."""
        self._done += steps
        if self._progress is not None:
            self._progress(self._done, self._total)

    def stage(self, expected: int = 0) -> Callable[[int, int], None]:
        """Return the progress callback of a stage that counts its own steps, of which some are in the total already."""
        before, total = self._done, self._total - expected

        def advance(done: int, of: int) -> None:
            self._total = total + of
            self(before + done - self._done)

        return advance


def count_cores() -> int:
    """Return the number of cores that this process may use."""
    cores_of = getattr(os, "sched_getaffinity", None)  # macOS does not say which cores a process may use
    return len(cores_of(0)) if cores_of else os.cpu_count() or 1
