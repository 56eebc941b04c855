"""`carlasc simulate`."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Annotated, Any

import typer

from carlasc.cli.capture_options import (
    BevOption,
    ChannelsOption,
    CountOption,
    OutArgument,
    PointsOption,
    RangeOption,
    SeedOption,
    SensorsOption,
    TrafficOption,
)
from carlasc.cli.common import (
    Cluster,
    Json,
    PartOption,
    Workers,
    console,
    echo,
    engine,
    parse_part,
    print_json,
    progress_bar,
    report_failures,
)
from carlasc.cli.grid_options import (
    CoordinatesOption,
    PresetOption,
    ResOption,
    SizeOption,
    parse_grid_or_published,
)
from carlasc.running.options import Run

if TYPE_CHECKING:
    from carlasc.captures import SimulationResult
    from carlasc.groundtruth import RegridResult


def simulate(
    out: OutArgument,
    count: CountOption = 20,
    first_frame: Annotated[int, typer.Option(help="Number of the first frame. The drive starts at 0.", min=0)] = 0,
    sensors: SensorsOption = 20,
    seed: SeedOption = 0,
    traffic: TrafficOption = "medium",
    channels: ChannelsOption = 64,
    points: PointsOption = 130_000,
    range_m: RangeOption = 50.0,
    bev: BevOption = True,
    res: ResOption = None,
    size: SizeOption = None,
    preset: PresetOption = None,
    coordinates: CoordinatesOption = None,
    workers: Workers = None,
    cluster: Cluster = None,
    part: PartOption = None,
    json: Json = False,
) -> None:
    """Record a drive through a simulated town as a raw capture, or its scans and ground truth at once.

    With a .zarr store as OUT, or with a grid (--res, --size, --preset), the scans of the ego sensor and the ground truth of all sensors are
    written, and no raw capture. A second run with the same options writes only the frames that are missing.
    """
    from carlasc import captures
    from carlasc.groundtruth import regrid

    drive: dict[str, Any] = {"count": count, "first_frame": first_frame, "sensors": sensors, "seed": seed}
    drive |= {"traffic": traffic, "lidar": captures.Lidar(channels, points, range_m), "bev": bev}
    part_of = parse_part(part)
    chosen = any(value is not None for value in (res, size, preset, coordinates))
    if not chosen and PurePosixPath(out).suffix != ".zarr":
        with progress_bar("simulate") as progress, engine(cluster, workers) as executor:
            written = captures.simulate(
                out, **drive, run=Run(workers=workers, executor=executor, part=part_of, progress=progress)
            )
        print_json(written) if json else _print_capture(written)
        return
    spec, simulated = parse_grid_or_published(res, size, preset, coordinates, None), captures.SimulatedCapture(**drive)
    with progress_bar("simulate") as progress, engine(cluster, workers) as executor:
        made = regrid(
            simulated, spec, out, run=Run(workers=workers, executor=executor, part=part_of, progress=progress)
        )
    print_json(made) if json else _print_grids(made)
    report_failures([(f.frame, f.message) for f in made.failures], made.made + made.skipped + len(made.failures))


def _print_capture(result: SimulationResult) -> None:
    from rich.table import Table

    table = Table("class", "points", "share", title=f"{result.out}: {result.count} frames of {result.sensors} sensors")
    total = sum(result.classes.values())
    for name, points_of_class in sorted(result.classes.items(), key=lambda item: -item[1]):
        table.add_row(name, f"{points_of_class:,}", f"{points_of_class / total:.2%}")
    console().print(table)
    console().print(f"{result.written} frames written, {result.count - result.written} existed already")


def _print_grids(result: RegridResult) -> None:
    for grid in result.grids:
        echo(grid)
    skipped = f" ({result.skipped} existed)" if result.skipped else ""
    echo(f"{result.spec}: {result.made} frames made{skipped} in {result.elapsed_s:.1f} s")
