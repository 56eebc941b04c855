"""`carlasc audit`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import carlasc
from carlasc.cli.common import (
    FAILED,
    Json,
    echo,
    file_option,
    place_argument,
    print_json,
    show,
)
from carlasc.cli.flags import OneWorkerRunFlags
from carlasc.cli.library import Given, Library
from carlasc.errors import count

if TYPE_CHECKING:
    from carlasc.inspection import AuditResult

_COLORS = {"fault": "red", "undetermined": "yellow", "sound": "green"}


def audit(
    *,
    work: OneWorkerRunFlags,
    grids: Annotated[
        str,
        place_argument(
            "Grids: a data set, a sequence, the folder of a grid, or files of SemanticKITTI, "
            "SSCBench, Occ3D, OpenOccupancy or CarlaOcc.",
            "GRIDS",
        ),
    ],
    scans: Annotated[
        str, place_argument("The recording that the grids belong to, in CarlaSC's layout.", "SCANS")
    ],
    options: Annotated[Given, Library("carlasc.audit")],
    html: Annotated[
        Path | None,
        file_option(
            "--html",
            metavar="FILE",
            text="Also write the audit as one page, with the worst frames.",
        ),
    ] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Print all checks, also those that found no fault.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Compare grids of any origin with the scans that they belong to, and print what is wrong with
    the grids.

    The exit code is 0 if no fault was found, and 1 if there is a fault or a frame that cannot be
    read.
    """
    with work.spread("Auditing", usual=1) as run:
        result: AuditResult = options.make(grids, scans, run=run)
    if html is not None and result.verdicts:
        carlasc.inspection.write_audit_page(result, html)
    if as_json:
        print_json(result.to_dict())
    else:
        _print(result, everything=everything)
    for failure in result.failures:
        echo(f"carlasc: {failure.where}: frame {failure.frame}: {failure.message}", err=True)
    if not result.ok:
        raise typer.Exit(FAILED)


def _print(result: AuditResult, *, everything: bool) -> None:
    for note in result.notes:
        echo(f"note: {note}", err=True)
    if not result.verdicts:
        echo("this part is counted; the part that ends last prints the verdicts")
        return
    for path, verdicts in result.verdicts.items():
        frames = count(result.frames[path], "frame")
        show(f"{path}: {frames}, grids in the coordinate frame of {result.placed[path]}", "bold")
        for verdict in verdicts:
            if everything or verdict.state != "sound":
                text = f"  {verdict.state:<12} {verdict.sentence}"
                show(text, _COLORS[verdict.state])
    state = (
        "sound, as far as the drives tell"
        if result.ok
        else f"not sound ({count(len(result.faults), 'fault')})"
    )
    show(f"{result.grids}: {state}", "bold")
