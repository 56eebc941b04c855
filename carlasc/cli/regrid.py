"""`carlasc regrid`: ground truth at any resolution."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

import typer

from carlasc.cli.common import (
    Cluster,
    FramesOption,
    Json,
    Overwrite,
    PartOption,
    Workers,
    echo,
    engine,
    parse_part,
    place_argument,
    place_option,
    print_json,
    progress_bar,
    report_failures,
)
from carlasc.cli.grid_options import (
    SCANS,
    BoundsOption,
    CompleteOption,
    CoordinatesOption,
    DynamicOption,
    MotionOption,
    NoOwnPathOption,
    PresetOption,
    ResOption,
    RuleOption,
    SizeOption,
    StrideOption,
    WindowMOption,
    WindowOption,
    parse_grid,
    scans_of,
)
from carlasc.errors import ArgumentError
from carlasc.running.options import Run

if TYPE_CHECKING:
    from carlasc.groundtruth import FromScans, Observe


class Observed(StrEnum):
    """What grids are made from."""

    capture = "capture"
    scans = "scans"
    grid = "grid"


class Poses(StrEnum):
    """Where poses come from."""

    auto = "auto"
    file = "file"
    kiss_icp = "kiss-icp"


def regrid(
    source: Annotated[
        str,
        place_argument(
            "A sequence's folder, with a raw capture or with scans, or a folder of such sequences, or its URL.",
            default="current folder",
        ),
    ] = ".",
    out: Annotated[
        str | None,
        place_option(
            "-o",
            "--out",
            text="Folder or URL to write to, each sequence at its path below SOURCE; default: SOURCE itself.",
        ),
    ] = None,
    res: ResOption = None,
    size: SizeOption = None,
    preset: PresetOption = None,
    coordinates: CoordinatesOption = None,
    bounds: BoundsOption = None,
    free_step_m: Annotated[float, typer.Option(help="Distance between two free samples on a ray, in metres.")] = 1.5,
    rule: RuleOption = None,
    frames: FramesOption = None,
    workers: Workers = None,
    cluster: Cluster = None,
    part: PartOption = None,
    keep: Annotated[bool, typer.Option("--keep-votes", help="Also write the votes of every class.")] = False,
    keep_evidence: Annotated[
        bool,
        typer.Option(
            "--keep-evidence",
            help="Also write how certain each voxel is: probabilities, flags and number of scans.",
            rich_help_panel=SCANS,
        ),
    ] = False,
    min_confidence: Annotated[
        float,
        typer.Option(
            help="Voxels that are neither free nor occupied with at least this probability become unknown.",
            rich_help_panel=SCANS,
        ),
    ] = 0.0,
    name: Annotated[str | None, typer.Option(help="Name of the grid's folder; default: a name by its size.")] = None,
    overwrite: Overwrite = False,
    observe: Annotated[
        Observed | None,
        typer.Option(
            help="What grids are made from; default: the capture if there is one, otherwise the scans.",
            show_default=False,
        ),
    ] = None,
    from_grid: Annotated[
        str | None, typer.Option(help="Name of the finer grid, with --observe grid; default: the finest one.")
    ] = None,
    window: WindowOption = None,
    window_m: WindowMOption = None,
    stride: StrideOption = None,
    dynamic: DynamicOption = None,
    motion: MotionOption = None,
    complete: CompleteOption = None,
    no_own_path: NoOwnPathOption = False,
    min_range_m: Annotated[
        float | None, typer.Option(help="Leave out nearer points, in metres.", rich_help_panel=SCANS)
    ] = None,
    max_range_m: Annotated[
        float | None, typer.Option(help="Leave out farther points, in metres.", rich_help_panel=SCANS)
    ] = None,
    poses: Annotated[
        Poses | None,
        typer.Option(
            help="file: from poses.txt; kiss-icp: estimated from the scans; auto: from the file if it exists, else estimated (default).",
            rich_help_panel=SCANS,
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Continue if poses jump between frames.", rich_help_panel=SCANS)
    ] = False,
    json: Json = False,
) -> None:
    """Make ground truth at any resolution: from a raw capture, from the scans of one sensor merged over time, or from a finer grid.

    Existing frames are skipped, so the same command continues an interrupted run. Inside a sequence's folder, `carlasc regrid --res 0.2` is
    enough.
    """
    from carlasc.groundtruth import Voting
    from carlasc.groundtruth import regrid as regrid_sequences

    spec = parse_grid(res, size, preset, coordinates, bounds)
    voting = Voting(None if rule is None else rule.value, free_step_m, keep, keep_evidence, min_confidence)
    scans = scans_of(
        window=window,
        window_m=window_m,
        stride=stride,
        dynamic=dynamic,
        motion=motion,
        complete=complete,
        own_path=False if no_own_path else None,
        min_range_m=min_range_m,
        max_range_m=max_range_m,
        poses=None if poses is None else poses.value,
        force=force or None,
    )
    with progress_bar("regrid") as progress, engine(cluster, workers) as executor:
        result = regrid_sequences(
            source,
            spec,
            out,
            observe=_observe(observe, scans, from_grid),
            voting=voting,
            frames=frames,
            name=name,
            overwrite=overwrite,
            run=Run(workers=workers, executor=executor, part=parse_part(part), progress=progress),
        )
    if json:
        print_json(result)
    else:
        for note in result.notes:
            echo(f"note: {note}")
        skipped = f" ({result.skipped} existed)" if result.skipped else ""
        for grid in result.grids:
            echo(grid)
        echo(f"{spec}: {result.made} frames made{skipped} in {result.elapsed_s:.1f} s")
    failures = [(failure.frame, failure.message) for failure in result.failures]
    report_failures(failures, result.made + result.skipped + len(failures))


def _observe(kind: Observed | None, scans: FromScans | None, grid: str | None) -> Observe | None:
    """Return the `observe` argument. Options for scans and for a finer grid say what is meant if --observe is not given."""
    from carlasc.groundtruth import FromCapture, FromGrid, FromScans

    if kind is None and (scans or grid) is not None:
        kind = Observed.scans if scans is not None else Observed.grid
    if scans is not None and kind is not Observed.scans:
        raise ArgumentError("observe", expected="scans with the options for scans", found=str(kind))
    if grid is not None and kind is not Observed.grid:
        raise ArgumentError("observe", expected="grid with --from-grid", found=str(kind))
    match kind:
        case Observed.capture:
            return FromCapture()
        case Observed.scans:
            return scans or FromScans()
        case Observed.grid:
            return FromGrid(grid)
    return None
