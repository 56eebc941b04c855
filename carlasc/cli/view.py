"""`carlasc view`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

import carlasc
from carlasc.cli.common import (
    FramesOption,
    Json,
    SourceClassesOption,
    echo,
    file_option,
    place_argument,
    place_option,
    print_json,
    progress_bar,
)
from carlasc.cli.flags import Flags
from carlasc.core.choices import PaletteName
from carlasc.errors import ArgumentError, count


@dataclass(frozen=True)
class SceneFlags(Flags):
    """The choice of a scene: the same options in `render` and in `view`."""

    frames: FramesOption = None
    every: Annotated[int, typer.Option(help="Show only every N-th frame.", min=1)] = 1
    sequence: Annotated[
        str | None,
        typer.Option(help="Name of the sequence, if SOURCE has several. Default: the first."),
    ] = None
    grid: Annotated[
        str | None, typer.Option(help="Name of the grid. Default: evaluation, or the first grid.")
    ] = None
    truth: Annotated[
        str | None,
        place_option(
            "--truth",
            text="Ground truth of SOURCE, which is then shown as a prediction with its errors.",
        ),
    ] = None
    truth_grid: Annotated[
        str | None,
        typer.Option(help="Name of the grid with the ground truth. Default: as for --grid."),
    ] = None
    classes: Annotated[
        str | None,
        typer.Option(
            help="Class table to show, such as carlasc11 (the paper's eleven). Default: that of "
            "the data."
        ),
    ] = None
    source_classes: SourceClassesOption = None

    def scene(self, source: str, palette: PaletteName) -> carlasc.Scene:
        """Return the scene of a source."""
        return carlasc.Scene(source, **vars(self), palette=palette)


def describe_frames(frames: tuple[int, ...]) -> str:
    """Return "frame 3" or "12 frames"."""
    return f"frame {frames[0]}" if len(frames) == 1 else count(len(frames), "frame")


def view(
    scene: SceneFlags,
    source: Annotated[
        str,
        place_argument(
            "A sequence or data set (folder, zip, packed store, URL), the folder of a grid, or the "
            "file of one frame."
        ),
    ],
    out: Annotated[
        Path | None,
        file_option(
            "-o",
            "--out",
            "--to",
            text="File to write instead of opening a window: an .html page for any browser, an "
            ".rrd recording for Rerun, or an .mcap recording for Foxglove. A name without an "
            "ending is the folder of a page for a web server.",
        ),
    ] = None,
    palette: Annotated[
        Literal["class", "colorblind"],
        typer.Option(
            help="class: colours of the class table. colorblind: colours for colour-blind readers."
        ),
    ] = "class",
    thin_m: Annotated[
        float,
        typer.Option(
            "--thin", help="Keep one point of a page per cell of this side length, in metres."
        ),
    ] = 0.2,
    full_points: Annotated[
        bool,
        typer.Option(
            "--full-points",
            help="Keep all points in a recording, and print its expected size first. Default: "
            "30,000 points per frame.",
        ),
    ] = False,
    beside: Annotated[
        str | None,
        place_option(
            "--beside",
            text="Another run of the sequence, shown in the page on the other side of a movable "
            "divider.",
        ),
    ] = None,
    beside_grid: Annotated[
        str | None,
        typer.Option(
            "--beside-grid",
            help="Name of the grid of the other run. Without --beside: another grid of SOURCE.",
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an existing file.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Show a sequence in a window (Open3D), or write it as a page for any browser or as a recording
    for Rerun or Foxglove (--out).

    In all of them, you can rotate and zoom, and step through the frames. Pages and recordings also
    show and hide the grid, points, scene flow, boxes, tracks and classes. Without --frames, a file shows the first 60 frames; a window and
    the folder of a page show all frames.
    """
    shown = scene.scene(source, palette)
    if out is None:
        if as_json:
            raise ArgumentError(
                "--json", problem="a window prints no result", advice="write a page with `out`"
            )
        if beside is not None or beside_grid is not None:
            raise ArgumentError(
                "--beside", problem="a window shows only one run", advice="write a page with `out`"
            )
        carlasc.view(shown, report=echo)
        return
    with progress_bar("Writing the file") as progress:
        result = carlasc.view(
            shown,
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
