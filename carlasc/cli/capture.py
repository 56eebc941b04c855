"""`carlasc capture`."""

from __future__ import annotations

import signal
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import typer

import carlasc
from carlasc.cli.common import Json, echo, place_argument, print_json, progress_bar
from carlasc.cli.flags import Flags
from carlasc.cli.library import Given, Library
from carlasc.errors import count as counted

OutArgument = Annotated[
    str,
    place_argument("Folder of the sequence, or its URL: the capture is written to OUT/raw.", "OUT"),
]


CamerasOption = Annotated[
    str,
    typer.Option(
        help="Cameras of the vehicle, separated by commas: front, front_left, front_right, left, "
        "right, back_left, back_right, back. Default: none.",
        metavar="NAMES",
    ),
]


def camera_names(cameras: str) -> tuple[str, ...]:
    """Return the names in the value of the option."""
    return tuple(filter(None, map(str.strip, cameras.split(","))))


@dataclass(frozen=True)
class SensorFlags(Flags):
    """The traffic and the sensors of a drive: the same options in `simulate` and in `capture`."""

    drive: Annotated[Given, Library("carlasc.simulate", "sensors seed traffic bev")]
    lidar: Annotated[Given, Library("carlasc.captures.Lidar", "channels points range_m")]

    def arguments(self) -> dict[str, Any]:
        """Return them as arguments of `carlasc.simulate` and `carlasc.record`."""
        return {**self.drive.values, "lidar": self.lidar.make()}


@dataclass(frozen=True)
class ServerFlags(Flags):
    """The CARLA server."""

    heading: ClassVar[str] = "CARLA server"

    host: Annotated[str, typer.Option(help="Host of the CARLA server.")] = "127.0.0.1"
    port: Annotated[int, typer.Option(help="RPC port of the server.", min=1, max=65535)] = 2000
    traffic_port: Annotated[
        int, typer.Option(help="Port of the traffic manager.", min=1, max=65535)
    ] = 8000
    timeout_s: Annotated[
        float,
        typer.Option(
            "--timeout", help="Longest time to wait for an answer of the server, in seconds.", min=1
        ),
    ] = 60.0
    town: Annotated[str, typer.Option(help="CARLA map to drive in.")] = "Town01"


def capture(
    server: ServerFlags,
    sensors: SensorFlags,
    out: OutArgument,
    count: Annotated[int, typer.Option(help="Number of frames, 0.1 s apart.", min=1)] = 2000,
    cameras: CamerasOption = "",
    json: Json = False,
) -> None:
    """Record a drive on a running CARLA server as a raw capture: the scans of all sensors.

    A second run with the same options replays the drive and writes only the missing frames. At the
    end, also after an error or Ctrl-C, the actors are destroyed and the settings of the server are
    restored.
    """
    # clean up the server also when a batch system ends the command
    signal.signal(signal.SIGTERM, _interrupt)
    with progress_bar("capture") as progress:
        place = carlasc.captures.ServerOptions(
            server.host, server.port, server.traffic_port, server.timeout_s
        )
        result = carlasc.record(
            out,
            server=place,
            town=server.town,
            count=count,
            **sensors.arguments(),
            cameras=camera_names(cameras),
            progress=progress,
        )
    if json:
        print_json(result)
        return
    echo(
        f"{result.out}: {counted(result.written, 'frame')} of {counted(result.sensors, 'LiDAR')} "
        f"written, {result.count - result.written} existed already (CARLA {result.server_version}, "
        f"{counted(result.vehicles, 'vehicle')}, {counted(result.walkers, 'pedestrian')})"
    )
    echo(f"next: carlasc regrid {result.out} --res 0.2")


def _interrupt(_: int, __: Any) -> None:
    raise KeyboardInterrupt
