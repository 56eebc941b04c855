"""`carlasc pack`: all files of a data set in one store."""

from __future__ import annotations

from typing import Annotated

import carlasc
from carlasc.cli.common import Json, echo, place_argument, print_json
from carlasc.cli.flags import RunFlags
from carlasc.cli.library import Given, Library
from carlasc.errors import count, first_names


def pack(
    run: RunFlags,
    source: Annotated[str, place_argument("A data set, a split, a sequence, a zip, or a URL.")],
    out: Annotated[
        str, place_argument("Store to write. Its name ends in .zarr, .h5 or .parquet.", "OUT")
    ],
    options: Annotated[Given, Library("carlasc.pack")],
    json: Json = False,
) -> None:
    """Pack all sequences of SOURCE into one store, which is several times smaller.

    Without --lossy-mm, nothing is lost.

    If it is interrupted, run the same command again to finish it.
    """
    with run.spread("Packing", "files") as spread:
        result = options.make(source, out, run=spread)
    if json:
        print_json(result)
    elif result.is_finished:
        _print(result)
    else:
        echo(f"{result.out}: part {run.part} is packed; the part that ends last finishes the store")


def _print(result: carlasc.storage.packing.PackResult) -> None:
    from carlasc.cli.tables import print_table

    echo(
        f"{result.out}: {count(len(result.sequences), 'sequence')}, {count(result.frames, 'frame')}"
    )
    published = result.published_bytes
    stored = result.stored_bytes
    rows = [
        (name, published.get(name, 0), stored.get(name, 0))
        for name in sorted({*published, *stored})
    ]
    rows.append(("total", sum(published.values()), sum(stored.values())))
    print_table(
        ("field", "published bytes", "packed bytes", "share"),
        [
            (name, f"{before:,}", f"{after:,}", f"{after / before:.1%}" if before else None)
            for name, before, after in rows
        ],
        turn=False,
    )
    if result.left_out:
        echo(
            "left out, because they are not part of CarlaSC's layout: "
            f"{first_names(result.left_out, 5)}"
        )
