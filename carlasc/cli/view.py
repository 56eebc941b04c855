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
            "-o",
            "--out",
            "--to",
            text="Write a file instead of opening a window: a self-contained .html page for any browser, an .rrd recording for Rerun, or an .mcap"
            " recording for Foxglove.",
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
    overwrite: OverwriteOption = False,
    as_json: Json = False,
) -> None:
    """Show a sequence in a window (Open3D), or write it as a page for any browser or as a recording for Rerun or Foxglove (--out).

    All can be rotated and zoomed, step through the frames, and show or hide the grid, points, scene flow and classes.
    Without --frames, a window shows all frames and a file shows the first 60.
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
    with progress_bar("Writing the file") as progress:
        result = viewing.view(
            scene,
            out,
            thin_m=thin_m,
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
    opened = {".rrd": "with `rerun`", ".mcap": "in Foxglove"}.get(out.suffix.lower(), "in a browser")
    echo(f"{result.out}: {result.sequence}, {describe_frames(result.frames)}, {size}: open it {opened}")
