"""A small benchmark that anyone can reproduce: `python examples/benchmark.py OUT --size small` (`--size full` on a GPU).

Simulates drives and labels them in three ways, trains the networks, scores them on capture truth, and prints tables: what labels are worth, the
networks of the paper and our own, and what history is worth. Seeds and settings are fixed in `benchmarking/`. Each drive and each run is kept
when it is finished, and a training that was stopped continues after its last epoch.
"""

from __future__ import annotations

import json
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import typer
from benchmarking.drives import build_drives
from benchmarking.pictures import CHART, SCENE, draw_chart, draw_scene
from benchmarking.rows import Row, history_rows, label_rows, network_rows, part_rows
from benchmarking.runs import Result, result_of
from benchmarking.sizes import SIZES, Size
from benchmarking.tables import label_table, network_tables, to_markdown
from completion.command import run
from completion.processes import Processes, join_processes


class Study(StrEnum):
    """What is trained and printed."""

    labels = "labels"
    networks = "networks"
    parts = "parts"
    history = "history"


ROWS = {
    Study.labels: label_rows,
    Study.networks: network_rows,
    Study.parts: part_rows,
    Study.history: history_rows,
}


def main(
    out: Annotated[Path, typer.Argument(help="Folder for drives, runs and results. A second run continues there.")],
    size: Annotated[
        Literal["tiny", "small", "medium", "full"],
        typer.Option(help="small and medium: on a CPU, in 20 minutes and in hours; full: on a GPU."),
    ] = "tiny",
    study: Annotated[
        list[Study] | None,
        typer.Option(
            help="labels, networks, parts (of our own network) or history; may be given several times. Default: the first two."
        ),
    ] = None,
    device: Annotated[str, typer.Option(help="auto, cuda or cpu.")] = "auto",
    workers: Annotated[
        int | None, typer.Option(help="Number of processes that merge scans. Default: all cores.")
    ] = None,
    pictures: Annotated[
        Path | None, typer.Option(help="Folder for the pictures of the study of labels. Needs carlasc[plots,render].")
    ] = None,
) -> None:
    """Simulate, train, score, and print the tables."""
    chosen, folder = SIZES[size], out / size
    studies = study or [Study.labels, Study.networks]
    with join_processes(device) as processes:
        if processes.first:
            build_drives(folder / "data", chosen.scenes, workers=workers, progress=_print_drives)
        processes.wait()
        figures: dict[str, Any] = {"size": size, "device": _describe(processes)}
        for each in studies:
            results = {row.name: _results_of(row, chosen, folder, processes) for row in ROWS[each](chosen)}
            tables = [label_table(results)] if each == Study.labels else network_tables(results)
            figures[each] = {name: [run.to_dict(name) for run in runs] for name, runs in results.items()}
            if not processes.first:
                continue
            print(*map(to_markdown, tables), sep="\n\n", end="\n\n")
            if pictures and each == Study.labels:
                pictures.mkdir(parents=True, exist_ok=True)
                draw_chart(results, pictures / CHART)
                draw_scene(label_rows(chosen), chosen.scenes, folder, pictures / SCENE)
        if processes.first:
            (folder / "results.json").write_text(json.dumps(figures, indent=1))


def _results_of(row: Row, size: Size, folder: Path, processes: Processes) -> list[Result]:
    results = []
    for config in row.runs():
        if processes.first:
            print(f"{row.name}, seed {config.seed}", file=sys.stderr)
        results.append(result_of(size.scenes, config, folder, processes))
    return results


def _print_drives(done: int, total: int) -> None:
    print(f"drives: {done}/{total}", file=sys.stderr)


def _describe(processes: Processes) -> str:
    if processes.device.type == "cuda":
        return f"{processes.world} x {torch.cuda.get_device_name(processes.device)}"
    return f"CPU, {torch.get_num_threads()} threads"


if __name__ == "__main__":
    run(main)
