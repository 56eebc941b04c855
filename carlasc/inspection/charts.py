"""Charts: the histograms of classes, the scores of frames."""

from __future__ import annotations

import io
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from carlasc.errors import ArgumentError, count, import_extra
from carlasc.inspection.statistics import KINDS, Kind, Statistics
from carlasc.storage.files import write_output

if TYPE_CHECKING:
    from carlasc.metrics.results import Evaluation

_SUFFIXES = (".png", ".svg", ".pdf")
_OF: dict[Kind, str] = {"points": "points", "voxels": "known voxels"}


def check_plot(plot: Path) -> ModuleType:
    """Check that a plot can be drawn to a file, before the figures for it are computed.

    Args:
        plot: the file, as for `draw_histograms`.

    Returns:
        The module `matplotlib.figure`.

    Raises:
        ArgumentError: the name has another ending.
        DependencyError: Matplotlib is not installed.
    """
    if plot.suffix.lower() not in _SUFFIXES:
        raise ArgumentError(
            "plot",
            expected=f"a file that ends in {', '.join(_SUFFIXES)}",
            found=plot.suffix or "no ending",
        )
    return import_extra("matplotlib.figure", "plots")


def draw_histograms(statistics: Statistics, plot: Path) -> None:
    """Draw the share of each class, points beside voxels, one bar per split, on a logarithmic
    scale.

    Args:
        statistics: as `stats` returns them.
        plot: a .png, .svg or .pdf file.

    Raises:
        ArgumentError: the name has another ending.
        DependencyError: Matplotlib is not installed.
    """
    figures = check_plot(plot)
    splits = statistics.by_split()
    names = statistics.classes.names
    colors = statistics.classes.palette / 255
    ids = [
        i
        for i in names
        if any(histogram.of(kind)[i] for histogram in splits.values() for kind in KINDS)
    ]
    figure = figures.Figure(figsize=(11, 0.9 + 0.32 * max(6, len(ids))), layout="constrained")
    for axes, kind in zip(figure.subplots(1, 2, sharey=True), KINDS, strict=True):
        for row, (split, histogram) in enumerate(splits.items()):
            counts = histogram.of(kind)[ids]
            if not counts.sum():
                continue
            height = 0.8 / len(splits)
            positions = np.arange(len(ids)) + (row - (len(splits) - 1) / 2) * height
            axes.barh(
                positions,
                counts / counts.sum(),
                height,
                color=colors[ids],
                edgecolor="black",
                linewidth=0.4,
                alpha=1 - 0.25 * row,
                label=split,
            )
        axes.set_xscale("log")
        axes.set_xlabel(f"share of {_OF[kind]}")
        axes.set_yticks(range(len(ids)), [names[i] for i in ids])
        axes.grid(axis="x", alpha=0.3)
    figure.axes[0].invert_yaxis()
    known = statistics.total.known_share
    title = count(len(statistics.sequences), "sequence")
    if len(splits) > 1:
        title += f" (darkest first: {', '.join(splits)})"
    figure.suptitle(title if np.isnan(known) else f"{title}, {known:.1%} of voxels known")
    _write(figure, plot)


def draw_frame_scores(evaluation: Evaluation, plot: Path) -> None:
    """Draw mIoU, IoU and the share of false free voxels over the frames of each sequence.

    Args:
        evaluation: as `evaluate` returns it.
        plot: a .png, .svg or .pdf file.

    Raises:
        ArgumentError: the name has another ending.
        DependencyError: Matplotlib is not installed.
    """
    figures = check_plot(plot)
    sequences = list(evaluation.sequences)
    figure = figures.Figure(figsize=(11, 1 + 2.2 * len(sequences)), layout="constrained")
    for axes, path in zip(
        figure.subplots(len(sequences), 1, squeeze=False)[:, 0], sequences, strict=True
    ):
        scores = [frame for frame in evaluation.frame_scores if frame.sequence == path]
        numbers = [int(s.frame) if s.frame.isdigit() else place for place, s in enumerate(scores)]
        for name, color, values in (
            ("mIoU", "#3566a8", [s.score.miou for s in scores]),
            ("IoU of occupied", "#4d9a5b", [s.score.iou for s in scores]),
            ("false free", "#c2452d", [s.score.false_free for s in scores]),
        ):
            axes.plot(numbers, np.array(values) * 100, ".-", color=color, label=name, linewidth=1)
        axes.set_ylim(0, 100)
        axes.set_ylabel("percent")
        axes.set_title(path or evaluation.name, loc="left", fontsize=10)
        axes.grid(alpha=0.3)
    figure.axes[0].legend(loc="upper right", fontsize=8, ncols=3)
    for axes in figure.axes:
        axes.xaxis.get_major_locator().set_params(integer=True)
    figure.axes[-1].set_xlabel("frame")
    figure.suptitle(f"{evaluation.name}, by {evaluation.convention.title}")
    _write(figure, plot)


def _write(figure: Any, plot: Path) -> None:
    """Write a chart that needs no installed fonts: PDF files contain TrueType fonts, SVG files the
    outlines of the letters.
    """
    buffer = io.BytesIO()
    with import_extra("matplotlib", "plots").rc_context(
        {"pdf.fonttype": 42, "svg.fonttype": "path"}
    ):
        figure.savefig(buffer, format=plot.suffix[1:].lower(), dpi=150)
    write_output(plot, buffer.getvalue())
