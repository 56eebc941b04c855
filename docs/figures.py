"""Draws the documentation's pictures: `python docs/figures.py [NAME ...]` writes
docs/images/<name>.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any, get_args

import matplotlib as mpl
import numpy as np
from carlasc_recorders import TownDrive
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray
from PIL import Image

from carlasc.core.choices import Preset
from carlasc.core.geometry import relative_to
from carlasc.core.grids import Grid, GridSpec
from carlasc.core.tables import CARLA, REMAPS
from carlasc.groundtruth import Observation, count_votes
from carlasc.viewing import (
    ClassColors,
    Look,
    Panel,
    Viewpoint,
    draw_panels,
    grid_drawing,
    render_grid,
)

IMAGES = Path(__file__).parent / "images"
SENSORS, FRAME = 20, 60
INK, FORWARD, RIGHT, UP, PALE = "#444444", "#d62728", "#2ca02c", "#1f77b4", "#dddddd"


def draw(name: str) -> bytes:
    """Return the bytes of one picture."""
    return FIGURES[name]()


def draw_frames() -> bytes:
    """The ego sensor's frame, from above and from the side."""
    figure, (above, side) = _canvas(2, (9.0, 4.2), [1, 1.15])
    above.set_title("from above", color=INK)
    _box(above, (-0.9, -2.2), 1.8, 4.4)  # the vehicle: width along y, length along x
    above.plot(0, -0.5 + 0.5, "o", color=INK)
    _arrow(above, (0, 0), (0, 3.6), FORWARD, "x forward", (0.25, 3.3))
    _arrow(above, (0, 0), (3.0, 0), RIGHT, "y right", (1.75, -0.45))
    turn = np.linspace(np.pi / 2, np.pi / 10, 40)
    above.plot(2.2 * np.cos(turn), 2.2 * np.sin(turn), color=UP)
    _arrow(
        above,
        (2.2 * np.cos(0.35), 2.2 * np.sin(0.35)),
        (2.2 * np.cos(0.31), 2.2 * np.sin(0.31)),
        UP,
        "",
        (0, 0),
    )
    above.text(1.75, 1.75, "azimuth, yaw\natan2(y, x)", color=UP)
    for x, y, text in ((-3.1, 0, "-π/2"), (0, -3.2, "±π"), (0, 3.85, "0"), (3.4, 0, "π/2")):
        above.text(x, y, text, color=INK, ha="center", va="center")
    above.set_xlim(-3.6, 4.2)
    above.set_ylim(-3.6, 4.3)

    side.set_title("from the right side", color=INK)
    side.axhline(-1.8, color=INK)
    _box(side, (-1.7, -1.6), 4.4, 0.8)
    _box(side, (-1.1, -0.8), 2.6, 0.7)
    side.plot(0, 0, "o", color=INK)
    _arrow(side, (0, 0), (3.6, 0), FORWARD, "x forward", (2.3, 0.15))
    _arrow(side, (0, 0), (0, 2.0), UP, "z up", (0.12, 1.7))
    side.annotate("", (-2.4, -1.8), (-2.4, 0), arrowprops={"arrowstyle": "<->", "color": INK})
    side.text(-2.5, -0.9, "1.8 m", color=INK, ha="right", va="center")
    side.plot([-2.5, 0], [0, 0], color=INK, linestyle=":", linewidth=1)
    side.plot([0.5, 0.5], [-1.6, -2.3], color=INK, linestyle=":", linewidth=1)
    side.plot([0, 0], [0, -2.3], color=INK, linestyle=":", linewidth=1)
    side.annotate("", (-0.12, -2.25), (0.62, -2.25), arrowprops={"arrowstyle": "<->", "color": INK})
    side.text(0.7, -2.25, "0.5 m to the vehicle's centre", color=INK, va="center")
    side.text(3.9, -1.72, "ground", color=INK, ha="right", va="bottom")
    side.set_xlim(-3.6, 4.2)
    side.set_ylim(-2.6, 2.4)
    return _svg(figure)


