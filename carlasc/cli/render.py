"""`carlasc render`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import carlasc
from carlasc.cli.common import Json, echo, file_option, place_argument, print_json, read_places
from carlasc.cli.flags import WorkFlags
from carlasc.cli.library import Given, Library
from carlasc.cli.view import SceneGiven, describe_frames
from carlasc.errors import ArgumentError


def render(
    *,
    sources: Annotated[
        list[str],
        place_argument(
            "A sequence or data set (folder, zip, packed store, URL), the folder of a grid, or the "
            "file of one frame. With --grid-of: one or more.",
            "SOURCES",
            read=read_places,
        ),
    ],
    out: Annotated[
        Path | None,
        file_option(
            "-o", "--out", text="A .png, .gif, .mp4 or .webp. Default: named after the sequence."
        ),
    ] = None,
    scene: SceneGiven,
    as_json: Json = False,
    options: Annotated[Given, Library("carlasc.render")],
    grid_of: Annotated[
        bool,
        typer.Option(
            "--grid-of", help="Draw several SOURCES, or the frames of one, as panels with captions."
        ),
    ] = False,
    over: Annotated[
        str | None,
        typer.Option(
            "--camera", help="Draw only the grid, over the images of this camera of the recording."
        ),
    ] = None,
    camera: Annotated[Given, Library("carlasc.CameraOptions")],
    style: Annotated[Given, Library("carlasc.StyleOptions")],
    work: WorkFlags,
) -> None:
    """Draw a frame (PNG) or several frames (GIF, MP4, WebP): grids, scans, scene flow, predictions
    with ground truth and errors.

    Neither a screen nor a GPU is needed. The camera is behind and above the ego vehicle and moves
    with it. Without --frames, a picture shows the first frame and a film shows all frames.
    """
    scenes = [scene.make(source) for source in sources]
    if len(scenes) > 1 and not grid_of:
        raise ArgumentError(
            "SOURCE", expected="one", found=len(scenes), advice="draw several with --grid-of"
        )
    result: carlasc.viewing.RenderResult
    if over is not None:
        film = {name: options.values[name] for name in {"fps", "overwrite"} & set(options.values)}
        result = carlasc.viewing.overlay(scenes[0], over, out or Path(f"{over}.png"), **film)
        content = f"grid over {over}"
    else:
        drawn = scenes if grid_of else scenes[0]
        taken = camera.make()
        looks = style.make()
        with work.spread("Rendering", "pictures") as run:
            result = options.make(drawn, out, camera=taken, style=looks, run=run)
        content = ", ".join(result.what)
    if as_json:
        print_json(result)
        return
    for note in result.notes:
        echo(note)
    if result.legend is not None:
        echo(f"{result.legend}: the legend")
    shown = f"{content} of {result.sequence}, {describe_frames(result.frames)}"
    if result.source_classes is not None:
        shown += f", classes {result.source_classes}"
    echo(f"{result.out}: {shown}, {result.size[0]} x {result.size[1]}")
