"""`carlasc export`: the layout as another data set's files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from carlasc.cli.common import Json, Workers, print_json, progress_bar, report_failures


def export(
    name: Annotated[str, typer.Argument(metavar="NAME", help="The other data set: kitti.")],
    src: Annotated[str, typer.Argument(metavar="SRC", help="Folder, zip, store or URL of one sequence or many.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder to write to.")],
    sequences: Annotated[
        str | None, typer.Option(help="Names of sequences, with commas between; all if not given.")
    ] = None,
    grid: Annotated[
        str | None,
        typer.Option(help="Which grid goes to voxels/; the original files, or the finest grid, if not given."),
    ] = None,
    predictions: Annotated[
        bool, typer.Option("--predictions", help="SRC holds a network's output: write predictions/ for the evaluator.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Write again what is there.")] = False,
    workers: Workers = None,
    json: Json = False,
) -> None:
    """Write sequences as another data set's files, so that its tools can read them.

    Run it again to go on where it stopped: frames that are there are skipped.
    """
    from carlasc.converting import export as export_sequences

    with progress_bar(f"export {name}") as progress:
        result = export_sequences(
            name,
            src,
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
        there = f" ({result.skipped} were there)" if result.skipped else ""
        typer.echo(f"{result.made} frames written{there} in {result.elapsed_s:.1f} s")
    report_failures(
        [(f.frame, f.message) for f in result.failures], result.made + result.skipped + len(result.failures)
    )
