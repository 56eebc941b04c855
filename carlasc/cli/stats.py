"""`carlasc stats`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from carlasc.cli.common import Json, console, print_json, progress_bar, report_failures

if TYPE_CHECKING:
    from rich.table import Table

    from carlasc.inspection.statistics import Histogram, Kind, Statistics

_KINDS: tuple[Kind, ...] = ("points", "voxels")


def stats(
    path: Annotated[
        str, typer.Argument(help="A data set, a split, a sequence, a zip, a packed store, or a URL.")
    ] = ".",
    by: Annotated[
        Literal["total", "split", "sequence"],
        typer.Option(help="Shares of all, of each split too, or of each sequence too."),
    ] = "split",
    grid: Annotated[str, typer.Option(help="Grid whose voxels are counted.")] = "evaluation",
    remap: Annotated[
        str, typer.Option(help="Classes of the second table: auto, none, carlasc11, semantickitti19, ...")
    ] = "auto",
    every: Annotated[int, typer.Option(help="Count every so many frames.")] = 1,
    plot: Annotated[Path | None, typer.Option(help="Draw the histograms: a .png, .svg or .pdf file.")] = None,
    workers: Annotated[int, typer.Option(help="Processes that count side by side.", min=1)] = 1,
    as_json: Json = False,
) -> None:
    """Count the classes of points and of known voxels, with class weights; as tables, a plot, JSON."""
    from carlasc.inspection.statistics import stats as count

    with progress_bar("Counting") as progress:
        result = count(
            path,
            grid=grid,
            remap=None if remap == "none" else remap,
            every=every,
            workers=workers,
            progress=progress,
        )
    if plot is not None:
        from carlasc.inspection.charts import draw_histograms

        draw_histograms(result, plot)
    if as_json:
        print_json(result.to_dict())
    else:
        print_statistics(result, by)
        if plot is not None:
            typer.echo(f"plot: {plot}")
    report_failures(list(result.failures), result.frames + len(result.failures), "files")


def print_statistics(result: Statistics, by: str = "split") -> None:
    """Print the class tables; `carlasc demo` does so too."""
    out = console()
    splits = result.by_split() if by == "split" else {}
    if set(splits) == {"none"}:
        splits = {}
    out.print(_class_table(result, splits, remapped=False))
    if result.remap:
        out.print(_class_table(result, splits, remapped=True))
    if by == "sequence":
        for kind in _KINDS:
            out.print(_sequence_table(result, kind))
    total = result.total
    if total.grids:
        text = f"{total.known_share:.1%} of voxels known ({total.grids} grids); shares of voxels are those of known ones, and class 0 of points is unlabelled"
        out.print(text, highlight=False)


def _class_table(result: Statistics, splits: dict[str, Histogram], *, remapped: bool) -> Table:
    """A row a class: how often it stands, its share in all and in each split, its weight."""
    from rich.table import Table

    classes = result.remap.target if remapped and result.remap else result.classes
    table = Table(title=f"Classes of {classes.name}", title_justify="left")
    table.add_column("Class")
    for header in (
        "points",
        "%",
        "voxels",
        "%",
        *(f"{split} {kind} %" for split in splits for kind in _KINDS),
        "weight",
    ):
        table.add_column(header, justify="right")
    totals = [_counts(result, result.total, kind, remapped) for kind in _KINDS]
    shares = [_counts(result, histogram, kind, remapped) for histogram in splits.values() for kind in _KINDS]
    weights = result.weights() if remapped or result.remap is None else {}
    for name in classes.names.values():
        if any(counts[name] for counts in totals):
            cells = [cell for counts in totals for cell in (f"{counts[name]:,}", _percent(counts, name))]
            weight = f"{weights[name]:.4f}" if name in weights else ""
            table.add_row(name, *cells, *(_percent(counts, name) for counts in shares), weight)
    return table


def _sequence_table(result: Statistics, kind: Kind) -> Table:
    """A row a sequence: the share of each class."""
    from rich.table import Table

    names = list(_counts(result, result.total, kind, remapped=True))
    table = Table("Sequence", title=f"{kind}, % by sequence", title_justify="left")
    for name in names:
        table.add_column(name, justify="right")
    for path, histogram in result.sequences.items():
        counts = _counts(result, histogram, kind, remapped=True)
        table.add_row(path or result.location, *(_percent(counts, name) for name in names))
    return table


def _counts(result: Statistics, histogram: Histogram, kind: Kind, remapped: bool) -> dict[str, int]:
    return result.summed(histogram.of(kind)) if remapped else result.named(histogram.of(kind))


def _percent(counts: dict[str, int], name: str) -> str:
    total = sum(counts.values())
    return f"{100 * counts[name] / total:.2f}" if total else ""
