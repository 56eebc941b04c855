"""A scene as a page for any browser: one self-contained HTML file, or a folder from which the
browser fetches frames.
"""

from __future__ import annotations

import base64
import html
import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from carlasc.errors import ArgumentError, ConflictError
from carlasc.running.spreading import StepCounter
from carlasc.storage.files import make_folder, sync_all, write_output, writing
from carlasc.storage.packed.output import remove
from carlasc.viewing.finding import SceneSource
from carlasc.viewing.page.contents import (
    FrameScores,
    PageContent,
    json_number,
    open_content,
    pack_arrays,
)
from carlasc.viewing.scene import Scene
from carlasc.viewing.targets import ViewResult, check_target, first_frames
from carlasc.viewing.trails import Trails

SCRIPTS = (
    "interface.js",
    "decode.js",
    "store.js",
    "modes.js",
    "voxels.js",
    "points.js",
    "path.js",
    "photos.js",
    "panels.js",
    "divider.js",
    "plot.js",
    "keys.js",
    "viewer.js",
)
FRAMES = "frames"
_MARK = b'<meta name="generator" content="carlasc">'
PAGES = (".html", ".htm")
"""Endings of the names of pages in one file."""


def compose(
    name: str, describe: Callable[[], Mapping[str, Any]], blocks: Iterator[bytes] | None
) -> Iterator[bytes]:
    """Yield a page piece by piece.

    Args:
        name: title of the page.
        describe: returns the description of the scene. It is called after the last block.
        blocks: the frames, which become part of the page; None if the browser fetches them from the
            folder of the page.
    """
    assets = files("carlasc.viewing.page").joinpath("assets")

    def read(asset: str) -> str:
        return assets.joinpath(asset).read_text("utf-8")

    def frames() -> Iterator[str]:
        for number, block in enumerate(blocks or ()):
            text = base64.b64encode(block).decode()
            yield f'<script type="application/octet-stream" id="frame{number}">{text}</script>\n'

    def scene() -> Iterator[str]:
        described = {**describe(), "embedded": blocks is not None}
        yield json.dumps(described, separators=(",", ":")).replace("<", "\\u003c")

    scripts = "\n".join(read(script) for script in SCRIPTS)
    parts: dict[str, Callable[[], Iterator[str]]] = {
        "TITLE": lambda: iter([html.escape(name)]),
        "STYLE": lambda: iter([read("style.css")]),
        "CONNECT": lambda: iter(["'none'" if blocks is not None else "'self'"]),
        "FRAMES": frames,
        "SCENE": scene,
        "LICENCE": lambda: iter([html.escape(read("vendor/three.LICENSE")).replace("--", "- -")]),
        "THREE": lambda: iter([read("vendor/three.min.js")]),
        "SCRIPTS": lambda: iter([f'"use strict";\n{scripts}']),
    }
    head, *rest = read("template.html").split("{{")
    yield head.encode()
    for piece in rest:
        part, text = piece.split("}}", 1)
        for found in parts[part]():
            yield found.encode()
        yield text.encode()


def check_folder(out: Path, overwrite: bool) -> None:
    """Check that the folder of a page can be written: it does not exist, is empty, or is a page
    that may be replaced.

    Raises:
        ConflictError: something else exists there, or `overwrite` is not given.
    """
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    index = out / "index.html"
    if not (index.is_file() and _MARK in index.read_bytes()[:2000] and (out / FRAMES).is_dir()):
        found = "a folder with other files" if out.is_dir() else "a file"
        advice = "choose another name; one that ends in .html writes a page in one file"
        raise ConflictError(
            out, expected="the folder of a page, or a new one", found=found, advice=advice
        )
    if not overwrite:
        raise ConflictError(
            out,
            problem="the page exists",
            advice="choose another name, or replace it with `overwrite=True`",
        )


