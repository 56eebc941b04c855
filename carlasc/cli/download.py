"""`carlasc download`: the published zips."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from carlasc.cli.common import Json, echo, file_argument, print_json, progress_bar
from carlasc.errors import count


def download(
    out: Annotated[Path, file_argument("Folder that the zips are written to.")],
    split: Annotated[
        list[str] | None, typer.Option(help="train (two zips), val, test or all; can be given several times.")
    ] = None,
    what: Annotated[
        Literal["sequences", "fine", "cylindrical"],
        typer.Option(help="Sequences (scans, poses, coarse grids), or only fine or cylindrical grids (of all splits)."),
    ] = "sequences",
    extract: Annotated[bool, typer.Option("--extract", help="Extract each zip into OUT, then remove it.")] = False,
    keep: Annotated[bool, typer.Option("--keep", help="With --extract: keep the zip too.")] = False,
    connections: Annotated[int, typer.Option(help="Number of connections at once.", min=1)] = 4,
    base_url: Annotated[str | None, typer.Option(help="A mirror: fetch the zips from BASE_URL/<name>.")] = None,
    json: Json = False,
) -> None:
    """Fetch the published zips. If it is interrupted, run the same command again to continue.

    A zip need not be extracted: every command reads it in place.
    """
    from carlasc.storage import download as fetch

    with progress_bar("Downloading", unit="MB") as show:
        result = fetch(
            out,
            split=split or (),
            what=what,
            extract=extract,
            keep=keep,
            base_url=base_url,
            connections=connections,
            progress=lambda done, total: show(done // 10**6, total // 10**6),
        )
    if json:
        print_json(result)
        return
    for archive in result.archives:
        place = archive.path if archive.folder is None else f"{count(archive.files, 'file')} in {archive.folder}"
        echo(f"{archive.name}: {archive.fetched / 1e9:.2f} GB fetched: {place}")
