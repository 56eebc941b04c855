"""`carlasc view`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import carlasc
from carlasc.cli.common import (
    Json,
    echo,
    file_option,
    place_argument,
    print_json,
    progress_bar,
)
from carlasc.cli.library import Given, Library
from carlasc.errors import ArgumentError, count

SceneGiven = Annotated[Given, Library("carlasc.Scene")]


def describe_frames(frames: tuple[int, ...]) -> str:
    """Return "frame 3" or "12 frames"."""
    return f"frame {frames[0]}" if len(frames) == 1 else count(len(frames), "frame")


def view(
    *,
    scene: SceneGiven,
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
    options: Annotated[Given, Library("carlasc.view")],
    as_json: Json = False,
) -> None:
    """Show a sequence in a window (Open3D), or write it as a page for any browser or as a recording
    for Rerun or Foxglove (--out).

    In all of them, you can rotate and zoom, and step through the frames. Pages and recordings also
    show and hide the grid, points, scene flow, boxes, tracks and classes. Without --frames, a file
    shows the first 60 frames; a window and the folder of a page show all frames.
    """
    shown: carlasc.Scene = scene.make(source)
    if out is None:
        if as_json:
            raise ArgumentError(
                "--json", problem="a window prints no result", advice="write a page with `out`"
            )
        if {"beside", "beside_grid"} & set(options.values):
            raise ArgumentError(
                "--beside", problem="a window shows only one run", advice="write a page with `out`"
            )
        carlasc.view(shown, report=echo)
        return
    with progress_bar("Writing the file") as progress:
        report = None if as_json else echo
        result = options.make(shown, out, progress=progress, report=report)
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
    about = f"{describe_frames(result.frames)}, classes {result.source_classes}, {size}"
    echo(f"{result.out}: {result.sequence}, {about}: {advice}")
