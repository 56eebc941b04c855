"""`carlasc scores`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from carlasc.cli.common import Overwrite, echo
from carlasc.cli.library import Given, Library


def scores(
    *,
    files: Annotated[
        list[Path], typer.Argument(help="JSON files that `carlasc evaluate --json` printed.")
    ],
    format: Annotated[
        Literal["text", "markdown", "latex", "csv", "html"] | None,
        typer.Option(help="Format of the table. Default: by the ending of OUT, otherwise text."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="File to write. Default: print the table.")
    ] = None,
    options: Annotated[Given, Library("carlasc.scores")],
    overwrite: Overwrite = False,
) -> None:
    """Put the results of several evaluations into one table."""
    from carlasc.errors import ConflictError

    table = options.make(files)
    if format is None and out is not None:
        endings = {".md": "markdown", ".tex": "latex", ".html": "html", ".htm": "html"}
        format = endings.get(out.suffix.lower(), "csv")  # type: ignore[assignment]
    if format in (None, "text") and out is None:
        from carlasc.cli.tables import print_table

        figures = table.table()
        print_table(figures.header, figures.texts(), title=figures.title)
        return
    if format == "html":
        text = table.to_html()
    else:
        text = getattr(table.table(), f"to_{'csv' if format == 'text' else format}")()
    if out is None:
        echo(text, nl=False)
        return
    if out.exists() and not overwrite:
        raise ConflictError(
            out,
            problem="the file exists",
            advice="choose another name, or replace it with `overwrite=True`",
        )
    from carlasc.storage.files import write_output

    write_output(out, text.encode())
