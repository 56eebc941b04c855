"""`carlasc simulate`: a raw capture of a small town."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from carlasc.cli.common import Json, Workers, console, print_json, progress_bar


class Amount(StrEnum):
    """How much traffic."""

    light = "light"
    medium = "medium"
    heavy = "heavy"


def simulate(
    out: Annotated[Path, typer.Argument(help="The sequence's folder; the capture goes to OUT/raw.")],
    frames: Annotated[int, typer.Option(help="Frames to record, 0.1 s apart.")] = 20,
    sensors: Annotated[int, typer.Option(help="LiDARs; the first is the ego one.")] = 20,
    seed: Annotated[int, typer.Option(help="Town, traffic, sensors and noise are drawn from it.")] = 0,
    traffic: Annotated[Amount, typer.Option(help="25, 50 or 100 vehicles and as many pedestrians.")] = Amount.medium,
    channels: Annotated[int, typer.Option(help="Channels of each LiDAR.")] = 64,
    points: Annotated[int, typer.Option(help="Rays a scan, all channels together.")] = 130_000,
    max_range: Annotated[float, typer.Option("--range", help="How far a LiDAR sees, metres.")] = 50.0,
    bev: Annotated[bool, typer.Option("--bev/--no-bev", help="Write the bird's-eye pictures.")] = True,
    first_frame: Annotated[int, typer.Option(help="Number of the first frame; the drive starts with 0.")] = 0,
    workers: Workers = None,
    json: Json = False,
) -> None:
    """Record a drive through a simulated town as a raw capture; a second run goes on where the first one stopped."""
    from carlasc.captures.town.record import simulate as run

    with progress_bar("simulate") as progress:
        result = run(
            out,
            frames=frames,
            sensors=sensors,
            seed=seed,
            traffic=traffic.value,
            channels=channels,
            points=points,
            max_range_m=max_range,
            bev=bev,
            first_frame=first_frame,
            workers=workers,
            progress=progress,
        )
    if json:
        print_json(result)
        return
    from rich.table import Table

    table = Table(
        "class", "points", "share", title=f"{result.capture}: {result.frames} frames of {result.sensors} sensors"
    )
    for name, count in sorted(result.classes.items(), key=lambda item: -item[1]):
        table.add_row(name, f"{count:,}", f"{count / result.points:.2%}")
    console().print(table)
    console().print(f"{result.written} frames written, {result.frames - result.written} were there already")
