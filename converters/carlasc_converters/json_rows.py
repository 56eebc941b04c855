"""Rows of large JSON tables, one after the other, so that a table of a gigabyte needs no more memory than what is kept of it."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from carlasc.errors import FormatError, MissingDataError

_CHUNK = 1 << 20  # characters read at a time
_LONGEST_ROW = 4 * _CHUNK
_GAP = re.compile(r"[\s,]*")
_EXPECTED = "a JSON list of objects"
_UNPACK = "the file may be cut short: unpack the archive of the tables again"


def read_rows(path: Path, keys: tuple[str, ...]) -> Iterator[tuple[Any, ...]]:
    """Yield the values of some keys of each row of a table: a JSON list of objects.

    Args:
        path: the file, in UTF-8.
        keys: keys that each object must have. Others are ignored.

    Yields:
        The values in the order of `keys`.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: it is not a list of objects, breaks off, or an object lacks a key.
    """
    for number, row in enumerate(_objects(path)):
        try:
            yield tuple(row[key] for key in keys)
        except KeyError as error:
            found = f"{', '.join(row)} in row {number}"
            advice = "the file belongs to another version of the data set"
            raise FormatError(path, expected=f"the key {error} in each row", found=found, advice=advice) from error


def _objects(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the objects of a list."""
    decode, count = json.JSONDecoder().raw_decode, 0
    try:
        with path.open(encoding="utf-8-sig") as file:
            text = file.read(_CHUNK).lstrip()
            if not text.startswith("["):
                raise FormatError(path, expected=_EXPECTED, found=repr(text[:20]))
            at = 1
            while text[(at := _end_of_gap(text, at)) : at + 1] != "]":
                try:
                    row, at = decode(text, at)
                except json.JSONDecodeError as error:  # the row goes on in the next chunk, or is damaged
                    more = file.read(_CHUNK) if len(text) - at < _LONGEST_ROW else ""
                    if not more:
                        found = f"text that ends or is damaged after {count} rows ({error.msg})"
                        raise FormatError(path, expected=_EXPECTED, found=found, advice=_UNPACK) from error
                    text, at = text[at:] + more, 0
                    continue
                if not isinstance(row, dict):
                    raise FormatError(path, expected=_EXPECTED, found=f"{type(row).__name__} in row {count}")
                yield row
                count += 1
    except FileNotFoundError:
        raise MissingDataError(path, expected="a table", found="no such file", advice=_UNPACK) from None
    except UnicodeDecodeError as error:
        raise FormatError(path, expected="text in UTF-8", found=f"something else ({error})", advice=_UNPACK) from error


def _end_of_gap(text: str, at: int) -> int:
    """Return where the next value begins: after spaces and the comma between values."""
    gap = _GAP.match(text, at)
    return gap.end() if gap else at
