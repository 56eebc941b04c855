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

from measuring import cells
from measuring.facts import CONSTANTS, EXCEPTIONS, FACTS
from measuring.places import fill, keys, sections, typed_by_hand

ROOT = Path(__file__).parents[3]
FILE = ROOT / "docs" / "figures.json"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


@dataclass(frozen=True)
class Figure:
    """A figure.

    Attributes:
        value: what was measured; the lower end of a range.
        unit: "s", "ms", "MB", "%", or "" for a ratio or a number.
        how: what was measured, and how, in a line.
        high: the upper end of a range; None for a single value.
        run: the run that measured it.
    """

    value: float
    unit: str
    how: str
    high: float | None = None
    run: str = ""

    def __str__(self) -> str:
        if self.high is None or _number(self.value) == _number(self.high):
            text = _number(self.value)
        else:
            text = f"{_number(self.value)} to {_number(self.high)}"
        return f"{text}%" if self.unit == "%" else f"{text} {self.unit}".strip()


def _number(value: float) -> str:
    """Return a number with two digits, or three if it is large: times repeat no better."""
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
        runs: the processor, its cores, the load, versions, the size and the date of each run, by
            its name.
        figures: each figure by its key.
    """

    runs: dict[str, dict[str, Any]]
    figures: dict[str, Figure]

    @classmethod
    def read(cls, file: Path = FILE) -> Figures:
        """Read the file; there are none if it does not exist."""
        if not file.exists():
            return cls({}, {})
        held = json.loads(file.read_text())
        figures = {key: Figure(**figure) for key, figure in held["figures"].items()}
        return cls(held["runs"], figures)

    def updated(self, run: Mapping[str, Any], measured: Mapping[str, Figure]) -> Figures:
        """Return them with what a run measured in place of older figures, without runs of which
        nothing is left.
        """
        name = f"{run['date']} {run['size']} {run['target']}"  # machines of one day are told apart
        new = {key: dataclasses.replace(figure, run=name) for key, figure in measured.items()}
        figures = dict(sorted((self.figures | new).items()))
        used = {figure.run for figure in figures.values()}
        runs = {key: held for key, held in (self.runs | {name: dict(run)}).items() if key in used}
        return Figures(runs, figures)

    def write(self, file: Path = FILE) -> None:
        """Write the file."""
        rows = {
            key: {
                name: _rounded(value)
                for name, value in dataclasses.asdict(figure).items()
                if value is not None and (value != "" or name == "unit")
            }
            for key, figure in self.figures.items()
        }
        file.write_text(json.dumps({"runs": self.runs, "figures": rows}, indent=1) + "\n")

    def texts(self) -> dict[str, str]:
        """Return what a page shows for each key: the figures, where they were measured, and what
        the faults say of theirs.
        """
        rows = faults.read()
        other = {
            "faults.table": faults.table(rows),
            "faults.commands": faults.commands(rows),
            "faults.runs": faults.runs(rows, faults.known_code()),
            "faults.large": faults.large(rows),
            "faults.line": faults.line(rows),
            "figures.machine": self._machine(),
        }
        return {key: str(figure) for key, figure in self.figures.items()} | other | cells.texts()

    def _machine(self) -> str:
        """Return a sentence for each run: processor, load, versions and date."""
        sentences = [
            f"{run['date']}: {run['cores']} cores of {run['processor']} (Numba's name for it: "
            f"{run['target']}), load {run['load']:.1f} at the start, Python {run['python']}, "
            + ", ".join(f"{name} {version}" for name, version in run["versions"].items())
            + f", size {run['size']}"
            for run in self.runs.values()
        ]
        return "; ".join(sentences)


def unwritten(path: Path) -> list[str]:
    """Return the numbers of a page that no figure, study, constant or definition of a file gives,
    apart from the exceptions.
    """
    page = path.relative_to(ROOT).as_posix()
    if page in FACTS:
        return []
    kept = [
        text
        for text in sections(path.read_text())
        if (page, text.partition("\n")[0]) not in EXCEPTIONS
    ]
    known = {*CONSTANTS.get(page, ()), *(number for at, number in EXCEPTIONS if at == page)}
    return [text for text in typed_by_hand("".join(kept)) if text not in known]


def _rounded(value: Any) -> Any:
    """Return a number with four digits: the rest is noise, and would only make differences between
    runs longer.
    """
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
