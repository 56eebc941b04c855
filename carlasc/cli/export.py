"""`carlasc export`: the layout as another data set's files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from carlasc.cli.common import (
    Cluster,
    Json,
    PartOption,
    Workers,
    echo,
    engine,
    file_argument,
    parse_options,
    parse_part,
    place_argument,
    print_json,
    progress_bar,
    report_failures,
)


def _print_list(wanted: bool) -> None:
    if wanted:
        from carlasc.converting import exporter_names, load_exporter, option_declarations

        for name in exporter_names():
            exporter = load_exporter(name)
            options = ", ".join(option.name for option in option_declarations(exporter))
            echo(f"{name}: {exporter.title}" + (f" (options: {options})" if options else ""))
        raise typer.Exit


def export(
    name: Annotated[str, typer.Argument(metavar="NAME", help="The other data set: kitti, occ3d, ... (see --list).")],
    source: Annotated[str, place_argument("Folder, zip, store or URL of one or more sequences.")],
    out: Annotated[Path, file_argument("Folder to write to.")],
    sequences: Annotated[
        str | None, typer.Option(help="Names of sequences, separated by commas. Default: all.")
    ] = None,
    grid: Annotated[
        str | None,
        typer.Option(
            help="Grid that is exported. Default: the one with exactly the voxels of the other data set, else the one of the smallest voxels."
        ),
    ] = None,
    predictions: Annotated[
        bool,
        typer.Option("--predictions", help="SOURCE holds the output of a network: grids without counts."),
    ] = False,
    option: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE", help="Another option of the exporter (see --list); may be given several times."
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Write frames again that exist.")] = False,
    workers: Workers = None,
    cluster: Cluster = None,
    part: PartOption = None,
    json: Json = False,
    _list: Annotated[
        bool,
        typer.Option("--list", help="List the exporters that are installed.", callback=_print_list, is_eager=True),
    ] = False,
) -> None:
    """Write sequences as another data set's files, so that its tools can read them.

    Run it again to continue where it stopped: frames that exist are skipped.
    """
    from carlasc.converting import export as export_sequences
    from carlasc.running import Run

    options: dict[str, Any] = {**parse_options(option)}
    options |= {} if grid is None else {"grid": grid}
    options |= {"predictions": True} if predictions else {}
    with progress_bar(f"export {name}") as progress, engine(cluster, workers) as executor:
        result = export_sequences(
            name,
            source,
            out,
            sequences=None if sequences is None else sequences.split(","),
            overwrite=overwrite,
            options=options,
            run=Run(workers, executor, parse_part(part), progress),
        )
    if json:
        print_json(result)
    else:
        for note in result.notes:
            echo(f"note: {note}")
        for path, place in result.sequences.items():
            echo(f"{path or '.'} -> {result.out / place}")
        skipped = f" ({result.skipped} existed)" if result.skipped else ""
        echo(f"{result.made} frames written{skipped} in {result.elapsed_s:.1f} s")
    report_failures(
        [(f.frame, f.message) for f in result.failures], result.made + result.skipped + len(result.failures)
    )
