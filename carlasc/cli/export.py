"""`carlasc export`: the layout as another data set's files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from carlasc.cli.common import Json, Workers, print_json, progress_bar, report_failures


def export(
    name: Annotated[str, typer.Argument(metavar="NAME", help="The other data set: kitti.")],
    source: Annotated[
        str, typer.Argument(metavar="SOURCE", help="Folder, zip, store or URL of one or more sequences.")
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder to write to.")],
    sequences: Annotated[
        str | None, typer.Option(help="Names of sequences, separated by commas. Default: all.")
    ] = None,
    grid: Annotated[
        str | None,
        typer.Option(
            help="Grid that goes to voxels/. Default: the original files if they were kept, else the finest grid."
        ),
    ] = None,
    predictions: Annotated[
        bool,
        typer.Option(
            "--predictions",
            help="SOURCE holds the output of a network: write predictions/ for SemanticKITTI's evaluator.",
        ),
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Write frames again that exist.")] = False,
    workers: Workers = None,
    json: Json = False,
) -> None:
    """Write sequences as another data set's files, so that its tools can read them.

    Run it again to continue where it stopped: frames that exist are skipped.
    """
    from carlasc.converting import export as export_sequences

    with progress_bar(f"export {name}") as progress:
        result = export_sequences(
            name,
            source,
            out,
            sequences=None if sequences is None else sequences.split(","),
            overwrite=overwrite,
            workers=workers,
            progress=progress,
            grid=grid,
            predictions=predictions,
        )
    if json:
        print_json(result)
    else:
        for path, folder in result.sequences.items():
            typer.echo(f"{path or '.'} -> {result.out / folder}")
        skipped = f" ({result.skipped} existed)" if result.skipped else ""
        typer.echo(f"{result.made} frames written{skipped} in {result.elapsed_s:.1f} s")
    report_failures(
        [(f.frame, f.message) for f in result.failures], result.made + result.skipped + len(result.failures)
    )
