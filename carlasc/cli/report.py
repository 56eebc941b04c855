"""`carlasc report`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from carlasc.cli.common import (
    MANY,
    Json,
    SourceArgument,
    echo,
    few,
    file_option,
    print_json,
    report_failures,
    show,
)
from carlasc.cli.flags import WorkFlags
from carlasc.cli.library import Given, Library

if TYPE_CHECKING:
    from carlasc.groundtruth.reporting import ActorTrack
    from carlasc.inspection.reports import ReportResult

_SHOWN = 12


def report(
    *,
    work: WorkFlags,
    source: SourceArgument = ".",
    options: Annotated[Given, Library("carlasc.report")],
    html: Annotated[
        Path | None,
        file_option(
            "--html", metavar="FILE", text="Also write the reports as one page for a browser."
        ),
    ] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Print all grids and actors, not only the first.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Print the report of each grid: contents, settings, tracks of actors, and how much the grid
    changes with fewer scans.

    `carlasc regrid` writes a report with each grid. For other grids, the report is made from their
    files.
    """
    from carlasc.inspection.report_page import write_report_page

    with work.spread("report", "steps") as run:
        result: ReportResult = options.make(source, run=run)
    if html is not None:
        write_report_page(result, html)
    if as_json:
        print_json(result.to_dict())
    else:
        _print(result, everything=everything)
        if html is not None:
            echo(f"page: {html}")
    frames = sum(len(one.frames) for one in result.reports.values()) + len(result.failures)
    report_failures([(failure.frame, failure.message) for failure in result.failures], frames)


def _print(result: ReportResult, *, everything: bool) -> None:
    from carlasc.cli.tables import print_table
    from carlasc.inspection.report_page import describe

    if result.places or (len(result.reports) > MANY and not everything):
        title = ""
        if result.places:
            number = sum(result.places.values())
            title = f"a sample of {number:,} sequences, known: {result.known():.1%}"
        splits = result.by_split()
        sums = [[split, *values.values()] for split, values in splits.items()]
        print_table(["sums of", *next(iter(splits.values()))], sums, title=title)
    for name, one in few(
        result.reports.items(), lambda row: -row[1].coverage.known_share, everything=everything
    ):
        show(name, "bold")
        rows = describe(one)
        width = max(len(label) for label, _ in rows)
        for label, text in rows:
            show(f"  {label:<{width}}  {text}")
        if one.actors:
            _print_actors(one.actors, everything=everything)


def _print_actors(actors: tuple[ActorTrack, ...], *, everything: bool) -> None:
    from carlasc.cli.tables import print_table

    shown = actors if everything else actors[:_SHOWN]
    header = "Actor|Instance|Frames|Observations|Points|m/s|Size m|Residual m|Static m|Sure".split(
        "|"
    )
    rows = [
        [
            actor.label,
            actor.instance or None,
            f"{actor.first}..{actor.last}",
            actor.observations,
            actor.points,
            f"{actor.speed_m_s:.1f}",
            " x ".join(f"{side:.1f}" for side in actor.size_m),
            actor.residual_m,
            actor.residual_static_m,
            f"{actor.confidence:.0%}",
        ]
        for actor in shown
    ]
    print_table(header, rows, turn=False)
    if len(actors) > len(shown):
        show(f"... and {len(actors) - len(shown)} more (--all prints them)")
