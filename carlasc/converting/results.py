"""The results of a conversion or an export, and the counting of their steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Failure:
    """A frame that could not be converted or exported.

    Attributes:
        sequence: location of its sequence in the source.
        frame: its number.
        message: the error, in one line.
    """

    sequence: str
    frame: int
    message: str


@dataclass(frozen=True)
class ConvertResult:
    """The result of `convert`.

    Attributes:
        sequences: locations of the sequences that were written.
        made: number of frames that were converted.
        skipped: number of frames that existed already.
        failures: frames that could not be converted, or whose grid could not be made.
        grids: locations of the grids that were made from scans.
        notes: remarks about the result, one line each.
        elapsed_s: duration in seconds.
    """

    sequences: tuple[str, ...]
    made: int
    skipped: int
    failures: tuple[Failure, ...]
    grids: tuple[str, ...]
    notes: tuple[str, ...]
    elapsed_s: float


class Steps:
    """Counts the steps of several stages for one progress callback. A stage adds its steps when it knows their number."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._done, self._total = progress, 0, total

    def expect(self, more: int) -> None:
        """Add steps to the total."""
        self._total += more

    def __call__(self, steps: int = 1) -> None:
        """Count finished steps, and report them."""
        self._done += steps
        if self._progress:
            self._progress(self._done, self._total)
