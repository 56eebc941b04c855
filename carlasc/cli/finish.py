"""`carlasc finish`: close a store that was written in parts."""

from __future__ import annotations

from typing import Annotated

import typer

import carlasc
from carlasc.cli.common import Json, echo, place_argument, print_json
from carlasc.errors import count


def finish(
    out: Annotated[str, place_argument("The .zarr store that was written in parts.", "OUT")],
    incomplete: Annotated[
        bool, typer.Option("--incomplete", help="Finish the store even if frames are missing.")
    ] = False,
    json: Json = False,
) -> None:
    """Finish a .zarr store that was written in parts, so that it can be opened.

    The last part of a run does this automatically. Use this command if a part failed, or was never
    run.
    """
    result = carlasc.finish(out, incomplete=incomplete)
    if json:
        print_json(result)
        return
    for path, fields in result.sequences.items():
        listed = ", ".join(f"{name} {count}" for name, count in fields.items())
        echo(f"{path or '.'}: {listed or 'no frames'}")
    missing = sum(sum(fields.values()) for fields in result.missing.values())
    left_out = f", {count(missing, 'file')} missing" if missing else ""
    echo(f"{result.location}: {count(len(result.sequences), 'sequence')}{left_out}")
