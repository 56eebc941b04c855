"""`carlasc unpack`: from a packed store to the published files again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from carlasc.cli.common import Json, print_json, progress_bar


def unpack(
    source: Annotated[str, typer.Argument(metavar="SOURCE", help="Packed store, zip or URL.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder to write.")],
    threads: Annotated[int, typer.Option(help="Number of threads that read ahead.", min=1)] = 2,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Write into a folder that exists, and replace files of the same names.")
    ] = False,
    json: Json = False,
) -> None:
    """Write all sequences of SOURCE as published files: the same bytes that were packed.

    If it is interrupted, run the same command again to finish it.
    """
    from carlasc.storage.packing import unpack as unpack_sequences

    with progress_bar("Unpacking", "files") as progress:
        result = unpack_sequences(source, out, overwrite=overwrite, threads=threads, progress=progress)
    if json:
        print_json(result)
    else:
        kept = f" ({result.kept} were written by an earlier run)" if result.kept else ""
        typer.echo(f"{result.out}: {len(result.sequences)} sequences, {result.files} files written{kept}")
