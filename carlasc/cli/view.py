"""`carlasc view`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from carlasc.cli.common import FramesOption, Json, echo, file_option, print_json, progress_bar
from carlasc.cli.scene_options import (
    ClassesOption,
    EveryOption,
    GridOption,
    OverwriteOption,
    SequenceOption,
    SourceArgument,
    SourceClassesOption,
    TruthGridOption,
    TruthOption,
    describe_frames,
)
from carlasc.errors import ArgumentError


def view(
    source: SourceArgument,
    out: Annotated[
        Path | None,
        file_option(
            "-o", "--out", text="Write a self-contained .html page for any browser, instead of opening a window."
        ),
    ] = None,
    frames: FramesOption = None,
    every: EveryOption = 1,
    grid: GridOption = None,
    truth: TruthOption = None,
    truth_grid: TruthGridOption = None,
    sequence: SequenceOption = None,
    classes: ClassesOption = None,
    source_classes: SourceClassesOption = None,
    palette: Annotated[
        Literal["class", "colorblind"],
        typer.Option(help="Colours of the class table, or colours for colour-blind readers."),
    ] = "class",
    thin_m: Annotated[
        float, typer.Option("--thin", help="Thin the points of a page to one per cell of this side length, metres.")
    ] = 0.2,
    overwrite: OverwriteOption = False,
    as_json: Json = False,
) -> None:
    """Show a sequence in a window (Open3D), or write it as a page that any browser opens without a network (--out).

    Both can be rotated and zoomed, step through the frames, and show or hide the grid, points, scene flow and classes.
    Without --frames, a window shows all frames and a page shows the first 60.
    """
    from carlasc import viewing

    scene = viewing.Scene(
        source,
        sequence=sequence,
        frames=frames,
        every=every,
        grid=grid,
        truth=truth,
        truth_grid=truth_grid,
        classes=classes,
        source_classes=source_classes,
        palette=palette,
    )
    if out is None:
        if as_json:
            raise ArgumentError("--json", problem="a window has no figures to print", advice="write a page with `out`")
        viewing.view(scene, report=echo)
        return
    with progress_bar("Writing the page") as progress:
        result = viewing.view(scene, out, thin_m=thin_m, overwrite=overwrite, progress=progress)
    if as_json:
        print_json(result)
        return
    for note in result.notes:
        echo(note)
    size = f"{result.size_bytes / 1e6:.1f} MB"
    echo(f"{result.out}: {result.sequence}, {describe_frames(result.frames)}, {size}: open it in a browser")
