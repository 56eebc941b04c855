"""The file that a picture or a page is written to."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from carlasc.errors import ArgumentError, ConflictError


def check_target(out: Path, endings: Sequence[str], overwrite: bool) -> None:
    """Check that a file can be written: its ending, and what exists at its path.

    Raises:
        ArgumentError: another ending, or a folder.
        ConflictError: the file exists, and `overwrite` is not given.
    """
    if out.suffix.lower() not in endings:
        raise ArgumentError("out", expected=f"a file name that ends in {' or '.join(endings)}", found=str(out))
    if out.is_dir():
        raise ArgumentError("out", expected="a file name", found=f"the folder {out}")
    if out.exists() and not overwrite:
        raise ConflictError(
            out, problem="the file exists", advice="choose another name, or replace it with `overwrite=True`"
        )
