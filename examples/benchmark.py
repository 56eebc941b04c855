"""A small benchmark that anyone can reproduce: `python examples/benchmark.py OUT` (`--size full` on a GPU).

Simulates towns for training, validation and test, makes their ground truth, trains LMSCNet SS, SSCNet-full, MotionSC T=1 and T=5, and prints the
paper's two tables. With `--history` also MotionSC without history, with history, with shuffled history and without pose alignment, three seeds each.
Seeds and settings are fixed in this file. A run that was stopped continues where it was.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import typer
from completion.command import run
from completion.config import Config
from completion.data import eval_loader, open_split
from completion.networks import build_network
from completion.processes import Processes, join_processes
from completion.scoring import score
from completion.towns import Town, build_towns
from completion.training import BEST, LAST, train
from completion.weights import load_weights, read_weights

from carlasc import GridSpec
from carlasc.captures import TrafficLevel
from carlasc.metrics import CONVENTIONS, Evaluation, Table, geometric_table, semantic_table

TRAFFIC: tuple[TrafficLevel, ...] = ("light", "medium", "heavy")
SPLITS = (("Train", 100), ("Val", 200), ("Test", 300))  # split, and seed of its first town


@dataclass(frozen=True)
class Size:
    """The amount of simulation and training.

    Attributes:
        towns: number of drives in Train, Val and Test.
        frames: number of frames of each drive.
        sensors: number of LiDARs per frame.
        points: number of rays per scan.
        half_width_m: distance from the sensor to the sides of the grid; its height is the published -2..1 m.
        cells: number of cells of the grid along x, y and z.
        epochs: number of epochs of every network.
        batch_size: samples per step.
        seeds: number of runs of each setting in the study of history.
        workers: number of processes that load data.
    """

    towns: tuple[int, int, int]
    frames: int
    sensors: int
    points: int
    half_width_m: float
    cells: tuple[int, int, int]
    epochs: int
    batch_size: int
    seeds: int = 3
    workers: int = 0


SIZES = {
    "tiny": Size((2, 1, 1), 6, 3, 10_000, 25.6, (16, 16, 8), 1, 4, seeds=1),
    "small": Size((6, 2, 3), 12, 12, 65_000, 12.8, (32, 32, 8), 12, 4),
    "full": Size((24, 3, 6), 100, 20, 130_000, 25.6, (128, 128, 8), 10, 8, workers=8),
}


@dataclass(frozen=True)
class Entry:
    """A row of the tables: a name and the settings of its run."""

    name: str
    config: Config


def list_entries(size: Size) -> list[Entry]:
    """Return the networks of the tables, with the optimizers and losses of their papers."""
    shared = {"epochs": size.epochs, "batch_size": size.batch_size, "workers": size.workers}
    motionsc = Config("motionsc", **shared)  # type: ignore[arg-type]
    return [
        Entry("LMSCNet SS", replace(motionsc, network="lmscnet_ss", decay=0.98)),
        Entry("SSCNet full", replace(motionsc, network="sscnet_full", decay=1.0, free_ratio=2.0)),
        Entry("MotionSC T=1", motionsc),
        Entry("MotionSC T=5", replace(motionsc, history=5)),
    ]


def list_history_entries(size: Size) -> dict[str, list[Entry]]:
    """Return MotionSC without history, with history, with shuffled history, and without alignment: one run per seed."""
    single, plain = (entry.config for entry in list_entries(size)[2:])
    variants = {
        "T=1": single,
        "T=5": plain,
        "T=5, history shuffled": replace(plain, shuffle_history=True),
        "T=5, not aligned": replace(plain, align=False),
    }
    return {
        name: [Entry(f"{name}, seed {seed}", replace(config, seed=seed)) for seed in range(size.seeds)]
        for name, config in variants.items()
    }


def build_data(out: Path, size: Size, workers: int | None) -> None:
    """Simulate the towns of every split and make their ground truth."""
    towns = [
        Town(f"Town{seed + index}_{TRAFFIC[index % 3].title()}", split, seed + index, TRAFFIC[index % 3], 50)
        for (split, seed), count in zip(SPLITS, size.towns, strict=True)
        for index in range(count)
    ]
    half = float(np.float32(size.half_width_m))  # the format's bounds are float32
    build_towns(
        out,
        towns,
        frames=size.frames,
        sensors=size.sensors,
        points=size.points,
        spec=GridSpec("cartesian", size.cells, (-half, -half, -2.0), (half, half, 1.0)),
        workers=workers,
        progress=lambda done, total: print(f"towns: {done}/{total}", file=sys.stderr),
    )


def run_entry(entry: Entry, data: Path, out: Path, processes: Processes) -> Evaluation:
    """Train a network if it is not trained yet, and score its best weights on the test split."""
    print(entry.name, file=sys.stderr)
    train(data, entry.config, out, processes, resume=(out / LAST).exists())
    test = open_split(data, entry.config.test, entry.config)
    num_classes = max(test.classes.names) + 1
    network = build_network(entry.config.network, num_classes, test.spec, entry.config.history)
    load_weights(network, read_weights(out / BEST), str(out / BEST))
    loader = eval_loader(test, entry.config, processes.rank, processes.world)
    matrix = score(network.to(processes.device), loader, num_classes, processes)
    return Evaluation(entry.name, CONVENTIONS["carlasc"], matrix, {}, len(test), "known", [])


def average_seeds(groups: Mapping[str, Sequence[Evaluation]]) -> list[Table]:
    """Return the paper's two tables with one row per group: the mean and the standard deviation of its runs."""
    tables = []
    for make in (semantic_table, geometric_table):
        rows: list[tuple[str, ...]] = []
        for name, runs in groups.items():
            table = make(runs)
            rows.append((name, *(_mean(column) for column in list(zip(*table.rows, strict=True))[1:])))
        tables.append(Table(f"{table.title}, mean and standard deviation over seeds", table.header, tuple(rows)))
    return tables


