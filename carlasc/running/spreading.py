"""How the work of a run is distributed: the options of all parallel functions, the executor, and
the part of the work.

This module does not import Dask, so that commands on one machine start fast.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from typing import Any, Protocol, Self, TypeVar

from carlasc.errors import ArgumentError, check_types


class DaskClient(Protocol):
    """The methods of `distributed.Client` that carlasc uses."""

    id: str
    status: str

    def map(self, func: Any, *iterables: Any, **kwargs: Any) -> Any:
        """Start tasks."""

    def gather(self, futures: Any) -> Any:
        """Return the results of tasks."""

    def nthreads(self) -> Any:
        """Return the number of threads of each worker."""


class LazyClient:
    """A client that connects on first use, so that a cluster starts no jobs for a run without work
    or with wrong arguments.

    Args:
        connect: returns the client.
    """

    def __init__(self, connect: Callable[[], DaskClient | Executor]) -> None:
        self._connect = connect

    @cached_property
    def client(self) -> DaskClient | Executor:
        """The client of Dask, or the executor of Ray, connected on first access."""
        return self._connect()


Engine = Executor | DaskClient | LazyClient
"""An executor of parallel work: any `concurrent.futures.Executor`, a `distributed.Client` of Dask,
or the result of `open_cluster`.
"""


Item = TypeVar("Item")

Progress = Callable[[int, int], None]
"""Takes the numbers of steps that are done, and of all."""


@dataclass(frozen=True)
class Part:
    """One of several parts of a run.

    Together, the parts process each item exactly once, in any order.

    Attributes:
        number: number of this part, from 1.
        count: number of parts.

    Raises:
        ArgumentError: the number is not from 1 to the count.
    """

    number: int = 1
    count: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.count:
            raise ArgumentError("part", expected="I/N with I from 1 to N, such as 2/4", found=self)

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read "2/4".

        Raises:
            ArgumentError: the text is not of this form, or the number is not between 1 and the
                count.
        """
        match = re.fullmatch(r"([0-9]+)/([0-9]+)", text.strip())
        if match is None:
            raise ArgumentError("part", expected="I/N with I from 1 to N, such as 2/4", found=text)
        return cls(int(match[1]), int(match[2]))

    def take(self, items: Sequence[Item]) -> Sequence[Item]:
        """Return the items of this part.

        They are consecutive, because neighbouring items often read the same data.
        """
        begin, end = (
            len(items) * number // self.count for number in (self.number - 1, self.number)
        )
        return items[begin:end]

    def share(self, names: Sequence[str]) -> tuple[list[str], Part]:
        """Return the names of this part, and how it shares each of them with other parts.

        Whole names are dealt by a digest of each, so that a name stays in its part when others are
        added. If the parts outnumber the names, several parts share one name.

        Args:
            names: names of sequences.

        Returns:
            The names of this part, and which part of each it does.
        """
        size = len(names)
        if self.count > size > 0:
            index = (self.number - 1) * size // self.count
            first, end = (-(-at * self.count // size) for at in (index, index + 1))
            return [names[index]], Part(self.number - first, end - first)
        own = [name for name in names if self.count == 1 or self._owns(name)]
        return own, Part()

    def _owns(self, name: str) -> bool:
        digest = sha256(name.encode(errors="surrogateescape")).digest()
        return int.from_bytes(digest[:8], "big") % self.count == self.number - 1

    def refuse(self, overwrite: bool) -> None:
        """Check that `overwrite` is not combined with several parts, because a part would remove
        the output of others.

        Raises:
            ArgumentError: `overwrite` is given, and the run has several parts.
        """
        if self.count > 1 and overwrite:
            raise ArgumentError(
                "overwrite",
                expected="False with `part`, because parts would remove the output of other parts",
                found="True",
                advice="remove the existing output first",
            )

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"


@dataclass(frozen=True)
class Run:
    """How the work of a run is distributed, and its progress callback.

    Attributes:
        workers: number of processes; None for one per core. With an executor: the number of its
            workers.
        executor: executor of the work, instead of new processes; it is not shut down. None starts
            new processes.
        part: the part of the work to do; other commands do the other parts, at the same time or
            later.
        sequences_from: file with the folders of the sequences to work on, relative to the source,
            one per line. If it does not exist, it is written, so that the other parts need not list
            the source. None: the source is listed.
        progress: called with the number of finished steps and the number of all steps.

    Raises:
        ArgumentError: `workers` is not positive.
    """

    workers: int | None = None
    executor: Engine | None = None
    part: Part = Part()
    sequences_from: str | os.PathLike[str] | None = None
    progress: Progress | None = None

    def __post_init__(self) -> None:
        check_types(Run, vars(self))
        if self.workers is not None and self.workers < 1:
            raise ArgumentError("workers", expected="at least 1", found=self.workers)

    @property
    def processes(self) -> int:
        """Number of processes: `workers`, or one per core that this process may use."""
        return count_cores() if self.workers is None else self.workers

    @property
    def is_share(self) -> bool:
        """Whether the run may work on some sequences of its source only."""
        return self.part.count > 1 or self.sequences_from is not None

    @property
    def is_alone(self) -> bool:
        """Whether all work runs in this process."""
        return self.executor is None and self.processes == 1


class StepCounter:
    """Counts the steps of a run for its progress callback.

    A stage adds its steps as soon as their number is known.
    """

    def __init__(self, progress: Progress | None, total: int = 0, done: int = 0) -> None:
        self._progress = progress
        self._done = done
        self._total = total

    def expect(self, more: int) -> None:
        """Add steps to the total."""
        self._total += more

    def __call__(self, steps: int = 1) -> None:
        """Count finished steps, and report progress. With `steps=0`, only report."""
        self._done += steps
        if self._progress is not None:
            self._progress(self._done, self._total)

    def stage(self, expected: int = 0) -> Progress:
        """Return the progress callback of a stage that counts its own steps.

        `expected` of them are already in the total.
        """
        before = self._done
        total = self._total - expected

        def advance(done: int, of: int) -> None:
            self._total = total + of
            self(before + done - self._done)

        return advance


def count_cores() -> int:
    """Return the number of cores that this process may use."""
    cores_of = getattr(os, "sched_getaffinity", None)  # macOS has no such function
    return len(cores_of(0)) if cores_of else os.cpu_count() or 1


def check_shared(location: str, run: Run) -> None:
    """Check that all processes of a run can access the output: `memory://` exists in one process
    only.

    Raises:
        ArgumentError: the output is in memory, and the run has several processes.
    """
    if location.startswith("memory://") and not run.is_alone:
        found = "an executor" if run.executor is not None else str(run.processes)
        raise ArgumentError(
            "workers", expected=f"1 with {location}, which exists in one process only", found=found
        )
