"""The panels of a picture: contents of a frame, camera, and order of frames and scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from string import ascii_lowercase
from typing import NamedTuple

import numpy as np

from carlasc.core.arrays import Uint8Array
from carlasc.core.geometry import Transform, transform_points
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.storage import layout
from carlasc.viewing.colors import Entry, merge_legends
from carlasc.viewing.rendering.actor_boxes import BOX, boxes_in, with_boxes
from carlasc.viewing.rendering.cameras import CameraOptions, View, Viewpoint
from carlasc.viewing.rendering.drawings import (
    EVIDENCE,
    VELOCITY,
    Drawing,
    Extent,
    GridColor,
    error_drawing,
    evidence_drawing,
    flow_drawing,
    grid_drawing,
    grid_extent,
    scan_drawing,
    scan_extent,
    with_arrows,
)
from carlasc.viewing.rendering.pictures import Panel, draw_panels
from carlasc.viewing.rendering.styles import Sheet
from carlasc.viewing.scene import RemappedSequence, SceneReader

MOST_PANELS = 64
_VIEW_NAMES = {"perspective": "from behind", "bev": "from above"}


@dataclass(frozen=True, eq=False)
class FrameRenderer:
    """Draws the frames of a scene.

    Attributes:
        reader: reads the scene; its `contents` are drawn side by side.
        camera: the camera for each of the contents. A camera that circles the scene has one
            distance, from which the whole scene is visible from each side.
        ego: whether the ego vehicle is drawn.
        color: what the colours of the grid mean.
        boxes: whether boxes around actors are drawn.
    """

    reader: SceneReader
    camera: CameraOptions
    ego: bool
    color: GridColor
    boxes: bool

    @cached_property
    def extent(self) -> Extent:
        """The extent of pictures of scans, the same in all frames: the grid beside them, or most of
        the first scan.
        """
        reader = self.reader
        if {"grid", "errors"} & set(reader.contents):
            return grid_extent(reader.data.spec)
        if "truth" in reader.contents and reader.truth is not None:
            return grid_extent(reader.truth.spec)
        return scan_extent(reader.data.read_scan(reader.frames[0]))

    @cached_property
    def fixed_view(self) -> tuple[Extent, Transform] | None:
        """What a camera that does not follow the vehicle shows: the (8, 3) corners of a box around
        the extents of all frames, in the frame of the middle pose, and `world_T_middle`.

        Raises:
            MissingDataError: the sequence has no poses.
            FormatError: a pose is not valid.
        """
        if not self.camera.still:
            return None
        reader = self.reader
        world_T_middle = _pose_of(reader, reader.frames[len(reader.frames) // 2])
        middle_T_world = np.linalg.inv(world_T_middle)
        points = np.concatenate(
            [
                transform_points(middle_T_world @ _pose_of(reader, frame), self.extent)
                for frame in reader.frames
            ]
        )
        box = np.array([points.min(0), points.max(0)])
        corners = np.array([(box[i, 0], box[j, 1], box[k, 2]) for i, j, k in np.ndindex(2, 2, 2)])
        return corners, world_T_middle

    def panels(self, frame: int) -> list[Panel]:
        """Return the panels of a frame: each of the scene's contents from each of the views."""
        contents = self.reader.contents
        panels = []
        for content in contents:
            drawing = self.draw(content, frame)
            title = self.title(content) if len(contents) > 1 else ""
            panels += [
                Panel(drawing, view, title, self._view_of(drawing, view, frame))
                for view in self.camera.views
            ]
        return panels

    def draw(self, content: str, frame: int) -> Drawing:
        """Return the drawing of one of the scene's contents in a frame."""
        drawing = self._draw(content, frame)
        if not self.boxes:
            return drawing
        boxes = boxes_in(self.reader.data, frame)
        lower = drawing.extent.min(axis=0)
        upper = drawing.extent.max(axis=0)
        shown = ((boxes.centers >= lower) & (boxes.centers <= upper))[:, :2].all(axis=1)
        return with_boxes(drawing, boxes.select(shown))

    def _draw(self, content: str, frame: int) -> Drawing:
        reader = self.reader
        colors = self.reader.colors
        if content in ("scan", "flow"):
            draw = scan_drawing if content == "scan" else flow_drawing
            return draw(reader.data.read_scan(frame), colors, extent=self.extent, ego=self.ego)
        if content == "errors":
            return error_drawing(
                reader.data.read_grid(frame), self._grid_of("truth").read_grid(frame), ego=self.ego
            )
        if content == "grid" and self.color != "class":
            drawing = evidence_drawing(reader.data, frame, self.color, ego=self.ego)
            return (
                with_arrows(drawing, reader.read_motion(frame, None))
                if self.color == "actor"
                else drawing
            )
        return grid_drawing(self._grid_of(content).read_grid(frame), colors, ego=self.ego)

    def legend_of(self, frame: int) -> list[Entry]:
        """Return the entries that the legend of a frame needs."""
        colors = self.reader.colors
        legends = []
        for content in self.reader.contents:
            if content == "grid" and self.color != "class":
                legends.append(EVIDENCE[self.color].legend)
                if self.color == "actor" and self.reader.has(f"{self.reader.data.grid}/velocity"):
                    legends.append([VELOCITY])
            elif (
                content in ("grid", "truth") and colors.palette != "height"
            ):  # without building the mesh
                labels = self._grid_of(content).read_grid(frame).labels
                legends.append(
                    colors.entries(np.flatnonzero(np.bincount(labels.reshape(-1))).tolist())
                )
            else:
                legends.append(self._draw(content, frame).legend)
        if self.boxes:
            legends.append([BOX])
        return merge_legends(legends)

    def _grid_of(self, content: str) -> RemappedSequence:
        truth = self.reader.truth
        return self.reader.data if content == "grid" or truth is None else truth

    def _view_of(self, drawing: Drawing, view: View, frame: int) -> tuple[Extent, Transform] | None:
        """Return the extent to show and `drawing_T_view`, or None if the camera is fitted to the
        drawing.
        """
        orbits = self.camera.orbit and view == "perspective"
        if self.fixed_view is None:
            return (_swept_extent(drawing.extent), np.eye(4)) if orbits else None
        extent, world_T_view = self.fixed_view
        drawing_T_view = np.linalg.inv(_pose_of(self.reader, frame)) @ world_T_view
        return (_swept_extent(extent) if orbits else extent), drawing_T_view

    def title(self, content: str) -> str:
        """Return the title of one of the scene's contents."""
        titles = {"scan": "scan", "flow": "scene flow", "truth": "truth", "errors": "errors"}
        data = self.reader.data
        truth = self.reader.truth
        return titles.get(content) or (str(data.spec) if truth is None else "prediction")


