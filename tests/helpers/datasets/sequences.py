"""The small data set of the contract tests, and folders as dictionaries."""

from __future__ import annotations

from pathlib import Path

from carlasc.testing.data import (
    FRAMES,
    SECOND,
    SIZE,
    grid,
    lines,
    params,
    published_bytes,
    scan,
    write_dataset,
)

__all__ = [
    "FRAMES",
    "SECOND",
    "SIZE",
    "files_of",
    "grid",
    "lines",
    "params",
    "published_bytes",
    "scan",
    "write_dataset",
]


def files_of(root: Path) -> dict[str, bytes]:
    """Every file below a folder, by its path."""
    return {
        file.relative_to(root).as_posix(): file.read_bytes()
        for file in sorted(root.rglob("*"))
        if file.is_file()
    }
