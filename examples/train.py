"""Train a network: `python examples/train.py examples/motionsc/carlasc.yaml DATA --out
runs/motionsc`.

On several GPUs: `torchrun --nproc-per-node 4 examples/train.py ...`. `--set key=value` changes a
setting of the file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from completion.command import run
from completion.config import Config
from completion.processes import join_processes
from completion.training import BEST, train

import carlasc


def main(
    config: Annotated[Path, typer.Argument(help="Settings: a YAML file.")],
    data: Annotated[str, typer.Argument(help="The data set: anything that carlasc opens.")],
    out: Annotated[Path, typer.Option(help="Folder of the run.")],
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="key=value, replaces a setting of the file.")
    ] = None,
    soft_labels: Annotated[
        bool,
        typer.Option(
            "--soft-labels",
            help="Train on probabilities instead of labels; the same as soft_labels=true.",
        ),
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue from the last checkpoint of the run.")
    ] = False,
    cache: Annotated[
        Path | None,
        typer.Option(
            help="Folder on a local disk for files of a remote data set, each of which is fetched "
            "once."
        ),
    ] = None,
    device: Annotated[str, typer.Option(help="auto, cuda or cpu.")] = "auto",
) -> None:
    """Train a network on a data set.

    The weights with the best mIoU on the validation split are kept.
    """
    with join_processes(device) as processes:
        overrides = [*(settings or ()), *(["soft_labels=true"] if soft_labels else [])]
        source = carlasc.open(data, cache=cache)
        progress = train(source, Config.read(config, overrides), out, processes, resume=resume)
        if processes.first:
            print(
                f"best mIoU {100 * progress.best_miou:.2f} after epoch {progress.best_epoch}: "
                f"{out / BEST}"
            )


if __name__ == "__main__":
    run(
        main,
        "with --resume, the same command continues from the last checkpoint (one an epoch, or "
        "--set save_every=N)",
    )
