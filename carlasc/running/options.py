"""How the work of a run is spread: the options that all functions share which work in parallel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

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
    """

    workers: int | None = None
    executor: Engine | None = None
    part: Part = Part()  # noqa: RUF009 (frozen)
    progress: Callable[[int, int], None] | None = None
