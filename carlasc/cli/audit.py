"""`carlasc audit`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import carlasc
from carlasc.cli.common import FAILED, FramesOption, Json, console, echo, file_option, line, place_argument, print_json
from carlasc.cli.flags import RunFlags
from carlasc.cli.grid_flags import parse_window
from carlasc.errors import count

if TYPE_CHECKING:
    from carlasc.inspection import AuditResult

_COLORS = {"fault": "red", "undetermined": "yellow", "sound": "green"}


def audit(
    work: RunFlags,
    grids: Annotated[
        str,
        place_argument(
            "Grids: a data set, a sequence, the folder of a grid, or files of SemanticKITTI, SSCBench, Occ3D, OpenOccupancy or CarlaOcc.",
            "GRIDS",
        ),
    ],
    scans: Annotated[str, place_argument("The recording that they belong to, in the layout.", "SCANS")],
    grid: Annotated[
        str | None, typer.Option(help="Name of the grids; if not given, evaluation, or the only one.")
    ] = None,
    made_from: Annotated[
        str | None,
        typer.Option(metavar="A:B", help="First and last scan, relative to its frame, that a grid was made from."),
    ] = None,
    frames: FramesOption = None,
    keep: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the sums of stretches of frames: an interrupted audit goes on, parts come together."
        ),
    ] = None,
    html: Annotated[
        Path | None,
        file_option("--html", metavar="FILE", text="Also write the audit as one page, with the worst frames."),
    ] = None,
    everything: Annotated[bool, typer.Option("--all", help="Print what is sound, too.")] = False,
    as_json: Json = False,
) -> None:
    """Compare anybody's grids with the scans that they belong to, and name what is wrong with the grids.

    Exit code 0: sound, as far as the drives tell. 1: a fault, or a frame that cannot be read.
    """
    window = None if made_from is None else parse_window(made_from, "made_from")
    with work.spread("Auditing", usual=1) as run:
        result = carlasc.audit(grids, scans, grid=grid, made_from=window, frames=frames, keep=keep, run=run)
    if html is not None and result.verdicts:
        carlasc.inspection.write_audit_page(result, html)
    if as_json:
        print_json(result.to_dict())
    else:
        _print(result, everything=everything)
    for failure in result.failures:
        echo(f"{failure.where}: frame {failure.frame}: {failure.message}", err=True)
    if not result.ok:
        raise typer.Exit(FAILED)


def _print(result: AuditResult, *, everything: bool) -> None:
    out = console()
    for note in result.notes:
        echo(f"note: {note}", err=True)
    if not result.verdicts:
        echo("counted; other parts have still to be counted before anything is judged")
        return
    for path, verdicts in result.verdicts.items():
        title = f"{path}: {count(result.frames[path], 'frame')}, in the frame of {result.placed[path]}"
        out.print(line(title, "bold"), soft_wrap=True)
        for verdict in verdicts:
            if everything or verdict.state != "sound":
                text = f"  {verdict.state:<12} {verdict.sentence}"
                out.print(line(text, _COLORS[verdict.state]), soft_wrap=True)
    state = "sound, as far as the drives tell" if result.ok else f"not sound ({count(len(result.faults), 'fault')})"
    out.print(line(f"{result.grids}: {state}", "bold"), soft_wrap=True)
