"""A small benchmark that anyone can reproduce: `python examples/benchmark.py OUT --size small`
(`--size full` on a GPU).

Simulates drives, labels them in four ways, trains the networks, scores them on capture truth, and
writes `results.json`, of which `benchmark_page.py` makes tables: the networks of the paper and our
own, what labels are worth, and what history is worth. Seeds and settings are fixed in
`benchmarking/`. Each drive and each run is kept when it is finished, and a training that was
stopped continues after its last epoch. The first seeds of all rows are run first: a study that was
stopped has equally many runs of each row, or one more of some.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

import typer
from benchmarking.drives import build_drives
from benchmarking.kept import note
from benchmarking.pictures import SCENE, draw_scene
from benchmarking.rows import Row, history_rows, js3cnet_rows, label_rows, network_rows, part_rows
from benchmarking.runs import choose_rate, result_of
from benchmarking.sizes import SIZES, Size
from completion.command import run
from completion.processes import Processes, join_processes


class Study(StrEnum):
    """What is trained and printed."""

    labels = "labels"
    networks = "networks"
    parts = "parts"
    history = "history"
    js3cnet = "js3cnet"


ROWS = {
    Study.labels: label_rows,
    Study.networks: network_rows,
    Study.parts: part_rows,
    Study.history: history_rows,
    Study.js3cnet: js3cnet_rows,
}


def main(
    out: Annotated[
        Path,
        typer.Argument(help="Folder for drives, runs and results. A second run continues there."),
    ],
    size: Annotated[
        Literal["tiny", "small", "medium", "long", "full"],
        typer.Option(
            help="small, medium and long: on a CPU, in minutes, hours and a day; full: on a GPU."
        ),
    ] = "tiny",
    study: Annotated[
        list[Study] | None,
        typer.Option(
            help="networks, labels, parts (of our own network), history or js3cnet; may be given "
            "several times. Default: the first two."
        ),
    ] = None,
    device: Annotated[str, typer.Option(help="auto, cuda or cpu.")] = "auto",
    workers: Annotated[
        int | None, typer.Option(help="Number of processes that merge scans. Default: all cores.")
    ] = None,
    pictures: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the pictures of the study of labels. Needs carlasc[plots,render]."
        ),
    ] = None,
) -> None:
    """Simulate, train, score, and write the results."""
    chosen, folder = SIZES[size], out / size
    studies = study or [Study.networks, Study.labels]
    with join_processes(device) as processes:
        if processes.first:
            merge = Study.labels in studies
            build_drives(
                folder / "data", chosen.scenes, merge=merge, workers=workers, progress=_print_drives
            )
        processes.wait()
        for each in studies:
            for seed in range(chosen.seeds):
                for row in ROWS[each](chosen):
                    if seed < row.seeds:
                        _run(each, row, seed, chosen, folder, processes)
        if pictures and processes.first and Study.labels in studies:
            pictures.mkdir(parents=True, exist_ok=True)
            draw_scene(label_rows(chosen), chosen, folder, pictures / SCENE)


def _run(study: Study, row: Row, seed: int, size: Size, folder: Path, processes: Processes) -> None:
    """Make a run of a row, and note it in results.json."""
    if processes.first:
        print(f"{row.name}, seed {seed}", file=sys.stderr)
    rate = choose_rate(size.scenes, row.config, size.trial_epochs, folder, processes)
    result = result_of(
        size.scenes, replace(row.config, seed=seed, learning_rate=rate), folder, processes
    )
    if processes.first:
        note(folder / "results.json", study, row.name, result)


def _print_drives(done: int, total: int) -> None:
    print(f"drives: {done}/{total}", file=sys.stderr)


if __name__ == "__main__":
    run(main)