def _pose_of(reader: SceneReader, frame: int) -> Transform:
    pose = reader.read_pose(frame)
    if pose is None:
        raise MissingDataError(
            reader.path,
            expected=layout.POSES,
            found="none",
            advice="let the camera follow the vehicle",
        )
    return pose


def _swept_extent(extent: Extent) -> Extent:
    """Return the rims of the upright cylinder around an extent, which looks the same from every
    side.
    """
    lower = extent.min(0)
    upper = extent.max(0)
    middle = (lower + upper) / 2
    radius = np.linalg.norm((extent - middle)[:, :2], axis=1).max()
    angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    rim = middle[:2] + radius * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.concatenate(
        [np.column_stack([rim, np.full(len(rim), z)]) for z in (lower[2], upper[2])]
    )


class Cell(NamedTuple):
    """One frame of one source.

    Attributes:
        renderer: draws the source.
        frame: frame number.
    """

    renderer: FrameRenderer
    frame: int


def draw_shot(
    shot: tuple[Sequence[Cell], Viewpoint],
    sheet: Sheet,
    legend: Sequence[Entry],
    captions: Sequence[str],
    columns: int | None,
) -> Uint8Array:
    """Return the picture of some cells from a viewpoint, (H, W, 3) uint8.

    Args:
        shot: the cells and the viewpoint.
        sheet: size and font size.
        legend: entries of the legend, the same in all pictures; empty for no legend.
        captions: texts below the panels; empty for titles of the contents.
        columns: number of panels in a row; None takes the number with which panels are largest.
    """
    cells, viewpoint = shot
    panels = [panel for cell in cells for panel in cell.renderer.panels(cell.frame)]
    if captions:
        extent = np.concatenate([panel.drawing.extent for panel in panels])
        panels = [
            replace(panel, title=caption, fixed_view=panel.fixed_view or (extent, np.eye(4)))
            for panel, caption in zip(panels, captions, strict=True)
        ]
    return draw_panels(
        panels,
        viewpoint=viewpoint,
        size=sheet.size,
        legend=legend,
        axes=cells[0].renderer.reader.axes,
        captioned=bool(captions),
        columns=columns,
        font_size=sheet.font_size,
    )


