"""Score published weights on simulated towns: `python examples/published.py LMSC_11_T1B.pt OUT`.

Simulates towns, makes their ground truth, completes the ego scans with the weights, and scores them
with 11 classes. The weights were trained on CARLA's towns, so that this checks the whole pipeline:
wrong axes, class ids, voxel sizes or sensor heights would give low scores. The towns were chosen
before any of them was scored.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from completion.command import run
from completion.predicting import Model, predict_dataset
from completion.towns import Town, build_towns

from carlasc import GridSpec
from carlasc.captures import TrafficLevel
from carlasc.metrics import Evaluation, evaluate

_TRAFFIC: tuple[tuple[int, TrafficLevel], ...] = ((10, "light"), (11, "medium"), (12, "heavy"))
TOWNS = tuple(
    Town(f"Town{seed}_{traffic.title()}", "Test", seed, traffic, first_frame)
    for seed, traffic in _TRAFFIC
    for first_frame in range(50, 550, 50)
)


def score_towns(
    weights: Path, out: Path, *, every: int = 1, lower_m: float = 0.0, workers: int | None = None
) -> Evaluation:
    """Simulate the towns, complete their ego scans, and score them.

    Existing files in `out` are not made again.
    """
    spec = GridSpec.published()
    low, high = (np.float32(bound[2] - lower_m).item() for bound in (spec.lower, spec.upper))
    spec = spec.with_bounds((*spec.lower[:2], low), (*spec.upper[:2], high))
    build_towns(out, TOWNS[::every], frames=1, sensors=20, spec=spec, workers=workers)
    predict_dataset(Model.read(weights), str(out), None, torch.device("cpu"), "eager")
    return evaluate(out, out, grid="completion", name=weights.name)


def main(
    weights: Annotated[Path, typer.Argument(help="Published weights of 11 classes.")],
    out: Annotated[
        Path, typer.Argument(help="Folder for the towns. A second run continues with it.")
    ],
    every: Annotated[int, typer.Option(help="Use every N-th of the 30 frames.", min=1)] = 1,
    lower_m: Annotated[
        float,
        typer.Option(
            help="Lower the grids by this many metres, as if the sensor were mounted lower."
        ),
    ] = 0.0,
    workers: Annotated[
        int | None, typer.Option(help="Number of processes. Default: all cores.")
    ] = None,
) -> None:
    """Score published weights on the simulated towns."""
    for table in score_towns(weights, out, every=every, lower_m=lower_m, workers=workers).tables():
        print(table.title, table.to_csv(), sep="\n")


if __name__ == "__main__":
    run(main)
