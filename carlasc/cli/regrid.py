"""`carlasc regrid`: ground truth at any resolution."""

from __future__ import annotations

import math
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from carlasc.cli.common import (
    Json,
    Overwrite,
    Workers,
    parse_frames,
    parse_numbers,
    print_json,
    progress_bar,
    report_failures,
)
from carlasc.errors import ArgumentError

if TYPE_CHECKING:
    from carlasc.grids import GridSpec


class Coordinates(StrEnum):
    """Axes of a grid."""

    cartesian = "cartesian"
    cylindrical = "cylindrical"


class Preset(StrEnum):
    """Grids of the published data set."""

    coarse = "coarse"
    fine = "fine"
    cylindrical = "cylindrical"


class Vote(StrEnum):
    """How votes are counted."""

    sensor = "sensor"
    sample = "sample"


_GRID = "Grid: one of --res, --size and --preset"


def regrid(
    src: Annotated[
        Path,
        typer.Argument(help="A sequence's folder that holds raw/, or a folder of such sequences.", show_default="here"),
    ] = Path(),
    out: Annotated[
        Path | None,
        typer.Option(
            "-o", "--out", help="Where the sequences go, each with its path below SRC; SRC itself if not given."
        ),
    ] = None,
    res: Annotated[
        str | None,
        typer.Option(
            help="Size of a voxel: metres, or one value an axis: x,y,z or radius,degrees,z.", rich_help_panel=_GRID
        ),
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(help="Number of voxels an axis, X,Y,Z, over exactly the bounds.", rich_help_panel=_GRID),
    ] = None,
    preset: Annotated[Preset | None, typer.Option(help="A published grid.", rich_help_panel=_GRID)] = None,
    coordinates: Annotated[
        Coordinates | None, typer.Option(help="Axes of the grid; cartesian if not given.", rich_help_panel=_GRID)
    ] = None,
    bounds: Annotated[
        str | None,
        typer.Option(
            help="x0,x1,y0,y1,z0,z1 in metres (cylindrical: radius in metres, azimuth in degrees, z); the published ones if not given.",
            rich_help_panel=_GRID,
        ),
    ] = None,
    free_step: Annotated[float, typer.Option(help="Distance between the free samples on a ray, metres.")] = 1.5,
    vote: Annotated[
        Vote, typer.Option(help="One vote a sensor, voxel and class (as published), or every sample (as in the paper).")
    ] = Vote.sensor,
    frames: Annotated[
        str | None, typer.Option(help="Frame numbers A:B of the source, B not included; either end may be left out.")
    ] = None,
    workers: Workers = None,
    keep_votes: Annotated[bool, typer.Option("--keep-votes", help="Write the votes of every class too.")] = False,
    name: Annotated[str | None, typer.Option(help="The grid's folder; by its size if not given.")] = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Make ground truth at any resolution from a raw capture, with its scans, flow, poses and times.

    Run it again to go on where it stopped: frames that are there are skipped. Inside a sequence's folder `carlasc regrid --res 0.2` is all.
    """
    from carlasc.groundtruth import regrid as regrid_sequences

    spec = parse_grid(res, size, preset, coordinates, bounds)
    with progress_bar("regrid") as progress:
        result = regrid_sequences(
            src,
            out,
            spec,
            vote=vote.value,
            free_step_m=free_step,
            frames=parse_frames(frames),
            name=name,
            keep_votes=keep_votes,
            overwrite=overwrite,
            workers=workers,
            progress=progress,
        )
    if json:
        print_json(result)
    else:
        there = f" ({result.skipped} were there)" if result.skipped else ""
        for grid in result.grids:
            typer.echo(grid)
        typer.echo(f"{spec}: {result.made} frames made{there} in {result.elapsed_s:.1f} s")
    failures = [(failure.frame, failure.message) for failure in result.failures]
    report_failures(failures, result.made + result.skipped + len(failures))


def parse_grid(
    res: str | None, size: str | None, preset: Preset | None, coordinates: Coordinates | None, bounds: str | None
) -> GridSpec:
    """Return the grid that the options describe; degrees end here.

    Raises:
        ArgumentError: not exactly one of the three, or values that make no grid.
    """
    from carlasc.grids import GridSpec

    given = [option for option, value in (("--res", res), ("--size", size), ("--preset", preset)) if value is not None]
    if len(given) != 1:
        found = " and ".join(given) or "none of them"
        raise ArgumentError(f"expected one of --res, --size and --preset, found {found}: try --res 0.2")
    if preset is Preset.cylindrical and coordinates is Coordinates.cartesian:
        raise ArgumentError("--preset cylindrical: expected no --coordinates, or cylindrical, found cartesian")
    if preset is not None and bounds is not None:
        raise ArgumentError("--bounds: expected --res or --size with it, found --preset, which has bounds of its own")
    cylindrical = preset is Preset.cylindrical or coordinates is Coordinates.cylindrical
    spec = GridSpec.published("cylindrical" if cylindrical else "cartesian")
    if bounds is not None:
        values = list(parse_numbers(bounds, float, (6,), "--bounds"))
        if cylindrical:
            values[2:4] = [math.radians(value) for value in values[2:4]]
        spec = spec.with_bounds(values[0::2], values[1::2])
    if size is not None:
        return spec.with_size(parse_numbers(size, int, (3,), "--size"))
    if res is not None:
        steps = list(parse_numbers(res, float, (1, 3), "--res"))
        if cylindrical and len(steps) == 3:
            steps[1] = math.radians(steps[1])
        return spec.with_resolution(steps)
    if preset is Preset.fine:
        return spec.with_size(GridSpec.published("cartesian_fine").size)
    return spec