def print_tables(tables: Sequence[Table]) -> None:
    """Print tables as Markdown."""
    for table in tables:
        rows = [list(table.header), ["---"] * len(table.header), *table.texts()]
        print(f"\n{table.title}\n", *(f"| {' | '.join(row)} |" for row in rows), sep="\n")


def main(
    out: Annotated[Path, typer.Argument(help="Folder for data, runs and results.")],
    size: Annotated[
        Literal["tiny", "small", "full"], typer.Option(help="tiny and small: on a CPU; full: on a GPU.")
    ] = "tiny",
    history: Annotated[
        bool,
        typer.Option("--history", help="Also run the study of history: none, in order, shuffled, and not aligned."),
    ] = False,
    device: Annotated[str, typer.Option(help="auto, cuda or cpu.")] = "auto",
    workers: Annotated[int | None, typer.Option(help="Number of processes that simulate. Default: all cores.")] = None,
) -> None:
    """Simulate, train, score, and print the tables."""
    chosen = SIZES[size]
    data = out / "data"
    groups = {"": list_entries(chosen), **(list_history_entries(chosen) if history else {})}
    with join_processes(device) as processes:
        if processes.first:
            build_data(data, chosen, workers)
        processes.wait()
        results = {
            group: [run_entry(entry, data, out / "runs" / entry.name.replace(" ", "_"), processes) for entry in entries]
            for group, entries in groups.items()
        }
        if processes.first:
            figures = {
                "size": size,
                "device": _describe(processes),
                "results": [result.to_dict() for runs in results.values() for result in runs],
            }
            networks = results.pop("")
            print_tables([semantic_table(networks), geometric_table(networks), *average_seeds(results)])
            (out / "results.json").write_text(json.dumps(figures, indent=1))


def _mean(values: Sequence[float]) -> str:
    if np.isnan(values).any():  # as in the tables: a class that never occurs
        return "-"
    spread = f" ± {np.std(values, ddof=1):.2f}" if len(values) > 1 else ""
    return f"{np.mean(values):.2f}{spread}"


def _describe(processes: Processes) -> str:
    if processes.device.type == "cuda":
        return f"{processes.world} x {torch.cuda.get_device_name(processes.device)}"
    return f"CPU, {torch.get_num_threads()} threads"


if __name__ == "__main__":
    run(main)
