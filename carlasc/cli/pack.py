"""`carlasc pack`: one store in the place of a million files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from carlasc.cli.common import Json, console, print_json, progress_bar

if TYPE_CHECKING:
    from carlasc.storage.packing import PackResult


def pack(
    src: Annotated[str, typer.Argument(metavar="SRC", help="Folder, zip or URL with one sequence or many.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Store to write: .zarr, .h5 or .parquet.")],
    small: Annotated[
        bool, typer.Option("--small", help="PCodec for points (zarr): smaller, but fewer programs read it.")
    ] = False,
    lossy_mm: Annotated[
        float | None, typer.Option(help="Quantise points to so many millimetres. Without it no bit is lost.")
    ] = None,
    workers: Annotated[int | None, typer.Option(help="Threads that read ahead.", min=1)] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a store that is there.")] = False,
    json: Json = False,
) -> None:
    """Pack all sequences of SRC into one store, several times smaller and faster to read; nothing is lost.

    A run that was cut off is finished by running the same command again.
    """
    from carlasc.storage.packing import pack as pack_sequences

    with progress_bar("Packing", "files") as progress:
        result = pack_sequences(
            src, out, small=small, lossy_mm=lossy_mm, overwrite=overwrite, workers=workers, progress=progress
        )
    if json:
        print_json(result)
    else:
        _print(result)


def _print(result: PackResult) -> None:
    from rich.table import Table

    table = Table(title=f"{result.out}: {len(result.sequences)} sequences, {result.frames} frames")
    for heading in ("field", "published", "packed", "share"):
        table.add_column(heading, justify="left" if heading == "field" else "right")
    for name in sorted({*result.published, *result.stored}):
        before, after = result.published.get(name, 0), result.stored.get(name, 0)
        table.add_row(name, f"{before:,}", f"{after:,}", f"{after / before:.1%}" if before else "")
    before, after = sum(result.published.values()), sum(result.stored.values())
    table.add_row("total", f"{before:,}", f"{after:,}", f"{result.ratio:.1%}", style="bold")
    console().print(table)
    if result.left_out:
        more = f" and {len(result.left_out) - 5} more" if len(result.left_out) > 5 else ""
        typer.echo(f"Left out, unknown to the layout: {', '.join(result.left_out[:5])}{more}")
