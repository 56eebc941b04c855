"""`carlasc view`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from carlasc.cli.common import Json, parse_frames, print_json, progress_bar
from carlasc.cli.scene_options import (
    ClassesOption,
    GridOption,
    PathClassesOption,
    SequenceOption,
    TruthGridOption,
    TruthOption,
)
from carlasc.errors import ArgumentError


def view(
    path: Annotated[
        str,
        typer.Argument(
            help="A sequence or data set (folder, zip, packed store, URL), a grid's folder, or a frame's file."
        ),
    ],
    html: Annotated[
        Path | None, typer.Option(help="Write one self-contained page for any browser, instead of opening a window.")
    ] = None,
    frames: Annotated[
        str | None, typer.Option(help="Frames A:B (B not included); all if not given, the first 60 in a page.")
    ] = None,
    every: Annotated[int, typer.Option(help="Take each N-th of them.", min=1)] = 1,
    grid: GridOption = None,
    truth: TruthOption = None,
    truth_grid: TruthGridOption = None,
    sequence: SequenceOption = None,
    classes: ClassesOption = None,
    path_classes: PathClassesOption = None,
    palette: Annotated[
        Literal["class", "colorblind"],
        typer.Option(help="The classes' own colours, or ones that the colour-blind tell apart."),
    ] = "class",
    thin: Annotated[float, typer.Option(help="A page's points are thinned to one a cell of this side, metres.")] = 0.2,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a page that is there.")] = False,
    as_json: Json = False,
) -> None:
    """Look at a sequence: in a window (Open3D), or in a page that any browser opens (--html), without a network.

    Keys and mouse step, play, and show or hide the grid, points, flow and classes.
    """
    from carlasc.viewing import make_page, show

    chosen: dict[str, Any] = {
        "sequence": sequence,
        "frames": parse_frames(frames),
        "every": every,
        "grid": grid,
        "truth": truth,
        "truth_grid": truth_grid,
        "classes": classes,
        "path_classes": path_classes,
        "palette": palette,
    }
    if html is None:
        if as_json:
            raise ArgumentError("--json: expected --html beside it: a window has no figures")
        show(path, **chosen, report=typer.echo)
        return
    with progress_bar("Writing the page") as progress:
        result = make_page(path, html, **chosen, thin_m=thin, overwrite=overwrite, progress=progress)
    if as_json:
        print_json(result)
        return
    for note in result.notes:
        typer.echo(note)
    shown = f"frame {result.frames[0]}" if len(result.frames) == 1 else f"{len(result.frames)} frames"
    typer.echo(f"{result.out}: {result.sequence}, {shown}, {result.size_bytes / 1e6:.1f} MB: open it in a browser")
