"""Numbers and names in messages."""

from __future__ import annotations

from collections.abc import Iterable


def count(number: int, noun: str, plural: str = "") -> str:
    """Return "1 frame", "2 frames"."""
    return f"{number:,} {noun if number == 1 else plural or f'{noun}s'}"


def first_names(names: Iterable[str], most: int = 8) -> str:
    """Return names separated by commas, without those after the first few."""
    names = list(names)
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
