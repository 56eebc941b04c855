"""`carlasc simulate`."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Annotated

import typer

import carlasc
from carlasc.cli.capture import CamerasOption, OutArgument, SensorFlags, camera_names
from carlasc.cli.common import Json, print_frames, print_json, show
from carlasc.cli.flags import PartFlags
from carlasc.cli.grid_flags import GridFlags
from carlasc.cli.library import Given, Library
from carlasc.core.choices import LidarName
from carlasc.errors import ArgumentError
from carlasc.errors import count as count_of  # `count` is an option


def simulate(
    *,
    out: OutArgument,
    count: Annotated[int, typer.Option(help="Number of frames, 0.1 s apart.", min=1)] = 20,
    first_frame: Annotated[
        int, typer.Option(help="Number of the first frame. The drive starts at 0.", min=0)
    ] = 0,
    cameras: CamerasOption = "",
    simulator: Annotated[
        str,
        typer.Option(
            help="What is simulated: town, or a simulator of another package.", metavar="NAME"
        ),
    ] = "town",
    lidar: Annotated[
        LidarName,
        typer.Option(help="Model of the LiDARs. --channels, --points and --range change it."),
    ] = "carlasc",
    grid: GridFlags,
    effects: Annotated[Given, Library("carlasc.captures.LidarEffects")],
    json: Json = False,
    sensors: SensorFlags,
    run: PartFlags,
) -> None:
    """Simulate a drive through a town, and write a raw capture (the scans of all sensors), or scans
    and ground truth.

    If OUT is a .zarr store, or a grid is given (--res, --size, --preset), the scans of the ego
    sensor and the ground truth of all sensors are written instead of a raw capture. A second run
    with the same options writes only the missing frames.
    """
    drive = {"count": count, "first_frame": first_frame, **sensors.drive.values}
    drive["cameras"] = camera_names(cameras)
    drive["lidar"] = carlasc.captures.Lidar.named(lidar, **sensors.lidar.values)
    if not grid.is_given and PurePosixPath(out).suffix != ".zarr":
        if effects.is_given:
            raise ArgumentError(
                min(effects.values),
                expected="a grid, or OUT a .zarr store: raw captures are ideal",
                found=f"OUT {out}",
                advice="add --res 0.4",
            )
        with run.spread("simulate") as spread:
            written = carlasc.simulate(out, simulator=simulator, **drive, run=spread)
        print_json(written) if json else _print_capture(written)
        return
    spec = grid.spec_or_published()
    recorder = carlasc.captures.load_recorder(simulator, carlasc.captures.Simulator)
    if effects.is_given:
        drive["effects"] = effects.make()
    simulated = recorder(**drive)
    with run.spread("simulate") as spread:
        made = carlasc.regrid(simulated, spec, out, run=spread)
    print_frames(made, made.grids, f"{made.spec}: made", json=json)


def _print_capture(result: carlasc.captures.SimulationResult) -> None:
    from carlasc.cli.tables import print_table

    frames = count_of(result.count, "frame")
    sensors = count_of(result.sensors, "sensor")
    total = sum(result.classes.values())
    print_table(
        ("class", "points", "share"),
        [
            (name, f"{points:,}", f"{points / total:.2%}")
            for name, points in sorted(result.classes.items(), key=lambda item: -item[1])
        ],
        title=f"{result.out}: {frames} of {sensors}",
        turn=False,
    )
    written = count_of(result.written, "frame")
    show(f"{written} written, {result.count - result.written} existed already")
