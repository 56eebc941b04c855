"""Tables of figures as text, LaTeX and CSV."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass

Cell = str | float


@dataclass(frozen=True)
class Table:
    """Rows under a header. Numbers are percentages; NaN, a figure that is not defined, is written as a dash.

    Attributes:
        title: what the table shows.
        header: names of the columns.
        rows: one per set of predictions: its name, then numbers.
    """

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def texts(self) -> list[list[str]]:
        """Return the rows as text, numbers with two decimals."""
        return [[_text(cell) for cell in row] for row in self.rows]

    def to_csv(self) -> str:
        """Return the table as CSV with a header."""
        buffer = io.StringIO()
        writer = csv.writer(buffer, lineterminator="\n")
        writer.writerow(self.header)
        writer.writerows(self.texts())
        return buffer.getvalue()

    def to_latex(self) -> str:
        r"""Return the table as a LaTeX `tabular` with the lines of the package booktabs (\toprule, \midrule, \bottomrule)."""
        lines = [" & ".join(map(_escape, row)) + r" \\" for row in [list(self.header), *self.texts()]]
        body = "\n".join([r"\toprule", lines[0], r"\midrule", *lines[1:], r"\bottomrule"])
        columns = "l" + "r" * (len(self.header) - 1)
        return f"% {self.title}\n\\begin{{tabular}}{{{columns}}}\n{body}\n\\end{{tabular}}\n"


def _text(cell: Cell) -> str:
    if isinstance(cell, str):
        return cell
    return "-" if math.isnan(cell) else f"{cell:.2f}"


def _escape(text: str) -> str:
    return "".join(f"\\{letter}" if letter in "&%$#_{}" else letter for letter in text)
