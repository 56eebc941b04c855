"""`carlasc export`: the layout as another data set's files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import typer

import carlasc
from carlasc.cli.common import (
    Json,
    echo,
    file_argument,
    place_argument,
    print_frames,
    starting_with,
)
from carlasc.cli.flags import DeclaredOptions, RunFlags
from carlasc.cli.library import Given, Library

DECLARED_BY: Final = "exporter"
"""What declares options of this command, if its arguments name one."""


def _print_list(wanted: bool) -> None:
    if wanted:
        for name in carlasc.converting.exporter_names():
            exporter = carlasc.converting.load_exporter(name)
            options = ", ".join(
                option.name for option in carlasc.converting.option_declarations(exporter)
            )
            echo(f"{name}: {exporter.title}" + (f" (options: {options})" if options else ""))
        raise typer.Exit


def export(
    *,
    options: DeclaredOptions,
    run: RunFlags,
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME",
            help="Name of the other data set: kitti, occ3d, ... (see --list). NAME --help also "
            "shows the options of this data set.",
            autocompletion=lambda incomplete: starting_with(
                incomplete, carlasc.converting.exporter_names()
            ),
        ),
    ],
    source: Annotated[str, place_argument("Folder, zip, store or URL of one or more sequences.")],
    out: Annotated[Path, file_argument("Folder to write to.")],
    sequences: Annotated[
        str | None, typer.Option(help="Names of sequences, separated by commas. Default: all.")
    ] = None,
    written: Annotated[Given, Library("carlasc.export")],
    json: Json = False,
    _list: Annotated[
        bool,
        typer.Option(
            "--list",
            help="List the exporters that are installed.",
            callback=_print_list,
            is_eager=True,
        ),
    ] = False,
) -> None:
    """Write sequences in the format of another data set, so that its tools can read them.

    Run it again to continue where it stopped: existing frames are skipped.
    """
    with run.spread(f"export {name}") as spread:
        result = written.make(
            name,
            source,
            out,
            sequences=None if sequences is None else sequences.split(","),
            options=options.values,
            run=spread,
        )
    lines = [f"{path or '.'} -> {result.out / place}" for path, place in result.sequences.items()]
    print_frames(result, lines, "written", json=json)
