"""`carlasc render`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from carlasc.cli.common import Json, Overwrite, parse_frames, print_json, progress_bar
from carlasc.cli.scene_options import (
    ClassesOption,
    GridOption,
    PathClassesOption,
    SequenceOption,
    TruthGridOption,
    TruthOption,
)
from carlasc.errors import ArgumentError


def render(
    path: Annotated[
        str,
        typer.Argument(
            help="A sequence or data set (folder, zip, packed store, URL), a grid's folder, or a frame's file."
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="A .png, .gif or .mp4; named after the sequence if not given.")
    ] = None,
    frame: Annotated[int | None, typer.Option(help="The frame; the first if not given.", min=0)] = None,
    frames: Annotated[str | None, typer.Option(help="Frames A:B of a film (B not included).")] = None,
    what: Annotated[
        str | None,
        typer.Option(help="grid, scan, flow, truth, errors; several with commas between stand side by side."),
    ] = None,
    view: Annotated[
        Literal["perspective", "bev", "both"], typer.Option(help="From behind and above, from straight above, or both.")
    ] = "perspective",
    grid: GridOption = None,
    truth: TruthOption = None,
    truth_grid: TruthGridOption = None,
    sequence: SequenceOption = None,
    classes: ClassesOption = None,
    path_classes: PathClassesOption = None,
    palette: Annotated[
        Literal["class", "colorblind", "height"],
        typer.Option(help="The classes' own colours, ones that the colour-blind tell apart, or by height."),
    ] = "class",
    size: Annotated[str, typer.Option(help="Pixels of the picture, WIDTHxHEIGHT.")] = "1280x720",
    camera: Annotated[
        str | None,
        typer.Option(
            help="'azimuth=DEG elevation=DEG distance=M fov=DEG target=X,Y,Z', or 'position=X,Y,Z target=X,Y,Z': any of these."
        ),
    ] = None,
    orbit: Annotated[bool, typer.Option("--orbit", help="Go once around the scene (a film).")] = False,
    still: Annotated[
        bool, typer.Option("--still", help="The camera does not follow the ego vehicle (needs poses).")
    ] = False,
    fps: Annotated[float | None, typer.Option(help="Pictures a second; 10 if not given, the data's own rate.")] = None,
    no_legend: Annotated[bool, typer.Option("--no-legend", help="Leave the legend out.")] = False,
    no_ego: Annotated[bool, typer.Option("--no-ego", help="Leave the ego vehicle out.")] = False,
    workers: Annotated[
        int | None, typer.Option(help="Processes that draw a film; all cores if not given.", min=1)
    ] = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Picture a frame (PNG) or a range of frames (GIF, MP4): grids, scans, flow, predictions beside the truth, errors.

    No screen and no GPU are needed. The camera stands behind and above the ego vehicle and follows it.
    """
    from carlasc.viewing.rendering import Viewpoint
    from carlasc.viewing.rendering import render as draw

    with progress_bar("Rendering", "pictures") as progress:
        result = draw(
            path,
            out,
            sequence=sequence,
            frame=frame,
            frames=parse_frames(frames),
            what=what,
            view=view,
            grid=grid,
            truth=truth,
            truth_grid=truth_grid,
            classes=classes,
            path_classes=path_classes,
            palette=palette,
            size=_parse_size(size),
            legend=not no_legend,
            ego=not no_ego,
            viewpoint=None if camera is None else Viewpoint.parse(camera),
            orbit=orbit,
            still=still,
            fps=fps,
            workers=workers,
            overwrite=overwrite,
            progress=progress,
        )
    if as_json:
        print_json(result)
        return
    for note in result.notes:
        typer.echo(note)
    shown = f"frame {result.frames[0]}" if len(result.frames) == 1 else f"{len(result.frames)} frames"
    typer.echo(
        f"{result.out}: {', '.join(result.what)} of {result.sequence}, {shown}, {result.size[0]} x {result.size[1]}"
    )


def _parse_size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise ArgumentError("--size", expected="WIDTHxHEIGHT such as 1280x720", found=f"{text!r}") from None
    return width, height
