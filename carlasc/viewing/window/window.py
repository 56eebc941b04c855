"""A window on the desktop: frames of a sequence, drawn by Open3D, steered by keys."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import Color
from carlasc.core.scans import Scan
from carlasc.errors import DependencyError
from carlasc.storage import Sequence, Source
from carlasc.storage.layout import FRAME_PERIOD_S
from carlasc.viewing.clip import Clip, FrameContent, open_clip
from carlasc.viewing.rendering import colors as palette
from carlasc.viewing.rendering.colors import PaletteName
from carlasc.viewing.rendering.meshes import QuadMesh, arrows, grid_mesh
from carlasc.viewing.rendering.scenes import ego_vehicle, grid_extent, motion_arrows, scan_extent
from carlasc.viewing.window.libraries import import_open3d

LAYERS = {"g": "grid", "p": "points", "f": "flow", "v": "vehicle"}
KEYS = {
    "right, left": "step",
    "space": "play, stop",
    "g p f v": "grid, points, flow, vehicle",
    "t": "next of prediction, truth, errors",
    "1 .. 9 0": "show or hide a class; with Shift the eleventh and on, with Ctrl the twenty-first and on",
    "a": "all classes",
    "r": "camera as at first",
    "q, Esc": "leave",
}
_RIGHT, _LEFT, _SPACE = 262, 263, 32  # GLFW's numbers
_PRESSED, _SHIFT, _CONTROL = 1, 1, 2
_SUN = np.array([-0.38, -0.5, 0.78]) / np.linalg.norm([0.38, 0.5, 0.78])
_BACKGROUND = (0.96, 0.965, 0.972)
_EDGE = 0.8  # how dark a voxel's edges are


@dataclass
class Look:
    """What is shown of a clip.

    Attributes:
        position: which of the clip's frames.
        panel: which of the clip's panels.
        layers: of `LAYERS`, those that are shown.
        hidden: ids of classes that are not.
        playing: whether frames follow each other.
    """

    position: int = 0
    panel: int = 0
    layers: set[str] = field(default_factory=lambda: set(LAYERS.values()))
    hidden: set[int] = field(default_factory=set)
    playing: bool = False


class Window:
    """An open window on a clip. Keys change its `look`; `tick` draws."""

    def __init__(
        self, clip: Clip, *, size: tuple[int, int] = (1280, 800), report: Callable[[str], None] | None = None
    ) -> None:
        """Open the window.

        Raises:
            DependencyError: Open3D or a library that it needs is missing, or there is no screen.
        """
        self.clip, self.look, self.report = clip, Look(), report or (lambda _: None)
        if clip.panels:
            self.look.layers.discard("points")
        self.o3d = import_open3d()
        self._mirror = np.array([1.0, -1.0, 1.0]) if clip.left_handed else np.ones(3)  # Open3D is right-handed
        self._content = self._read()
        self._shown: dict[str, Any] = {}
        self._due = time.monotonic()
        self._visualizer = self.o3d.visualization.VisualizerWithKeyCallback()
        self._open(size)
        self._frame_camera()
        self._bind_keys()
        self._draw()

    def tick(self) -> bool:
        """Draw, and take the next frame where it is due; returns False once the window is closed."""
        if self.look.playing and time.monotonic() >= self._due:
            self._due = time.monotonic() + FRAME_PERIOD_S
            self.step(1)
        alive = bool(self._visualizer.poll_events())
        self._visualizer.update_renderer()
        return alive

    def step(self, by: int) -> None:
        """Go to another frame, round and round."""
        self.look.position = (self.look.position + by) % len(self.clip.frames)
        self._content = self._read()
        self._draw()
        if not self.look.playing:
            self.report(f"frame {self.clip.frames[self.look.position]}")

    def toggle_play(self) -> None:
        """Play, or stop."""
        self.look.playing = not self.look.playing and len(self.clip.frames) > 1

    def toggle_layer(self, layer: str) -> None:
        """Show or hide a layer."""
        self.look.layers ^= {layer}
        self._draw()

    def toggle_class(self, number: int) -> None:
        """Show or hide the `number`-th class (from 0) of those that `classes` lists."""
        listed = self.classes
        if number < len(listed):
            label, name, _ = listed[number]
            self.look.hidden ^= {label}
            self.report(f"{name}: {'hidden' if label in self.look.hidden else 'shown'}")
            self._draw()

    def show_all(self) -> None:
        """Show all classes."""
        self.look.hidden.clear()
        self._draw()

    def next_panel(self) -> None:
        """Show the next of prediction, truth and errors."""
        if len(self.clip.panels) > 1:
            self.look.panel = (self.look.panel + 1) % len(self.clip.panels)
            self.look.hidden.clear()
            self.report(self.clip.panels[self.look.panel].title)
            self._draw()

    @property
    def classes(self) -> list[tuple[int, str, Color]]:
        """Id, name and colour of the classes in the table that is shown, free left out."""
        colors = self.clip.panels[self.look.panel].colors if self.clip.panels else self.clip.colors
        return [(entry.order, entry.name, entry.color) for entry in colors.entries(colors.table.names)]

    def picture(self) -> NDArray[np.uint8]:
        """Return what is seen, (H, W, 3) uint8."""
        self.tick()
        image = np.asarray(self._visualizer.capture_screen_float_buffer(do_render=True))
        return np.round(image * 255).astype(np.uint8)

    def close(self) -> None:
        """Close the window."""
        self._visualizer.destroy_window()

    def _read(self) -> FrameContent:
        return self.clip.read(self.clip.frames[self.look.position])

    def _open(self, size: tuple[int, int]) -> None:
        no_screen = sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
        if no_screen or not self._visualizer.create_window(f"carlasc: {self.clip.name}", *size):
            found = "no DISPLAY" if no_screen else "one that Open3D cannot draw on"
            raise DependencyError(
                "window",
                expected="a screen",
                found=f"{found}",
                advice="work on a desktop, use `xvfb-run`, or open a page instead with --html",
            )

    def _frame_camera(self) -> None:
        """Look from behind and above; the extent, which is never drawn over, fixes the scale for all frames."""
        options = self._visualizer.get_render_option()
        options.background_color = np.array(_BACKGROUND)
        options.light_on = False  # the light is in the colours
        options.point_size = 2.5
        options.mesh_show_back_face = True
        panels, scan = self.clip.panels, self._content.scan
        corners = grid_extent(panels[0].spec) if panels else scan_extent(scan or Scan(np.empty((0, 3), np.float32)))
        lower, upper = corners.min(0), corners.max(0)
        rim = np.array([(x, y, lower[2]) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], np.float64)
        rim[:, :2] = lower[:2] + rim[:, :2] * (upper - lower)[:2]
        lines = self.o3d.geometry.LineSet(
            self.o3d.utility.Vector3dVector(rim * self._mirror),
            self.o3d.utility.Vector2iVector(np.array([(0, 1), (1, 2), (2, 3), (3, 0)])),
        )
        lines.paint_uniform_color((0.55, 0.58, 0.63))
        self._visualizer.add_geometry(lines)
        self._reset_camera()

    def _reset_camera(self) -> None:
        control = self._visualizer.get_view_control()
        control.set_lookat([-3.0, 0.0, -1.0])
        control.set_front([-0.79, 0.0, 0.61])
        control.set_up([0.0, 0.0, 1.0])
        control.set_zoom(0.52)

    def _bind_keys(self) -> None:
        simple: dict[int, Callable[[], None]] = {
            _RIGHT: partial(self.step, 1),
            _LEFT: partial(self.step, -1),
            _SPACE: self.toggle_play,
            ord("T"): self.next_panel,
            ord("A"): self.show_all,
            ord("R"): self._reset_camera,
        }
        simple |= {ord(key.upper()): partial(self.toggle_layer, layer) for key, layer in LAYERS.items()}
        for key, action in simple.items():
            self._visualizer.register_key_callback(key, partial(_call, action))
        for digit in range(10):
            self._visualizer.register_key_action_callback(ord(str(digit)), partial(self._on_digit, (digit - 1) % 10))

    def _on_digit(self, place: int, _: Any, action: int, modifiers: int) -> bool:
        if action == _PRESSED:
            tens = 2 if modifiers & _CONTROL else 1 if modifiers & _SHIFT else 0
            self.toggle_class(10 * tens + place)
        return True

    def _draw(self) -> None:
        """Bring what is in the window to the look."""
        layers, content = self.look.layers, self._content
        self._replace("edges", None)
        self._replace("grid", self._grid() if content.grids and "grid" in layers else None)
        self._replace("points", self._points() if content.scan is not None and "points" in layers else None)
        self._replace("flow", self._flow() if content.scan is not None and "flow" in layers else None)
        self._replace("vehicle", self._mesh(ego_vehicle()) if "vehicle" in layers else None)

    def _replace(self, name: str, geometry: Any) -> None:
        if (old := self._shown.pop(name, None)) is not None:
            self._visualizer.remove_geometry(old, reset_bounding_box=False)
        if geometry is not None:
            self._visualizer.add_geometry(geometry, reset_bounding_box=False)
            self._shown[name] = geometry

    def _grid(self) -> Any:
        grid, colors = self._content.grids[self.look.panel], self.clip.panels[self.look.panel].colors.by_id
        drawn = (grid.labels > 0) & ~np.isin(grid.labels, list(self.look.hidden))
        if not drawn.any():
            return None
        mesh = grid_mesh(grid.spec, colors[grid.labels], drawn)
        self._replace("edges", self._edges(mesh))
        return self._mesh(mesh)

    def _edges(self, mesh: QuadMesh) -> Any:
        """Return the edges between voxels as lines, darker than their faces and a hair above them."""
        face, side = np.nonzero(mesh.edges)
        corners = mesh.corners + 4e-3 * mesh.normals[:, None]
        ends = np.stack([corners[face, side], corners[face, (side + 1) % 4]], axis=1)
        lines = self.o3d.geometry.LineSet(
            self._vectors(ends.reshape(-1, 3)),
            self.o3d.utility.Vector2iVector(np.arange(2 * len(face), dtype=np.int32).reshape(-1, 2)),
        )
        lines.colors = self.o3d.utility.Vector3dVector(
            mesh.colors[face] * (_EDGE / 255.0) * self._light(mesh)[face, None]
        )
        return lines

    def _points(self) -> Any:
        scan, colors = self._content.scan, self.clip.colors.by_id.copy()
        colors[0] = palette.UNLABELLED
        if scan is None:
            return None
        labels = np.zeros(len(scan), np.uint8) if scan.labels is None else scan.labels
        # ids of the errors' panel are no classes of points
        hidden = self.look.hidden if not self.clip.panels or self.look.panel < 2 else set[int]()
        shown = ~np.isin(labels, list(hidden))
        cloud = self.o3d.geometry.PointCloud(self._vectors(scan.points[shown]))
        cloud.colors = self.o3d.utility.Vector3dVector(colors[labels[shown]] / 255.0)
        return cloud if shown.any() else None

    def _flow(self) -> Any:
        scan = self._content.scan
        if scan is None or scan.flow is None:
            return None
        tails, vectors = motion_arrows(scan.select(np.linalg.norm(scan.flow, axis=1) > 0))
        if self.clip.panels and "points" not in self.look.layers:  # elsewhere they would stand above nothing
            spec = self.clip.panels[0].spec
            _, inside = spec.index(spec.to_axes(tails * [1, 1, 0] + [0, 0, (spec.lower[2] + spec.upper[2]) / 2]))
            tails, vectors = tails[inside], vectors[inside]
        return self._mesh(arrows(tails, vectors, palette.ARROW, 0.24)) if len(tails) else None

    def _mesh(self, mesh: QuadMesh) -> Any:
        """Return Open3D's mesh of quads, with sun and sky in the colours of the corners."""
        corners, triangles = mesh.triangles()
        light = self._light(mesh)[:, None] * mesh.openness
        colors = np.clip(mesh.colors[:, None, :] / 255.0 * light[..., None], 0, 1)
        shown = self.o3d.geometry.TriangleMesh(
            self._vectors(corners), self.o3d.utility.Vector3iVector(triangles.astype(np.int32))
        )
        shown.vertex_colors = self.o3d.utility.Vector3dVector(colors.reshape(-1, 3))
        return shown

    def _light(self, mesh: QuadMesh) -> NDArray[np.floating]:
        """Return how much of the sun each face sees; an open, level one has exactly its colour."""
        lit = np.clip(mesh.normals @ _SUN, 0, None) / _SUN[2]
        return 0.58 + 0.42 * np.minimum(lit, 1.25)

    def _vectors(self, points: NDArray[np.floating]) -> Any:
        return self.o3d.utility.Vector3dVector(np.asarray(points, np.float64) * self._mirror)


