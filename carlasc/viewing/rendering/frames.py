"""One frame of a scene as a picture: which drawings are side by side, and from where each is seen."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import Transform, transform_points
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.storage import layout
from carlasc.viewing.colors import Entry, merge_legends
from carlasc.viewing.remapping import RemappedSequence
from carlasc.viewing.rendering.cameras import Viewpoint
from carlasc.viewing.rendering.drawings import (
    Drawing,
    Extent,
    error_drawing,
    flow_drawing,
    grid_drawing,
    grid_extent,
    scan_drawing,
    scan_extent,
)
from carlasc.viewing.rendering.pictures import DEFAULT_SIZE, VIEWS, Panel, View, draw_panels
from carlasc.viewing.scene import SceneReader


@dataclass(frozen=True, eq=False)
class FrameRenderer:
    """Draws the frames of a scene.

    Attributes:
        reader: reads the scene; its `contents` are drawn side by side.
        views: from where each of the contents is seen.
        extent: what pictures of scans show, the same in all frames.
        size: (width, height) of a picture, pixels.
        ego: whether the ego vehicle is drawn.
        legend: entries of the legend, the same in all frames; empty for no legend.
        fixed_view: for a camera that does not follow the vehicle: extent of what it shows, and `world_T_view`, the frame of that
            extent; or None.
        orbit: whether the camera circles the scene, at one distance that shows it from every side.
    """

    reader: SceneReader
    views: tuple[View, ...]
    extent: Extent
    size: tuple[int, int] = DEFAULT_SIZE
    ego: bool = True
    legend: list[Entry] = field(default_factory=list)
    fixed_view: tuple[Extent, Transform] | None = None
    orbit: bool = False

    def render(self, frame: int, viewpoint: Viewpoint) -> NDArray[np.uint8]:
        """Return the picture of a frame, (H, W, 3) uint8."""
        contents, panels = self.reader.contents, []
        for content in contents:
            drawing = self.draw(content, frame)
            title = self._title(content) if len(contents) > 1 else ""
            panels += [Panel(drawing, view, title, self._view_of(drawing, view, frame)) for view in self.views]
        return draw_panels(
            panels,
            viewpoint=viewpoint,
            size=self.size,
            legend=self.legend,
            axes=self.reader.axes,
        )

    def draw(self, content: str, frame: int) -> Drawing:
        """Return the drawing of one of the scene's contents in a frame."""
        reader, colors = self.reader, self.reader.colors
        if content == "scan":
            return scan_drawing(reader.data.read_scan(frame), colors, extent=self.extent, ego=self.ego)
        if content == "flow":
            return flow_drawing(reader.data.read_scan(frame), colors, extent=self.extent, ego=self.ego)
        if content == "errors":
            return error_drawing(reader.data.read_grid(frame), self._grid_of("truth").read_grid(frame), ego=self.ego)
        return grid_drawing(self._grid_of(content).read_grid(frame), colors, ego=self.ego)

    def legend_of(self, frame: int) -> list[Entry]:
        """Return the entries that the legend of a frame needs."""
        colors, legends = self.reader.colors, []
        for content in self.reader.contents:
            if content in ("grid", "truth") and colors.palette != "height":  # without building the mesh
                labels = self._grid_of(content).read_grid(frame).labels
                legends.append(colors.entries(np.flatnonzero(np.bincount(labels.reshape(-1))).tolist()))
            else:
                legends.append(self.draw(content, frame).legend)
        return merge_legends(legends)

    def _grid_of(self, content: str) -> RemappedSequence:
        truth = self.reader.truth
        return self.reader.data if content == "grid" or truth is None else truth

    def _view_of(self, drawing: Drawing, view: View, frame: int) -> tuple[Extent, Transform] | None:
        """Return what the camera shows and `drawing_T_view`, or None if the camera is fitted to the drawing."""
        orbits = self.orbit and view == "perspective"
        if self.fixed_view is None:
            return (_swept_extent(drawing.extent), np.eye(4)) if orbits else None
        extent, world_T_view = self.fixed_view
        drawing_T_view = np.linalg.inv(_pose_of(self.reader, frame)) @ world_T_view
        return (_swept_extent(extent) if orbits else extent), drawing_T_view

    def _title(self, content: str) -> str:
        titles = {"scan": "scan", "flow": "scene flow", "truth": "truth", "errors": "errors"}
        data, truth = self.reader.data, self.reader.truth
        return titles.get(content) or (str(data.spec) if truth is None else "prediction")


def views_named(name: str) -> tuple[View, ...]:
    """Return the views that a name means: one, or two for "both".

    Raises:
        ArgumentError: an unknown name.
    """
    views: dict[str, tuple[View, ...]] = {
        "perspective": ("perspective",),
        "bev": ("bev",),
        "both": ("perspective", "bev"),
    }
    if name not in views:
        raise ArgumentError("view", expected=f"{', '.join(VIEWS)} or both", found=repr(name))
    return views[name]


def scan_extent_in(reader: SceneReader) -> Extent:
    """Return what pictures of scans show in all frames: the grid beside them, or most of the first scan."""
    if {"grid", "errors"} & set(reader.contents):
        return grid_extent(reader.data.spec)
    if "truth" in reader.contents and reader.truth is not None:
        return grid_extent(reader.truth.spec)
    return scan_extent(reader.data.read_scan(reader.frames[0]))


def view_of_drive(reader: SceneReader, extent: Extent) -> tuple[Extent, Transform]:
    """Return what a camera that does not follow the vehicle shows: a box around the extents of all frames.

    Returns:
        (8, 3) corners of the box in the frame of the middle pose, and `world_T_middle`.

    Raises:
        MissingDataError: the sequence has no poses.
        FormatError: one of them is none.
    """
    world_T_middle = _pose_of(reader, reader.frames[len(reader.frames) // 2])
    middle_T_world = np.linalg.inv(world_T_middle)
    seen = [transform_points(middle_T_world @ _pose_of(reader, frame), extent) for frame in reader.frames]
    points = np.concatenate(seen)
    box = np.array([points.min(0), points.max(0)])
    corners = np.array([(box[i, 0], box[j, 1], box[k, 2]) for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    return corners, world_T_middle


def _pose_of(reader: SceneReader, frame: int) -> Transform:
    pose = reader.read_pose(frame)
    if pose is None:
        raise MissingDataError(
            reader.path, expected=layout.POSES, found="none", advice="let the camera follow the vehicle"
        )
    return pose


def _swept_extent(extent: Extent) -> Extent:
    """Return the rims of the upright cylinder around an extent, which looks the same from every side."""
    lower, upper = extent.min(0), extent.max(0)
    middle = (lower + upper) / 2
    radius = np.linalg.norm((extent - middle)[:, :2], axis=1).max()
    angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    rim = middle[:2] + radius * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.concatenate([np.column_stack([rim, np.full(len(rim), z)]) for z in (lower[2], upper[2])])
