"""`carlasc map`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import carlasc
from carlasc.cli.common import (
    FramesOption,
    Json,
    echo,
    file_argument,
    file_option,
    place_argument,
    print_json,
)
from carlasc.cli.flags import WorkFlags
from carlasc.cli.grid_flags import MOTION_HELP, PoseFlags
from carlasc.errors import count


def map(
    poses: PoseFlags,
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
    cell_m: Annotated[
        float, typer.Option("--cell", help="Cell size, in metres: one point is written per cell.")
    ] = 0.05,
    frames: FramesOption = None,
    actors: Annotated[
        bool,
        typer.Option(
            "--actors",
            help="Also write the body of each actor, in its own frame, to the folder OUT_actors.",
        ),
    ] = False,
    mesh: Annotated[
        Path | None,
        file_option(
            "--mesh",
            text="File of the surface, with classes as colours: .ply or .glb.",
            metavar="FILE",
        ),
    ] = None,
    grid: Annotated[
        str | None,
        typer.Option(
            help="Make the map from this grid of one frame (see --frames), instead of the scans."
        ),
    ] = None,
    distance: Annotated[
        Path | None,
        file_option(
            "--distance",
            text="With --grid: .npz file of the distance of each voxel from the surface.",
            metavar="FILE",
        ),
    ] = None,
    motion: Annotated[carlasc.motion.MotionSource, typer.Option(help=f"{MOTION_HELP}.")] = "auto",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
    json: Json = False,
) -> None:
    """Write a map of a drive: the static points of all scans in one coordinate frame, as points, as
    a mesh, or for OctoMap.
    """
    options = poses.options()
    with run.spread("Mapping", "scans") as spread:
        result = carlasc.map(
            source,
            out,
            cell_m=cell_m,
            frames=frames,
            grid=grid,
            actors=actors,
            mesh=mesh,
            distance=distance,
            motion=carlasc.motion.MotionOptions(motion),
            poses=options,
            overwrite=overwrite,
            run=spread,
        )
    if json:
        print_json(result)
        return
    for note in result.notes:
        echo(f"note: {note}")
    for name in result.files:
        echo(name)
    what, of = (
        ("voxels", f"of {grid}")
        if grid is not None
        else ("points", f"of {count(result.frames, 'scan')}")
    )
    bodies = f", and {count(result.actors, 'actor')} in files of their own" if actors else ""
    echo(f"{result.points:,} {what} {of}{bodies}, in {result.elapsed_s:.1f} s")
