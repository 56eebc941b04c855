"""`carlasc demo`: a first look."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from carlasc.cli.common import FAILED, Workers, progress_bar
from carlasc.cli.stats import print_statistics
from carlasc.cli.validate import print_result


def demo(
    out: Annotated[Path, typer.Argument(help="Folder to write to.")] = Path("carlasc-demo"),
    frames: Annotated[int, typer.Option(help="Frames to simulate.", min=1)] = 4,
    sensors: Annotated[int, typer.Option(help="LiDARs in the town.", min=1)] = 20,
    seed: Annotated[int, typer.Option(help="Another town.", min=0)] = 0,
    workers: Workers = None,
) -> None:
    """Simulate a town, make its ground truth in three grids, check it, draw it: everything in a minute or two."""
    from carlasc.demo import demonstrate

    result = demonstrate(out, frames=frames, sensors=sensors, seed=seed, workers=workers, step=_announced)
    print_statistics(result.statistics)
    print_result(result.validation)
    typer.echo(f"\ndone in {result.elapsed_s:.0f} s")
    typer.echo(f"capture  {result.sequence / 'raw'}")
    for grid in result.grids:
        typer.echo(f"grid     {grid}")
    for picture in result.pictures:
        typer.echo(f"picture  {picture}")
    typer.echo(
        f"next     carlasc regrid {result.sequence} --res 0.4    or    carlasc render {result.sequence} --frames 0:{frames} -o drive.mp4"
    )
    if not result.validation.ok:
        raise typer.Exit(FAILED)


@contextmanager
def _announced(name: str) -> Iterator[Callable[[int, int], None]]:
    """Say what is being done; a bar shows how far it is, where there is a terminal."""
    typer.echo(f"{name} ...")
    with progress_bar(name, unit="steps") as progress:
        yield progress
