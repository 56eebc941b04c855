"""A window on the desktop that shows a scene with Open3D and is controlled by keys."""

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

from carlasc.core.geometry import invert, transform_points
from carlasc.core.scans import Scan
from carlasc.errors import DependencyError
from carlasc.storage.layout import FRAME_PERIOD_S
from carlasc.viewing import colors as palette
from carlasc.viewing.colors import Entry
from carlasc.viewing.open3d_shapes import PAGE_ADVICE, Shapes, import_open3d
from carlasc.viewing.rendering.actor_boxes import box_lines
from carlasc.viewing.rendering.drawings import ego_vehicle, grid_extent, motion_arrows, scan_extent
from carlasc.viewing.rendering.meshes import arrows, grid_mesh
from carlasc.viewing.scene import FrameContent, GridPanel, Scene, SceneReader
from carlasc.viewing.trails import Trail, Trails

LAYERS = {"g": "grid", "p": "points", "f": "flow", "b": "boxes", "k": "tracks", "v": "vehicle"}
KEYS = {
    "right, left": "next or previous frame",
    "space": "play or stop",
    "g p f b k v": "show or hide the grid, points, flow, boxes, tracks, vehicle",
    "t": "switch between the grid, prediction, truth and errors, and its actors",
    "1 .. 9 0": "show or hide one of classes 1 to 10; with Shift 11 to 20, with Ctrl 21 to 30",
    "a": "show all classes",
    "r": "reset the camera",
    "q, Esc": "close the window",
}
_RIGHT, _LEFT, _SPACE = 262, 263, 32  # key codes of GLFW
_PRESSED, _SHIFT, _CONTROL = 1, 1, 2
_BACKGROUND = (0.96, 0.965, 0.972)
_RIM = (140, 148, 161)


@dataclass
class WindowState:
    """The state of a window.

    Attributes:
        position: index of the frame in the scene's frames.
        panel: index of the panel in the scene's panels.
        layers: names from `LAYERS` that are visible.
        hidden: ids of classes that are hidden.
        playing: whether the frames are played.
    """

    position: int = 0
    panel: int = 0
    layers: set[str] = field(default_factory=lambda: set(LAYERS.values()))
    hidden: set[int] = field(default_factory=set)
    playing: bool = False


