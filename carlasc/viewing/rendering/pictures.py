"""One picture: scenes, each from a viewpoint, on a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable
from carlasc.core.geometry import Transform
from carlasc.core.grids import Grid
from carlasc.core.scans import Scan
from carlasc.core.tables import CARLA
from carlasc.errors import ArgumentError
from carlasc.viewing.rendering.cameras import Viewpoint, birdseye_camera, perspective_camera
from carlasc.viewing.rendering.colors import ClassColors, Entry, PaletteName, merge_legends
from carlasc.viewing.rendering.pages import Page, draw_page, plan_page
from carlasc.viewing.rendering.scenes import Extent, Scene, error_scene, flow_scene, grid_scene, scan_scene

View = Literal["perspective", "bev"]
VIEWS: tuple[str, ...] = get_args(View)
DEFAULT_SIZE = (1280, 720)


@dataclass(frozen=True)
class Panel:
    """One picture of a page.

    Attributes:
        scene: what is drawn.
        view: "perspective" or "bev".
        title: what stands above it.
        standpoint: for a camera that does not move with the scene: what it shows, and scene_T_standpoint from there.
    """

    scene: Scene
    view: View = "perspective"
    title: str = ""
    standpoint: tuple[Extent, Transform] | None = None


def draw_panels(
    panels: Sequence[Panel],
    *,
    viewpoint: Viewpoint | None = None,
    size: tuple[int, int] = DEFAULT_SIZE,
    legend: Sequence[Entry] | bool = True,
    left_handed: bool = True,
) -> NDArray[np.uint8]:
    """Draw scenes side by side.

    Args:
        panels: what is drawn.
        viewpoint: where the perspective views are taken from; behind and above the ego vehicle if None.
        size: (width, height) of the whole picture, pixels.
        legend: whether there is one; or its entries, where a film wants the same in all its frames.
        left_handed: the frame of the data has y on the right.

    Returns:
        (height, width, 3) uint8 RGB.

    Raises:
        ArgumentError: a size, view or viewpoint that makes no picture.
    """
    if not panels:
        raise ArgumentError("panels", expected="at least one", found="none")
    for panel in panels:
        if panel.view not in VIEWS:
            raise ArgumentError(f"view {panel.view!r}: expected one of {', '.join(VIEWS)}")
    entries = (
        (merge_legends([p.scene.legend for p in panels]) if legend else []) if isinstance(legend, bool) else legend
    )
    page = plan_page(
        size,
        len(panels),
        titled=any(panel.title for panel in panels),
        legend=entries,
        aspect=float(np.mean([1.0 if panel.view == "bev" else 16 / 9 for panel in panels])),
    )
    pictures = [
        _draw(panel, page, number, viewpoint or Viewpoint(), left_handed) for number, panel in enumerate(panels)
    ]
    return draw_page(page, pictures, [panel.title for panel in panels], [panel.scene.note for panel in panels])


def render_grid(
    grid: Grid,
    table: ClassTable = CARLA,
    *,
    view: View = "perspective",
    viewpoint: Viewpoint | None = None,
    size: tuple[int, int] = DEFAULT_SIZE,
    palette: PaletteName = "class",
    legend: bool = True,
    left_handed: bool = True,
    title: str = "",
    ego: bool = True,
) -> NDArray[np.uint8]:
    """Picture a voxel grid; free and unknown voxels are not drawn.

    Args:
        grid: Cartesian or cylindrical.
        table: of its labels.
        view: "perspective" or "bev" (bird's-eye).
        viewpoint: where a perspective view is taken from.
        size: (width, height), pixels.
        palette: "class", "colorblind" or "height".
        legend: whether classes are named; those present, by id.
        left_handed: the frame has y on the right (CarlaSC); False: on the left (KITTI).
        title: a line above the picture.
        ego: draw a plain car at the sensor's place.

    Returns:
        (height, width, 3) uint8 RGB.

    Raises:
        FormatError: a label is not of the table.
        ArgumentError: an argument makes no picture.
    """
    scene = grid_scene(grid, ClassColors(table, palette), ego=ego)
    return draw_panels(
        [Panel(scene, view, title)], viewpoint=viewpoint, size=size, legend=legend, left_handed=left_handed
    )


def render_scan(
    scan: Scan,
    table: ClassTable = CARLA,
    *,
    view: View = "perspective",
    viewpoint: Viewpoint | None = None,
    size: tuple[int, int] = DEFAULT_SIZE,
    palette: PaletteName = "class",
    legend: bool = True,
    left_handed: bool = True,
    title: str = "",
    ego: bool = True,
    flow: bool = False,
    extent: Extent | None = None,
) -> NDArray[np.uint8]:
    """Picture a scan's points, by class, by height where they have none, or how they move.

    Args:
        scan: in the sensor's frame.
        table: of its labels.
        view: "perspective" or "bev".
        viewpoint: where a perspective view is taken from.
        size: (width, height), pixels.
        palette: "class", "colorblind" or "height".
        legend: whether colours are explained.
        left_handed: the frame has y on the right (CarlaSC); False: on the left (KITTI).
        title: a line above the picture.
        ego: draw a plain car at the sensor's place.
        flow: draw what stands grey, what moves in colour, with an arrow as long as the way of one second.
        extent: (M, 3) points, metres, that a fitted camera shows; most of the scan if None.

    Returns:
        (height, width, 3) uint8 RGB.

    Raises:
        FormatError: a label is not of the table, or flow is wanted of a scan without.
        ArgumentError: an argument makes no picture.
    """
    draw = flow_scene if flow else scan_scene
    scene = draw(scan, ClassColors(table, palette), extent=extent, ego=ego)
    return draw_panels(
        [Panel(scene, view, title)], viewpoint=viewpoint, size=size, legend=legend, left_handed=left_handed
    )


def render_comparison(
    prediction: Grid,
    truth: Grid,
    table: ClassTable = CARLA,
    *,
    errors: bool = True,
    view: View = "perspective",
    viewpoint: Viewpoint | None = None,
    size: tuple[int, int] = DEFAULT_SIZE,
    palette: PaletteName = "class",
    legend: bool = True,
    left_handed: bool = True,
    ego: bool = True,
) -> NDArray[np.uint8]:
    """Picture a prediction beside its truth and, with `errors`, where it is right, wrong, misses and invents.

    Args:
        prediction: of the truth's cells.
        truth: with counts: errors are shown where it is known.
        table: of both grids' labels.
        errors: add the picture of errors.
        view: "perspective" or "bev".
        viewpoint: where perspective views are taken from.
        size: (width, height) of the whole, pixels.
        palette: "class", "colorblind" or "height".
        legend: whether colours are explained.
        left_handed: the frame has y on the right (CarlaSC); False: on the left (KITTI).
        ego: draw a plain car at the sensor's place.

    Returns:
        (height, width, 3) uint8 RGB.

    Raises:
        FormatError: a label is not of the table.
        ArgumentError: the grids differ in their cells, or an argument makes no picture.
    """
    colors = ClassColors(table, palette)
    panels = [
        Panel(grid_scene(prediction, colors, ego=ego), view, "prediction"),
        Panel(grid_scene(truth, colors, ego=ego), view, "truth"),
    ]
    if errors:
        panels.append(Panel(error_scene(prediction, truth, ego=ego), view, "errors"))
    return draw_panels(panels, viewpoint=viewpoint, size=size, legend=legend, left_handed=left_handed)


def _draw(panel: Panel, page: Page, number: int, viewpoint: Viewpoint, left_handed: bool) -> NDArray[np.uint8]:
    box = page.panels[number]
    aspect = box.width / box.height
    extent = panel.scene.extent if panel.standpoint is None else panel.standpoint[0]
    if panel.view == "bev":
        camera = birdseye_camera(extent, aspect, left_handed=left_handed)
    else:
        camera = perspective_camera(extent, viewpoint, aspect, left_handed=left_handed)
    if panel.standpoint is not None:
        camera = camera.moved(panel.standpoint[1])
    return panel.scene.draw(camera, box.width, box.height, left_handed=left_handed)
