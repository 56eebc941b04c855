"""A page to share: one HTML file that draws frames of a sequence in any browser, without a network."""

from __future__ import annotations

import base64
import html
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from carlasc.errors import ArgumentError, ConflictError
from carlasc.storage import Sequence, Source
from carlasc.storage.files import write_atomic
from carlasc.viewing.clip import Clip, PanelSpec, open_clip
from carlasc.viewing.page.coding import OFFSET_STEPS, encode_grid, encode_scan, pack_arrays
from carlasc.viewing.rendering.colors import ClassColors, PaletteName

AT_MOST = 60  # frames of a page where no range is given: a few megabytes
_SCRIPTS = ("decode.js", "voxels.js", "points.js", "panels.js", "interface.js", "viewer.js")


@dataclass(frozen=True)
class PageResult:
    """What was written.

    Attributes:
        out: the file.
        sequence: path of the sequence.
        panels: titles of what stands side by side.
        frames: the frames in it.
        size_bytes: size of the file.
        seconds: how long it took.
        notes: what was chosen where there was a choice.
    """

    out: Path
    sequence: str
    panels: tuple[str, ...]
    frames: tuple[int, ...]
    size_bytes: int
    seconds: float
    notes: tuple[str, ...]


def make_page(
    path: str | os.PathLike[str] | Source | Sequence,
    out: str | os.PathLike[str],
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
    thin_m: float = 0.2,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> PageResult:
    """Write frames of a sequence as one self-contained HTML page.

    Args:
        path: anything `carlasc.open` takes, a grid's folder, a frame's file in it, a Source or a Sequence.
        out: the file, a name that ends in .html.
        sequence: path or name of the sequence where there are several; None takes the first.
        frames: half-open range of frames; None takes the first 60.
        every: take each `every`-th of them.
        grid: name of the grid; None takes `evaluation`, or the first.
        truth: what a prediction is compared with: anything that `path` may be.
        truth_grid: name of the truth's grid; None as for `grid`.
        classes: name of the class table to show; None shows the data's own.
        path_classes: class table of the labels at `path` where nothing beside them says.
        palette: "class" or "colorblind".
        thin_m: points are thinned to one a cell of this side, metres.
        overwrite: replace a file that is there.
        progress: called with (frames done, frames in all).

    Returns:
        What was written.

    Raises:
        ArgumentError: arguments that make no sense.
        MissingDataError: a sequence, grid or frame that is not there.
        FormatError: what is there is not what the format says.
        ConflictError: `out` is there already.
        StorageError: `out` cannot be written.
    """
    started = time.monotonic()
    target = _check_target(Path(out), overwrite)
    if not 0.01 <= thin_m <= 10:
        raise ArgumentError("thin", expected="0.01 to 10 m", found=f"{thin_m}")
    clip = open_clip(
        path, sequence=sequence, frames=frames, every=every, at_most=AT_MOST, grid=grid, truth=truth,
        truth_grid=truth_grid, classes=classes, path_classes=path_classes, palette=palette,
    )  # fmt: skip
    blocks = []
    for done, frame in enumerate(clip.frames, 1):
        blocks.append(encode_frame(clip, frame, thin_m))
        if progress is not None:
            progress(done, len(clip.frames))
    page = compose(describe(clip, thin_m), blocks).encode()
    write_atomic(target, page)
    return PageResult(
        target, clip.data.sequence.path or clip.data.sequence.location, tuple(panel.title for panel in clip.panels), clip.frames, len(page),
        time.monotonic() - started, clip.notes,
    )  # fmt: skip


def encode_frame(clip: Clip, frame: int, thin_m: float) -> bytes:
    """Return a frame's block: arrays named `panel0/index`, ... and `scan/index`, ... (see `coding`)."""
    content = clip.read(frame)
    arrays: dict[str, Any] = {}
    for number, grid in enumerate(content.grids):
        arrays |= {f"panel{number}/{name}": array for name, array in encode_grid(grid).items()}
    if content.scan is not None:
        arrays |= {f"scan/{name}": array for name, array in encode_scan(content.scan, thin_m).items()}
    return pack_arrays(arrays)


def describe(clip: Clip, thin_m: float) -> dict[str, Any]:
    """Return what the page needs to know beside the frames' blocks."""
    tables = {colors.table.name: colors for colors in (clip.colors, *(panel.colors for panel in clip.panels))}
    return {
        "name": clip.name,
        "leftHanded": clip.left_handed,
        "tables": {name: _describe_classes(colors) for name, colors in tables.items()},
        "pointTable": clip.colors.table.name,
        "panels": [_describe_panel(panel) for panel in clip.panels],
        "frames": list(clip.frames),
        "times": [clip.read_time(frame) for frame in clip.frames],
        "hasPoints": "points" in clip.data.sequence.fields(),
        "hasFlow": "flow" in clip.data.sequence.fields(),
        "pointCell": thin_m,
        "offsetSteps": OFFSET_STEPS,
    }


def compose(scene: dict[str, Any], blocks: list[bytes]) -> str:
    """Return the page: template, style, three.js, our scripts, the scene's description and its frames."""
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


def _describe_panel(panel: PanelSpec) -> dict[str, Any]:
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
    """Return [name, "#rrggbb"] by id."""
    return [
        [colors.table.names.get(number, f"class {number}"), "#" + bytes(color.tolist()).hex()]
        for number, color in enumerate(colors.by_id)
    ]


def _check_target(target: Path, overwrite: bool) -> Path:
    if target.suffix.lower() not in (".html", ".htm"):
        raise ArgumentError(f"{target}: expected a name that ends in .html")
    if target.is_dir():
        raise ArgumentError(target, expected="a file name", found="a folder")
    if target.exists() and not overwrite:
        raise ConflictError(f"{target}: is already there: choose another name, or replace it with --overwrite")
    return target
