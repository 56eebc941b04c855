"""What a run of faults found."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

Measured = tuple[str, str, tuple[float, ...], tuple[float, ...]]
"""A command, its size, and for three sizes its CPU time, s, and its largest memory, kB."""


@dataclass(frozen=True)
class Outcome:
    """The result of trying many faults of one kind.

    Attributes:
        kind: which faults: kills, calls, crashes, changes, mutations, hostile.
        tried: number of cases that were really run.
        found: one line per case that failed, with what repeats it (command, seed, number).
        seconds: how long it took.
        commands: number of cases of each command, where cases are of commands.
        measured: what large data cost.
    """

    kind: str
    tried: int
    found: list[str]
    seconds: float
    commands: dict[str, int] = field(default_factory=dict)
    measured: list[Measured] = field(default_factory=list)

    @classmethod
    def of(cls, kind: str, began: float, tried: dict[str, int], found: list[str]) -> Outcome:
        """Return the outcome of commands that were tried since a time of `time.monotonic`."""
        return cls(kind, sum(tried.values()), found, time.monotonic() - began, tried)