def plan_cells(renderers: Sequence[FrameRenderer], film: bool) -> list[list[Cell]]:
    """Return the cells of each picture: one frame of each source for a film, otherwise all frames
    of each source.

    Raises:
        ArgumentError: sources of different handedness, or too many panels.
        MissingDataError: the sources of a film have no common frame.
    """
    axes = {renderer.reader.axes for renderer in renderers}
    if len(axes) > 1:
        raise ArgumentError(
            "source",
            expected="sources with the same axes",
            found="left-handed and right-handed ones",
        )
    if film:
        frames = sorted(set.intersection(*(set(r.reader.frames) for r in renderers)))
        if not frames:
            where = renderers[0].reader.path
            advice = "choose others with `frames`"
            raise MissingDataError(
                where, expected="frames that all sources have", found="none", advice=advice
            )
        pictures = [[Cell(renderer, frame) for renderer in renderers] for frame in frames]
    else:
        pictures = [
            [Cell(renderer, frame) for renderer in renderers for frame in renderer.reader.frames]
        ]
    count = len(_parts_of(pictures[0]))
    if count > MOST_PANELS:
        raise ArgumentError(
            "frames",
            expected=f"at most {MOST_PANELS} panels",
            found=count,
            advice="choose fewer with `every`",
        )
    return pictures


def columns_of(cells: Sequence[Cell]) -> int | None:
    """Return the panels in a row: those of one source if there are several sources with several
    panels; otherwise None.
    """
    sources = len({id(cell.renderer) for cell in cells})
    each = len(_parts_of(cells)) // sources
    return each if sources > 1 and each > 1 else None


def caption_panels(cells: Sequence[Cell], texts: Sequence[str], film: bool) -> tuple[str, ...]:
    """Return the captions of all panels: a letter in brackets, and a text.

    Args:
        cells: the cells of the panels.
        texts: one for each panel; empty takes the differences between the panels: sequence, grid,
            frame, content and view.
        film: whether the frames are those of a film, which are not named.

    Raises:
        ArgumentError: another number of texts than of panels.
    """
    parts = _parts_of(cells)
    if texts and len(texts) != len(parts):
        raise ArgumentError(
            "captions", expected=f"one for each of the {len(parts)} panels", found=len(texts)
        )
    if not texts:
        rows = [row[:2] + row[3:] for row in parts] if film else parts
        differing = [
            column for column in range(len(rows[0])) if len({row[column] for row in rows}) > 1
        ]
        texts = [", ".join(row[column] for column in differing if row[column]) for row in rows]
    # a, b, ... z, aa, ab, ...
    letters = [
        *ascii_lowercase,
        *map("".join, product(ascii_lowercase, repeat=2)),
    ]
    return tuple(f"({letter}) {text}".strip() for letter, text in zip(letters, texts, strict=False))


def _parts_of(cells: Sequence[Cell]) -> list[tuple[str, ...]]:
    """Return sequence, grid, frame, content and view of each panel."""
    return [
        (
            reader.name,
            reader.data.grid,
            f"frame {cell.frame}",
            content if content == "grid" and reader.truth is None else cell.renderer.title(content),
            _VIEW_NAMES[view],
        )
        for cell in cells
        for reader in [cell.renderer.reader]
        for content in reader.contents
        for view in cell.renderer.camera.views
    ]
