"""`carlasc pack`: one store instead of a quarter of a million files."""

from __future__ import annotations

from typing import Annotated

import typer

import carlasc
from carlasc.cli.common import Json, console, echo, line, place_argument, print_json
from carlasc.cli.flags import RunFlags
from carlasc.errors import count


def pack(
    run: RunFlags,
    source: Annotated[str, place_argument("Folder, zip or URL with one or more sequences.")],
    out: Annotated[str, place_argument("Store to write; its ending says which kind: .zarr, .h5 or .parquet.", "OUT")],
    small: Annotated[
        bool,
        typer.Option("--small", help="Pack points with PCodec (zarr only): smaller, but fewer programs can read it."),
    ] = False,
    lossy_mm: Annotated[
        float | None, typer.Option(help="Quantise points to this many millimetres. Without it, every bit is kept.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a store that exists at OUT.")] = False,
    json: Json = False,
) -> None:
    """Pack all sequences of SOURCE into one store, which is several times smaller. Nothing is lost.

    If it is interrupted, run the same command again to finish it.
    """
    with run.spread("Packing", "files") as spread:
        result = carlasc.pack(source, out, small=small, lossy_mm=lossy_mm, overwrite=overwrite, run=spread)
    if json:
        print_json(result)
    elif result.is_finished:
        _print(result)
    else:
        echo(f"{result.out}: part {run.part} is packed; the last part finishes the store")


def _print(result: carlasc.storage.packing.PackResult) -> None:
    from rich.table import Table

    echo(f"{result.out}: {count(len(result.sequences), 'sequence')}, {count(result.frames, 'frame')}")
    table = Table()
    for heading in ("field", "published bytes", "packed bytes", "share"):
        table.add_column(heading, justify="left" if heading == "field" else "right")
    for name in sorted({*result.published_bytes, *result.stored_bytes}):
        before, after = result.published_bytes.get(name, 0), result.stored_bytes.get(name, 0)
        table.add_row(line(name), f"{before:,}", f"{after:,}", f"{after / before:.1%}" if before else "")
    before, after = sum(result.published_bytes.values()), sum(result.stored_bytes.values())
    table.add_row("total", f"{before:,}", f"{after:,}", f"{result.ratio:.1%}", style="bold")
    console().print(table)
    if result.left_out:
        more = f" and {len(result.left_out) - 5} more" if len(result.left_out) > 5 else ""
        echo(f"Left out, because the layout does not know them: {', '.join(result.left_out[:5])}{more}")
