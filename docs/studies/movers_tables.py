"""The tables of `movers.py`, with means and standard deviations over drives."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any

import numpy as np
from movers_rows import UNLABELLED
from movers_scores import GROUPS, Counts, calibration_error, figures, groups, reliability

COLUMNS = (  # heading, figure, number of decimals
    ("Vehicle", "Vehicle IoU", 2),
    ("Pedestrian", "Pedestrian IoU", 2),
    ("Vehicle, all", "Vehicle IoU, all", 2),
    ("Pedestrian, all", "Pedestrian IoU, all", 2),
    ("Vehicle found", "Vehicle found", 2),
    ("Vehicle called free", "Vehicle free", 2),
    ("wrongly Vehicle", "wrongly Vehicle", 0),
    ("wrongly occupied", "wrongly occupied", 0),
    ("Road", "Road IoU", 3),
    ("Building", "Building IoU", 3),
    ("ECE", "ECE", 3),
    ("ECE, uncertain", "ECE, uncertain", 3),
)
# found is occupied
_WITHOUT_CLASSES = (
    "Vehicle found",
    "Vehicle free",
    "wrongly occupied",
    "ECE",
    "ECE, uncertain",
)
FEWEST = 5  # drives of which a standard deviation is shown
_RATIOS = ("wrongly Vehicle", "wrongly occupied")  # shown beside that of `tube`


@dataclass(frozen=True)
class Table:
    """Rows of some drives with one LiDAR and one grid.

    Attributes:
        title: what they have in common.
        rows: counts by row and drive.
    """

    title: str
    rows: dict[str, dict[str, Counts]]

    def of_kind(self, kind: str) -> Table:
        """Return the rows of one kind of drive."""
        rows = {
            row: {drive: counts for drive, counts in drives.items() if drive.startswith(kind)}
            for row, drives in self.rows.items()
        }
        return Table(
            f"{self.title}, {kind}", {row: drives for row, drives in rows.items() if drives}
        )

    @property
    def drives(self) -> list[str]:
        """The drives of any row."""
        return sorted({drive for drives in self.rows.values() for drive in drives})

    def to_markdown(self) -> str:
        """Return the table: mean and standard deviation over drives."""
        lines = [f"{self.title}; {len(self.drives)} drives:", ""]
        lines += [
            "| rule | " + " | ".join(heading for heading, _, _ in COLUMNS) + " |",
            "|---|" + "---:|" * len(COLUMNS),
        ]
        tube = self._means("tube") if "tube" in self.rows else {}
        for row in self.rows:
            means, deviations = self._means(row), self._deviations(row)
            cells = []
            for _, figure, decimals in COLUMNS:
                mean, deviation = means[figure], deviations[figure]
                is_shown = not np.isnan(mean) and (row != UNLABELLED or figure in _WITHOUT_CLASSES)
                spread = f" ± {deviation:.{decimals}f}" if len(self.drives) >= FEWEST else ""
                cell = f"{mean:.{decimals}f}{spread}" if is_shown else ""
                if is_shown and figure in _RATIOS and row != "tube" and tube:
                    cell = (
                        f"{mean:.0f} (1/{tube[figure] / mean:.0f})" if mean >= 1 else f"{mean:.0f}"
                    )
                cells.append(cell)
            missing = len(self.drives) - len(self.rows[row])
            note = f" ({len(self.rows[row])} drives)" if missing else ""
            lines.append(f"| {row}{note} | " + " | ".join(cells) + " |")
        return "\n".join(lines) + "\n"

    def movers_to_markdown(self, rows: Iterable[str]) -> str:
        """Return the table of what was found of movers, by speed and by sides seen, over all
        drives.
        """
        chosen = {row: groups(reduce(add, self.rows[row].values())) for row in rows}
        if not chosen:
            return ""
        names = [name for name, (_, _, voxels) in next(iter(chosen.values())).items() if voxels]
        lines = [f"{self.title}: share found / called free:", ""]
        lines += [
            "| movers | voxels | " + " | ".join(chosen) + " |",
            "|---|" + "---:|" * (1 + len(chosen)),
        ]
        for name in names:
            cells = [f"{found[name][0]:.2f} / {found[name][1]:.2f}" for found in chosen.values()]
            voxels = next(iter(chosen.values()))[name][2]
            lines.append(f"| {name} | {voxels} | " + " | ".join(cells) + " |")
        return "\n".join(lines) + "\n"

    def calibration_to_markdown(self, row: str) -> str:
        """Return the reliability diagram of a row as a table, and the calibration error by what a
        voxel is called.
        """
        counts = reduce(add, self.rows[row].values())
        lines = [
            f"{self.title}, {row}: calibration:",
            "",
            "| posterior | voxels | mean posterior | share occupied |",
        ]
        lines += ["|---|---:|---:|---:|"]
        for first, last, voxels, posterior, occupied in reliability(counts):
            lines.append(f"| {first:g} to {last:g} | {voxels} | {posterior:.3f} | {occupied:.3f} |")
        lines += ["", "| called | voxels | ECE |", "|---|---:|---:|"]
        for name, histogram in zip(GROUPS, counts.posterior, strict=True):
            lines.append(
                f"| {name} | {int(histogram[0].sum())} | {calibration_error(histogram):.3f} |"
            )
        return "\n".join(lines) + "\n"

    def to_json(self) -> dict[str, object]:
        """Return the figures of every row and drive as plain values."""
        return {
            "title": self.title,
            "rows": {
                row: {d: figures(c) for d, c in drives.items()} for row, drives in self.rows.items()
            },
        }

    def mean(self, row: str, figure: str) -> tuple[float, float]:
        """Return the mean and the standard deviation of a figure of a row over drives."""
        return self._means(row)[figure], self._deviations(row)[figure]

    def _values(self, row: str) -> dict[str, list[float]]:
        found = [figures(counts) for counts in self.rows[row].values()]
        return {
            name: [values[name] for values in found if not np.isnan(values[name])]
            for name in found[0]
        }

    def _means(self, row: str) -> dict[str, float]:
        return {
            name: float(np.mean(v)) if v else float("nan") for name, v in self._values(row).items()
        }

    def _deviations(self, row: str) -> dict[str, float]:
        return {
            name: float(np.std(v, ddof=1)) if len(v) > 1 else 0.0
            for name, v in self._values(row).items()
        }


CALIBRATED = ("align, flow", "align, free space")
MOVERS_OF = (
    "tube",
    "perfect removal, then tube",
    "align, flow",
    "align, boxes",
    "align, free space",
    UNLABELLED,
)


def lidars_to_markdown(tables: list[Table], figure: str) -> str:
    """Return one figure of every row that was made with several LiDARs: mean and standard deviation
    over drives.
    """
    rows = [row for row in tables[0].rows if sum(row in table.rows for table in tables) > 1]
    lines = [f"{figure}, with other LiDARs:", ""]
    lines += [
        "| rule | " + " | ".join(table.title for table in tables) + " |",
        "|---|" + "---:|" * len(tables),
    ]
    for row in rows:
        cells = []
        for table in tables:
            mean, deviation = table.mean(row, figure) if row in table.rows else (float("nan"), 0.0)
            cells.append("" if np.isnan(mean) else f"{mean:.2f} ± {deviation:.2f}")
        lines.append(f"| {row} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def worst_to_markdown(tables: list[Table]) -> str:
    """Return the mean and the worst drive of each table by flow and by free space."""
    lines = ["| LiDAR | motion by | drives | Vehicle | worst | Pedestrian | worst |"]
    lines += ["|---|---|---:|---:|---:|---:|---:|"]
    for table in tables:
        for row in CALIBRATED:
            if row not in table.rows:
                continue
            cells = [table.title, row.removeprefix("align, "), str(len(table.rows[row]))]
            for figure in ("Vehicle IoU", "Pedestrian IoU"):
                values = [figures(counts)[figure] for counts in table.rows[row].values()]
                cells += [f"{np.nanmean(values):.3f}", f"{np.nanmin(values):.2f}"]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def held_out_to_markdown(scores: dict[str, list[dict[str, Any]]]) -> str:
    """Return the table of held-out rays, the mean over drives in percent, from the scores of each
    row and drive.
    """
    shares = {
        "returns in free voxels": "free",
        "rays through something other than ground": "passed_object",
    }
    headings = [*shares, "own path occupied"]
    lines = ["Held-out rays, 32 channels, coarse, in percent:", ""]
    lines += ["| rule | " + " | ".join(headings) + " |", "|---|" + "---:|" * len(headings)]
    for row, drives in scores.items():
        values = [[drive["rays"][key] for drive in drives] for key in shares.values()]
        values.append([drive["swept"]["occupied_share"] for drive in drives])
        means = [np.mean([value for value in column if value is not None]) for column in values]
        lines.append(f"| {row} | " + " | ".join(f"{100 * mean:.2f}" for mean in means) + " |")
    return "\n".join(lines) + "\n"


def write_tables(tables: list[Table], held_out: dict[str, list[dict[str, Any]]], out: Path) -> str:
    """Write tables as Markdown and as JSON, `out` with each suffix, and return the Markdown."""
    parts = []
    for table in tables:
        parts.append(table.to_markdown())
        kinds = sorted({drive.rstrip("0123456789") for drive in table.drives})
        if table is tables[0]:
            parts += [table.of_kind(kind).to_markdown() for kind in kinds if len(kinds) > 1]
            parts.append(table.movers_to_markdown([row for row in MOVERS_OF if row in table.rows]))
            parts += [table.calibration_to_markdown(row) for row in CALIBRATED if row in table.rows]
    if len(tables) > 1:
        parts.append(worst_to_markdown(tables))
        parts += [
            lidars_to_markdown(tables, name)
            for name in ("Vehicle IoU", "Pedestrian IoU", "Vehicle free")
        ]
    if held_out:
        parts.append(held_out_to_markdown(held_out))
    text = "\n".join(parts)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.with_suffix(".md").write_text(text)
    out.with_suffix(".json").write_text(
        json.dumps(
            {"tables": [table.to_json() for table in tables], "held out": held_out}, indent=1
        )
    )
    return text
