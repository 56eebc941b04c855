"""`carlasc stats`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from carlasc.cli.common import (
    Json,
    SourceArgument,
    echo,
    few,
    file_option,
    print_json,
    report_failures,
    show,
)
from carlasc.cli.flags import OneWorkerFlags
from carlasc.cli.library import Given, Library
from carlasc.errors import count

if TYPE_CHECKING:
    from carlasc.core import ClassTable
    from carlasc.inspection.statistics import Histogram, Kind, Statistics

_KINDS: tuple[Kind, ...] = ("points", "voxels")


def stats(
    *,
    work: OneWorkerFlags,
    source: SourceArgument = ".",
    by: Annotated[
        Literal["total", "split", "sequence"],
        typer.Option(
            help="Print shares of the whole (total), and also of each split or of each sequence."
        ),
    ] = "split",
    remap: Annotated[
        str,
        typer.Option(
            help="Classes of the second table: auto, none (no table), carlasc11, semantickitti19, "
            "..."
        ),
    ] = "auto",
    options: Annotated[Given, Library("carlasc.stats")],
    plot: Annotated[
        Path | None,
        file_option("--plot", text="Also draw the histograms to this .png, .svg or .pdf file."),
    ] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Print all sequences, not only the ten most unusual.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Count the classes of points and of known voxels, and compute class weights: as tables, a plot
    or JSON.
    """
    from carlasc.inspection.charts import check_plot, draw_histograms

    if plot is not None:  # before counting, which may take hours
        check_plot(plot)
    with work.spread("Counting", usual=1) as run:
        result: Statistics = options.make(source, remap=None if remap == "none" else remap, run=run)
    if plot is not None:
        draw_histograms(result, plot)
    if as_json:
        print_json(result.to_dict())
    else:
        print_statistics(result, by, everything=everything)
        if plot is not None:
            echo(f"plot: {plot}")
    report_failures(list(result.failures), result.frames + len(result.failures), "files")


def print_statistics(result: Statistics, by: str = "split", *, everything: bool = False) -> None:
    """Print the class tables; `carlasc demo` uses it too."""
    from carlasc.cli.tables import print_table
    from carlasc.core.classes import times

    splits = result.by_split() if by == "split" else {}
    if set(splits) == {"none"}:
        splits = {}
    for remapped in (False, True) if result.remap else (False,):
        classes = result.remap.target if remapped and result.remap else result.classes
        header, rows = _class_table(result, classes, splits, remapped=remapped)
        print_table(header, rows, title=f"Classes of {classes.name}", turn=False)
    if by == "sequence":
        for kind in _KINDS:
            header, rows = _sequence_table(result, kind, everything=everything)
            print_table(header, rows, title=f"{kind}, % by sequence")
    total = result.total
    if result.places:
        show(f"a sample of {sum(result.places.values()):,} sequences, with intervals of 95 %")
    show(f"classes: {', '.join(map(str, result.uses))}")
    if total.unlisted:
        ids = times(dict(sorted(total.unlisted.items())))
        show(f"points and voxels of ids that are no class, in no row: {ids}")
    if total.grids:
        show(f"{total.known_share:.1%} of voxels known ({count(total.grids, 'grid')})")
        show("voxels % is of the known voxels; class 0 of points is unlabelled")
    else:
        show("no voxels counted: choose a grid with --grid (`carlasc info` lists them)")
    if total.actor_voxels:
        show(
            f"{total.actor_voxels:,} voxels belong to actors, {total.moving_voxels:,} of them move"
        )


def _class_table(
    result: Statistics, classes: ClassTable, splits: dict[str, Histogram], *, remapped: bool
) -> tuple[list[str], list[list[object]]]:
    """Return a header and a row per class: its counts, its shares in the whole and in each split,
    its weight.
    """
    shares = [f"{split} {kind} %" for split in splits for kind in _KINDS]
    header = ["Class", *(text for kind in _KINDS for text in (kind, f"{kind} %")), *shares]
    totals = [_counts(result, result.total, kind, remapped) for kind in _KINDS]
    parts = [
        _counts(result, histogram, kind, remapped)
        for histogram in splits.values()
        for kind in _KINDS
    ]
    whole = [result.intervals(kind, remapped=remapped) if result.places else {} for kind in _KINDS]
    weights = result.weights() if remapped or result.remap is None else {}
    header += ["weight"] if weights else []
    rows = list[list[object]]()
    for name in classes.names.values():
        if any(counts[name] for counts in totals):
            cells = [
                cell
                for counts, intervals in zip(totals, whole, strict=True)
                for cell in (
                    f"{counts[name]:,}",
                    f"{intervals[name]:.2%}" if intervals else _percent(counts, name),
                )
            ]
            weight = [f"{weights[name]:.4f}"] if weights else []
            rows.append([name, *cells, *(_percent(counts, name) for counts in parts), *weight])
    return header, rows


def _sequence_table(
    result: Statistics, kind: Kind, *, everything: bool
) -> tuple[list[str], list[list[object]]]:
    """Return a header and a row per sequence: the share of each class. Of many sequences, those
    whose shares differ most from the whole.
    """
    whole = _counts(result, result.total, kind, remapped=True)
    usual = [_percent(whole, name) or 0 for name in whole]
    rows = list[list[Any]]()
    for path, histogram in result.sequences.items():
        counts = _counts(result, histogram, kind, remapped=True)
        rows.append([path or result.location, *(_percent(counts, name) for name in whole)])

    def distance(row: list[Any]) -> float:
        return sum(abs((share or 0) - mean) for share, mean in zip(row[1:], usual, strict=True))

    return ["Sequence", *whole], few(rows, distance, everything=everything)


def _counts(result: Statistics, histogram: Histogram, kind: Kind, remapped: bool) -> dict[str, int]:
    return result.summed(histogram.of(kind)) if remapped else result.named(histogram.of(kind))


def _percent(counts: dict[str, int], name: str) -> float | None:
    total = sum(counts.values())
    return 100 * counts[name] / total if total else None
