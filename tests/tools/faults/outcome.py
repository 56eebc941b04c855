"""What a run of faults found."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Outcome:
    """The result of trying many faults of one kind.

    Attributes:
        kind: which faults: kills, calls, crashes, changes, mutations, hostile.
        tried: number of cases that were really run.
        found: one line per case that failed, with what repeats it (command, seed, number).
        seconds: how long it took.
    """

    kind: str
    tried: int
    found: list[str]
    seconds: float
