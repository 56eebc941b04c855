"""`carlasc capture`."""

from __future__ import annotations

import signal
from typing import Annotated, Any

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
from carlasc.cli.common import Json, echo, print_json, progress_bar


def capture(
    out: OutArgument,
    host: Annotated[str, typer.Option(help="Host of the CARLA server.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="RPC port of the server.", min=1, max=65535)] = 2000,
    traffic_port: Annotated[int, typer.Option(help="Port of the traffic manager.", min=1, max=65535)] = 8000,
    timeout_s: Annotated[
        float, typer.Option("--timeout", help="Longest time that the server may take to answer, in seconds.", min=1)
    ] = 60.0,
    town: Annotated[str, typer.Option(help="Map to drive in.")] = "Town01",
    count: CountOption = 2000,
    sensors: SensorsOption = 20,
    seed: SeedOption = 0,
    traffic: TrafficOption = "medium",
    channels: ChannelsOption = 64,
    points: PointsOption = 130_000,
    range_m: RangeOption = 50.0,
    bev: BevOption = True,
    json: Json = False,
) -> None:
    """Record a drive on a running CARLA server as a raw capture.

    A second run with the same options replays the drive and writes only the frames that are missing. At the end, also after an
    error or Ctrl-C, the actors are destroyed and the settings of the server are restored.
    """
    from carlasc import captures

    signal.signal(signal.SIGTERM, _interrupt)  # clean up the server also when a batch system ends the command
    with progress_bar("capture") as progress:
        result = captures.record(
            out,
            server=captures.ServerOptions(host, port, traffic_port, timeout_s),
            town=town,
            count=count,
            sensors=sensors,
            seed=seed,
            traffic=traffic,
            lidar=captures.Lidar(channels, points, range_m),
            bev=bev,
            progress=progress,
        )
    if json:
        print_json(result)
        return
    echo(
        f"{result.out}: {result.written} frames of {result.sensors} LiDARs written,"
        f" {result.count - result.written} existed already"
        f" (CARLA {result.server_version}, {result.vehicles} vehicles, {result.walkers} pedestrians)"
    )
    echo(f"next: carlasc regrid {result.out} --res 0.2")


def _interrupt(_: int, __: Any) -> None:
    raise KeyboardInterrupt
