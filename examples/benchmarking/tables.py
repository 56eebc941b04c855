"""The figures of runs, tables of them, and how sure differences are: intervals over test drives and
seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from benchmarking.runs import Result
from carlasc.core import CARLASC11
from carlasc.metrics import FigureTable, Interval, interval_of, jackknife

VEHICLE, PEDESTRIAN = CARLASC11.id_of("Vehicles"), CARLASC11.id_of("Pedestrian")
FREE = 0
Counts = NDArray[np.floating | np.integer]  # (..., K, K) confusion matrices, rows are the truth
Figure = Callable[[Counts], NDArray[np.float64]]


def iou(counts: Counts, label: int) -> NDArray[np.float64]:
    """IoU of a class in percent; 0 if it is neither in the truth nor predicted, as in the paper."""
    right = counts[..., label, label]
    either = counts[..., label, :].sum(-1) + counts[..., label].sum(-1) - right
    return 100 * right / np.maximum(either, 1)


def miou(counts: Counts) -> NDArray[np.float64]:
    """Mean IoU over all classes, free included, in percent."""
    return np.mean([iou(counts, label) for label in range(counts.shape[-1])], axis=0)


def geometric(counts: Counts) -> NDArray[np.float64]:
    """IoU of occupied space in percent."""
    right = counts[..., 1:, 1:].sum((-1, -2))
    return 100 * right / (counts.sum((-1, -2)) - counts[..., FREE, FREE])


def false_free(counts: Counts) -> NDArray[np.float64]:
    """Percentage of the occupied voxels that are called free."""
    return 100 * counts[..., 1:, FREE].sum(-1) / counts[..., 1:, :].sum((-1, -2))


def phantoms(counts: Counts) -> NDArray[np.float64]:
    """Percentage of the free voxels that are called Vehicle or Pedestrian."""
    return 100 * counts[..., FREE, [VEHICLE, PEDESTRIAN]].sum(-1) / counts[..., FREE, :].sum(-1)


def class_figures() -> dict[str, Figure]:
    """Return the IoU of each class by its name."""
    return {name: partial(iou, label=label) for label, name in CARLASC11.names.items()}


MIOU, VEHICLES = "mIoU", "Vehicles"
NETWORK: Mapping[str, Figure] = {
    MIOU: miou,
    VEHICLES: lambda counts: iou(counts, VEHICLE),
    "Pedestrian": lambda counts: iou(counts, PEDESTRIAN),
    "IoU": geometric,
}
LABELS: Mapping[str, Figure] = {
    **{name: NETWORK[name] for name in (MIOU, VEHICLES, "Pedestrian")},
    "false free": false_free,
    "phantom actors": phantoms,
}
CAUSES: Mapping[str, Figure] = {
    "IoU": NETWORK[VEHICLES],
    "missed: called free": lambda counts: _share(counts, counts[..., VEHICLE, FREE]),
    "missed: another class": lambda counts: _share(
        counts, counts[..., VEHICLE, 1:].sum(-1) - counts[..., VEHICLE, VEHICLE]
    ),
    "false: is free": lambda counts: _share(counts, counts[..., FREE, VEHICLE]),
    "false: another class": lambda counts: _share(
        counts, counts[..., 1:, VEHICLE].sum(-1) - counts[..., VEHICLE, VEHICLE]
    ),
}
"""Why the IoU of vehicles is not 100: errors in percent of the true voxels of vehicles."""


def _share(counts: Counts, errors: Counts) -> NDArray[np.float64]:
    return 100 * errors / np.maximum(counts[..., VEHICLE, :].sum(-1), 1)


def figure_row(runs: Sequence[Result], figures: Mapping[str, Figure]) -> tuple[str, ...]:
    """Return mean and standard deviation of the figures of a row's runs, over all test drives."""
    return tuple(
        spread([float(figure(run.drives.sum(0))) for run in runs]) for figure in figures.values()
    )


def figure_table(
    title: str, groups: Mapping[str, Sequence[Result]], figures: Mapping[str, Figure]
) -> FigureTable:
    """Return a table with one row per group of runs."""
    return FigureTable(
        title,
        ("", *figures),
        tuple((name, *figure_row(runs, figures)) for name, runs in groups.items()),
    )


def difference(first: Sequence[Result], second: Sequence[Result], figure: Figure) -> Interval:
    """Return by how much a figure of the first runs is higher than that of the second, and its
    95% interval, which holds for other towns and other seeds; with one run of each, for other
    towns only.

    The variance over test drives is that of the difference, because both are tested on the same;
    that over seeds is the sum of both sides.
    """
    sides = [np.stack([run.drives for run in runs]) for runs in (first, second)]
    seeds = [figure(side.sum(axis=1)) for side in sides]

    def of_drives(drives: Counts) -> float:
        runs = figure(drives.sum(axis=0))
        return float(runs[: len(first)].mean() - runs[len(first) :].mean())

    drives = jackknife(of_drives, np.concatenate(sides).swapaxes(0, 1))
    parts = [(float(of.var(ddof=1)) / len(of), len(of) - 1) for of in seeds if len(of) > 1]
    return interval_of(float(seeds[0].mean() - seeds[1].mean()), drives, *parts)


def with_interval(found: Interval) -> str:
    """Return a difference and its interval as text; bold where the interval does not hold zero."""
    text = f"{found.value:+.1f} ({found.low:+.1f} to {found.high:+.1f})"
    return f"**{text}**" if found.low * found.high > 0 else text


def spread(values: Sequence[float]) -> str:
    """Return mean and standard deviation as text; no deviation of a single value."""
    deviation = f" ± {np.std(values, ddof=1):.1f}" if len(values) > 1 else ""
    return f"{np.mean(values):.1f}{deviation}"


def to_markdown(table: FigureTable) -> str:
    """Return a table as Markdown."""
    rows = [list(table.header), ["---", *["---:"] * (len(table.header) - 1)], *table.texts()]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)
