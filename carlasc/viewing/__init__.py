"""Looking at sequences: pictures and films, a page that any browser opens, a window on the desktop."""

from carlasc.viewing.clip import Clip, FrameContent, PanelSpec, open_clip
from carlasc.viewing.page.page import PageResult, make_page
from carlasc.viewing.rendering import RenderResult, Viewpoint, render, render_comparison, render_grid, render_scan
from carlasc.viewing.window.window import Window, show

__all__ = [
    "Clip",
    "FrameContent",
    "PageResult",
    "PanelSpec",
    "RenderResult",
    "Viewpoint",
    "Window",
    "make_page",
    "open_clip",
    "render",
    "render_comparison",
    "render_grid",
    "render_scan",
    "show",
]
