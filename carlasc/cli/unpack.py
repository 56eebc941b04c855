"""`carlasc unpack`: the published files again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from carlasc.cli.common import Json, print_json, progress_bar


def unpack(
    src: Annotated[str, typer.Argument(metavar="SRC", help="Packed store (or a zip, or a URL).")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder to write.")],
    workers: Annotated[int | None, typer.Option(help="Threads that read ahead.", min=1)] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Write into a folder that is there, over files of the same names.")
    ] = False,
    json: Json = False,
) -> None:
    """Write all sequences of SRC as published files: the very bytes that were packed.

    A run that was cut off is finished by running the same command again.
    """
    from carlasc.storage.packing import unpack as unpack_sequences

    with progress_bar("Unpacking", "files") as progress:
        result = unpack_sequences(src, out, overwrite=overwrite, workers=workers, progress=progress)
    if json:
        print_json(result)
    else:
        kept = f" ({result.kept} were there from an earlier run)" if result.kept else ""
        typer.echo(f"{result.out}: {len(result.sequences)} sequences, {result.files} files written{kept}")
