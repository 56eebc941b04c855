"""`carlasc map`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

from carlasc.cli.common import (
    Json,
    as_typed,
    echo,
    file_argument,
    place_argument,
    print_json,
    print_warnings,
    report_failures,
)
from carlasc.cli.flags import DeclaredOptions, WorkFlags
from carlasc.cli.grid_flags import MotionGiven, PosesGiven
from carlasc.cli.library import Given, Library
from carlasc.errors import count

DECLARED_BY: Final = "converter"
"""What declares options of this command, if its arguments name one."""


def map(
    *,
    declared: DeclaredOptions,
    recording: Annotated[Given, Library("carlasc.RecordingOptions")],
    poses: PosesGiven,
    run: WorkFlags,
    source: Annotated[
        str,
        place_argument(
            "A sequence: its folder, a zip, a packed store, or a URL; or a recording: a bag, or a "
            "folder of scans."
        ),
    ],
    out: Annotated[
        Path | None,
        file_argument(
            "File of the map: .ply, .pcd, .las or .npz (points), or .bt (OctoMap). Not needed with "
            "--mesh or --distance."
        ),
    ] = None,
    options: Annotated[Given, Library("carlasc.map")],
    extras: Annotated[Given, Library("carlasc.MapExtras")],
    motion: MotionGiven,
    json: Json = False,
) -> None:
    """Write a map of a drive: the static points of all scans in one coordinate frame, as points, as
    a mesh, or for OctoMap.
    """
    with run.spread("Mapping", "scans") as spread:
        result = options.make(
            source,
            out,
            extras=extras.make(),
            recording=recording.make(options=declared.values),
            motion=motion.make(),
            poses=poses.make(),
            run=spread,
        )
    failures = [(failure.frame, failure.message) for failure in result.failures]
    if json:
        print_json(result)
        report_failures(failures, result.frames + len(failures))
        return
    print_warnings(result.findings)
    for note in result.notes:
        echo(as_typed(f"note: {note}"))
    for name in result.files:
        echo(name)
    what, of = (
        ("voxels", f"of {options.values['grid']}")
        if "grid" in options.values
        else ("points", f"of {count(result.frames, 'scan')}")
    )
    bodies = (
        f", and {count(result.actors, 'actor')} in files of their own"
        if "actors" in extras.values
        else ""
    )
    echo(f"{result.points:,} {what} {of}{bodies}, in {result.elapsed_s:.1f} s")
    report_failures(failures, result.frames + len(failures))
