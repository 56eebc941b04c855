"""Measure samples per second of the loader and of the network: `python examples/throughput.py
examples/motionsc/carlasc.yaml CarlaSC --set history=16`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import torch
import typer
from completion.command import run
from completion.config import Config
from completion.throughput import measure_throughput


def main(
    config: Annotated[Path, typer.Argument(help="Settings: a YAML file.")],
    data: Annotated[str, typer.Argument(help="The data set.")],
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="key=value, replaces a setting of the file.")
    ] = None,
    batches: Annotated[int, typer.Option(help="Number of timed batches.", min=1)] = 20,
    device: Annotated[str, typer.Option(help="auto, cuda or cpu.")] = "auto",
) -> None:
    """Print the samples per second of the loader and of the network."""
    own = torch.device(
        ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device
    )
    rates = measure_throughput(data, Config.read(config, settings or ()), own, batches)
    print(
        f"loader {rates.loader:.1f} samples/s, network {rates.network:.1f} samples/s on {own.type}"
    )


if __name__ == "__main__":
    run(main)
