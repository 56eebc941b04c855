"""The file or the folder that a picture, a page or a recording is written to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from carlasc.errors import ArgumentError, ConflictError

MAX_FRAMES = 60
"""Frames of a page in one file and of a recording, if the scene gives no range: a few megabytes."""


@dataclass(frozen=True)
class ViewResult:
    """A page or a recording that was written.

    Attributes:
        out: the file, or the folder of a page.
        sequence: path of the sequence.
        panels: titles of the grids in it.
        frames: the frames in it.
        size_bytes: size of the file, or of all files in the folder.
        elapsed_s: duration, seconds.
        notes: choices that were made for options that were not given.
    """

    out: Path
    sequence: str
    panels: tuple[str, ...]
    frames: tuple[int, ...]
    size_bytes: int
    elapsed_s: float
    notes: tuple[str, ...]


def first_frames(frames: tuple[int, ...]) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Return the first `MAX_FRAMES` frames, and a note if there are more."""
    if len(frames) <= MAX_FRAMES:
        return frames, ()
    return frames[:MAX_FRAMES], (f"{len(frames)} frames found, showing the first {MAX_FRAMES}",)


def check_target(out: Path, endings: Sequence[str], overwrite: bool) -> None:
    """Check that a file can be written: its ending, and that its path is free.

    Raises:
        ArgumentError: another ending, or a folder.
        ConflictError: the file exists, and `overwrite` is not given.
    """
    if out.suffix.lower() not in endings:
        raise ArgumentError(
            "out", expected=f"a file name that ends in {' or '.join(endings)}", found=str(out)
        )
    if out.is_dir():
        raise ArgumentError("out", expected="a file name", found=f"the folder {out}")
    if out.exists() and not overwrite:
        raise ConflictError(
            out,
            problem="the file exists",
            advice="choose another name, or replace it with `overwrite=True`",
        )