def show(
    path: str | os.PathLike[str] | Source | Sequence,
    *,
    sequence: str | None = None,
    frames: tuple[int | None, int | None] | None = None,
    every: int = 1,
    grid: str | None = None,
    truth: str | os.PathLike[str] | Source | Sequence | None = None,
    truth_grid: str | None = None,
    classes: str | None = None,
    path_classes: str | None = None,
    palette: PaletteName = "class",
    report: Callable[[str], None] | None = None,
) -> Clip:
    """Open a window on a sequence, until it is closed.

    Args:
        path: anything `carlasc.open` takes, a grid's folder, a frame's file in it, a Source or a Sequence.
        sequence: path or name of the sequence where there are several; None takes the first.
        frames: half-open range of frames; None takes all.
        every: take each `every`-th of them.
        grid: name of the grid; None takes `evaluation`, or the first.
        truth: what a prediction is compared with: anything that `path` may be.
        truth_grid: name of the truth's grid; None as for `grid`.
        classes: name of the class table to show; None shows the data's own.
        path_classes: class table of the labels at `path` where nothing beside them says.
        palette: "class" or "colorblind".
        report: called with a line for what a key did, keys and classes first.

    Returns:
        What was shown.

    Raises:
        DependencyError: Open3D or a library that it needs is missing, or there is no screen.
        ArgumentError: arguments that make no sense.
        MissingDataError: a sequence, grid or frame that is not there.
        FormatError: what is there is not what the format says.
    """
    clip = open_clip(
        path, sequence=sequence, frames=frames, every=every, grid=grid, truth=truth, truth_grid=truth_grid,
        classes=classes, path_classes=path_classes, palette=palette,
    )  # fmt: skip
    window = Window(clip, report=report)
    for line in help_lines(window):
        window.report(line)
    try:
        while window.tick():
            time.sleep(0.005)
    finally:
        window.close()
    return clip


def help_lines(window: Window) -> list[str]:
    """Return what the keys do, and which class each digit stands for."""
    marks = ("", "Shift+", "Ctrl+")
    digits = [
        f"{marks[number // 10]}{(number + 1) % 10} {name}" for number, (_, name, _) in enumerate(window.classes[:30])
    ]
    return [*window.clip.notes, *(f"{keys:<12} {what}" for keys, what in KEYS.items()), ", ".join(digits)]


def _call(action: Callable[[], None], _: Any) -> bool:
    action()
    return True
