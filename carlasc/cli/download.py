"""`carlasc download`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from carlasc.cli.common import Json, print_json, progress_bar


def download(
    to: Annotated[Path, typer.Option("--to", help="Folder that the zips go to.")],
    split: Annotated[
        list[str] | None, typer.Option(help="train (two zips), val, test or all; may be given more than once.")
    ] = None,
    what: Annotated[
        Literal["sequences", "fine", "cylindrical"],
        typer.Option(help="Sequences (scans, poses, coarse grids), or only fine or cylindrical grids (all splits)."),
    ] = "sequences",
    extract: Annotated[bool, typer.Option("--extract", help="Unpack each zip, then remove it.")] = False,
    keep: Annotated[bool, typer.Option("--keep", help="With --extract: keep the zip.")] = False,
    connections: Annotated[int, typer.Option(help="Connections at once.", min=1)] = 4,
    base_url: Annotated[str | None, typer.Option(help="A mirror: zips are fetched from BASE_URL/<name>.")] = None,
    as_json: Json = False,
) -> None:
    """Fetch the published zips. Run again after an interruption, it goes on where it stopped.

    A zip need not be unpacked: every command reads it in place.
    """
    from carlasc.errors import ArgumentError
    from carlasc.storage.downloads import download as fetch
    from carlasc.storage.downloads.transfer import Settings

    if keep and not extract:
        raise ArgumentError("--keep: expected --extract beside it; without it zips are always kept")
    with progress_bar("Downloading", unit="MB") as show:
        result = fetch(
            to,
            split=split or (),
            what=what,
            unpack=extract,
            keep=keep,
            base_url=base_url,
            settings=Settings(connections=connections),
            progress=lambda done, total: show(done // 10**6, total // 10**6),
        )
    if as_json:
        print_json(result)
        return
    for archive in result.archives:
        place = archive.path if archive.folder is None else f"{archive.files} files in {archive.folder}"
        typer.echo(f"{archive.name}: {archive.fetched / 1e9:.2f} GB fetched: {place}")
