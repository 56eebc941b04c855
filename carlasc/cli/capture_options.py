"""Arguments and options that `carlasc simulate` and `carlasc capture` share."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from carlasc.cli.common import place_argument

OutArgument = Annotated[
    str, place_argument("Folder of the sequence, or its URL: the capture is written to OUT/raw.", "OUT")
]
CountOption = Annotated[int, typer.Option(help="Number of frames, 0.1 s apart.", min=1)]
SensorsOption = Annotated[int, typer.Option(help="Number of LiDARs. The first is the ego sensor.", min=1)]
SeedOption = Annotated[int, typer.Option(help="Seed of all random choices: traffic, sensor positions, noise.", min=0)]
TrafficOption = Annotated[
    Literal["light", "medium", "heavy"],
    typer.Option(help="Amount of traffic: 25, 50 or 100 moving vehicles, and as many pedestrians."),
]
ChannelsOption = Annotated[int, typer.Option(help="Number of channels of each LiDAR.", min=1)]
PointsOption = Annotated[int, typer.Option(help="Number of rays per scan, all channels together.", min=1)]
RangeOption = Annotated[float, typer.Option("--range", help="Range of each LiDAR in metres.")]
BevOption = Annotated[bool, typer.Option("--bev/--no-bev", help="Write bird's-eye pictures.")]