class Window:
    """A window that shows a scene. Keys change its `state`; `tick` draws it.

    Attributes:
        reader: reads the scene.
        state: what is shown.
        report: called with a line of text after a key was pressed.
    """

    def __init__(
        self,
        reader: SceneReader,
        *,
        size: tuple[int, int] = (1280, 800),
        report: Callable[[str], None] | None = None,
    ) -> None:
        """Open the window.

        Args:
            reader: reads the scene.
            size: (width, height) of the window, pixels.
            report: called with a line of text after a key was pressed.

        Raises:
            DependencyError: Open3D or a library that it needs is missing, or there is no screen.
        """
        self.reader = reader = reader.right_handed().with_actors()  # right-handed, as Open3D is
        self.state, self.report = WindowState(), report or (lambda _: None)
        if reader.panels:
            self.state.layers.discard("points")
        self.o3d = import_open3d()
        self._shapes, self._trails = Shapes(self.o3d), Trails()
        self._read()
        self._shown: dict[str, Any] = {}
        self._due = time.monotonic()
        self._visualizer = self.o3d.visualization.VisualizerWithKeyCallback()
        self._open(size)
        self._frame_camera()
        self._bind_keys()
        self._draw()

    def tick(self) -> bool:
        """Draw, and go to the next frame when it is due while playing; return False after the
        window was closed.
        """
        if self.state.playing and time.monotonic() >= self._due:
            self._due = time.monotonic() + FRAME_PERIOD_S
            self.step(1)
        alive = bool(self._visualizer.poll_events())
        self._visualizer.update_renderer()
        return alive

    def step(self, by: int) -> None:
        """Go forward by a number of frames; the first frame follows the last."""
        self.state.position = (self.state.position + by) % len(self.reader.frames)
        self._read()
        self._draw()
        if not self.state.playing:
            self.report(f"frame {self.reader.frames[self.state.position]}")

    def toggle_play(self) -> None:
        """Play the frames, or stop."""
        self.state.playing = not self.state.playing and len(self.reader.frames) > 1

    def toggle_layer(self, layer: str) -> None:
        """Show or hide a layer."""
        self.state.layers ^= {layer}
        self._draw()

    def toggle_class(self, number: int) -> None:
        """Show or hide the class at an index of `classes`."""
        listed = self.classes
        if number < len(listed):
            entry = listed[number]
            self.state.hidden ^= {entry.order}
            self.report(
                f"{entry.name}: {'hidden' if entry.order in self.state.hidden else 'shown'}"
            )
            self._draw()

    def show_all(self) -> None:
        """Show all classes."""
        self.state.hidden.clear()
        self._draw()

    def next_panel(self) -> None:
        """Switch to the next panel of the scene: prediction, truth and errors, or the grid, and its
        voxels by actor.
        """
        if len(self.reader.panels) > 1:
            self.state.panel = (self.state.panel + 1) % len(self.reader.panels)
            self.state.hidden.clear()
            self.report(self.reader.panels[self.state.panel].title)
            self._draw()

    @property
    def classes(self) -> list[Entry]:
        """The classes that can be hidden: all classes of the panel's table except free.

        `order` is the class id.
        """
        colors = self.reader.colors if self._panel is None else self._panel.colors
        return colors.entries(colors.table.names)

    def picture(self) -> NDArray[np.uint8]:
        """Return a screenshot, (H, W, 3) uint8."""
        self.tick()
        image = np.asarray(self._visualizer.capture_screen_float_buffer(do_render=True))
        return np.round(image * 255).astype(np.uint8)

    def close(self) -> None:
        """Close the window."""
        self._visualizer.destroy_window()

    @property
    def _panel(self) -> GridPanel | None:
        return self.reader.panels[self.state.panel] if self.reader.panels else None

    def _read(self) -> None:
        position, frame = self.state.position, self.reader.frames[self.state.position]
        self._content: FrameContent = self.reader.read(frame)
        self._moving = self.reader.read_motion(frame, self._content.scan)
        self._ways: tuple[Trail, ...] = self._trails.follow(position, self._content, self._moving)

    def _open(self, size: tuple[int, int]) -> None:
        no_screen = sys.platform == "linux" and not (
            os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        )
        if no_screen or not self._visualizer.create_window(f"carlasc: {self.reader.name}", *size):
            raise DependencyError(
                "window",
                expected="a screen",
                found="no DISPLAY" if no_screen else "a screen that Open3D cannot draw on",
                advice=f"use a desktop or `xvfb-run`, {PAGE_ADVICE}",
            )

    def _frame_camera(self) -> None:
        """Draw the rim of the extent, so that all frames have one scale, and look from behind and
        above.
        """
        options = self._visualizer.get_render_option()
        options.background_color = np.array(_BACKGROUND)
        options.light_on = False  # the colours include the light
        options.point_size = 2.5
        options.mesh_show_back_face = True
        panels, scan = self.reader.panels, self._content.scan
        corners = (
            grid_extent(panels[0].spec)
            if panels
            else scan_extent(scan or Scan(np.empty((0, 3), np.float32)))
        )
        lower, upper = corners.min(0), corners.max(0)
        rim = np.array([(x, y, lower[2]) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], np.float64)
        rim[:, :2] = lower[:2] + rim[:, :2] * (upper - lower)[:2]
        ends = np.stack([rim, np.roll(rim, -1, axis=0)], axis=1)
        self._visualizer.add_geometry(self._shapes.lines(ends, np.array(_RIM)))
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
        simple |= {
            ord(key.upper()): partial(self.toggle_layer, layer) for key, layer in LAYERS.items()
        }
        for key, action in simple.items():
            self._visualizer.register_key_callback(key, partial(_call, action))
        for digit in range(10):
            self._visualizer.register_key_action_callback(
                ord(str(digit)), partial(self._on_digit, (digit - 1) % 10)
            )

    def _on_digit(self, place: int, _: Any, action: int, modifiers: int) -> bool:
        if action == _PRESSED:
            tens = 2 if modifiers & _CONTROL else 1 if modifiers & _SHIFT else 0
            self.toggle_class(10 * tens + place)
        return True

    def _draw(self) -> None:
        """Draw the current state."""
        draw: dict[str, Callable[[], Any]] = {
            "grid": self._grid,
            "points": self._points,
            "flow": self._flow,
            "boxes": self._boxes,
            "tracks": self._tracks,
            "vehicle": lambda: self._shapes.mesh(ego_vehicle()),
        }
        self._replace("edges", None)
        for layer, function in draw.items():
            self._replace(layer, function() if layer in self.state.layers else None)

    def _replace(self, name: str, geometry: Any) -> None:
        if (old := self._shown.pop(name, None)) is not None:
            self._visualizer.remove_geometry(old, reset_bounding_box=False)
        if geometry is not None:
            self._visualizer.add_geometry(geometry, reset_bounding_box=False)
            self._shown[name] = geometry

    def _grid(self) -> Any:
        if self._panel is None:
            return None
        grid = self._content.grids[self.state.panel]
        drawn = (grid.labels > 0) & ~np.isin(grid.labels, list(self.state.hidden))
        if not drawn.any():
            return None
        mesh = grid_mesh(grid.spec, self._panel.colors.by_id[grid.labels], drawn)
        self._replace("edges", self._shapes.edges(mesh))
        return self._shapes.mesh(mesh)

    def _points(self) -> Any:
        """Return the points in the colours of their classes, or of their actors if the panel shows
        actors.
        """
        scan = self._content.scan
        if scan is None:
            return None
        panel, colors, ids = self._panel, self.reader.colors, scan.labels
        if panel is not None and panel.name == "actors" and scan.instances is not None:
            colors, ids = panel.colors, palette.actor_ids(scan.instances)
        ids = np.zeros(len(scan), np.uint8) if ids is None else ids
        # ids of the panel
        hidden = self.state.hidden if panel is None or panel.colors is colors else set[int]()
        shown, by_id = ~np.isin(ids, list(hidden)), colors.by_id.copy()
        by_id[0] = palette.UNLABELLED
        return self._shapes.points(scan.points[shown], by_id[ids[shown]]) if shown.any() else None

    def _flow(self) -> Any:
        if self._moving is None:
            return None
        tails, vectors = motion_arrows(self._moving)
        inside = self._within(tails)
        return (
            self._shapes.mesh(arrows(tails[inside], vectors[inside], palette.ARROW, 0.24))
            if inside.any()
            else None
        )

    def _within(self, places: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which of (N, 3) positions are in the drawn scene: above or below the grid if
        points are not shown.
        """
        if self._panel is None or "points" in self.state.layers:
            return np.ones(len(places), np.bool_)
        spec = self._panel.spec
        middle = (spec.lower[2] + spec.upper[2]) / 2
        return spec.index(spec.to_axes(places * [1, 1, 0] + [0, 0, middle]))[1]

    def _boxes(self) -> Any:
        """Return the edges of the boxes, and a bar to the front of each, in the colours of their
        classes.
        """
        boxes = self._content.boxes
        if boxes is None or not len(boxes):
            return None
        ends = box_lines(boxes)
        return self._shapes.lines(
            ends, np.repeat(self.reader.colors.by_id[boxes.labels], len(ends) // len(boxes), 0)
        )

    def _tracks(self) -> Any:
        """Return the tracks of the actors, in the colours of their classes."""
        if not self._ways or self._content.pose is None:
            return None
        ends = np.concatenate(
            [np.stack([way.points[:-1], way.points[1:]], axis=1) for way in self._ways]
        )
        labels = np.repeat(
            [way.label for way in self._ways], [len(way.points) - 1 for way in self._ways]
        )
        ends = transform_points(invert(self._content.pose), ends.reshape(-1, 3)).reshape(-1, 2, 3)
        inside = self._within(ends[:, 1])
        return (
            self._shapes.lines(ends[inside], self.reader.colors.by_id[labels[inside]])
            if inside.any()
            else None
        )


def show_window(scene: Scene, *, report: Callable[[str], None] | None = None) -> None:
    """Show a scene in a window until it is closed; see `carlasc.viewing.view` for the arguments and
    errors.
    """
    window = Window(scene.open(), report=report)
    for line in help_lines(window):
        window.report(line)
    try:
        while window.tick():
            time.sleep(0.005)
    finally:
        window.close()


def help_lines(window: Window) -> list[str]:
    """Return what the keys do, and the class of each digit key."""
    marks = ("", "Shift+", "Ctrl+")
    digits = [
        f"{marks[number // 10]}{(number + 1) % 10} {entry.name}"
        for number, entry in enumerate(window.classes[:30])
    ]
    return [
        *window.reader.notes,
        *(f"{keys:<12} {what}" for keys, what in KEYS.items()),
        ", ".join(digits),
    ]


def _call(action: Callable[[], None], _: Any) -> bool:
    action()
    return True
