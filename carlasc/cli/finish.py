"""`carlasc finish`: close a store that was written in parts."""

from __future__ import annotations

from typing import Annotated

from carlasc.cli.common import Json, echo, place_argument, print_json
from carlasc.cli.library import Given, Library
from carlasc.errors import count


def finish(
    out: Annotated[
        str, place_argument("The folder or the .zarr store that was written in parts.", "OUT")
    ],
    options: Annotated[Given, Library("carlasc.finish")],
    json: Json = False,
) -> None:
    """Check that an output that was written in parts is complete, and finish a .zarr store, so that
    it can be opened.

    The last part of a run does this automatically. Use this command if a part failed, or was never
    run.
    """
    result = options.make(out)
    if json:
        print_json(result)
        return
    for path, fields in result.sequences.items():
        listed = ", ".join(f"{name} {count}" for name, count in fields.items())
        echo(f"{path or '.'}: {listed or 'no frames'}")
    missing = sum(sum(fields.values()) for fields in result.missing.values())
    left_out = f", {count(missing, 'file')} missing" if missing else ""
    echo(f"{result.location}: {count(len(result.sequences), 'sequence')}{left_out}")
