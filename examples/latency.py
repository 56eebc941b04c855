"""Measure time and memory of networks for one frame: `python examples/latency.py motionsc:1
motionsc:16 lmscnet_ss sscnet_full`.
"""

from __future__ import annotations

import dataclasses
import json
from typing import Annotated

import torch
import typer
from completion.command import run
from completion.latency import measure_network

from carlasc import GridSpec
from carlasc.core.choices import Preset


def main(
    networks: Annotated[
        list[str], typer.Argument(help="Names of networks, with :T for a history of T scans.")
    ],
    device: Annotated[str, typer.Option(help="auto, cuda or cpu.")] = "auto",
    repetitions: Annotated[
        int, typer.Option(help="Number of timed calls, after a first one.", min=1)
    ] = 100,
    grid: Annotated[Preset, typer.Option(help="A published grid.")] = "coarse",
    threads: Annotated[
        int | None, typer.Option(help="Number of threads on the CPU. Default: all cores.", min=1)
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Print latency and peak memory at batch 1, eagerly in float32 and compiled."""
    own = torch.device(
        ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device
    )
    if threads:
        torch.set_num_threads(threads)
    results = []
    for text in networks:
        name, _, history = text.partition(":")
        measured = measure_network(
            name, int(history or 1), own, spec=GridSpec.published(grid), repetitions=repetitions
        )
        results += measured
        for r in measured if not as_json else ():
            print(
                f"{r.network} T={r.history} {r.mode:8s} median {r.median_ms:8.2f} ms  fastest "
                f"{r.fastest_ms:8.2f} ms  {r.memory_mb:6.0f} MB  x{r.speedup:.2f}  "
                f"{r.differing:.1f} voxels per million differ",
                flush=True,
            )
    if as_json:
        print(json.dumps([dataclasses.asdict(result) for result in results]))


if __name__ == "__main__":
    run(main)
