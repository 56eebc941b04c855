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
    places_argument,
    print_json,
    progress_bar,
)
from carlasc.cli.scene_options import (
    ClassesOption,
    EveryOption,
    GridOption,
    OverwriteOption,
    SequenceOption,
    SourceClassesOption,
    TruthGridOption,
    TruthOption,
    describe_frames,
)
from carlasc.errors import ArgumentError
from carlasc.running.options import Run


def render(
    sources: Annotated[
        list[str],
        places_argument(
            "A sequence or data set (folder, zip, packed store, URL), the folder of a grid, or the file of one frame;"
            " several with --grid-of.",
        ),
    ],
    out: Annotated[
        Path | None, file_option("-o", "--out", text="A .png, .gif, .mp4 or .webp. Default: named after the sequence.")
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
    grid_of: Annotated[
        bool,
        typer.Option("--grid-of", help="Draw panels of several SOURCES, or of the frames of one, with captions."),
    ] = False,
    captions: Annotated[
        list[str] | None,
        typer.Option(
            "--caption",
            help="With --grid-of: text of a panel, once for each. Default: what differs between the panels.",
        ),
    ] = None,
    columns: Annotated[int | None, typer.Option(help="With --grid-of: number of panels in a row.", min=1)] = None,
    color: Annotated[
        Literal["class", "confidence", "views", "votes", "inferred"],
        typer.Option(help="What the colours of the grid mean: classes, or one of the kinds of evidence."),
    ] = "class",
    boxes: Annotated[bool, typer.Option("--boxes", help="Draw boxes around actors.")] = False,
    palette: Annotated[
        Literal["class", "colorblind", "height"],
        typer.Option(help="Colours of the class table, colours for colour-blind readers, or colours by height."),
    ] = "class",
    style: Annotated[
        Literal["screen", "paper"],
        typer.Option(help="paper: 300 dpi, type of 8 points, and the legend in a file of its own (NAME.legend.png)."),
    ] = "screen",
    size: Annotated[
        str | None,
        typer.Option(
            help="WIDTHxHEIGHT in pixels, or with a unit, such as 8.8cmx5cm or 3.5inx2in. Default: 1280x720, or 8.8cmx5cm on paper."
        ),
    ] = None,
    dpi: Annotated[
        float | None,
        typer.Option(help="Pixels per inch, written into a PNG. Default: 300 on paper and for a size with a unit."),
    ] = None,
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
    """Draw a frame (PNG) or several frames (GIF, MP4, WebP): grids, scans, scene flow, predictions with ground truth and errors.

    No screen and no GPU are needed. The camera is behind and above the ego vehicle and follows it.
    Without --frames, a picture shows the first frame and a film shows all frames.
    """
    from carlasc import viewing

    scenes = [
        viewing.Scene(
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
        for source in sources
    ]
    if len(scenes) > 1 and not grid_of:
        raise ArgumentError("SOURCE", expected="one", found=str(len(scenes)), advice="draw several with --grid-of")
    with progress_bar("Rendering", "pictures") as progress, engine(cluster, workers) as executor:
        result = viewing.render(
            scenes if grid_of else scenes[0],
            out,
            what=what,
            view=view,
            color=color,
            boxes=boxes,
            style=style,
            size=size,
            dpi=dpi,
            captions=captions or (),
            columns=columns,
            legend=legend,
            ego=ego,
            viewpoint=None if viewpoint is None else viewing.Viewpoint.parse(viewpoint),
            orbit=orbit,
            still=still,
            fps=fps,
            run=Run(workers=workers, executor=executor, progress=progress),
            overwrite=overwrite,
        )
    if as_json:
        print_json(result)
        return
    for note in result.notes:
        echo(note)
    if result.legend is not None:
        echo(f"{result.legend}: the legend")
    shown = f"{', '.join(result.what)} of {result.sequence}, {describe_frames(result.frames)}"
    echo(f"{result.out}: {shown}, {result.size[0]} x {result.size[1]}")
