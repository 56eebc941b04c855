"""`carlasc demo`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from carlasc.cli.common import FAILED, Workers, echo, file_argument, progress_bar
from carlasc.cli.stats import print_statistics
from carlasc.cli.validate import print_result


def demo(
    out: Annotated[Path, file_argument("Folder to write to.")] = Path("carlasc-demo"),
    count: Annotated[int, typer.Option(help="Number of frames.", min=1)] = 4,
    sensors: Annotated[int, typer.Option(help="Number of LiDARs.", min=1)] = 20,
    seed: Annotated[int, typer.Option(help="Seed of the town: another seed makes another town.", min=0)] = 0,
    workers: Workers = None,
) -> None:
    """Simulate a drive, make its ground truth in three grids, check it and draw it. This takes a minute or two."""
    from carlasc.demo import demonstrate

    result = demonstrate(out, count=count, sensors=sensors, seed=seed, workers=workers, step=_show_step)
    print_statistics(result.statistics)
    print_result(result.validation)
    echo(f"\ndone in {result.elapsed_s:.0f} s")
    echo(f"capture  {result.sequence / 'raw'}")
    for grid in result.grids:
        echo(f"grid     {grid}")
    for picture in result.pictures:
        echo(f"picture  {picture}")
    echo(
        f"next     carlasc regrid {result.sequence} --res 0.4    or    carlasc render {result.sequence} --frames 0:{count} -o drive.mp4"
    )
    if not result.validation.ok:
        raise typer.Exit(FAILED)


@contextmanager
def _show_step(name: str) -> Iterator[Callable[[int, int], None]]:
    """Print the name of a step, and show its progress where there is a terminal."""
    echo(f"{name} ...")
    with progress_bar(name, unit="steps") as progress:
        yield progress
