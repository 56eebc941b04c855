"""`carlasc view`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from carlasc.cli.common import FramesOption, Json, echo, file_option, place_option, print_json, progress_bar
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
            "-o",
            "--out",
            "--to",
            text="Write a file instead of opening a window: an .html page for any browser, an .rrd recording for Rerun, or an .mcap recording for"
            " Foxglove. A name without an ending: the folder of a page for a web server.",
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
    full_points: Annotated[
        bool,
        typer.Option(
            "--full-points",
            help="Keep all points in a recording, and say first how large it becomes. Default: 30,000 a frame.",
        ),
    ] = False,
    beside: Annotated[
        str | None,
        place_option("--beside", text="Another run of the sequence, shown in the page on the other side of a divider."),
    ] = None,
    beside_grid: Annotated[
        str | None,
        typer.Option("--beside-grid", help="Name of its grid. Without --beside: another grid of SOURCE, shown so."),
    ] = None,
    overwrite: OverwriteOption = False,
    as_json: Json = False,
) -> None:
    """Show a sequence in a window (Open3D), or write it as a page for any browser or as a recording for Rerun or Foxglove (--out).

    All can be rotated and zoomed, step through the frames, and show or hide the grid, points, scene flow and classes.
    Without --frames, a file shows the first 60 frames; a window and the folder of a page show all.
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
        if beside is not None or beside_grid is not None:
            raise ArgumentError("--beside", problem="a window shows one run", advice="write a page with `out`")
        viewing.view(scene, report=echo)
        return
    with progress_bar("Writing the file") as progress:
        result = viewing.view(
            scene,
            out,
            thin_m=thin_m,
            beside=beside,
            beside_grid=beside_grid,
            full_points=full_points,
            overwrite=overwrite,
            progress=progress,
            report=None if as_json else echo,
        )
    if as_json:
        print_json(result)
        return
    for note in result.notes:
        echo(note)
    size = f"{result.size_bytes / 1e6:.1f} MB"
    opened = {
        ".rrd": "open it with `rerun`",
        ".mcap": "open it in Foxglove",
        "": "serve it with `python -m http.server`",
    }
    advice = opened.get(out.suffix.lower(), "open it in a browser")
    echo(f"{result.out}: {result.sequence}, {describe_frames(result.frames)}, {size}: {advice}")
