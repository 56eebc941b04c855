"""`carlasc refine`."""

from __future__ import annotations

from typing import Annotated

from carlasc.cli.common import Json, SourceArgument, echo, place_option, print_json
from carlasc.cli.flags import RunFlags
from carlasc.cli.grid_flags import PosesGiven
from carlasc.cli.library import Given, Library
from carlasc.errors import count


def refine(
    poses: PosesGiven,
    run: RunFlags,
    source: SourceArgument,
    out: Annotated[
        str, place_option("-o", "--out", text="Folder of the data set with refined poses.")
    ],
    options: Annotated[Given, Library("carlasc.refine")],
    json: Json = False,
) -> None:
    """Write a copy of SOURCE with refined poses, so that neighbouring scans agree.

    SOURCE is not changed.

    Unchanged files are hard links. If it is interrupted, run the same command again to finish it.
    """
    with run.spread("Refining poses", "scans and files") as spread:
        result = options.make(source, out, poses=poses.make(), run=spread)
    if json:
        print_json(result)
        return
    for note in result.notes:
        echo(note)
    if result.left_out:
        echo(f"note: {', '.join(result.left_out)} left out, because of other poses")
    files = f"{count(result.linked, 'file')} linked, {result.files} written"
    echo(
        f"{result.out}: poses of {len(result.refined)} of "
        f"{count(len(result.sequences), 'sequence')} refined; {files}"
    )
