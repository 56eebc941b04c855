"""One frame of a sequence as a picture: which scenes stand side by side, and drawing them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from carlasc.core.geometry import Transform, transform_points
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.viewing.rendering.cameras import Viewpoint
from carlasc.viewing.rendering.colors import ClassColors, Entry, merge_legends
from carlasc.viewing.rendering.inputs import Input
from carlasc.viewing.rendering.pictures import DEFAULT_SIZE, VIEWS, Panel, View, draw_panels
from carlasc.viewing.rendering.scenes import (
    Extent,
    Scene,
    check_same_spec,
    error_scene,
    flow_scene,
    grid_extent,
    grid_scene,
    scan_extent,
    scan_scene,
)

KINDS = ("grid", "scan", "flow", "truth", "errors")


@dataclass(frozen=True, eq=False)
class Shot:
    """What is pictured of every frame, and how.

    Attributes:
        data: the sequence.
        truth: the sequence that a prediction is compared with, or None.
        kinds: what is drawn, side by side: of `KINDS`.
        views: from where each is seen.
        grid: name of the grid, and
        truth_grid: of the truth's.
        colors: how classes are drawn.
        extent: what scans show, the same in all frames.
        size: (width, height) pixels.
        ego: draw the ego vehicle.
        legend: its entries, the same in all frames; empty for none.
        standpoint: extent and world_T_standpoint of a camera that stands still while the vehicle drives; or None.
        orbit: the camera goes round, at one distance from which it sees everything from every side.
    """

    data: Input
    truth: Input | None
    kinds: tuple[str, ...]
    views: tuple[View, ...]
    grid: str
    truth_grid: str
    colors: ClassColors
    extent: Extent
    size: tuple[int, int] = DEFAULT_SIZE
    ego: bool = True
    legend: list[Entry] = field(default_factory=list)
    standpoint: tuple[Extent, Transform] | None = None
    orbit: bool = False

    def draw(self, frame: int, viewpoint: Viewpoint) -> NDArray[np.uint8]:
        """Return the picture of a frame, (H, W, 3) uint8."""
        panels = []
        for kind in self.kinds:
            scene = self.scene(kind, frame)
            title = self._title(kind) if len(self.kinds) > 1 else ""
            panels += [Panel(scene, view, title, self._standpoint(scene, view, frame)) for view in self.views]
        return draw_panels(
            panels, viewpoint=viewpoint, size=self.size, legend=self.legend, left_handed=self.left_handed
        )

    @property
    def left_handed(self) -> bool:
        """Whether y is on the right."""
        return self.data.sequence.metadata.axes == "left"

    def scene(self, kind: str, frame: int) -> Scene:
        """Return what is drawn of a frame."""
        if kind in ("scan", "flow"):
            draw = flow_scene if kind == "flow" else scan_scene
            return draw(self.data.read_scan(frame), self.colors, extent=self.extent, ego=self.ego)
        if kind == "grid":
            return grid_scene(self.data.read_grid(self.grid, frame), self.colors, ego=self.ego)
        if self.truth is None:
            raise ArgumentError(f"what {kind}", expected="a truth to compare with", found="none", advice="give --truth")
        truth = self.truth.read_grid(self.truth_grid, frame)
        if kind == "truth":
            return grid_scene(truth, self.colors, ego=self.ego)
        return error_scene(self.data.read_grid(self.grid, frame), truth, ego=self.ego)

    def legend_of(self, frame: int) -> list[Entry]:
        """Return the legend that a frame asks for."""
        legends = []
        for kind in self.kinds:
            if kind in ("grid", "truth") and self.colors.palette != "height":  # without building the mesh
                data = self.truth if kind == "truth" and self.truth is not None else self.data
                labels = data.read_grid(self.truth_grid if kind == "truth" else self.grid, frame).labels
                self.colors.table.check(labels, f"{data.sequence.location}: frame {frame}")
                legends.append(self.colors.entries(np.flatnonzero(np.bincount(labels.reshape(-1))).tolist()))
            else:
                legends.append(self.scene(kind, frame).legend)
        return merge_legends(legends)

    def _standpoint(self, scene: Scene, view: View, frame: int) -> tuple[Extent, Transform] | None:
        """What the camera shows, and scene_T_standpoint, where it does not go by the scene alone."""
        turning = self.orbit and view == "perspective"
        if self.standpoint is None:
            return (_turned_all_round(scene.extent), np.eye(4)) if turning else None
        extent, world_T_standpoint = self.standpoint
        scene_T_standpoint = np.linalg.inv(self.data.sequence.read_pose(frame)) @ world_T_standpoint
        return (_turned_all_round(extent) if turning else extent), scene_T_standpoint

    def _title(self, kind: str) -> str:
        titles = {"scan": "scan", "flow": "scene flow", "truth": "truth", "errors": "errors"}
        own = "prediction" if self.truth is not None else str(self.data.sequence.grids.get(self.grid, ""))
        return titles.get(kind, own)


def choose_kinds(data: Input, truth: Input | None, wanted: str | None) -> tuple[str, ...]:
    """Return what is drawn: what is asked for, or what there is.

    Raises:
        ArgumentError: an unknown kind, or one that needs a truth.
        MissingDataError: there is neither a grid nor a scan.
    """
    if wanted is not None:
        kinds = tuple(wanted.split(","))
        for kind in kinds:
            if kind not in KINDS:
                raise ArgumentError(f"what {kind!r}: expected one or more of {', '.join(KINDS)} with commas between")
            if kind in ("truth", "errors") and truth is None:
                raise ArgumentError(
                    f"what {kind}", expected="a truth to compare with", found="none", advice="give --truth"
                )
        return kinds
    if data.scan:
        return ("scan",)
    if data.sequence.grids:
        return ("grid",) if truth is None else ("grid", "truth", "errors")
    if "points" in data.sequence.fields():
        return ("scan",)
    raise MissingDataError(
        data.sequence.location, expected="a grid or points", found="neither", advice="nothing to picture"
    )


def choose_views(view: str) -> tuple[View, ...]:
    """Return the views that a name stands for; "both" is two.

    Raises:
        ArgumentError: no such view.
    """
    if view == "both":
        return ("perspective", "bev")
    if view == "perspective":
        return ("perspective",)
    if view == "bev":
        return ("bev",)
    raise ArgumentError(f"view {view!r}: expected one of {', '.join(VIEWS)}, both")


def available_frames(
    data: Input, truth: Input | None, kinds: tuple[str, ...], grid: str, truth_grid: str
) -> np.ndarray:
    """Return the frames that have all that is drawn."""
    fields = {"scan": ("points",), "flow": ("points", "flow"), "truth": (), "errors": (f"{grid}/labels",)}
    own = {name for kind in kinds for name in fields.get(kind, (f"{grid}/labels",))}
    found = [data.sequence.frames(name) for name in sorted(own)]
    for name, frames in zip(sorted(own), found, strict=True):
        if not len(frames):
            raise MissingDataError(
                data.sequence.location,
                expected=f"{name}",
                found=f"{', '.join(sorted(data.sequence.fields())) or 'nothing'}",
            )
    if truth is not None and {"truth", "errors"} & set(kinds):
        found.append(truth.sequence.frames(f"{truth_grid}/labels"))
    frames = found[0]
    for others in found[1:]:
        frames = np.intersect1d(frames, others)
    return frames


def extent_for(data: Input, kinds: tuple[str, ...], grid: str, frame: int) -> Extent:
    """Return what scans show in all pictures: the grid beside them, or most of the first one."""
    if {"grid", "truth", "errors"} & set(kinds):
        return grid_extent(data.sequence.grids[grid])
    return scan_extent(data.read_scan(frame))


def still_standpoint(data: Input, frames: list[int], extent: Extent) -> tuple[Extent, Transform]:
    """Return what a camera that stands still shows of a drive, in the frame of its middle, and where that is."""
    world_T_middle = data.sequence.read_pose(frames[len(frames) // 2])
    middle_T_world = np.linalg.inv(world_T_middle)
    seen = [transform_points(middle_T_world @ data.sequence.read_pose(frame), extent) for frame in frames]
    points = np.concatenate(seen)
    box = np.array([points.min(0), points.max(0)])
    corners = np.array([(box[i, 0], box[j, 1], box[k, 2]) for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    return corners, world_T_middle


def check_cells(shot: Shot, frame: int) -> None:
    """Raise ArgumentError where a prediction's cells are not the truth's."""
    if shot.truth is not None and "errors" in shot.kinds:
        check_same_spec(shot.data.read_grid(shot.grid, frame), shot.truth.read_grid(shot.truth_grid, frame))


def _turned_all_round(extent: Extent) -> Extent:
    """Return the rims of the upright cylinder around an extent: it looks the same from every side."""
    lower, upper = extent.min(0), extent.max(0)
    middle = (lower + upper) / 2
    radius = np.linalg.norm((extent - middle)[:, :2], axis=1).max()
    angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    rim = middle[:2] + radius * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.concatenate([np.column_stack([rim, np.full(len(rim), z)]) for z in (lower[2], upper[2])])
