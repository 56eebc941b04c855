"""The paper's two tables, as rows that print, as LaTeX and as CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from carlasc.errors import ArgumentError

if TYPE_CHECKING:
    from carlasc.metrics.evaluation import Evaluation

Cell = str | float


@dataclass(frozen=True)
class Table:
    """Rows under a header. Numbers are percent; NaN stands for "nothing to divide by" and is written as a dash.

    Attributes:
        title: what it shows.
        header: names of the columns.
        rows: one a network: its name, then numbers.
    """

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def texts(self) -> list[list[str]]:
        """Return the rows as text, percent with two decimals."""
        return [[_text(cell) for cell in row] for row in self.rows]

    def to_csv(self) -> str:
        """Return the table as CSV, header first."""
        buffer = io.StringIO()
        writer = csv.writer(buffer, lineterminator="\n")
        writer.writerow(self.header)
        writer.writerows(self.texts())
        return buffer.getvalue()

    def to_latex(self) -> str:
        r"""Return the table as a LaTeX `tabular` between \toprule and \bottomrule (package booktabs)."""
        lines = [" & ".join(map(_escape, row)) + r" \\" for row in [list(self.header), *self.texts()]]
        body = "\n".join([r"\toprule", lines[0], r"\midrule", *lines[1:], r"\bottomrule"])
        columns = "l" + "r" * (len(self.header) - 1)
        return f"% {self.title}\n\\begin{{tabular}}{{{columns}}}\n{body}\n\\end{{tabular}}\n"


def semantic_table(evaluations: Sequence[Evaluation]) -> Table:
    """Return the table of per-class IoU, with mIoU over all classes and over those of things, and accuracy.

    Raises:
        ArgumentError: the evaluations are none, or of different classes.
    """
    classes = {evaluation.classes.name for evaluation in evaluations}
    if len(classes) != 1:
        raise ArgumentError(
            "table", expected="evaluations of one set of classes", found=f"{', '.join(classes) or 'none'}"
        )
    header = ("Network", *evaluations[0].class_iou, "mIoU", "mIoU w/o free", "Accuracy")
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (e.name, *_percent(*e.class_iou.values(), e.miou, e.miou_without_free, e.matrix.accuracy)) for e in evaluations
    )
    return Table("Semantic scene completion: IoU of each class", header, rows)


def geometric_table(evaluations: Sequence[Evaluation]) -> Table:
    """Return the table of completeness: precision, recall and IoU of occupied against free."""
    rows: list[tuple[Cell, ...]] = []
    for evaluation in evaluations:
        found = evaluation.matrix.completeness()
        rows.append((evaluation.name, *_percent(found.precision, found.recall, found.iou)))
    return Table(
        "Scene completion: every class but free is one", ("Network", "Precision", "Recall", "IoU"), tuple(rows)
    )


def _percent(*values: float) -> tuple[float, ...]:
    return tuple(100 * value for value in values)


def _text(cell: Cell) -> str:
    if isinstance(cell, str):
        return cell
    return "-" if math.isnan(cell) else f"{cell:.2f}"


def _escape(text: str) -> str:
    return "".join(f"\\{letter}" if letter in "&%$#_{}" else letter for letter in text)