class NewFolder:
    """A folder that is being written.

    Attributes:
        size_bytes: size of the files so far.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._written: list[Path] = []
        self.size_bytes = 0

    def write(self, name: str, data: bytes) -> None:
        """Write a file, with the folders that it needs."""
        path = self._path / name
        make_folder(path.parent)
        path.write_bytes(data)
        self._written.append(path)
        self.size_bytes += len(data)

    def sync(self) -> None:
        """Wait until the files and their names are on the disk."""
        sync_all(self._written)
        sync_all({path.parent for path in self._written})


@contextmanager
def writing_folder(out: Path) -> Iterator[NewFolder]:
    """Yield a temporary folder, which is renamed at the end of the block, and removed if the block
    fails.

    An existing folder is replaced at the end of the block. Call `check_folder` before.

    Raises:
        StorageError: the folder cannot be written; nothing is left behind.
    """
    out = out.resolve()  # "." has no name
    part, old = (out.with_name(f".{out.name}.{ending}") for ending in ("part", "old"))
    try:
        with writing(out):
            remove(part)  # left by a killed run
            make_folder(part)
            folder = NewFolder(part)
            yield folder
            folder.sync()
            if out.exists():
                remove(old)
                out.rename(old)
            part.rename(out)
            sync_all([out.parent])
            remove(old)
    finally:
        remove(part)
        if old.exists() and not out.exists():
            old.rename(out)


def write_page(
    scene: Scene,
    out: Path,
    *,
    thin_m: float,
    beside: SceneSource | None = None,
    beside_grid: str | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> ViewResult:
    """Write a scene as a page; see `carlasc.viewing.view` for the arguments and errors."""
    started = time.monotonic()
    in_folder = out.suffix == ""
    if in_folder:
        check_folder(out, overwrite)
    else:
        check_target(out, PAGES, overwrite)
    if not 0.01 <= thin_m <= 10:
        raise ArgumentError("thin_m", expected="0.01 to 10 metres", found=str(thin_m))
    content = open_content(scene, thin_m, beside, beside_grid)
    notes = content.reader.notes
    if not in_folder and scene.frames is None:
        frames, more = first_frames(content.frames)
        content, notes = replace(content, frames=frames), notes + more
    writer = _Writer(content, progress)
    size = writer.write_folder(out) if in_folder else writer.write_file(out)
    titles = tuple(panel.title for panel in content.panels)
    elapsed = time.monotonic() - started
    return ViewResult(out, content.reader.path, titles, content.frames, size, elapsed, notes)


class _Writer:
    """Writes the frames of a page one after the other, then their description."""

    def __init__(self, content: PageContent, progress: Callable[[int, int], None] | None) -> None:
        self.content = content
        self.progress = progress
        self.scores: list[FrameScores | None] = []

    def write_file(self, out: Path) -> int:
        """Write one file that contains the frames; return its size in bytes."""
        pieces = compose(self.content.reader.name, self.describe, self.blocks())
        write_output(out, lambda file: file.writelines(pieces))
        return out.stat().st_size

    def write_folder(self, out: Path) -> int:
        """Write index.html and a file for each frame; return their size in bytes."""
        with writing_folder(out) as folder:
            for number, block in enumerate(self.blocks()):
                folder.write(f"{FRAMES}/{number:06d}.bin", block)
            folder.write(
                "index.html", b"".join(compose(self.content.reader.name, self.describe, None))
            )
        return folder.size_bytes

    def blocks(self) -> Iterator[bytes]:
        """Yield the frames, each as one block of arrays (see `contents`)."""
        trails, step = Trails(), StepCounter(self.progress, len(self.content.frames))
        for frame in self.content.frames:
            arrays, scores = self.content.read(frame, trails)
            self.scores.append(scores)
            yield pack_arrays(arrays)
            step()

    def describe(self) -> dict[str, object]:
        """Return the description of the scene, with the scores of the frames that were written."""
        scored = [scores for scores in self.scores if scores is not None]
        runs = range(len(self.content.runs))
        found = {
            name: [[json_number(getattr(scores, name)[run]) for scores in scored] for run in runs]
            for name in ("miou", "iou")
        }
        return self.content.describe() | {"scores": found if scored else None}
