"""`carlasc validate`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from carlasc.cli.common import FAILED, Json, console, print_json, progress_bar
from carlasc.errors import ArgumentError

if TYPE_CHECKING:
    from carlasc.inspection.findings import ValidationResult

_SHOWN = 3
_COLORS = {"error": "red", "warning": "yellow", "note": "cyan"}


def validate(
    source: Annotated[
        str, typer.Argument(help="A data set, a split, a sequence, a zip, a packed store, or a URL.")
    ] = ".",
    every: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="Read the contents of every N-th frame; of about forty frames per sequence if not given."
        ),
    ] = None,
    full: Annotated[bool, typer.Option("--full", help="Read the contents of all frames.")] = False,
    everything: Annotated[
        bool, typer.Option("--all", help="Print all findings, not only the first three of each kind.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Check a data set: files, poses, times, and whether scans agree with poses and grids. The exit code is 1 if there is an error.

    It finds files of the wrong size, labels without votes, unknown classes, poses that are not rigid or jump, and gaps. From the
    scans it recognizes a mirrored y axis, poses of a camera, transposed rotations, and a grid that is shifted by a cell.
    """
    from carlasc.inspection.validation import validate as examine

    if full and every is not None:
        raise ArgumentError("every", expected="only one of --every and --full", found="both")
    with progress_bar("Validating", unit="steps") as progress:
        result = examine(source, every=1 if full else every, progress=progress)
    if as_json:
        print_json(result.to_dict())
    else:
        print_result(result, everything=everything)
    if not result.ok:
        raise typer.Exit(FAILED)


def print_result(result: ValidationResult, *, everything: bool = False) -> None:
    """Print the findings by kind, errors first; `carlasc demo` uses it too."""
    from rich.text import Text

    from carlasc.inspection.findings import SEVERITIES

    out = console()
    for (severity, check), findings in result.grouped().items():
        out.print(Text(f"{severity}: {check} ({len(findings)})", style=_COLORS[severity]))
        shown = findings if everything else findings[:_SHOWN]
        for finding in shown:
            out.print(Text(f"  {finding}"), soft_wrap=True)
        if len(findings) > len(shown):
            out.print(Text(f"  ... and {len(findings) - len(shown)} more (--all prints them)"))
    for report in result.sequences:
        figures = [
            f"{share:.1%} of points in voxels of their class ({grid})" for grid, share in report.voxel_share.items()
        ]
        if report.pose_share is not None:
            figures.append(f"{report.pose_share:.1%} of a scan's structure on that of an earlier scan under the poses")
        name = report.path or result.location
        text = f"{name}: {report.frames} frames, {report.sampled} read{''.join('; ' + figure for figure in figures)}"
        out.print(Text(text), soft_wrap=True)
    counts = ", ".join(f"{result.count(severity)} {severity}s" for severity in SEVERITIES)
    out.print(
        Text(f"{result.location}: {'sound' if result.ok else 'not sound'} ({counts})", style="bold"), soft_wrap=True
    )
