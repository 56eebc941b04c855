"""The figures, with how and where each was measured: docs/figures.json."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from faults import figures as faults

from measuring.places import fill, keys, typed_by_hand

ROOT = Path(__file__).parents[3]
FILE = ROOT / "docs" / "figures.json"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
STRICT = (ROOT / "README.md", ROOT / "docs" / "performance.md")
"""Pages whose every figure comes from a run, or from the history."""

HISTORY = "history"
"""The run of figures that cannot be measured again, because what they compare with is gone. They have a date and a machine of their own."""


@dataclass(frozen=True)
class Figure:
    """A figure.

    Attributes:
        value: what was measured; the lower end of a range.
        unit: "s", "ms", "MB", "%", or "" for a ratio or a number.
        how: what was measured, and how, in a line.
        high: the upper end of a range; None for a single value.
        run: the run that measured it.
        date: of a figure of the history: when it was measured.
        machine: of a figure of the history: where.
    """

    value: float
    unit: str
    how: str
    high: float | None = None
    run: str = ""
    date: str | None = None
    machine: str | None = None

    def __str__(self) -> str:
        if self.high is None or _number(self.value) == _number(self.high):
            text = _number(self.value)
        else:
            text = f"{_number(self.value)} to {_number(self.high)}"
        return f"{text} {self.unit}".strip()


def _number(value: float) -> str:
    """Return a number with two digits, or three if it is large, which is as much as a time repeats."""
    if value >= 99.5:
        return f"{float(f'{value:.3g}'):,.0f}"
    if value >= 0.0995:
        return f"{value:.{0 if value >= 9.95 else 1 if value >= 0.995 else 2}f}"
    return f"{value:.2g}"


def within(figures: Iterable[Figure], how: str) -> Figure:
    """Return the range of several figures of one unit."""
    found = list(figures)
    return Figure(min(f.value for f in found), found[0].unit, how, high=max(f.value for f in found))


def ratio(slower: Figure, faster: Figure, how: str) -> Figure:
    """Return how many times as long one takes as another."""
    return Figure(slower.value / faster.value, "", how)


@dataclass(frozen=True)
class Figures:
    """All figures.

    Attributes:
        runs: the processor, its cores, the load, versions, the size and the date of each run, by its name.
        figures: each figure by its key.
        others: for each page, the numbers with units in its text that no run measures: limits and settings of the code, facts of data sets,
            results of the studies in docs/studies, and times that were measured once by hand.
    """

    runs: dict[str, dict[str, Any]]
    figures: dict[str, Figure]
    others: dict[str, list[str]]

    @classmethod
    def read(cls, file: Path = FILE) -> Figures:
        """Read the file; there are none if it does not exist."""
        if not file.exists():
            return cls({}, {}, {})
        held = json.loads(file.read_text())
        figures = {key: Figure(**figure) for key, figure in held["figures"].items()}
        return cls(held["runs"], figures, held["others"])

    def updated(self, run: Mapping[str, Any], measured: Mapping[str, Figure]) -> Figures:
        """Return them with what a run measured in place of older figures, without runs of which nothing is left."""
        name = f"{run['date']} {run['size']}"
        new = {key: dataclasses.replace(figure, run=name) for key, figure in measured.items()}
        figures = dict(sorted((self.figures | new).items()))
        used = {figure.run for figure in figures.values()} - {HISTORY}
        runs = {key: held for key, held in (self.runs | {name: dict(run)}).items() if key in used}
        return Figures(runs, figures, self.others)

    def accepting(self) -> Figures:
        """Return them with the numbers that the pages hold now outside of their places."""
        found = {path: sorted(set(typed(path))) for path in PAGES}
        return dataclasses.replace(
            self, others={path.relative_to(ROOT).as_posix(): texts for path, texts in found.items() if texts}
        )

    def write(self, file: Path = FILE) -> None:
        """Write the file."""
        rows = {
            key: {
                name: _rounded(value)
                for name, value in dataclasses.asdict(figure).items()
                if value is not None and value != ""
            }
            | {"unit": figure.unit}
            for key, figure in self.figures.items()
        }
        file.write_text(json.dumps({"runs": self.runs, "figures": rows, "others": self.others}, indent=1) + "\n")

    def texts(self) -> dict[str, str]:
        """Return what a page shows for each key: the figures, where they were measured, and what the faults say of theirs."""
        rows = faults.read()
        other = {
            "faults.table": faults.table(rows),
            "faults.line": faults.line(rows),
            "figures.machine": self._machine(),
        }
        return {key: str(figure) for key, figure in self.figures.items()} | other

    def _machine(self) -> str:
        """Return a sentence for each run: processor, load, versions and date."""
        sentences = [
            f"{run['date']}: {run['cores']} cores of {run['processor']} (Numba's name for it: {run['target']}), load {run['load']:.1f} at the start,"
            f" Python {run['python']}, "
            + ", ".join(f"{name} {version}" for name, version in run["versions"].items())
            + f", size {run['size']}"
            for run in self.runs.values()
        ]
        return "; ".join(sentences)


def typed(path: Path) -> list[str]:
    """Return the numbers with units that a page holds outside of its places; on the pages of `STRICT`, percentages too."""
    return typed_by_hand(path.read_text(), shares=path in STRICT)


def _rounded(value: Any) -> Any:
    """Return a number with four digits: the rest is noise, and would only make differences between runs longer."""
    if not isinstance(value, float) or not math.isfinite(value):
        return value
    return float(f"{value:.4g}")


def pages(figures: Figures) -> dict[Path, str]:
    """Return the pages that hold figures, as they should be."""
    texts = figures.texts()
    held = {path: path.read_text() for path in PAGES}
    return {path: fill(text, texts) for path, text in held.items() if keys(text)}


def publish(figures: Figures) -> None:
    """Write the figures into the pages."""
    for path, text in pages(figures).items():
        path.write_text(text)
