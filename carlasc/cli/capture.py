"""`carlasc capture`."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from carlasc.cli.common import Json, print_json, progress_bar


def capture(
    out: Annotated[Path, typer.Argument(help="The sequence's folder; the capture goes to OUT/raw.")],
    host: Annotated[str, typer.Option(help="Where the CARLA server runs.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="The server's RPC port.", min=1, max=65535)] = 2000,
    traffic_port: Annotated[int, typer.Option(help="Port of the traffic manager.", min=1, max=65535)] = 8000,
    timeout: Annotated[float, typer.Option(help="How long an answer of the server may take, seconds.", min=1)] = 60.0,
    town: Annotated[str, typer.Option(help="The map to drive in.")] = "Town01",
    traffic: Annotated[
        Literal["light", "medium", "heavy"],
        typer.Option(help="25, 50 or 100 vehicles and as many pedestrians."),
    ] = "medium",
    frames: Annotated[int, typer.Option(help="Frames to record, 0.1 s apart.", min=1)] = 2000,
    sensors: Annotated[int, typer.Option(help="LiDARs; the first is the ego one.", min=1)] = 20,
    seed: Annotated[int, typer.Option(help="Places, traffic, sensors and noise are drawn from it.", min=0)] = 0,
    channels: Annotated[int, typer.Option(help="Channels of each LiDAR.", min=1)] = 64,
    points: Annotated[int, typer.Option(help="Rays a scan, all channels together.", min=1)] = 130_000,
    range_m: Annotated[float, typer.Option("--range", help="How far a LiDAR sees, metres.")] = 50.0,
    bev: Annotated[bool, typer.Option(help="Take the pictures from above.")] = True,
    as_json: Json = False,
) -> None:
    """Record a raw capture from a running CARLA server; a second run goes on where the first one stopped.

    The server is left as it was, after Ctrl-C and errors too: no actor stays, its settings are restored.
    """
    from carlasc.captures.carla import record
    from carlasc.captures.carla.sensors import LidarModel

    signal.signal(signal.SIGTERM, _interrupt)  # a batch system's end is cleaned up after too
    with progress_bar("Recording") as progress:
        result = record(
            out,
            host=host,
            port=port,
            traffic_port=traffic_port,
            timeout_s=timeout,
            town=town,
            traffic=traffic,
            frames=frames,
            sensors=sensors,
            seed=seed,
            lidar=LidarModel(channels, points, range_m),
            bev=bev,
            progress=progress,
        )
    if as_json:
        print_json(result)
        return
    there = result.frames - result.written
    typer.echo(
        f"{result.capture}: {result.written} frames of {result.sensors} LiDARs written, {there} were there already"
        f" (CARLA {result.server_version}, {result.vehicles} vehicles, {result.walkers} pedestrians)"
    )
    typer.echo(f"next: carlasc regrid {result.capture} --res 0.2")


def _interrupt(_: int, __: Any) -> None:
    raise KeyboardInterrupt
