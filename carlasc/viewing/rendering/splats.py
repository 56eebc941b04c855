"""Drawing points as small balls: nearer ones hide farther ones, and points behind others are darker."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from carlasc.core.compiling import cached
from carlasc.viewing.rendering.cameras import Camera
from carlasc.viewing.rendering.raycasting import Frame

POINT_RADIUS_M = 0.07
_LEAST_RADIUS = 1.3  # samples
_MOST_RADIUS = 40.0


def splat(
    points: NDArray[np.floating],
    colors: NDArray[np.uint8],
    camera: Camera,
    frame: Frame,
    radius_m: float = POINT_RADIUS_M,
) -> None:
    """Draw points into a frame as shaded balls.

    Args:
        points: (N, 3) metres.
        colors: (N, 3) uint8 RGB.
        camera: from where they are seen.
        frame: is drawn into; what it shows hides points that are farther.
        radius_m: radius of a ball.
    """
    height, width = frame.depth.shape
    columns, rows, depths = camera.project(points, width, height)
    pixel = camera.footprint(height) * (np.ones_like(depths) if camera.orthographic else np.maximum(depths, 1e-6))
    radii = np.clip(radius_m / pixel, _LEAST_RADIUS, _MOST_RADIUS)
    seen = (depths > 0.1) & (np.abs(columns - width / 2) < width) & (np.abs(rows - height / 2) < height)
    drawn = np.zeros((height, width), np.bool_)
    _draw_balls(
        columns[seen], rows[seen], depths[seen].astype(np.float32), radii[seen], np.ascontiguousarray(colors[seen]),
        frame.colors, frame.depth, drawn,
    )  # fmt: skip
    _darken_behind(frame.colors, frame.depth, drawn)


@cached(error_model="python")
def _draw_balls(columns, rows, depths, radii, colors, out, out_depth, drawn):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    height, width = out_depth.shape
    for i in range(len(columns)):
        radius = radii[i]
        for y in range(max(0, int(rows[i] - radius)), min(height, int(rows[i] + radius) + 1)):
            for x in range(max(0, int(columns[i] - radius)), min(width, int(columns[i] + radius) + 1)):
                dx, dy = x + 0.5 - columns[i], y + 0.5 - rows[i]
                rim = (dx * dx + dy * dy) / (radius * radius)
                if rim > 1 or depths[i] >= out_depth[y, x]:
                    continue
                light = 0.78 + 0.22 * np.sqrt(1 - rim)
                for c in range(3):
                    out[y, x, c] = np.uint8(colors[i, c] * light)
                out_depth[y, x] = depths[i]
                drawn[y, x] = True


@cached(error_model="python")
def _darken_behind(out, depth, drawn):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    """Eye-dome lighting: the farther a point is behind its neighbours in the picture, the darker it is."""
    height, width = depth.shape
    reach = 3
    for y in range(reach, height - reach):
        for x in range(reach, width - reach):
            if not drawn[y, x]:
                continue
            behind = np.float32(0.0)
            for dy in (-reach, 0, reach):
                for dx in (-reach, 0, reach):
                    behind += min(
                        np.float32(1.5), max(np.float32(0.0), depth[y, x] - depth[y + dy, x + dx] - np.float32(0.15))
                    )
            light = np.exp(-0.12 * behind)
            for c in range(3):
                out[y, x, c] = np.uint8(out[y, x, c] * light)
