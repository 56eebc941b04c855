"""Arrays of .npz files. No pickle is read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from carlasc.errors import FormatError, MissingDataError
from carlasc.storage.arrays import ArrayFormat, open_npz


def read_arrays(path: str | Path, formats: Mapping[str, ArrayFormat], advice: str) -> list[NDArray[Any]]:
    """Return some arrays of an .npz file, in the order of their names.

    Args:
        path: the file.
        formats: what each array that it must have is, by its name.
        advice: what to do if the file is missing or damaged.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: it is no .npz file, is damaged, or lacks an array; or an array has another type, shape or size.
    """
    try:
        with open_npz(path) as arrays:
            return [arrays.read(name, expected) for name, expected in formats.items()]
    except (MissingDataError, FormatError) as error:
        error.advice = error.advice or advice
        raise
