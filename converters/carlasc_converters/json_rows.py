"""Rows of large JSON tables, one after the other, so that only the values that are kept need
memory.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from carlasc.errors import FormatError
from carlasc_converters.files import opening

_CHUNK = 1 << 20  # characters read at a time
_LONGEST_ROW = 4 * _CHUNK
_TOO_LARGE = 2**63  # numbers from here on do not fit into 64 bits
_GAP = re.compile(r"[\s,]*")
_EXPECTED = "a JSON list of objects"
_OTHER = "the file is damaged, or belongs to another version of the data set"
_UNPACK = "the file may be cut short: unpack the archive of the tables again"


def read_rows(
    path: Path, keys: tuple[str, ...], kinds: Mapping[str, type | int] | None = None
) -> Iterator[tuple[Any, ...]]:
    """Yield the values of some keys of each row of a table: a JSON list of objects.

    Args:
        path: the file, in UTF-8.
        keys: keys that each object must have. Others are ignored.
        kinds: the type of the value of a key, or N for a list of N numbers; text for other keys.

    Yields:
        The values in the order of `keys`.

    Raises:
        MissingDataError: the file does not exist.
        FormatError: the file is not a list of objects or is cut short, or an object lacks a key or
            has a wrong value.
    """
    wanted = [(kinds or {}).get(key, str) for key in keys]
    for number, row in enumerate(_objects(path)):
        try:
            values = tuple(row[key] for key in keys)
            for key, value, kind in zip(keys, values, wanted, strict=True):
                if not _is_of(value, kind):
                    name = (
                        f"a list of {kind} numbers"
                        if isinstance(kind, int)
                        else f"a value of type {kind.__name__}"
                    )
                    found = f"{str(value)[:40]!r} in row {number}"
                    raise FormatError(
                        path, expected=f"{name} under {key!r}", found=found, advice=_OTHER
                    )
            yield values
        except KeyError as error:
            found = f"{', '.join(row)} in row {number}"
            raise FormatError(
                path, expected=f"the key {error} in each row", found=found, advice=_OTHER
            ) from error


def _is_of(value: object, kind: type | int) -> bool:
    """Return whether a value is of a type, or a list of the given length of numbers."""
    if kind in (int, float):
        return _is_number(value) and isinstance(value, int | float if kind is float else int)
    if isinstance(kind, type):
        return isinstance(value, kind) and (kind is bool or not isinstance(value, bool))
    return isinstance(value, list) and len(value) == kind and all(map(_is_number, value))


def _is_number(value: object) -> bool:
    """Return whether a value is a finite number that fits into 64 bits."""
    return (
        isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < _TOO_LARGE
    )


def _objects(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the objects of a list."""
    decode = json.JSONDecoder().raw_decode
    count = 0
    with opening(path, _EXPECTED, _UNPACK), path.open(encoding="utf-8-sig") as file:
        text = file.read(_CHUNK).lstrip()
        if not text.startswith("["):
            raise FormatError(path, expected=_EXPECTED, found=repr(text[:20]))
        at = 1
        while text[(at := _end_of_gap(text, at)) : at + 1] != "]":
            try:
                row, at = decode(text, at)
            except (
                json.JSONDecodeError
            ) as error:  # the row goes on in the next chunk, or is damaged
                more = file.read(_CHUNK) if len(text) - at < _LONGEST_ROW else ""
                if not more:
                    found = f"text that ends or is damaged after {count} rows ({error.msg})"
                    raise FormatError(
                        path, expected=_EXPECTED, found=found, advice=_UNPACK
                    ) from error
                text = text[at:] + more
                at = 0
                continue
            if not isinstance(row, dict):
                raise FormatError(
                    path, expected=_EXPECTED, found=f"{type(row).__name__} in row {count}"
                )
            yield row
            count += 1


def _end_of_gap(text: str, at: int) -> int:
    """Return where the next value begins: after spaces and the comma between values."""
    gap = _GAP.match(text, at)
    return gap.end() if gap else at
