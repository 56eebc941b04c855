"""A look at the frames of a scene in a window on the desktop, drawn by Open3D.

Layers, classes, tracks and everything else that a scene holds are in pages and recordings.
"""

from __future__ import annotations

import importlib
import os
import sys
import time
from collections.abc import Callable
from functools import partial
from types import ModuleType
from typing import Any

import numpy as np

from carlasc.core.arrays import AnyArray, Uint8Array
from carlasc.errors import DependencyError, import_extra
from carlasc.storage.layout import FRAME_PERIOD_S
from carlasc.viewing.rendering.drawings import ego_vehicle
from carlasc.viewing.rendering.meshes import QuadMesh, grid_mesh, join
from carlasc.viewing.scene import SceneReader

KEYS = {
    "right, left": "next or previous frame",
    "space": "play or stop",
    "t": "switch between the grids and the points",
    "r": "reset the camera",
    "q, Esc": "close the window",
}
# key codes of GLFW
_RIGHT = 262
_LEFT = 263
_SPACE = 32
_PAGE = 'or write a page instead with `out="page.html"`'
_LIBRARIES = "libegl1 libgl1 libx11-6 libudev1 libusb-1.0-0 libidn2-0 libgomp1"  # Debian, Ubuntu
# brightness of all faces, and what the direction of a face adds: 1 in all for a level face
_BASE = 0.75
_LIGHT = (-0.05, 0.1, 0.25)


class Window:
    """A window that shows the grids and the points of a scene, one at a time.

    Attributes:
        reader: reads the scene, in right-handed axes.
        position: index of the shown frame in the scene's frames.
        look: index of what is shown in `looks`.
        playing: whether the frames are played.
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
        self.reader = reader.right_handed()  # as Open3D is
        self.position = 0
        self.look = 0
        self.playing = False
        self.report = report or (lambda _: None)
        self._due = time.monotonic()
        self._shown = list[Any]()
        self._o3d: Any = import_open3d()
        self._visualizer = self._o3d.visualization.VisualizerWithKeyCallback()
        no_screen = sys.platform == "linux" and not (
            os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        )
        if no_screen or not self._visualizer.create_window(f"carlasc: {reader.name}", *size):
            found = "no DISPLAY" if no_screen else "a screen that Open3D cannot draw on"
            advice = f"use a desktop or `xvfb-run`, {_PAGE}"
            raise DependencyError("window", expected="a screen", found=found, advice=advice)
        options = self._visualizer.get_render_option()
        options.light_on = False  # the colours include the light
        options.point_size = 2.5
        actions: dict[int, Callable[[], None]] = {
            _RIGHT: partial(self.step, 1),
            _LEFT: partial(self.step, -1),
            _SPACE: self.toggle_play,
            ord("T"): self.next_look,
        }
        for key, action in actions.items():
            self._visualizer.register_key_callback(key, partial(_call, action))
        self._draw()
        control = self._visualizer.get_view_control()  # from behind and above
        control.set_lookat([-3.0, 0.0, -1.0])
        control.set_front([-0.79, 0.0, 0.61])
        control.set_up([0.0, 0.0, 1.0])
        control.set_zoom(0.55)

    @property
    def looks(self) -> list[str]:
        """What can be shown: the titles of the grids, and "points" if the sequence has them."""
        titles = [panel.title for panel in self.reader.panels]
        return titles + ["points"] * self.reader.has("points")

    def tick(self) -> bool:
        """Draw, and go to the next frame when it is due while playing; return False after the
        window was closed.
        """
        if self.playing and time.monotonic() >= self._due:
            self._due = time.monotonic() + FRAME_PERIOD_S
            self.step(1)
        alive = bool(self._visualizer.poll_events())
        self._visualizer.update_renderer()
        return alive

    def step(self, by: int) -> None:
        """Go forward by a number of frames; the first frame follows the last."""
        self.position = (self.position + by) % len(self.reader.frames)
        self._draw()
        if not self.playing:
            self.report(f"frame {self.reader.frames[self.position]}")

    def toggle_play(self) -> None:
        """Play the frames, or stop."""
        self.playing = not self.playing and len(self.reader.frames) > 1

    def next_look(self) -> None:
        """Show the next of `looks`."""
        self.look = (self.look + 1) % len(self.looks)
        self.report(self.looks[self.look])
        self._draw()

    def picture(self) -> Uint8Array:
        """Return a screenshot, (H, W, 3) uint8."""
        self.tick()
        image = np.asarray(self._visualizer.capture_screen_float_buffer(do_render=True))
        return np.round(image * 255).astype(np.uint8)

    def close(self) -> None:
        """Close the window."""
        self._visualizer.destroy_window()

    def _draw(self) -> None:
        content = self.reader.read(self.reader.frames[self.position])
        parts = [ego_vehicle()] if self.reader.shows_ego else []
        shapes = []
        if self.look < len(content.grids):
            grid = content.grids[self.look]
            colors = self.reader.panels[self.look].colors
            parts.append(grid_mesh(grid.spec, colors.by_id[grid.labels], grid.labels > 0))
        elif content.scan is not None:
            cloud = self._o3d.geometry.PointCloud(self._vectors(content.scan.points))
            cloud.colors = self._vectors(self.reader.colors.of_points(content.scan) / 255)
            shapes.append(cloud)
        shapes.append(self._surface(join(parts)))
        for shape in self._shown:
            self._visualizer.remove_geometry(shape, reset_bounding_box=False)
        for shape in shapes:
            # the first frame sets the scale of the view
            self._visualizer.add_geometry(shape, reset_bounding_box=not self._shown)
        self._shown = shapes

    def _surface(self, mesh: QuadMesh) -> Any:
        corners, triangles = mesh.triangles()
        indices = self._o3d.utility.Vector3iVector(triangles.astype(np.int32))
        surface = self._o3d.geometry.TriangleMesh(self._vectors(corners), indices)
        light = np.minimum(_BASE + mesh.normals @ _LIGHT, 1)[:, None] * mesh.openness
        surface.vertex_colors = self._vectors(mesh.colors[:, None] / 255 * light[..., None])
        return surface

    def _vectors(self, values: AnyArray) -> Any:
        return self._o3d.utility.Vector3dVector(np.asarray(values, np.float64).reshape(-1, 3))


def show_window(reader: SceneReader, report: Callable[[str], None] | None) -> None:
    """Show a scene in a window until it is closed; see `carlasc.viewing.view` for the errors."""
    window = Window(reader, report=report)
    for line in (*reader.notes, *(f"{keys:<12} {what}" for keys, what in KEYS.items())):
        window.report(line)
    try:
        while window.tick():
            time.sleep(0.005)
    finally:
        window.close()


def import_open3d() -> ModuleType:
    """Import Open3D.

    Raises:
        DependencyError: Open3D is not installed, or a system library is missing; the advice says
            what to install.
    """
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        if isinstance(error, ModuleNotFoundError):
            return import_extra("open3d", "view")
        advice = f"apt-get install {_LIBRARIES} (Debian, Ubuntu), {_PAGE}"
        problem = f"cannot be loaded: {str(error).splitlines()[0]}"
        raise DependencyError("open3d", problem=problem, advice=advice) from error


def _call(action: Callable[[], None], _: Any) -> bool:
    action()
    return True
