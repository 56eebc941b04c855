"""A table of several results, as Markdown, LaTeX, or HTML with a small chart of the IoU of each
class.
"""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from carlasc.core.notebook import data_frame
from carlasc.errors import ArgumentError, FormatError, MissingDataError, check_types
from carlasc.metrics.results import Cell, FigureTable
from carlasc.storage.files import AnyPath, parse_json

if TYPE_CHECKING:
    import pandas

_FIGURES = {
    "miou": "mIoU",
    "iou": "IoU",
    "precision": "Precision",
    "recall": "Recall",
    "false_free": "False free",
}
_REQUIRED = ("name", "convention", "frames", "class_iou", *_FIGURES)
# pixels: width of a bar, and height of the chart
_BAR = 7
_HEIGHT = 24


@dataclass(frozen=True)
class ScoreTable:
    """Results of several predictions in one table.

    Attributes:
        convention: name of the convention; several names, joined by commas, if mixing was allowed.
        results: result of `Evaluation.to_dict` for each prediction.
    """

    convention: str
    results: tuple[Mapping[str, Any], ...]

    @property
    def class_names(self) -> list[str]:
        """The classes of all results, in the order of the first result."""
        return list(dict.fromkeys(name for result in self.results for name in result["class_iou"]))

    def table(self, *, classes: bool = True) -> FigureTable:
        """Return the scores in percent, one row per result. `classes` adds a column per class."""
        rayed = any(result.get("rayiou") is not None for result in self.results)
        mixed = len({result["convention"] for result in self.results}) > 1
        names = self.class_names if classes else []
        header = ["Network", *["Convention"] * mixed, *names, *_FIGURES.values()]
        header += ["RayIoU"] * rayed
        rows: list[tuple[Cell, ...]] = []
        for result in self.results:
            values = [result["class_iou"].get(name) for name in names]
            values += [result[figure] for figure in _FIGURES] + [result.get("rayiou")] * rayed
            cells = [math.nan if value is None else 100 * value for value in values]
            rows.append((str(result["name"]), *[str(result["convention"])] * mixed, *cells))
        return FigureTable(
            f"Scores by the convention {self.convention} (percent)", tuple(header), tuple(rows)
        )

    def to_pandas(self) -> pandas.DataFrame:
        """Return one row per result, with the columns of `table`.

        Scores are fractions, NaN if undefined.

        Raises:
            DependencyError: pandas is not installed.
        """
        table = self.table()
        rows = (dict(zip(table.header, row, strict=True)) for row in table.rows)
        fractions = (
            {name: cell / 100 if isinstance(cell, float) else cell for name, cell in row.items()}
            for row in rows
        )
        return data_frame(fractions, table.header[0])

    def to_html(self) -> str:
        """Return a self-contained HTML page: the scores, and a bar chart of classes for each
        result.
        """
        table = self.table(classes=False)
        header = "".join(
            f"<th>{html.escape(name)}</th>" for name in (*table.header, "IoU of each class")
        )
        rows = ""
        for cells, result in zip(table.texts(), self.results, strict=True):
            shown = "".join(f"<td>{html.escape(cell)}</td>" for cell in cells)
            rows += f"<tr>{shown}<td>{self._chart(result)}</td></tr>\n"
        return _PAGE.format(title=html.escape(table.title), header=header, rows=rows)

    def _chart(self, result: Mapping[str, Any]) -> str:
        bars = ""
        for place, name in enumerate(self.class_names):
            iou = result["class_iou"].get(name)
            height = 0.0 if iou is None else iou * _HEIGHT
            text = f"{name}: {'-' if iou is None else f'{100 * iou:.1f}'}"
            bars += (
                f'<rect x="{place * _BAR}" y="{_HEIGHT - height:.1f}" width="{_BAR - 2}" '
                f'height="{max(height, 0.6):.1f}">'
                f"<title>{html.escape(text)}</title></rect>"
            )
        width = len(self.class_names) * _BAR
        size = f'width="{width}" height="{_HEIGHT}"'
        return f'<svg {size} role="img" aria-label="IoU of each class">{bars}</svg>'


def scores(files: AnyPath | Iterable[AnyPath], *, mixed: bool = False) -> ScoreTable:
    """Read the results of several evaluations (`carlasc evaluate --json`) into one table.

    Args:
        files: JSON files, or one.
        mixed: allow results by different conventions, which cannot be compared, and show the
            convention of each.

    Raises:
        ArgumentError: the conventions differ, so the results cannot be compared, and `mixed` is not
            given.
        FormatError: a file is not a result of an evaluation.
        MissingDataError: a file does not exist, or none was given.
    """
    check_types(scores, locals())
    files = [files] if isinstance(files, str | PathLike) else files
    results = tuple(_read(Path(file)) for file in files)
    if not results:
        raise MissingDataError(
            "files", expected="results of `carlasc evaluate --json`", found="none"
        )
    conventions = sorted({str(result["convention"]) for result in results})
    if len(conventions) > 1 and not mixed:
        raise ArgumentError(
            "files",
            expected="results by one convention",
            found=", ".join(conventions),
            advice="score them by the same convention, or give `mixed=True` to print them side by "
            "side",
        )
    return ScoreTable(", ".join(conventions), results)


def _read(file: Path) -> dict[str, Any]:
    try:
        values = parse_json(file.read_bytes(), str(file))
    except FileNotFoundError as error:
        raise MissingDataError(
            file, expected="a result of `carlasc evaluate --json`", found="nothing"
        ) from error
    except OSError as error:
        raise FormatError(file, problem=f"cannot be read: {error.strerror}") from error
    if missing := [key for key in _REQUIRED if key not in values]:
        raise FormatError(
            file,
            expected="a result of `carlasc evaluate --json`",
            found=f"JSON without {', '.join(missing[:3])}",
        )
    for key, kind in {"name": str, "convention": str, "class_iou": dict}.items():
        if not isinstance(values[key], kind):
            found = type(values[key]).__name__
            raise FormatError(file, expected=f"a {kind.__name__} under {key}", found=found)
    figures = {figure: values.get(figure) for figure in (*_FIGURES, "rayiou")} | values["class_iou"]
    for name, value in figures.items():
        if value is not None and not (isinstance(value, int | float) and 0 <= value <= 1):
            raise FormatError(
                file,
                expected=f"a fraction from 0 to 1, or null, for {name}",
                found=repr(value)[:40],
            )
    return values


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>
body {{ font: 14px/1.4 sans-serif; margin: 2em; color: #222; background: #fff }}
table {{ border-collapse: collapse }}
th, td {{ padding: .35em .8em; border-bottom: 1px solid #ddd; text-align: right }}
th:first-child, td:first-child {{ text-align: left }} rect {{ fill: #3566a8 }}
caption {{ text-align: left; padding: .5em 0 }}
</style></head><body><table><caption>{title}</caption><thead><tr>{header}</tr></thead><tbody>
{rows}</tbody></table></body></html>
"""
