"""A window on the desktop that shows a scene with Open3D and is controlled by keys."""

from __future__ import annotations

import importlib
import os
import re
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.core.scans import Scan
from carlasc.errors import DependencyError, import_extra
from carlasc.storage.layout import FRAME_PERIOD_S
from carlasc.viewing import colors as palette
from carlasc.viewing.colors import Entry
from carlasc.viewing.rendering.drawings import ego_vehicle, grid_extent, motion_arrows, scan_extent
from carlasc.viewing.rendering.meshes import QuadMesh, arrows, grid_mesh
from carlasc.viewing.scene import FrameContent, Scene, SceneReader

PAGE_ADVICE = 'or write a page instead with `out="page.html"`'

_DEBIAN = {  # shared library -> its package in Debian and Ubuntu
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libGLX.so.0": "libglx0",
    "libX11.so.6": "libx11-6",
    "libudev.so.1": "libudev1",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libidn2.so.0": "libidn2-0",
    "libgomp.so.1": "libgomp1",
    "libstdc++.so.6": "libstdc++6",
    "libz.so.1": "zlib1g",
}


def import_open3d() -> ModuleType:
    """Import Open3D.

    Raises:
        DependencyError: Open3D is not installed, or a system library is missing; the advice says what to install.
    """
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        missing = missing_library(str(error))
        if missing is None and isinstance(error, ImportError):
            return import_extra("open3d", "view")  # says that it is not installed, or what the loader said
        problem = str(error) if missing is None else f"{missing} is missing"
        raise DependencyError("open3d", problem=f"cannot be loaded: {problem}", advice=advice(missing)) from error


def missing_library(message: str) -> str | None:
    """Return the shared library that is missing according to a loader's message, or None."""
    match = re.search(r"(\S+\.so[.0-9]*): cannot open shared object file", message)
    return match[1] if match else None


def advice(library: str | None) -> str:
    """Return what to install for a library, or what to do if its package is not known."""
    package = _DEBIAN.get(library or "")
    if package is None:
        return f"install the library that the message names, {PAGE_ADVICE}"
    root = "sudo " if shutil.which("sudo") else ""
    return f"{root}apt-get install {package} (Debian, Ubuntu), {PAGE_ADVICE}"


LAYERS = {"g": "grid", "p": "points", "f": "flow", "b": "boxes", "v": "vehicle"}
KEYS = {
    "right, left": "next or previous frame",
    "space": "play or stop",
    "g p f b v": "show or hide the grid, points, flow, boxes, vehicle",
    "t": "switch between prediction, truth and errors",
    "1 .. 9 0": "show or hide one of classes 1 to 10; with Shift 11 to 20, with Ctrl 21 to 30",
    "a": "show all classes",
    "r": "reset the camera",
    "q, Esc": "close the window",
}
_RIGHT, _LEFT, _SPACE = 262, 263, 32  # key codes of GLFW
_PRESSED, _SHIFT, _CONTROL = 1, 1, 2
_SUN = np.array([-0.38, -0.5, 0.78]) / np.linalg.norm([0.38, 0.5, 0.78])
_BACKGROUND = (0.96, 0.965, 0.972)
_BOX_CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
_BOX_EDGES = np.array(
    [(a, b) for a in range(8) for b in range(a) if (a ^ b) in (1, 2, 4)]
)  # corners that differ in one axis
_EDGE = 0.8  # brightness of the edges of voxels, relative to their faces


