"""Tables for terminals of any width: a wide table is transposed or printed in parts, so that no
word is broken.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from carlasc.cli.common import console as stdout
from carlasc.errors import printable

_MOST_COLUMNS = 10  # a table with more columns beside the first is transposed
_TEXT_WIDTH = 16  # a longer text is wrapped at this width or wider, never inside a word
_BORDER = 3  # border and padding of a column, in characters
_NUMBER = re.compile(r"[-+\d.,%]*")

Column = tuple[str, ...]  # the header and the cells


def print_table(
    header: Sequence[str],
    rows: Sequence[Sequence[object]],
    *,
    title: str = "",
    turn: bool = True,
    console: Console | None = None,
) -> None:
    """Print a table whose first column holds the names of the rows.

    A table with more than ten columns beside the first, or one that is wider than the terminal, is
    transposed. If it is still too wide, it is printed in several parts, each of which starts with
    the first column.

    Args:
        header: names of the columns.
        rows: the cells of each row, as many as there are columns. A number with a fraction gets two
            decimals, and None is an empty cell.
        title: printed above the table.
        turn: whether the table may be transposed.
        console: where to print, as wide as the terminal; None for stdout.
    """
    console = console or stdout()
    title = printable(title)
    header = [printable(name) for name in header]
    texts = [list(map(_text, row)) for row in rows]
    columns: list[Column] = list(zip(header, *texts, strict=True))
    if (
        turn
        and texts
        and (len(columns) - 1 > _MOST_COLUMNS or _least_width(columns) > console.width)
    ):
        # paths are too long for a column
        names = [
            header[0],
            *(row[0].replace("/", "/\n") for row in texts),
        ]
        columns = [(name, *cells[1:]) for name, cells in zip(names, [header, *texts], strict=True)]
    if title:  # rich would wrap it at the width of the table
        console.print(Text(title, style="italic"))
    for chosen in _split(columns, console.width):
        table = Table()
        for column, width in zip(chosen, _widths(chosen, console.width), strict=True):
            right = column is not chosen[0] and all(_NUMBER.fullmatch(cell) for cell in column[1:])
            table.add_column(
                Text(column[0]), width=width, overflow="fold", justify="right" if right else "left"
            )
        for cells in zip(*(column[1:] for column in chosen), strict=True):
            table.add_row(*map(Text, cells))
        console.print(table)


def _text(cell: object) -> str:
    if isinstance(cell, float):
        return f"{cell:.2f}"
    return "" if cell is None else printable(str(cell))  # names come from data


def _split(columns: list[Column], width: int) -> Iterator[list[Column]]:
    """Yield as many columns at a time as fit beside the first one, and at least one."""
    first = columns[0]
    rest = columns[1:]
    while rest:
        count = 1
        while count < len(rest) and _least_width([first, *rest[: count + 1]]) <= width:
            count += 1
        yield [first, *rest[:count]]
        rest = rest[count:]


def _least_width(columns: list[Column]) -> int:
    """Return the width of the narrowest table in which these columns can be read."""
    return sum(_least(column) + _BORDER for column in columns) + 1


def _least(column: Column) -> int:
    words = max((cell_len(word) for text in column for word in text.split()), default=0)
    return max(words, min(_most(column[1:]), _TEXT_WIDTH))


def _most(texts: Column) -> int:
    """Return the width at which no text is wrapped."""
    return max((cell_len(line) for text in texts for line in text.splitlines()), default=0)


def _widths(columns: list[Column], width: int) -> list[int]:
    """Return the width of each column: the least that it needs, and for columns with longer texts a
    part of the rest.
    """
    widths = [_least(column) for column in columns]
    spare = width - _least_width(columns)
    while spare > 0 and (
        short := [i for i, column in enumerate(columns) if widths[i] < _most(column)]
    ):
        for index in short[:spare]:
            widths[index] += 1
        spare -= len(short)
    return widths
