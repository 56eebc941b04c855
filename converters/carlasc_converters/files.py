"""Reading the files of other data sets: what the system or another library says of them becomes an error that names the file."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from carlasc.errors import MissingDataError, reading

COPY = "the file may be cut short: copy it again"


@contextmanager
def opening(path: str | os.PathLike[str], expected: str, advice: str = COPY) -> Iterator[None]:
    """Turn whatever goes wrong in a block that opens and interprets one file into an error of carlasc.

    Args:
        path: the file.
        expected: what it should hold.
        advice: what to do if it does not, or does not exist.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: it cannot be read, or does not hold what it should.
    """
    with reading(path, expected, advice):
        try:
            yield
        except FileNotFoundError:
            raise MissingDataError(path, expected=expected, found="nothing", advice=advice) from None


def read_bytes(path: str | os.PathLike[str], expected: str = "a file", advice: str = COPY) -> bytes:
    """Return a whole file.

    Raises:
        MissingDataError: it does not exist.
        FormatError: it cannot be read.
    """
    with opening(path, expected, advice):
        return Path(path).read_bytes()


def read_text(path: str | os.PathLike[str], expected: str = "a text file", advice: str = COPY) -> str:
    """Return a whole text file in UTF-8.

    Raises:
        MissingDataError: it does not exist.
        FormatError: it cannot be read, or is not text.
    """
    with opening(path, expected, advice):
        return Path(path).read_text("utf-8")
