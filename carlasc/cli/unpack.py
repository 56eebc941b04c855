"""`carlasc unpack`: from a packed store to the published files again."""

from __future__ import annotations

from typing import Annotated

import typer

from carlasc.cli.common import (
    Cluster,
    Json,
    PartOption,
    Workers,
    echo,
    engine,
    parse_part,
    place_argument,
    print_json,
    progress_bar,
)
from carlasc.running.options import Run


def unpack(
    source: Annotated[str, place_argument("Packed store, zip or URL.")],
    out: Annotated[str, place_argument("Folder to write.", "OUT")],
    workers: Workers = None,
    cluster: Cluster = None,
    part: PartOption = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Write into a folder that exists, and replace files of the same names.")
    ] = False,
    json: Json = False,
) -> None:
    """Write all sequences of SOURCE as published files: the same bytes that were packed.

    If it is interrupted, run the same command again to finish it.
    """
    from carlasc.storage.unpacking import unpack as unpack_sequences

    with progress_bar("Unpacking", "files") as progress, engine(cluster, workers) as executor:
        result = unpack_sequences(
            source,
            out,
            overwrite=overwrite,
            run=Run(workers=workers, executor=executor, part=parse_part(part), progress=progress),
        )
    if json:
        print_json(result)
    else:
        kept = f" ({result.kept} were written by an earlier run)" if result.kept else ""
        echo(f"{result.out}: {len(result.sequences)} sequences, {result.files} files written{kept}")
