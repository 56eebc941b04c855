"""`carlasc download`: the published zips."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from carlasc.cli.common import Json, echo, file_argument, print_json, progress_bar
from carlasc.errors import count


def download(
    out: Annotated[Path, file_argument("Folder to write the zips to.")],
    split: Annotated[
        list[str] | None,
        typer.Option(
            help="Split: train (two zips), val, test or all. Repeat it for several. Needed for "
            "sequences only."
        ),
    ] = None,
    what: Annotated[
        Literal["sequences", "fine", "cylindrical"],
        typer.Option(
            help="What to download. sequences: scans, poses and coarse grids. fine, cylindrical: "
            "only these grids, of all splits."
        ),
    ] = "sequences",
    extract: Annotated[
        bool, typer.Option("--extract", help="Extract each zip into OUT, then remove it.")
    ] = False,
    keep: Annotated[bool, typer.Option("--keep", help="With --extract: keep the zips.")] = False,
    connections: Annotated[int, typer.Option(help="Number of parallel connections.", min=1)] = 4,
    base_url: Annotated[
        str | None, typer.Option(help="URL of a mirror: zips are read from BASE_URL/NAME.")
    ] = None,
    json: Json = False,
) -> None:
    """Download the published zips. If it is interrupted, run the same command again to continue.

    The zips need not be extracted: every command can read them.
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
        place = (
            archive.path
            if archive.folder is None
            else f"{count(archive.files, 'file')} in {archive.folder}"
        )
        echo(f"{archive.name}: {archive.fetched / 1e9:.2f} GB downloaded: {place}")
