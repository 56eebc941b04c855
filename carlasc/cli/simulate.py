"""`carlasc simulate`."""

from __future__ import annotations

from typing import Annotated

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
from carlasc.cli.common import Json, Workers, console, print_json, progress_bar


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
    workers: Workers = None,
    json: Json = False,
) -> None:
    """Record a drive through a simulated town as a raw capture.

    A second run with the same options writes only the frames that are missing.
    """
    from carlasc import captures

    with progress_bar("simulate") as progress:
        result = captures.simulate(
            out,
            count=count,
            first_frame=first_frame,
            sensors=sensors,
            seed=seed,
            traffic=traffic,
            lidar=captures.Lidar(channels, points, range_m),
            bev=bev,
            workers=workers,
            progress=progress,
        )
    if json:
        print_json(result)
        return
    from rich.table import Table

    table = Table("class", "points", "share", title=f"{result.out}: {result.count} frames of {result.sensors} sensors")
    for name, points_of_class in sorted(result.classes.items(), key=lambda item: -item[1]):
        table.add_row(name, f"{points_of_class:,}", f"{points_of_class / result.points:.2%}")
    console().print(table)
    console().print(f"{result.written} frames written, {result.count - result.written} existed already")