def draw_votes() -> bytes:
    """A ray, its free samples, and the voxels that they vote for."""
    figure, (axes,) = _canvas(1, (9.0, 3.4), [1])
    start, hit, step = np.array([0.6, 0.7]), np.array([9.55, 3.3]), 1.5
    distance = float(np.linalg.norm(hit - start))
    ray = (hit - start) / distance
    samples = [start + ray * d for d in np.arange(distance - step, 0, -step)]
    for x in range(12):
        for y in range(4):
            inside = [s for s in samples if (np.floor(s) == (x, y)).all()]
            color = (
                "#cfe8cf" if inside else "#f3b4b4" if (np.floor(hit) == (x, y)).all() else "white"
            )
            axes.add_patch(_rectangle((x, y), 1, 1, facecolor=color, edgecolor=PALE))
    axes.plot(*zip(start, hit, strict=True), color=INK, linewidth=1)
    axes.plot(*start, "s", color=INK, markersize=9)
    axes.plot(*zip(*samples, strict=True), "o", color=RIGHT, linestyle="none")
    axes.plot(*hit, "o", color=FORWARD, markersize=8)
    axes.text(0.6, 0.28, "sensor", color=INK, ha="center", va="center")
    axes.annotate(
        "labelled point: a vote for its class", (9.65, 3.35), (10.1, 4.35),
        color=FORWARD, ha="right", arrowprops={"arrowstyle": "-", "color": FORWARD},
    )  # fmt: skip
    axes.annotate(
        "free samples, 1.5 m apart: votes for free", tuple(samples[3]), (3.2, 4.35),
        color=RIGHT, ha="center", arrowprops={"arrowstyle": "-", "color": RIGHT},
    )  # fmt: skip
    axes.text(
        6.0,
        -0.45,
        "white: no vote from here. A voxel that no sensor votes for is unknown",
        color=INK,
        ha="center",
    )
    axes.set_xlim(-0.1, 12.1)
    axes.set_ylim(-0.8, 4.8)
    return _svg(figure)


def draw_town() -> bytes:
    """Ground truth of twenty LiDARs at 0.2 m up to 4 m above the sensor, in the paper's classes and
    colours.
    """
    published = GridSpec.published()
    spec = published.with_bounds(published.lower, (*published.upper[:2], 4.0)).with_resolution(0.2)
    picture = render_grid(
        _ground_truth(spec),
        REMAPS["carlasc11"].target,
        Look(
            size=(1280, 720),
            viewpoint=Viewpoint.parse("azimuth=28 elevation=35 distance=80 target=-2,0,-2.5"),
        ),
    )
    return _png(picture)


def draw_grids() -> bytes:
    """The published grids, coarse, fine and cylindrical, of one frame."""
    panels = [
        Panel(
            grid_drawing(
                _ground_truth(GridSpec.published(name)), ClassColors(REMAPS["carlasc11"].target)
            ),
            title=name,
        )
        for name in get_args(Preset)
    ]
    return _png(draw_panels(panels, size=(1500, 470)))


def draw_steps() -> bytes:
    """What goes in, the steps of the method, and what comes out."""
    figure, (axes,) = _canvas(1, (6.4, 5.6), [1])
    rows = (
        (5, "#dce9f5", ["bag", "folder of\nscans", "11 data\nsets", "simulated\ntown", "CARLA"]),
        (4, "#f2f2f2", ["one layout: scans, poses, labels, boxes (checked)"]),
        (3, "#f7e6cf", ["poses refined", "moving actors\nfound", "actors followed\nand completed"]),
        (2, "#f7e6cf", ["rays of all scans vote: class, free or unknown per voxel"]),
        (
            1,
            "#d9ecd9",
            ["training\nsamples", "clean\nmap", "audit,\nscores", "page,\nfilm", "card"],
        ),
    )
    for row, color, texts in rows:
        width = 10 / len(texts)
        for place, text in enumerate(texts):
            axes.add_patch(
                _rectangle(
                    (place * width + 0.1, row * 1.75),
                    width - 0.2,
                    1.15,
                    facecolor=color,
                    edgecolor=INK,
                )
            )
            axes.text(
                (place + 0.5) * width, row * 1.75 + 0.57, text, color=INK, ha="center",
                va="center", fontsize=11,
            )  # fmt: skip
        if row > 1:
            _arrow(axes, (5, row * 1.75), (5, row * 1.75 - 0.6), INK, "", (0, 0))
    axes.set_xlim(0, 10)
    axes.set_ylim(1.6, 10.0)
    return _svg(figure)


