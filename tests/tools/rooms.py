"""`python tests/tools/rooms.py`: write the tokens of each room into the table of docs/design.md.

The mass of code is counted in tokens: names, operators and numbers. Comments, docstrings and line
breaks cost nothing, so that nobody saves lines at the reader's expense.
"""

from __future__ import annotations

import re
import tokenize
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "design.md"
GROWTH = 0.05  # of a room, beyond what the page says; fact: room-growth
COUNTED = (tokenize.NAME, tokenize.OP, tokenize.NUMBER)
# the name, two cells of text, and the tokens, which a new row may lack
_ROW = re.compile(r"^(\| `([\w/]+)` \|[^|\n]*\|[^|\n]*\|)(?: *([\d,]*) \|)?$", re.MULTILINE)


@dataclass(frozen=True)
class Mass:
    """What code weighs.

    Attributes:
        tokens: number of names, operators and numbers.
        lines: number of lines with such a token.
    """

    tokens: int
    lines: int


@cache
def mass(path: Path) -> Mass:
    """Return the mass of a file, or of all Python files of a folder."""
    if path.is_dir():
        found = [mass(file) for file in sorted(path.rglob("*.py"))]
        return Mass(sum(one.tokens for one in found), sum(one.lines for one in found))
    with tokenize.open(path) as file:
        rows = [
            token.start[0]
            for token in tokenize.generate_tokens(file.readline)
            if token.type in COUNTED
        ]
    return Mass(len(rows), len(set(rows)))


def mass_of_room(room: str) -> Mass:
    """Return the mass of a room of `carlasc/`, or of a folder with a slash at its end."""
    if room.endswith("/"):
        return mass(ROOT / room)
    return mass(
        next(
            path
            for path in (ROOT / "carlasc" / room, ROOT / "carlasc" / f"{room}.py")
            if path.exists()
        )
    )


def table(text: str) -> dict[str, int]:
    """Return the tokens that a page gives for each room."""
    return {room: int(tokens.replace(",", "") or 0) for _, room, tokens in _ROW.findall(text)}


def fill(text: str) -> str:
    """Return the text of a page with the tokens of each room as they are now."""
    return _ROW.sub(lambda row: f"{row[1]} {mass_of_room(row[2]).tokens:,} |", text)


if __name__ == "__main__":
    PAGE.write_text(fill(PAGE.read_text()))
