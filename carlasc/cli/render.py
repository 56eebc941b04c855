"""`carlasc render`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import typer

import carlasc
from carlasc.cli.common import Json, echo, file_option, places_argument, print_json
from carlasc.cli.flags import Flags, WorkFlags
from carlasc.cli.view import SceneFlags, describe_frames
from carlasc.core.choices import GridColor, PaletteName, StyleName, ViewName
from carlasc.errors import ArgumentError


@dataclass(frozen=True)
class CameraFlags(Flags):
    """Where pictures are taken from."""

    heading: ClassVar[str] = "Camera"

    view: Annotated[
        ViewName,
        typer.Option(
            help="perspective: from behind and above. bev: from straight above (bird's-eye view)."
        ),
    ] = "perspective"
    viewpoint: Annotated[
        str | None,
        typer.Option(
            help="Position of the camera: any of azimuth=DEG elevation=DEG distance=M fov=DEG "
            "target=X,Y,Z position=X,Y,Z (degrees and metres), together in quotes."
        ),
    ] = None
    orbit: Annotated[
        bool, typer.Option("--orbit", help="Make a film that circles the scene once.")
    ] = False
    camera: Annotated[
        str | None,
        typer.Option(help="Draw only the grid, over the images of this camera of the recording."),
    ] = None
    still: Annotated[
        bool,
        typer.Option("--still", help="Do not move the camera with the ego vehicle (needs poses)."),
    ] = False

    def options(self) -> carlasc.CameraOptions:
        """Return where pictures are taken from."""
        given = (
            {}
            if self.viewpoint is None
            else {"viewpoint": carlasc.viewing.Viewpoint.parse(self.viewpoint)}
        )
        return carlasc.CameraOptions(self.view, orbit=self.orbit, still=self.still, **given)


@dataclass(frozen=True)
class StyleFlags(Flags):
    """How pictures look."""

    heading: ClassVar[str] = "Style"

    style: Annotated[
        StyleName,
        typer.Option(
            help="paper: 300 dpi, text of 8 points, and the legend in a separate file "
            "(NAME.legend.png)."
        ),
    ] = "screen"
    size: Annotated[
        str | None,
        typer.Option(
            help="WIDTHxHEIGHT in pixels, or with a unit, such as 8.8cmx5cm or 3.5inx2in. Default: "
            "1280x720; with --style paper: 8.8cmx5cm."
        ),
    ] = None
    dpi: Annotated[
        float | None,
        typer.Option(
            help="Pixels per inch, written into a PNG. Default: 300 for paper and for a size with "
            "a unit."
        ),
    ] = None
    captions: Annotated[
        list[str] | None,
        typer.Option(
            "--caption",
            help="With --grid-of: caption of a panel. Repeat it for each panel. Default: what "
            "differs between the panels.",
        ),
    ] = None
    columns: Annotated[
        int | None, typer.Option(help="With --grid-of: number of panels in a row.", min=1)
    ] = None
    legend: Annotated[bool, typer.Option("--legend/--no-legend", help="Draw a legend.")] = True
    ego: Annotated[bool, typer.Option("--ego/--no-ego", help="Draw the ego vehicle.")] = True

    def options(self) -> carlasc.StyleOptions:
        """Return how pictures look."""
        return carlasc.StyleOptions(
            self.style,
            self.size,
            self.dpi,
            self.captions or (),
            self.columns,
            self.legend,
            self.ego,
        )


@dataclass(frozen=True)
class ContentFlags(Flags):
    """What is drawn."""

    heading: ClassVar[str] = "What is drawn"

    what: Annotated[
        str | None,
        typer.Option(
            help="grid, scan, flow, truth or errors. Several, separated by commas, are drawn side "
            "by side."
        ),
    ] = None
    color: Annotated[
        GridColor,
        typer.Option(
            help="What the colours of the grid show: classes, a kind of evidence, actors, or "
            "cameras."
        ),
    ] = "class"
    boxes: Annotated[bool, typer.Option("--boxes", help="Draw boxes around actors.")] = False


@dataclass(frozen=True)
class PanelFlags(Flags):
    """What several panels show, and in which colours."""

    heading: ClassVar[str] = ContentFlags.heading

    grid_of: Annotated[
        bool,
        typer.Option(
            "--grid-of", help="Draw several SOURCES, or the frames of one, as panels with captions."
        ),
    ] = False
    palette: Annotated[
        PaletteName,
        typer.Option(
            help="Colours of the class table, colours for colour-blind readers, or colours by "
            "height."
        ),
    ] = "class"


def render(
    *,
    sources: Annotated[
        list[str],
        places_argument(
            "A sequence or data set (folder, zip, packed store, URL), the folder of a grid, or the "
            "file of one frame. With --grid-of: one or more.",
        ),
    ],
    out: Annotated[
        Path | None,
        file_option(
            "-o", "--out", text="A .png, .gif, .mp4 or .webp. Default: named after the sequence."
        ),
    ] = None,
    scene: SceneFlags,
    fps: Annotated[
        float | None,
        typer.Option(help="Frames of a film per second. Default: 10, the rate of the data."),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an existing file.")
    ] = False,
    as_json: Json = False,
    content: ContentFlags,
    panels: PanelFlags,
    camera: CameraFlags,
    style: StyleFlags,
    work: WorkFlags,
) -> None:
    """Draw a frame (PNG) or several frames (GIF, MP4, WebP): grids, scans, scene flow, predictions
    with ground truth and errors.

    Neither a screen nor a GPU is needed. The camera is behind and above the ego vehicle and moves
    with it. Without --frames, a picture shows the first frame and a film shows all frames.
    """
    scenes = [scene.scene(source, panels.palette) for source in sources]
    if len(scenes) > 1 and not panels.grid_of:
        raise ArgumentError(
            "SOURCE", expected="one", found=str(len(scenes)), advice="draw several with --grid-of"
        )
    if camera.camera is not None:
        _draw_over_images(scenes[0], camera, out, fps, overwrite, as_json)
        return
    taken, looks = camera.options(), style.options()
    with work.spread("Rendering", "pictures") as run:
        result = carlasc.render(
            scenes if panels.grid_of else scenes[0],
            out,
            **vars(content),
            camera=taken,
            style=looks,
            fps=fps,
            overwrite=overwrite,
            run=run,
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


def _draw_over_images(
    scene: carlasc.Scene,
    camera: CameraFlags,
    out: Path | None,
    fps: float | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Draw a grid over the images of a camera of the recording."""
    target = Path(f"{camera.camera}.png") if out is None else out
    result = carlasc.viewing.overlay(
        scene, camera.camera or "", target, fps=fps, overwrite=overwrite
    )
    if as_json:
        print_json(result)
        return
    shown = f"grid over {camera.camera} of {result.sequence}, {describe_frames(result.frames)}"
    echo(f"{result.out}: {shown}, {result.size[0]} x {result.size[1]}")
