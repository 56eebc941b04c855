"""A scene as a page that any browser opens: one self-contained HTML file, or a folder of which a browser fetches the frames that it shows."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

from carlasc.errors import ArgumentError
from carlasc.storage.files import write_output
from carlasc.viewing.finding import SceneSource
from carlasc.viewing.page.assembly import compose
from carlasc.viewing.page.coding import pack_arrays
from carlasc.viewing.page.contents import FrameScores, PageContent, json_number, open_content
from carlasc.viewing.page.folder import FRAMES, check_folder, writing_folder
from carlasc.viewing.scene import Scene
from carlasc.viewing.targets import ViewResult, check_target, first_frames

PAGES = (".html", ".htm")
"""Endings of the names of pages in one file."""


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
    """Writes the frames of a page one after the other, and then what describes them."""

    def __init__(self, content: PageContent, progress: Callable[[int, int], None] | None) -> None:
        self.content = content
        self.progress = progress
        self.scores: list[FrameScores | None] = []

    def write_file(self, out: Path) -> int:
        """Write one file that contains the frames; return its size in bytes."""

        def write(file: BinaryIO) -> None:
            file.writelines(compose(self.content.reader.name, self.describe, self.blocks()))

        write_output(out, write)
        return out.stat().st_size

    def write_folder(self, out: Path) -> int:
        """Write index.html and a file for each frame; return their size in bytes."""
        with writing_folder(out) as folder:
            for number, block in enumerate(self.blocks()):
                folder.write(f"{FRAMES}/{number:06d}.bin", block)
            folder.write("index.html", b"".join(compose(self.content.reader.name, self.describe, None)))
        return folder.size_bytes

    def blocks(self) -> Iterator[bytes]:
        """Yield the frames, each as one block of arrays (see `coding`)."""
        for done, frame in enumerate(self.content.frames, 1):
            arrays, scores = self.content.read(frame)
            self.scores.append(scores)
            yield pack_arrays(arrays)
            if self.progress is not None:
                self.progress(done, len(self.content.frames))

    def describe(self) -> dict[str, object]:
        """Return the description of the scene, with the scores of the frames that were written."""
        scored = [scores for scores in self.scores if scores is not None]
        runs = range(len(self.content.runs))
        found = {
            name: [[json_number(getattr(scores, name)[run]) for scores in scored] for run in runs]
            for name in ("miou", "iou")
        }
        return self.content.describe() | {"scores": found if scored else None}
