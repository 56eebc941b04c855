"""A scene as one self-contained HTML file that any browser opens, without a network."""

from __future__ import annotations

import base64
import html
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from carlasc.errors import ArgumentError
from carlasc.storage.files import write_output
from carlasc.viewing.colors import ClassColors
from carlasc.viewing.page.coding import OFFSET_STEPS, encode_grid, encode_scan, pack_arrays
from carlasc.viewing.scene import GridPanel, Scene, SceneReader
from carlasc.viewing.targets import check_target

MAX_FRAMES = 60  # of a page, if the scene gives no range: a few megabytes
_SCRIPTS = ("decode.js", "voxels.js", "points.js", "panels.js", "interface.js", "viewer.js")


@dataclass(frozen=True)
class PageResult:
    """The page that was written.

    Attributes:
        out: the file.
        sequence: path of the sequence.
        panels: titles of the grids that are shown side by side.
        frames: the frames in the page.
        size_bytes: size of the file.
        elapsed_s: how long it took, seconds.
        notes: what was chosen where the scene left a choice.
    """

    out: Path
    sequence: str
    panels: tuple[str, ...]
    frames: tuple[int, ...]
    size_bytes: int
    elapsed_s: float
    notes: tuple[str, ...]


def write_page(
    scene: Scene,
    out: Path,
    *,
    thin_m: float,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> PageResult:
    """Write a scene as a page; see `carlasc.viewing.view` for the arguments and errors."""
    started = time.monotonic()
    check_target(out, (".html", ".htm"), overwrite)
    if not 0.01 <= thin_m <= 10:
        raise ArgumentError("thin_m", expected="0.01 to 10 metres", found=str(thin_m))
    reader = scene.open()
    if scene.frames is None and len(reader.frames) > MAX_FRAMES:
        note = f"{len(reader.frames)} frames found, showing the first {MAX_FRAMES}"
        reader = replace(reader, frames=reader.frames[:MAX_FRAMES], notes=(*reader.notes, note))
    blocks = []
    for done, frame in enumerate(reader.frames, 1):
        blocks.append(encode_frame(reader, frame, thin_m))
        if progress is not None:
            progress(done, len(reader.frames))
    page = compose(describe(reader, thin_m), blocks).encode()
    write_output(out, page)
    titles = tuple(panel.title for panel in reader.panels)
    return PageResult(
        out, reader.path, titles, reader.frames, len(page), time.monotonic() - started, reader.notes
    )  # fmt: skip


def encode_frame(reader: SceneReader, frame: int, thin_m: float) -> bytes:
    """Return a frame as one block of arrays named `panel0/index`, ... and `scan/index`, ... (see `coding`)."""
    content = reader.read(frame)
    arrays: dict[str, Any] = {}
    for number, grid in enumerate(content.grids):
        arrays |= {f"panel{number}/{name}": array for name, array in encode_grid(grid).items()}
    if content.scan is not None:
        arrays |= {f"scan/{name}": array for name, array in encode_scan(content.scan, thin_m).items()}
    return pack_arrays(arrays)


def describe(reader: SceneReader, thin_m: float) -> dict[str, Any]:
    """Return what the scripts of the page need to know besides the blocks of the frames."""
    tables = {colors.table.name: colors for colors in (reader.colors, *(panel.colors for panel in reader.panels))}
    return {
        "name": reader.name,
        "leftHanded": reader.left_handed,
        "tables": {name: _describe_classes(colors) for name, colors in tables.items()},
        "pointTable": reader.table.name,
        "panels": [_describe_panel(panel) for panel in reader.panels],
        "frames": list(reader.frames),
        "times": [reader.read_time(frame) for frame in reader.frames],
        "hasPoints": reader.has("points"),
        "hasFlow": reader.has("flow"),
        "pointCell": thin_m,
        "offsetSteps": OFFSET_STEPS,
    }


def compose(scene: dict[str, Any], blocks: list[bytes]) -> str:
    """Return the page: the template with the style, three.js, the scripts, the description of the scene and its frames."""
    assets = files("carlasc.viewing.page").joinpath("assets")
    scripts = "\n".join(assets.joinpath(name).read_text("utf-8") for name in _SCRIPTS)
    licence = assets.joinpath("vendor/three.LICENSE").read_text("utf-8")
    data = "\n".join(
        f'<script type="application/octet-stream" id="frame{number}">{base64.b64encode(block).decode()}</script>'
        for number, block in enumerate(blocks)
    )
    parts = {
        "TITLE": html.escape(scene["name"]),
        "STYLE": assets.joinpath("style.css").read_text("utf-8"),
        "LICENCE": html.escape(licence).replace("--", "- -"),
        "SCENE": json.dumps(scene, separators=(",", ":")).replace("<", "\\u003c"),
        "FRAMES": data,
        "THREE": assets.joinpath("vendor/three.min.js").read_text("utf-8"),
        "SCRIPTS": f'"use strict";\n{scripts}',
    }
    page = assets.joinpath("template.html").read_text("utf-8")
    head, *rest = page.split("{{")
    return head + "".join(parts[name] + text for name, text in (piece.split("}}", 1) for piece in rest))


def _describe_panel(panel: GridPanel) -> dict[str, Any]:
    spec = panel.spec
    return {
        "title": panel.title,
        "table": panel.colors.table.name,
        "coordinates": spec.coordinates,
        "size": list(spec.size),
        "lower": list(spec.lower),
        "upper": list(spec.upper),
        "voxel": spec.voxel_size.tolist(),
    }


def _describe_classes(colors: ClassColors) -> list[list[Any]]:
    """Return [name, "#rrggbb"] by class id."""
    return [
        [colors.table.names.get(number, f"class {number}"), "#" + bytes(color.tolist()).hex()]
        for number, color in enumerate(colors.by_id)
    ]
