"""Pictures of grids and scans as arrays: drawings, each seen from a viewpoint, side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from carlasc.core.arrays import Uint8Array
from carlasc.core.choices import Axes
from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform
from carlasc.core.grids import Grid
from carlasc.core.scans import Scan
from carlasc.core.tables import CARLA
from carlasc.errors import ArgumentError, check_choice
from carlasc.viewing.colors import ClassColors, Entry, PaletteName, merge_legends
from carlasc.viewing.rendering.cameras import (
    VIEWS,
    View,
    Viewpoint,
    birdseye_camera,
    perspective_camera,
)
from carlasc.viewing.rendering.drawings import (
    Drawing,
    Extent,
    error_drawing,
    flow_drawing,
    grid_drawing,
    scan_drawing,
)
from carlasc.viewing.rendering.pages import draw_page, plan_page

DEFAULT_SIZE = (1280, 720)


@dataclass(frozen=True)
class Panel:
    """A drawing seen from a view: one part of a picture.

    Attributes:
        drawing: the drawing.
        view: "perspective" or "bev" (bird's-eye view).
        title: line above the panel, or its caption; "" for none.
        fixed_view: for a camera that is not fitted to the drawing: the extent to show, and
            `drawing_T_view`, the frame of that extent.
    """

    drawing: Drawing
    view: View = "perspective"
    title: str = ""
    fixed_view: tuple[Extent, Transform] | None = None


def draw_panels(
    panels: Sequence[Panel],
    *,
    viewpoint: Viewpoint | None = None,
    size: tuple[int, int] = DEFAULT_SIZE,
    legend: Sequence[Entry] | bool = True,
    axes: Axes = "left",
    captioned: bool = False,
    columns: int | None = None,
    font_size: int | None = None,
) -> Uint8Array:
    """Draw panels side by side.

    Args:
        panels: the panels.
        viewpoint: where perspective views are taken from; None takes a point behind and above the
            ego vehicle.
        size: (width, height) of the whole picture, pixels.
        legend: whether there is a legend; or its entries, so that all pictures of a film have the
            same legend.
        axes: handedness of the data: "left" (CarlaSC: y to the right) or "right" (KITTI: y to the
            left).
        captioned: whether titles are captions: below the panels, in as many lines as needed. All
            panels then have one size.
        columns: number of panels in a row; None takes the number with which panels are largest.
        font_size: pixels; None takes one by the size of the picture.

    Returns:
        (height, width, 3) uint8 RGB.

    Raises:
        ArgumentError: no panel, or an impossible size, view, viewpoint or value of `axes`.
        DependencyError: Pillow or Embree is not installed.
    """
    if not panels:
        raise ArgumentError("panels", expected="at least one", found="none")
    check_choice("axes", axes, Axes)
    for panel in panels:
        check_choice("view", panel.view, VIEWS)
    entries = (
        (merge_legends([p.drawing.legend for p in panels]) if legend else [])
        if isinstance(legend, bool)
        else legend
    )
    titles = [panel.title for panel in panels]
    page = plan_page(
        size,
        len(panels),
        titled=any(titles) and not captioned,
        legend=entries,
        aspect=float(np.mean([1.0 if panel.view == "bev" else 16 / 9 for panel in panels])),
        captions=titles if captioned else (),
        columns=columns,
        font_size=font_size,
    )
    pictures = []
    for panel, box in zip(panels, page.panels, strict=True):
        extent, drawing_T_view = panel.fixed_view or (panel.drawing.extent, None)
        aspect = box.width / box.height
        if panel.view == "bev":
            camera = birdseye_camera(extent, aspect, axes=axes)
        else:
            camera = perspective_camera(extent, viewpoint or Viewpoint(), aspect, axes=axes)
        if drawing_T_view is not None:
            camera = camera.moved(drawing_T_view)
        pictures.append(panel.drawing.render(camera, box.width, box.height, axes=axes))
    return draw_page(
        page, pictures, titles, [panel.drawing.note for panel in panels], wrapped=captioned
    )


@dataclass(frozen=True)
class Look:
    """How a picture of a grid or a scan looks.

    Attributes:
        view: "perspective" or "bev" (bird's-eye view).
        viewpoint: where perspective views are taken from; None takes a point behind and above the
            ego vehicle.
        size: (width, height) of the whole picture, pixels.
        palette: "class", "colorblind" or "height".
        legend: whether there is a legend, of the classes that are shown.
        axes: handedness of the data: "left" (CarlaSC: y to the right) or "right" (KITTI: y to the
            left).
        ego: whether a plain car is drawn at the sensor.
    """

    view: View = "perspective"
    viewpoint: Viewpoint | None = None
    size: tuple[int, int] = DEFAULT_SIZE
    palette: PaletteName = "class"
    legend: bool = True
    axes: Axes = "left"
    ego: bool = True

    def draw(self, drawings: Mapping[str, Drawing]) -> Uint8Array:
        """Draw drawings side by side, by their titles."""
        return draw_panels(
            [Panel(drawing, self.view, title) for title, drawing in drawings.items()],
            viewpoint=self.viewpoint,
            size=self.size,
            legend=self.legend,
            axes=self.axes,
        )


def render_grid(
    grid: Grid,
    table: ClassTable = CARLA,
    look: Look = Look(),
    *,
    title: str = "",
) -> Uint8Array:
    """Draw a voxel grid, without free and unknown voxels.

    Args:
        grid: Cartesian or cylindrical.
        table: class table of its labels.
        look: how the picture looks.
        title: a line above the picture; "" for none.

    Returns:
        (height, width, 3) uint8 RGB.

    Raises:
        FormatError: a label is not in the class table.
        ArgumentError: an impossible size, view, palette or value of `axes`.
        DependencyError: Pillow or Embree is not installed.
    """
    return look.draw({title: grid_drawing(grid, ClassColors(table, look.palette), ego=look.ego)})


def render_scan(
    scan: Scan,
    table: ClassTable = CARLA,
    look: Look = Look(),
    *,
    title: str = "",
    flow: bool = False,
    extent: Extent | None = None,
) -> Uint8Array:
    """Draw the points of a scan, coloured by class (by height if they have no labels), or their
    scene flow.

    Args:
        scan: in the frame of the sensor.
        table: class table of its labels.
        look: how the picture looks.
        title: a line above the picture; "" for none.
        flow: draw static points in grey, moving ones in colour, with an arrow as long as the
            distance moved in one second.
        extent: (M, 3) points, metres, that the camera shows; None shows most of the scan.

    Returns:
        (height, width, 3) uint8 RGB.

    Raises:
        FormatError: a label is not in the class table, or `flow` is given and the scan has no flow.
        ArgumentError: an impossible size, view, palette or value of `axes`.
        DependencyError: Pillow or Embree is not installed.
    """
    draw = flow_drawing if flow else scan_drawing
    colors = ClassColors(table, look.palette)
    return look.draw({title: draw(scan, colors, extent=extent, ego=look.ego)})


def render_comparison(
    prediction: Grid,
    truth: Grid,
    table: ClassTable = CARLA,
    look: Look = Look(),
    *,
    errors: bool = True,
) -> Uint8Array:
    """Draw a prediction beside the ground truth and, with `errors`, its errors: right, wrong class,
    missed or invented.

    Args:
        prediction: a grid with the geometry of the truth.
        truth: the ground truth; with counts, errors are shown only where it is known.
        table: class table of the labels of both grids.
        look: how the picture looks.
        errors: whether a panel shows the errors.

    Returns:
        (height, width, 3) uint8 RGB.

    Raises:
        FormatError: a label is not in the class table.
        ArgumentError: the grids differ in their geometry; or an impossible size, view, palette or
            value of `axes`.
        DependencyError: Pillow or Embree is not installed.
    """
    colors = ClassColors(table, look.palette)
    drawings = {
        "prediction": grid_drawing(prediction, colors, ego=look.ego),
        "truth": grid_drawing(truth, colors, ego=look.ego),
    }
    if errors:
        drawings["errors"] = error_drawing(prediction, truth, ego=look.ego)
    return look.draw(drawings)