@dataclass
class WindowState:
    """What a window shows of its scene.

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
        report: called with a line of text for what a key did.
    """

    def __init__(
        self, reader: SceneReader, *, size: tuple[int, int] = (1280, 800), report: Callable[[str], None] | None = None
    ) -> None:
        """Open the window.

        Args:
            reader: reads the scene.
            size: (width, height) of the window, pixels.
            report: called with a line of text for what a key did.

        Raises:
            DependencyError: Open3D or a library that it needs is missing, or there is no screen.
        """
        self.reader = reader = reader.right_handed()  # as Open3D is
        self.state, self.report = WindowState(), report or (lambda _: None)
        if reader.panels:
            self.state.layers.discard("points")
        self.o3d = import_open3d()
        self._content = self._read()
        self._shown: dict[str, Any] = {}
        self._due = time.monotonic()
        self._visualizer = self.o3d.visualization.VisualizerWithKeyCallback()
        self._open(size)
        self._frame_camera()
        self._bind_keys()
        self._draw()

    def tick(self) -> bool:
        """Draw, and go to the next frame if one is due while playing; return False once the window is closed."""
        if self.state.playing and time.monotonic() >= self._due:
            self._due = time.monotonic() + FRAME_PERIOD_S
            self.step(1)
        alive = bool(self._visualizer.poll_events())
        self._visualizer.update_renderer()
        return alive

    def step(self, by: int) -> None:
        """Go forward by a number of frames; after the last frame follows the first."""
        self.state.position = (self.state.position + by) % len(self.reader.frames)
        self._content = self._read()
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
            self.report(f"{entry.name}: {'hidden' if entry.order in self.state.hidden else 'shown'}")
            self._draw()

    def show_all(self) -> None:
        """Show all classes."""
        self.state.hidden.clear()
        self._draw()

    def next_panel(self) -> None:
        """Switch to the next of prediction, truth and errors."""
        if len(self.reader.panels) > 1:
            self.state.panel = (self.state.panel + 1) % len(self.reader.panels)
            self.state.hidden.clear()
            self.report(self.reader.panels[self.state.panel].title)
            self._draw()

    @property
    def classes(self) -> list[Entry]:
        """The classes that can be hidden: all classes of the panel's table except free. `order` is the class id."""
        reader = self.reader
        colors = reader.panels[self.state.panel].colors if reader.panels else reader.colors
        return colors.entries(colors.table.names)

    def picture(self) -> NDArray[np.uint8]:
        """Return a screenshot, (H, W, 3) uint8."""
        self.tick()
        image = np.asarray(self._visualizer.capture_screen_float_buffer(do_render=True))
        return np.round(image * 255).astype(np.uint8)

    def close(self) -> None:
        """Close the window."""
        self._visualizer.destroy_window()

    def _read(self) -> FrameContent:
        return self.reader.read(self.reader.frames[self.state.position])

    def _open(self, size: tuple[int, int]) -> None:
        no_screen = sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
        if no_screen or not self._visualizer.create_window(f"carlasc: {self.reader.name}", *size):
            raise DependencyError(
                "window",
                expected="a screen",
                found="no DISPLAY" if no_screen else "a screen that Open3D cannot draw on",
                advice=f"use a desktop or `xvfb-run`, {PAGE_ADVICE}",
            )

    def _frame_camera(self) -> None:
        """Draw the rim of the extent, so that all frames have one scale, and look from behind and above."""
        options = self._visualizer.get_render_option()
        options.background_color = np.array(_BACKGROUND)
        options.light_on = False  # the colours include the light
        options.point_size = 2.5
        options.mesh_show_back_face = True
        panels, scan = self.reader.panels, self._content.scan
        corners = grid_extent(panels[0].spec) if panels else scan_extent(scan or Scan(np.empty((0, 3), np.float32)))
        lower, upper = corners.min(0), corners.max(0)
        rim = np.array([(x, y, lower[2]) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], np.float64)
        rim[:, :2] = lower[:2] + rim[:, :2] * (upper - lower)[:2]
        lines = self._lines(rim, np.array([(0, 1), (1, 2), (2, 3), (3, 0)]))
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
        """Draw the current state."""
        layers, content = self.state.layers, self._content
        self._replace("edges", None)
        self._replace("grid", self._grid() if content.grids and "grid" in layers else None)
        self._replace("points", self._points() if content.scan is not None and "points" in layers else None)
        self._replace("flow", self._flow() if "flow" in layers else None)
        self._replace("boxes", self._boxes() if content.boxes is not None and "boxes" in layers else None)
        self._replace("vehicle", self._mesh(ego_vehicle()) if "vehicle" in layers else None)

    def _replace(self, name: str, geometry: Any) -> None:
        if (old := self._shown.pop(name, None)) is not None:
            self._visualizer.remove_geometry(old, reset_bounding_box=False)
        if geometry is not None:
            self._visualizer.add_geometry(geometry, reset_bounding_box=False)
            self._shown[name] = geometry

    def _grid(self) -> Any:
        grid, colors = self._content.grids[self.state.panel], self.reader.panels[self.state.panel].colors.by_id
        drawn = (grid.labels > 0) & ~np.isin(grid.labels, list(self.state.hidden))
        if not drawn.any():
            return None
        mesh = grid_mesh(grid.spec, colors[grid.labels], drawn)
        self._replace("edges", self._edges(mesh))
        return self._mesh(mesh)

    def _edges(self, mesh: QuadMesh) -> Any:
        """Return the edges of voxels as lines, darker than their faces and slightly in front of them."""
        face, side = np.nonzero(mesh.edges)
        corners = mesh.corners + 4e-3 * mesh.normals[:, None]
        ends = np.stack([corners[face, side], corners[face, (side + 1) % 4]], axis=1)
        lines = self._lines(ends, np.arange(2 * len(face)))
        lines.colors = self.o3d.utility.Vector3dVector(
            mesh.colors[face] * (_EDGE / 255.0) * self._light(mesh)[face, None]
        )
        return lines

    def _points(self) -> Any:
        scan, colors = self._content.scan, self.reader.colors.by_id.copy()
        colors[0] = palette.UNLABELLED
        if scan is None:
            return None
        labels = np.zeros(len(scan), np.uint8) if scan.labels is None else scan.labels
        # hidden ids in the panel of errors are outcomes, not classes of points
        hidden = self.state.hidden if not self.reader.panels or self.state.panel < 2 else set[int]()
        shown = ~np.isin(labels, list(hidden))
        cloud = self.o3d.geometry.PointCloud(self._vectors(scan.points[shown]))
        cloud.colors = self.o3d.utility.Vector3dVector(colors[labels[shown]] / 255.0)
        return cloud if shown.any() else None

    def _flow(self) -> Any:
        moving = self.reader.read_motion(self.reader.frames[self.state.position], self._content.scan)
        if moving is None:
            return None
        tails, vectors = motion_arrows(moving)
        if self.reader.panels and "points" not in self.state.layers:  # no arrows where nothing else is drawn
            spec = self.reader.panels[0].spec
            _, inside = spec.index(spec.to_axes(tails * [1, 1, 0] + [0, 0, (spec.lower[2] + spec.upper[2]) / 2]))
            tails, vectors = tails[inside], vectors[inside]
        return self._mesh(arrows(tails, vectors, palette.ARROW, 0.24)) if len(tails) else None

    def _boxes(self) -> Any:
        """Return the edges of the boxes as lines in the colours of their classes."""
        boxes = self._content.boxes
        if boxes is None or not len(boxes):
            return None
        corners = boxes.centers[:, None] + np.einsum(
            "nij,nkj->nki", boxes.sensor_T_box[:, :3, :3], _BOX_CORNERS * boxes.sizes[:, None] / 2
        )
        edges = 8 * np.arange(len(boxes))[:, None, None] + _BOX_EDGES
        lines = self._lines(corners, edges)
        colors = np.repeat(self.reader.colors.by_id[boxes.labels], len(_BOX_EDGES), axis=0)
        lines.colors = self.o3d.utility.Vector3dVector(colors / 255.0)
        return lines

    def _mesh(self, mesh: QuadMesh) -> Any:
        """Return a mesh for Open3D, with the light of sun and sky in the colours of its corners."""
        corners, triangles = mesh.triangles()
        light = self._light(mesh)[:, None] * mesh.openness
        colors = np.clip(mesh.colors[:, None, :] / 255.0 * light[..., None], 0, 1)
        shown = self.o3d.geometry.TriangleMesh(
            self._vectors(corners), self.o3d.utility.Vector3iVector(triangles.astype(np.int32))
        )
        shown.vertex_colors = self.o3d.utility.Vector3dVector(colors.reshape(-1, 3))
        return shown

    def _light(self, mesh: QuadMesh) -> NDArray[np.floating]:
        """Return the brightness of each face in the sun; a level face without shade has exactly its own colour."""
        lit = np.clip(mesh.normals @ _SUN, 0, None) / _SUN[2]
        return 0.58 + 0.42 * np.minimum(lit, 1.25)

    def _lines(self, corners: NDArray[np.floating], ends: NDArray[np.integer]) -> Any:
        pairs = self.o3d.utility.Vector2iVector(ends.reshape(-1, 2).astype(np.int32))
        return self.o3d.geometry.LineSet(self._vectors(corners.reshape(-1, 3)), pairs)

    def _vectors(self, points: NDArray[np.floating]) -> Any:
        return self.o3d.utility.Vector3dVector(np.asarray(points, np.float64))


def show_window(scene: Scene, *, report: Callable[[str], None] | None = None) -> None:
    """Show a scene in a window until it is closed; see `carlasc.viewing.view` for the arguments and errors."""
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
        f"{marks[number // 10]}{(number + 1) % 10} {entry.name}" for number, entry in enumerate(window.classes[:30])
    ]
    return [*window.reader.notes, *(f"{keys:<12} {what}" for keys, what in KEYS.items()), ", ".join(digits)]


def _call(action: Callable[[], None], _: Any) -> bool:
    action()
    return True
