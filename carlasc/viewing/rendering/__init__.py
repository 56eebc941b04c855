"""Pictures without a screen: grids, scans, how things move, where a prediction errs; stills and films."""

from carlasc.viewing.rendering.cameras import Viewpoint
from carlasc.viewing.rendering.colors import ClassColors, colorblind_palette
from carlasc.viewing.rendering.pictures import Panel, draw_panels, render_comparison, render_grid, render_scan
from carlasc.viewing.rendering.run import RenderResult, render
from carlasc.viewing.rendering.scenes import Scene, error_scene, flow_scene, grid_scene, scan_scene

__all__ = [
    "ClassColors",
    "Panel",
    "RenderResult",
    "Scene",
    "Viewpoint",
    "colorblind_palette",
    "draw_panels",
    "error_scene",
    "flow_scene",
    "grid_scene",
    "render",
    "render_comparison",
    "render_grid",
    "render_scan",
    "scan_scene",
]
