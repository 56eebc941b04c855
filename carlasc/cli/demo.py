"""`carlasc demo`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from carlasc.cli.common import FAILED, echo, file_argument, progress_bar
from carlasc.cli.flags import WorkFlags
from carlasc.cli.stats import print_statistics
from carlasc.cli.validate import print_result


def demo(
    work: WorkFlags,
    out: Annotated[Path, file_argument("Folder to write to.")] = Path("carlasc-demo"),
    count: Annotated[int, typer.Option(help="Number of frames of each drive.", min=1)] = 6,
    sensors: Annotated[
        int,
        typer.Option(
            help="Number of LiDARs; a fifth of them record the drive for validation.", min=1
        ),
    ] = 20,
    seed: Annotated[
        int, typer.Option(help="Seed of the town: another seed makes another town.", min=0)
    ] = 0,
) -> None:
    """Simulate two drives, one to train and one to validate, make their ground truth, check it, and
    draw pictures and a page for a browser. This takes about a minute.
    """
    from carlasc.demo import demonstrate

    with work.spread("demo", shown=False) as run:
        result = demonstrate(out, count=count, sensors=sensors, seed=seed, run=run, step=_show_step)
    print_statistics(result.statistics)
    print_result(result.validation)
    echo(f"\ndone in {result.elapsed_s:.0f} s")
    for sequence in result.sequences:
        echo(f"capture  {sequence / 'raw'}")
    for grid in result.grids:
        echo(f"grid     {grid}")
    for picture in result.pictures:
        echo(f"picture  {picture}")
    first = result.sequences[0]
    echo(
        f"next     carlasc regrid {first} --res 0.4    or    carlasc render {first} --frames "
        f"0:{count} -o drive.mp4"
    )
    echo(f"page     {result.page}    (open it in a browser)")
    if not result.validation.ok:
        raise typer.Exit(FAILED)


@contextmanager
def _show_step(name: str) -> Iterator[Callable[[int, int], None]]:
    """Print the name of a step, and its time when it is done.

    On a terminal, also show its progress.
    """
    start = time.perf_counter()
    has_bar = sys.stderr.isatty()
    if not has_bar:  # a bar would be drawn over an unfinished line
        echo(f"{name} ...", nl=False)
        sys.stdout.flush()
    try:
        with progress_bar(name, unit="steps", transient=True) as progress:
            yield progress
    except BaseException:
        if not has_bar:
            echo("")
        raise
    elapsed = f"{time.perf_counter() - start:.1f} s"
    echo(f"{name} ... {elapsed}" if has_bar else f" {elapsed}")
