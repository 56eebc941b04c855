"""The results of conversions and exports, and the check of the output folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from carlasc.errors import ConflictError


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
        skipped: number of frames that existed before.
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


@dataclass(frozen=True)
class ExportResult:
    """The result of `export`.

    Attributes:
        out: root of the data set that was written.
        sequences: the folder of each sequence in it, or its file where a format has one, by the
            sequence's path in the source.
        made: number of frames that were written.
        skipped: number of frames that existed already.
        failures: frames that could not be written.
        notes: remarks about the result, one line each.
        elapsed_s: duration in seconds.
    """

    out: Path
    sequences: dict[str, str]
    made: int
    skipped: int
    failures: tuple[Failure, ...]
    notes: tuple[str, ...]
    elapsed_s: float


def check_outside(out: Path, source: str) -> None:
    """Check that a folder to write to is neither the source nor inside it.

    A URL is never the same place.

    Raises:
        ConflictError: the folder is the source, or inside it.
    """
    if out.resolve().is_relative_to(Path(source).resolve()):
        raise ConflictError(
            out,
            expected=f"a place outside {source}",
            found="one inside it",
            advice="choose another place, because the source is never written to",
        )
