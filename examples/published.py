"""Do published weights see our simulated town? `python examples/published.py LMSC_11_T1B.pt OUT`.

Simulates towns, makes their ground truth, completes the ego scans with the weights, and scores them at 11 classes. It is an end-to-end check
against data that we do not have: a wrong frame, class id, voxel size or sensor height would show. The towns were fixed before any was scored.
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
from carlasc.metrics import Evaluation, evaluate

TOWNS = tuple(
    Town(f"Town{seed}_{traffic.title()}", "Test", seed, traffic, first_frame)
    for seed, traffic in ((10, "light"), (11, "medium"), (12, "heavy"))
    for first_frame in range(50, 550, 50)
)


def score_towns(
    weights: Path, out: Path, *, every: int = 1, lower_m: float = 0.0, workers: int | None = None
) -> Evaluation:
    """Simulate the towns, complete their ego scans, score them; what is in `out` already is not made again."""
    spec = GridSpec.published()
    low, high = (np.float32(bound[2] - lower_m).item() for bound in (spec.lower, spec.upper))
    spec = spec.with_bounds((*spec.lower[:2], low), (*spec.upper[:2], high))
    build_towns(out, TOWNS[::every], frames=1, sensors=20, spec=spec, workers=workers)
    predict_dataset(Model.read(weights), str(out), None, torch.device("cpu"), "eager")
    return evaluate(out, out, grid="completion", name=weights.name)


def main(
    weights: Annotated[Path, typer.Argument(help="Published weights of 11 classes.")],
    out: Annotated[Path, typer.Argument(help="Folder for the towns; a second run goes on with it.")],
    every: Annotated[int, typer.Option(help="Only every so many of the 30 frames.", min=1)] = 1,
    lower_m: Annotated[float, typer.Option(help="Grids so much lower, metres: as if the sensor stood lower.")] = 0.0,
    workers: Annotated[int | None, typer.Option(help="Processes side by side; all cores if not given.")] = None,
) -> None:
    """Score published weights on the simulated towns."""
    for table in score_towns(weights, out, every=every, lower_m=lower_m, workers=workers).tables():
        print(table.title, table.to_csv(), sep="\n")


if __name__ == "__main__":
    run(main)
