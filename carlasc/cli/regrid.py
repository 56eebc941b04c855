"""`carlasc regrid`: ground truth at any resolution."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from carlasc.cli.common import (
    Json,
    Overwrite,
    Workers,
    parse_frames,
    print_json,
    progress_bar,
    report_failures,
)
from carlasc.cli.grid_options import (
    SCANS,
    BoundsOption,
    CoordinatesOption,
    DynamicOption,
    PresetOption,
    ResOption,
    SizeOption,
    StrideOption,
    VoteOption,
    WindowMOption,
    WindowOption,
    merging_of,
    parse_grid,
)

if TYPE_CHECKING:
    pass


class Observed(StrEnum):
    """What grids are made of."""

    capture = "capture"
    scans = "scans"
    grid = "grid"


class Poses(StrEnum):
    """Where poses come from."""

    file = "file"
    kiss_icp = "kiss-icp"


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
    res: ResOption = None,
    size: SizeOption = None,
    preset: PresetOption = None,
    coordinates: CoordinatesOption = None,
    bounds: BoundsOption = None,
    free_step: Annotated[float, typer.Option(help="Distance between the free samples on a ray, metres.")] = 1.5,
    vote: VoteOption = None,
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
    window: WindowOption = None,
    window_m: WindowMOption = None,
    stride: StrideOption = None,
    dynamic: DynamicOption = None,
    min_range: Annotated[
        float | None, typer.Option(help="Leave nearer points out of grids, metres.", rich_help_panel=SCANS)
    ] = None,
    max_range: Annotated[
        float | None, typer.Option(help="Leave farther points out of grids, metres.", rich_help_panel=SCANS)
    ] = None,
    poses: Annotated[
        Poses, typer.Option(help="poses.txt, or estimated from the scans by KISS-ICP.", rich_help_panel=SCANS)
    ] = Poses.file,
    force: Annotated[bool, typer.Option("--force", help="Go on where poses jump.", rich_help_panel=SCANS)] = False,
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
