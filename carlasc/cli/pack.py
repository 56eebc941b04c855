"""`carlasc pack`: all files of a data set in one store."""

from __future__ import annotations

from typing import Annotated

import carlasc
from carlasc.cli.common import Json, console, echo, line, place_argument, print_json
from carlasc.cli.flags import RunFlags
from carlasc.cli.library import Given, Library
from carlasc.errors import count


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
    from rich.table import Table

    echo(
        f"{result.out}: {count(len(result.sequences), 'sequence')}, {count(result.frames, 'frame')}"
    )
    table = Table()
    for heading in ("field", "published bytes", "packed bytes", "share"):
        table.add_column(heading, justify="left" if heading == "field" else "right")
    for name in sorted({*result.published_bytes, *result.stored_bytes}):
        before, after = result.published_bytes.get(name, 0), result.stored_bytes.get(name, 0)
        table.add_row(
            line(name), f"{before:,}", f"{after:,}", f"{after / before:.1%}" if before else ""
        )
    before, after = sum(result.published_bytes.values()), sum(result.stored_bytes.values())
    table.add_row("total", f"{before:,}", f"{after:,}", f"{result.ratio:.1%}", style="bold")
    console().print(table)
    if result.left_out:
        more = f" and {len(result.left_out) - 5} more" if len(result.left_out) > 5 else ""
        echo(
            f"left out, because they are not part of CarlaSC's layout: "
            f"{', '.join(result.left_out[:5])}{more}"
        )
