"""What a conversion or an export did, and how far it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Failure:
    """A frame that could not be converted.

    Attributes:
        sequence: where its source is.
        frame: its number.
        message: what is wrong, in one line.
    """

    sequence: str
    frame: int
    message: str


@dataclass(frozen=True)
class ConvertResult:
    """What `convert` did.

    Attributes:
        sequences: where the sequences are now.
        made: frames that were converted now.
        skipped: frames that were there already.
        failures: frames that could not be converted, or not be gridded.
        grids: where grids were made from scans.
        notes: what the reader should know.
        elapsed_s: how long it took, seconds.
    """

    sequences: tuple[str, ...]
    made: int
    skipped: int
    failures: tuple[Failure, ...]
    grids: tuple[str, ...]
    notes: tuple[str, ...]
    elapsed_s: float


class Steps:
    """Counts the steps of several stages for one progress callback; a stage's steps are added when they are known."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._done, self._total = progress, 0, total

    def expect(self, more: int) -> None:
        """Add steps to come."""
        self._total += more

    def __call__(self, steps: int = 1) -> None:
        """Say that so many steps are done."""
        self._done += steps
        if self._progress:
            self._progress(self._done, self._total)
