"""Numbers of the landing page and the README that are cells of tables of the studies."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[3]

# key -> page, row and column of the first table that has both
CELLS = {
    "cell.network.tube": ("docs/studies/networks.md", "tube", "Vehicles"),
    "cell.network.align": ("docs/studies/networks.md", "align", "Vehicles"),
    "cell.false.tube": ("docs/studies/movers.md", "tube", "wrongly Vehicle"),
    "cell.false.align": ("docs/studies/movers.md", "align, free space", "wrongly Vehicle"),
    "cell.path.tube": ("docs/studies/movers.md", "`tube`", "own path"),
    "cell.path.align": ("docs/studies/movers.md", "`align`, free space, unlabelled", "own path"),
}


def texts() -> dict[str, str]:
    """Return the number of each cell, without its spread."""
    return {key: _number(*cell) for key, cell in CELLS.items()}


def _number(page: str, row: str, column: str) -> str:
    """Return the number in a cell of a page.

    Raises:
        KeyError: no table has the row and the column.
    """
    header: list[str] = []
    for line in (ROOT / page).read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")] if line[:1] == "|" else []
        header = (header or cells) if cells else []
        if cells[:1] == [row] and column in header:
            number = cells[header.index(column)].split(" ")[0]
            return f"{int(number):,}" if re.fullmatch(r"\d{4,}", number) else number
    raise KeyError(f"{page}: no table has the row {row} and the column {column}")
