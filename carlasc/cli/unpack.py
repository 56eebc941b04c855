"""`carlasc unpack`: the published files from a packed store."""

from __future__ import annotations

from typing import Annotated

from carlasc.cli.common import Json, echo, place_argument, print_json
from carlasc.cli.flags import RunFlags
from carlasc.cli.library import Given, Library
from carlasc.errors import count


def unpack(
    run: RunFlags,
    source: Annotated[str, place_argument("Packed store, zip or URL.")],
    out: Annotated[str, place_argument("Folder to write.", "OUT")],
    options: Annotated[Given, Library("carlasc.unpack")],
    json: Json = False,
) -> None:
    """Write all sequences of SOURCE as files in CarlaSC's layout, with the bytes that were packed.

    If it is interrupted, run the same command again to finish it.
    """
    with run.spread("Unpacking", "files") as spread:
        result = options.make(source, out, run=spread)
    if json:
        print_json(result)
    else:
        kept = f" ({result.kept} were written by an earlier run)" if result.kept else ""
        echo(
            f"{result.out}: {count(len(result.sequences), 'sequence')}, "
            f"{count(result.files, 'file')} written{kept}"
        )
