"""The tables: the paper's two for networks, and one of what labels are worth; mean and standard deviation over seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from benchmarking.runs import Result
from carlasc.core import CARLASC11
from carlasc.metrics import FigureTable, geometric_table, semantic_table

VEHICLE, PEDESTRIAN = CARLASC11.id_of("Vehicles"), CARLASC11.id_of("Pedestrian")
FREE = 0


def miou(result: Result) -> float:
    """Mean IoU over the eleven classes, in percent."""
    return 100 * result.evaluation("").miou


def iou(result: Result, label: int) -> float:
    """IoU of a class in percent; NaN if it is neither in the truth nor predicted."""
    return 100 * float(result.matrix.iou[label])


def false_free(result: Result) -> float:
    """Percentage of the occupied voxels that are called free."""
    return 100 * result.evaluation("").score.false_free


def actors_called_free(result: Result) -> float:
    """Percentage of the voxels of vehicles and pedestrians that are called free."""
    counts = result.matrix.counts[[VEHICLE, PEDESTRIAN]]
    return float(100 * counts[:, FREE].sum() / counts.sum())


def phantoms(result: Result) -> float:
    """Number of voxels per frame that are called Vehicle or Pedestrian and are free."""
    return float(result.matrix.counts[FREE, [VEHICLE, PEDESTRIAN]].sum() / result.frames)


FIGURES: Mapping[str, Callable[[Result], float]] = {
    "mIoU": miou,
    "Vehicle": lambda result: iou(result, VEHICLE),
    "Pedestrian": lambda result: iou(result, PEDESTRIAN),
    "false free": false_free,
    "actors called free": actors_called_free,
    "phantom actors, voxels per frame": phantoms,
    "ECE, free": lambda result: 100 * result.ece_free,
    "ECE, occupied": lambda result: 100 * result.ece_occupied,
}
"""The columns of the table of labels."""


def label_table(groups: Mapping[str, Sequence[Result]]) -> FigureTable:
    """Return what each kind of labels gives: one row per group of runs."""
    rows = tuple(
        (name, *(spread([figure(run) for run in runs]) for figure in FIGURES.values())) for name, runs in groups.items()
    )
    return FigureTable("What labels are worth, scored on capture truth", ("trained on", *FIGURES), rows)


def network_tables(groups: Mapping[str, Sequence[Result]]) -> list[FigureTable]:
    """Return the paper's two tables with one row per group of runs."""
    tables = []
    for make in (semantic_table, geometric_table):
        rows: list[tuple[str, ...]] = []
        for name, runs in groups.items():
            table = make([run.evaluation(name) for run in runs])
            columns = list(zip(*table.rows, strict=True))[1:]
            rows.append((name, *(spread([float(value) for value in column]) for column in columns)))
        tables.append(FigureTable(table.title, table.header, tuple(rows)))
    return tables


def spread(values: Sequence[float]) -> str:
    """Return mean and standard deviation as text: a dash where a value is not defined, and no deviation of a single value."""
    if np.isnan(values).any():  # a class that never occurs
        return "-"
    deviation = f" ± {np.std(values, ddof=1):.2f}" if len(values) > 1 else ""
    return f"{np.mean(values):.2f}{deviation}"


def to_markdown(table: FigureTable) -> str:
    """Return a table as Markdown, under its title."""
    rows = [list(table.header), ["---", *["---:"] * (len(table.header) - 1)], *table.texts()]
    return "\n".join([table.title, "", *(f"| {' | '.join(row)} |" for row in rows)])