def draw_logo() -> bytes:
    """The logo: three voxels, of which one is only an outline: it is unknown."""
    faces = []
    for at, colors in (
        ((0, 0), ("#f2a65a", "#d9822b", "#b5651d")),
        ((1, 0), ("#5b9bd5", "#2f74b5", "#1f5182")),
        ((0.5, 1), None),
    ):
        x, y = 12 + 34.64 * at[0], 66 - 30 * at[1]
        top = [(x, y), (x + 17.32, y - 10), (x + 34.64, y), (x + 17.32, y + 10)]
        left = [top[0], top[3], (top[3][0], y + 30), (x, y + 20)]
        right = [top[3], top[2], (top[2][0], y + 20), (top[3][0], y + 30)]
        for place, corners in enumerate((top, left, right)):
            points = " ".join(f"{a:.2f},{b:.2f}" for a, b in corners)
            style = (
                f'fill="{colors[place]}"'
                if colors
                else 'fill="none" stroke="#9aa5b1" stroke-width="2.5" stroke-linejoin="round"'
            )
            faces.append(f'<polygon points="{points}" {style}/>')
    return "\n".join(
        [
            '<svg xmlns="http://www.w3.org/2000/svg" viewBox="6 20 82 82">',
            "<title>carlasc</title>",
            *faces,
            "</svg>\n",
        ]
    ).encode()


FIGURES: dict[str, Callable[[], bytes]] = {
    "../assets/logo.svg": draw_logo,
    "steps.svg": draw_steps,
    "frames.svg": draw_frames,
    "votes.svg": draw_votes,
    "town.png": draw_town,
    "grids.png": draw_grids,
}


@cache
def _observations() -> list[Observation]:
    """Return what twenty LiDARs see of one simulated frame."""
    drive = TownDrive(seed=2, traffic="heavy")
    recordings = [drive.record(FRAME, sensor) for sensor in range(SENSORS)]
    ego = recordings[0].world_T_sensor
    return [
        Observation(r.scan.points, r.scan.labels, relative_to(ego, r.world_T_sensor))
        for r in recordings
        if r.scan.labels is not None
    ]


def _ground_truth(spec: GridSpec) -> Grid:
    """Return their grid, in the eleven classes."""
    grid = count_votes(_observations(), spec, CARLA).to_grid()
    return Grid(spec, REMAPS["carlasc11"](grid.labels), grid.counts)


def _canvas(columns: int, size: tuple[float, float], widths: list[float]) -> tuple[Any, Any]:
    mpl.rcParams |= {
        "svg.fonttype": "none",
        "svg.hashsalt": "carlasc",
        "font.family": "sans-serif",
        "font.size": 10,
    }
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, columns, squeeze=False, width_ratios=widths)[0]
    for axis in axes:
        axis.set_aspect("equal")
        axis.axis("off")
    return figure, axes


def _rectangle(corner: tuple[float, float], width: float, height: float, **style: Any) -> Any:
    return Rectangle(corner, width, height, **style)


def _box(axis: Any, corner: tuple[float, float], width: float, height: float) -> None:
    axis.add_patch(_rectangle(corner, width, height, facecolor="#f2f2f2", edgecolor=INK))


def _arrow(axis: Any, tail: Any, head: Any, color: str, text: str, at: tuple[float, float]) -> None:
    axis.annotate("", head, tail, arrowprops={"arrowstyle": "-|>", "color": color, "linewidth": 2})
    axis.text(*at, text, color=color)


def _svg(figure: Any) -> bytes:
    buffer = BytesIO()
    figure.savefig(
        buffer, format="svg", metadata={"Date": None, "Creator": None}, facecolor="white"
    )
    return buffer.getvalue()


def _png(picture: NDArray[np.uint8]) -> bytes:
    """Return a small PNG, of 256 colours; rare ones, the legend's, are kept."""
    small = Image.fromarray(picture).quantize(
        256, Image.Quantize.MAXCOVERAGE, kmeans=3, dither=Image.Dither.NONE
    )
    buffer = BytesIO()
    small.save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


if __name__ == "__main__":
    for chosen in sys.argv[1:] or FIGURES:
        (IMAGES / chosen).write_bytes(draw(chosen))
        print(IMAGES / chosen, (IMAGES / chosen).stat().st_size)
