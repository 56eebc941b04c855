"""Looking at sequences: pictures and films, a page for any browser, recordings for other viewers, a window on the desktop."""

from __future__ import annotations

from typing import TYPE_CHECKING

from carlasc.loading import late_names

if TYPE_CHECKING:
    from carlasc.viewing.colors import ClassColors, Entry, colorblind_palette
    from carlasc.viewing.rendering.cameras import Viewpoint
    from carlasc.viewing.rendering.drawings import Drawing, error_drawing, flow_drawing, grid_drawing, scan_drawing
    from carlasc.viewing.rendering.pictures import Panel, draw_panels, render_comparison, render_grid, render_scan
    from carlasc.viewing.rendering.run import RenderResult, render
    from carlasc.viewing.scene import FrameContent, GridPanel, Scene, SceneReader
    from carlasc.viewing.targets import ViewResult
    from carlasc.viewing.viewer import view
    from carlasc.viewing.window.window import Window
else:
    __getattr__, __dir__ = late_names(
        __name__,
        {
            "colors": ("ClassColors", "Entry", "colorblind_palette"),
            "rendering.cameras": ("Viewpoint",),
            "rendering.drawings": ("Drawing", "error_drawing", "flow_drawing", "grid_drawing", "scan_drawing"),
            "rendering.pictures": ("Panel", "draw_panels", "render_comparison", "render_grid", "render_scan"),
            "rendering.run": ("RenderResult", "render"),
            "scene": ("FrameContent", "GridPanel", "Scene", "SceneReader"),
            "targets": ("ViewResult",),
            "viewer": ("view",),
            "window.window": ("Window",),
        },
    )

__all__ = [
    "ClassColors",
    "Drawing",
    "Entry",
    "FrameContent",
    "GridPanel",
    "Panel",
    "RenderResult",
    "Scene",
    "SceneReader",
    "ViewResult",
    "Viewpoint",
    "Window",
    "colorblind_palette",
    "draw_panels",
    "error_drawing",
    "flow_drawing",
    "grid_drawing",
    "render",
    "render_comparison",
    "render_grid",
    "render_scan",
    "scan_drawing",
    "view",
]
