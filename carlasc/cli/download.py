"""`carlasc download`: the published zips."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from carlasc.cli.common import Json, echo, file_argument, print_json, progress_bar
from carlasc.cli.library import Given, Library
from carlasc.errors import count


def download(
    out: Annotated[Path, file_argument("Folder to write the zips to.")],
    options: Annotated[Given, Library("carlasc.download")],
    json: Json = False,
) -> None:
    """Download the published zips. If it is interrupted, run the same command again to continue.

    The zips need not be extracted: every command can read them.
    """
    with progress_bar("Downloading", unit="MB") as show:
        result = options.make(out, progress=lambda done, total: show(done // 10**6, total // 10**6))
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
