"""`carlasc render`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from carlasc.cli.common import (
    Cluster,
    FramesOption,
    Json,
    echo,
    engine,
    file_option,
    print_json,
    progress_bar,
)
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


def render(
    source: SourceArgument,
    out: Annotated[
        Path | None, file_option("-o", "--out", text="A .png, .gif or .mp4. Default: named after the sequence.")
    ] = None,
    frames: FramesOption = None,
    every: EveryOption = 1,
    what: Annotated[
        str | None,
        typer.Option(help="grid, scan, flow, truth, errors; several, separated by commas, are drawn side by side."),
    ] = None,
    view: Annotated[
        Literal["perspective", "bev", "both"],
        typer.Option(help="From behind and above, from straight above (bird's-eye view), or both."),
    ] = "perspective",
    grid: GridOption = None,
    truth: TruthOption = None,
    truth_grid: TruthGridOption = None,
    sequence: SequenceOption = None,
    classes: ClassesOption = None,
    source_classes: SourceClassesOption = None,
    palette: Annotated[
        Literal["class", "colorblind", "height"],
        typer.Option(help="Colours of the class table, colours for colour-blind readers, or colours by height."),
    ] = "class",
    size: Annotated[str, typer.Option(help="Size of the picture in pixels, WIDTHxHEIGHT.")] = "1280x720",
    viewpoint: Annotated[
        str | None,
        typer.Option(
            help="Any of azimuth=DEG elevation=DEG distance=M fov=DEG target=X,Y,Z position=X,Y,Z, in one pair of quotes."
        ),
    ] = None,
    orbit: Annotated[bool, typer.Option("--orbit", help="Circle the scene once (a film).")] = False,
    still: Annotated[
        bool, typer.Option("--still", help="The camera does not follow the ego vehicle (needs poses).")
    ] = False,
    fps: Annotated[
        float | None, typer.Option(help="Pictures per second of a film. Default: 10, the rate of the data.")
    ] = None,
    legend: Annotated[bool, typer.Option("--legend/--no-legend", help="Draw a legend.")] = True,
    ego: Annotated[bool, typer.Option("--ego/--no-ego", help="Draw the ego vehicle.")] = True,
    workers: Annotated[
        int | None, typer.Option(help="Processes that draw the pictures of a film. Default: all cores.", min=1)
    ] = None,
    cluster: Cluster = None,
    overwrite: OverwriteOption = False,
    as_json: Json = False,
) -> None:
    """Draw a frame (PNG) or several frames (GIF, MP4): grids, scans, scene flow, predictions with ground truth and errors.

    No screen and no GPU are needed. The camera is behind and above the ego vehicle and follows it.
    Without --frames, a picture shows the first frame and a film shows all frames.
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
    with progress_bar("Rendering", "pictures") as progress, engine(cluster, workers) as executor:
        result = viewing.render(
            scene,
            out,
            what=what,
            view=view,
            size=_parse_size(size),
            legend=legend,
            ego=ego,
            viewpoint=None if viewpoint is None else viewing.Viewpoint.parse(viewpoint),
            orbit=orbit,
            still=still,
            fps=fps,
            workers=workers,
            executor=executor,
            overwrite=overwrite,
            progress=progress,
        )
    if as_json:
        print_json(result)
        return
    for note in result.notes:
        echo(note)
    shown = f"{', '.join(result.what)} of {result.sequence}, {describe_frames(result.frames)}"
    echo(f"{result.out}: {shown}, {result.size[0]} x {result.size[1]}")


def _parse_size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise ArgumentError("size", expected="WIDTHxHEIGHT, such as 1280x720", found=repr(text)) from None
    return width, height
