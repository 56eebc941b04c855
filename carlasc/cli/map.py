"""`carlasc map`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from carlasc.cli.common import (
    Json,
    echo,
    file_argument,
    place_argument,
    print_json,
)
from carlasc.cli.flags import WorkFlags
from carlasc.cli.grid_flags import MotionGiven, PosesGiven
from carlasc.cli.library import Given, Library
from carlasc.errors import count


def map(
    *,
    poses: PosesGiven,
    run: WorkFlags,
    source: Annotated[
        str, place_argument("A sequence: its folder, a zip, a packed store, or a URL.")
    ],
    out: Annotated[
        Path | None,
        file_argument(
            "File of the map: .ply, .pcd, .las or .npz (points), or .bt (OctoMap). Not needed with "
            "--mesh or --distance."
        ),
    ] = None,
    options: Annotated[Given, Library("carlasc.map")],
    motion: MotionGiven,
    json: Json = False,
) -> None:
    """Write a map of a drive: the static points of all scans in one coordinate frame, as points, as
    a mesh, or for OctoMap.
    """
    with run.spread("Mapping", "scans") as spread:
        result = options.make(source, out, motion=motion.make(), poses=poses.make(), run=spread)
    if json:
        print_json(result)
        return
    for note in result.notes:
        echo(f"note: {note}")
    for name in result.files:
        echo(name)
    what, of = (
        ("voxels", f"of {options.values['grid']}")
        if "grid" in options.values
        else ("points", f"of {count(result.frames, 'scan')}")
    )
    bodies = (
        f", and {count(result.actors, 'actor')} in files of their own"
        if "actors" in options.values
        else ""
    )
    echo(f"{result.points:,} {what} {of}{bodies}, in {result.elapsed_s:.1f} s")
