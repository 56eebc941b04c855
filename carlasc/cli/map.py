"""`carlasc map`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import carlasc
from carlasc.cli.common import FramesOption, Json, echo, file_argument, file_option, place_argument, print_json
from carlasc.cli.flags import WorkFlags
from carlasc.cli.grid_flags import PoseFlags


def map(
    poses: PoseFlags,
    run: WorkFlags,
    source: Annotated[str, place_argument("A sequence: its folder, a zip, a packed store, or a URL.")],
    out: Annotated[
        Path | None,
        file_argument(
            "File of the map: .ply, .pcd, .las or .npz (points), or .bt (OctoMap); may be left out with --mesh or --distance."
        ),
    ] = None,
    cell_m: Annotated[
        float, typer.Option("--cell", help="Size of a cell, in metres: one point is written per cell.")
    ] = 0.05,
    frames: FramesOption = None,
    actors: Annotated[
        bool,
        typer.Option("--actors", help="Also write the body of each actor, in its own frame, to the folder OUT_actors."),
    ] = False,
    mesh: Annotated[
        Path | None,
        file_option("--mesh", text="File of the surface, with classes as colours: .ply or .glb.", metavar="FILE"),
    ] = None,
    grid: Annotated[
        str | None, typer.Option(help="Take this grid of one frame (see --frames) as the map, instead of the scans.")
    ] = None,
    distance: Annotated[
        Path | None,
        file_option(
            "--distance", text="File of the distance of each voxel from the surface, with --grid: .npz.", metavar="FILE"
        ),
    ] = None,
    motion: Annotated[
        carlasc.motion.MotionSource,
        typer.Option(
            help="What tells which points move. boxes, instances, flow: the field of that name; evidence: free space that other scans saw"
            " there; none: nothing but moving classes; auto: the best field that exists, and evidence for what it misses."
        ),
    ] = "auto",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files that exist.")] = False,
    json: Json = False,
) -> None:
    """Write a map of a drive: the static points of its scans in one frame, without what moves; also as a mesh, or for OctoMap."""
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
    what, of = ("voxels", f"of {grid}") if grid is not None else ("points", f"of {result.frames} scans")
    bodies = f", {result.actors} actors beside it" if actors else ""
    echo(f"{result.points:,} {what} {of}{bodies}, in {result.elapsed_s:.1f} s")
