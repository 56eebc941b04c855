"""`carlasc regrid`: ground truth at any resolution."""

from __future__ import annotations

import math
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
    from carlasc.groundtruth.windows import Merging


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
    point = "point"


class Observed(StrEnum):
    """What grids are made of."""

    capture = "capture"
    scans = "scans"
    grid = "grid"


class Dynamics(StrEnum):
    """What becomes of moving points."""

    align = "align"
    current = "current"
    drop = "drop"
    tube = "tube"


class Poses(StrEnum):
    """Where poses come from."""

    file = "file"
    kiss_icp = "kiss-icp"


_GRID = "Grid: one of --res, --size and --preset"
_SCANS = "Scans merged over time"


def regrid(
    src: Annotated[
        Path,
        typer.Argument(
            help="A sequence's folder, with a raw capture or with scans; or a folder of such sequences.",
            show_default="here",
        ),
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
        Vote | None,
        typer.Option(
            help="sensor: one vote a sensor, voxel and class (as published; the default for captures); sample: every sample (as in the"
            " paper); point: every point, free space once a scan (the default for scans)."
        ),
    ] = None,
    frames: Annotated[
        str | None, typer.Option(help="Frame numbers A:B of the source, B not included; either end may be left out.")
    ] = None,
    workers: Workers = None,
    keep_votes: Annotated[bool, typer.Option("--keep-votes", help="Write the votes of every class too.")] = False,
    name: Annotated[str | None, typer.Option(help="The grid's folder; by its size if not given.")] = None,
    overwrite: Overwrite = False,
    source: Annotated[
        Observed | None,
        typer.Option(help="What grids are made of; the capture where there is one, else scans.", show_default=False),
    ] = None,
    from_grid: Annotated[
        str | None, typer.Option(help="With --source grid: the finer grid; the finest if not given.")
    ] = None,
    window: Annotated[
        str | None,
        typer.Option(help="Scans A:B around each frame, in frames; -30:30 if not given.", rich_help_panel=_SCANS),
    ] = None,
    window_m: Annotated[
        float | None,
        typer.Option(help="Of those, only scans within so many metres driven.", rich_help_panel=_SCANS),
    ] = None,
    stride: Annotated[int | None, typer.Option(help="Every so manyth scan.", rich_help_panel=_SCANS)] = None,
    dynamic: Annotated[
        Dynamics | None,
        typer.Option(
            help="What moves: align (complete each actor; the default), current (that frame's points only), drop, tube (SemanticKITTI's rule).",
            rich_help_panel=_SCANS,
        ),
    ] = None,
    min_range: Annotated[
        float | None, typer.Option(help="Leave nearer points out of grids, metres.", rich_help_panel=_SCANS)
    ] = None,
    max_range: Annotated[
        float | None, typer.Option(help="Leave farther points out of grids, metres.", rich_help_panel=_SCANS)
    ] = None,
    poses: Annotated[
        Poses, typer.Option(help="poses.txt, or estimated from the scans by KISS-ICP.", rich_help_panel=_SCANS)
    ] = Poses.file,
    force: Annotated[bool, typer.Option("--force", help="Go on where poses jump.", rich_help_panel=_SCANS)] = False,
    json: Json = False,
) -> None:
    """Make ground truth at any resolution: from a raw capture, from the scans of one sensor merged over time, or from a finer grid.

    Run it again to go on where it stopped: frames that are there are skipped. Inside a sequence's folder `carlasc regrid --res 0.2` is all.
    """
    from carlasc.groundtruth import regrid as regrid_sequences

    spec = parse_grid(res, size, preset, coordinates, bounds)
    with progress_bar("regrid") as progress:
        result = regrid_sequences(
            src,
            out,
            spec,
            observations=None if source is None else source.value,
            vote=None if vote is None else vote.value,
            free_step_m=free_step,
            frames=parse_frames(frames),
            name=name,
            keep_votes=keep_votes,
            overwrite=overwrite,
            merging=merging_of(window, window_m, stride, dynamic, min_range, max_range),
            from_grid=from_grid,
            estimate_poses=poses is Poses.kiss_icp,
            force=force,
            workers=workers,
            progress=progress,
        )
    if json:
        print_json(result)
    else:
        for note in result.notes:
            typer.echo(f"note: {note}")
        there = f" ({result.skipped} were there)" if result.skipped else ""
        for grid in result.grids:
            typer.echo(grid)
        typer.echo(f"{spec}: {result.made} frames made{there} in {result.elapsed_s:.1f} s")
    failures = [(failure.frame, failure.message) for failure in result.failures]
    report_failures(failures, result.made + result.skipped + len(failures))


def merging_of(
    window: str | None,
    window_m: float | None,
    stride: int | None,
    dynamic: Dynamics | None,
    min_range: float | None,
    max_range: float | None,
) -> Merging | None:
    """Return how scans are merged, None if nothing was said of it."""
    from carlasc.groundtruth.windows import Merging

    given: dict[str, Any] = {"window_m": window_m, "stride": stride, "min_range_m": min_range, "max_range_m": max_range}
    given["dynamic"] = None if dynamic is None else dynamic.value
    given["window"] = None if window is None else _parse_window(window)
    given = {name: value for name, value in given.items() if value is not None}
    return Merging(**given) if given else None


def _parse_window(text: str) -> tuple[int, int]:
    first, _, last = text.partition(":")
    try:
        return int(first), int(last)
    except ValueError:
        raise ArgumentError(
            f"--window: expected A:B in frames around the current one such as -30:30, found {text!r}"
        ) from None


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
