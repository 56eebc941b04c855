"""`view`: a scene in a page for any browser, in a recording for another viewer, or in a window.

A page is one self-contained HTML file, or a folder from which the browser fetches frames.
"""

from __future__ import annotations

import base64
import html
import json
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO, overload

from carlasc.core.classes import TableUse
from carlasc.errors import ArgumentError, ConflictError, check_types
from carlasc.running.spreading import Progress
from carlasc.storage.files import (
    AnyPath,
    check_target,
    make_folder,
    naming,
    write_output,
    writing_folder,
)
from carlasc.viewing.actor_lines import Trails
from carlasc.viewing.page.contents import PageContent, Scores, open_content, pack_arrays
from carlasc.viewing.recordings.content import MAX_POINTS, RecordingWriter, record_frames
from carlasc.viewing.recordings.foxglove import FoxgloveWriter
from carlasc.viewing.recordings.rerun import RerunWriter
from carlasc.viewing.scene import Scene, SceneReader, SceneSource, as_scene
from carlasc.viewing.window import show_window

_WRITERS: dict[str, Callable[[Path, SceneReader], RecordingWriter]] = {
    ".rrd": RerunWriter,
    ".mcap": FoxgloveWriter,
}
RECORDINGS = tuple(_WRITERS)
"""Endings of the names of recordings: Rerun's, and the one that Foxglove reads."""
PAGES = (".html", ".htm")
"""Endings of the names of pages in one file."""
MAX_FRAMES = 60
"""Frames of a page in one file and of a recording, if the scene gives no range: a few megabytes."""


_SCRIPTS = (
    *("interface.js", "decode.js", "store.js", "modes.js", "voxels.js", "points.js", "path.js"),
    *("photos.js", "panels.js", "divider.js", "plot.js", "keys.js", "viewer.js"),
)
_FRAMES = "frames"
_MARK = b'<meta name="generator" content="carlasc">'


@dataclass(frozen=True)
class ViewResult:
    """A page or a recording that was written.

    Attributes:
        out: the file, or the folder of a page.
        sequence: path of the sequence.
        panels: titles of the grids in it.
        frames: the frames in it.
        size_bytes: size of the file, or of all files in the folder.
        elapsed_s: duration, seconds.
        notes: choices that were made for options that were not given.
        source_classes: class table by which the labels were read, and what named it.
    """

    out: Path
    sequence: str
    panels: tuple[str, ...]
    frames: tuple[int, ...]
    size_bytes: int
    elapsed_s: float
    notes: tuple[str, ...]
    source_classes: TableUse


@overload
def view(
    source: Scene | SceneSource,
    out: AnyPath,
    *,
    thin_m: float = ...,
    beside: SceneSource | None = ...,
    beside_grid: str | None = ...,
    full_points: bool = ...,
    overwrite: bool = ...,
    progress: Progress | None = ...,
    report: Callable[[str], None] | None = ...,
) -> ViewResult: ...


@overload
def view(
    source: Scene | SceneSource,
    out: None = ...,
    *,
    report: Callable[[str], None] | None = ...,
) -> None: ...


def view(
    source: Scene | SceneSource,
    out: AnyPath | None = None,
    *,
    thin_m: float = 0.2,
    beside: SceneSource | None = None,
    beside_grid: str | None = None,
    full_points: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
    report: Callable[[str], None] | None = None,
) -> ViewResult | None:
    """Write a scene as a page for any browser or as a recording, or, without `out`, show it in a
    window until it is closed.

    Args:
        source: a `Scene`; or anything that a scene's `source` may be. Its palette is "class" or
            "colorblind". A file of a scene without `frames` shows the first 60 frames.
        out: file name. Its ending gives the format: .html is a page in one file, .rrd a recording
            for Rerun, .mcap a recording for Foxglove. A name without an ending is the folder of a
            page for a web server: the browser fetches frames when it shows them, and without
            `frames` the page shows the whole sequence. None opens a window.
        thin_m: keep one point of a page per cell of this side length, in metres.
        beside: another run of the sequence, shown in the page on the other side of a movable
            divider.
        beside_grid: name of the grid of the other run; without another run, another grid of the
            same one.
        full_points: keep all points in a recording, and print its expected size first; otherwise at
            most 30,000 points per frame.
        overwrite: replace an existing file.
        progress: called with (frames done, frames in all) while a file is written.
        report: called with lines of text: for a recording with `full_points`, its approximate size;
            for a window, the keys, and after each key its effect.

    Returns:
        The file and its contents; None for a window.

    Raises:
        ArgumentError: an argument has a wrong value.
        MissingDataError: a sequence, grid or frame does not exist.
        FormatError: the data do not have the format.
        ConflictError: `out` exists.
        StorageError: `out` cannot be written; nothing is left behind.
        DependencyError: the SDK of Rerun or of Foxglove is missing; or for a window, Open3D or a
            library that it needs is missing, or there is no screen.
    """
    check_types(view, locals())
    started = time.monotonic()
    scene = as_scene(source)
    if scene.palette == "height":
        raise ArgumentError("palette", expected="class or colorblind", found="height")
    target = None if out is None else Path(out)
    ending = "" if target is None else target.suffix.lower()
    recorded = ending in RECORDINGS
    if ending not in ("", *PAGES, *RECORDINGS):
        endings = ", ".join((PAGES[0], *RECORDINGS))
        expected = f"a name that ends in {endings}, or without an ending for a folder"
        raise ArgumentError("out", expected=expected, found=out)
    compared = beside is not None or beside_grid is not None
    page = target and not recorded
    for name, given, fits, expected in (
        ("beside", compared, page, "a page, .html or a folder"),
        ("full_points", full_points, recorded, "a recording, .rrd or .mcap"),
    ):
        if given and not fits:
            raise ArgumentError(name, expected=expected, found=out or "a window")
    if target is None:
        show_window(scene.open(), report)
        return None
    if ending:
        check_target(target, (ending,), overwrite)
    else:
        check_folder(target, overwrite)
    if not recorded and not 0.01 <= thin_m <= 10:
        raise ArgumentError("thin_m", expected="0.01 to 10 metres", found=thin_m)
    content = open_content(scene, thin_m, beside, beside_grid)
    frames = content.frames
    notes = content.reader.notes
    if ending and scene.frames is None and len(frames) > MAX_FRAMES:
        notes += (f"{len(frames)} frames found, showing the first {MAX_FRAMES}",)
        content = replace(content, frames=frames[:MAX_FRAMES])
    if recorded:
        reader = replace(content.reader, frames=content.frames).right_handed().with_actors()
        titles = tuple(panel.title for panel in reader.panels)
        most = None if full_points else MAX_POINTS
        if full_points and report is not None:
            size = estimate_size(reader, ending, most)
            about = f"{len(reader.frames)} frames with all of their points"
            report(f"{target}: about {size / 1e6:,.0f} MB: {about}")
        write_output(target, partial(_write_recording, reader, ending, most, progress))
    else:
        titles = tuple(panel.title for panel in content.panels)
        if ending:
            write_output(target, partial(_write_file, content, progress))
        else:
            _write_folder(content, progress, target)
    parts = [target] if ending else [path for path in target.rglob("*") if path.is_file()]
    size = sum(path.stat().st_size for path in parts)
    elapsed = time.monotonic() - started
    use = content.reader.table_use
    return ViewResult(
        target, content.reader.path, titles, content.frames, size, elapsed, notes, use
    )


def _write_recording(
    reader: SceneReader,
    ending: str,
    max_points: int | None,
    progress: Progress | None,
    file: BinaryIO,
) -> None:
    writer = _WRITERS[ending](Path(file.name), reader)
    try:
        for done, frame in enumerate(record_frames(reader, max_points), 1):
            writer.write(frame)
            if progress is not None:
                progress(done, len(reader.frames))
    except BaseException:
        with suppress(OSError):  # the first error is reported
            writer.close()
        raise
    writer.close()


def estimate_size(reader: SceneReader, ending: str, max_points: int | None) -> int:
    """Return the approximate size of a recording in bytes, from temporary copies of the first, the
    middle and the last frame.

    Args:
        reader: the scene, right-handed.
        ending: of the file name.
        max_points: points that are kept of each frame; None keeps all.
    """
    frames = reader.frames
    sample = tuple(dict.fromkeys((frames[0], frames[len(frames) // 2], frames[-1])))
    sizes = []
    with TemporaryDirectory(prefix="carlasc-") as folder:
        for number, chosen in enumerate((sample[:1], sample)):
            path = Path(folder, f"{number}{ending}")
            with path.open("wb") as file:
                _write_recording(replace(reader, frames=chosen), ending, max_points, None, file)
            sizes.append(path.stat().st_size)
    if len(sample) == 1:
        return sizes[1]
    return sizes[0] + (sizes[1] - sizes[0]) * (len(frames) - 1) // (len(sample) - 1)


def _write_file(content: PageContent, progress: Progress | None, file: BinaryIO) -> None:
    """Write one file that contains the frames."""
    scores: list[Scores] = []
    file.writelines(_compose(content, scores, _blocks(content, scores, progress)))


def _write_folder(content: PageContent, progress: Progress | None, out: Path) -> None:
    """Write index.html and a file for each frame."""
    scores: list[Scores] = []
    with writing_folder(out) as folder:
        make_folder(folder / _FRAMES)
        for number, block in enumerate(_blocks(content, scores, progress)):
            with naming(folder / _FRAMES / f"{number:06d}.bin") as path:
                path.write_bytes(block)
        with naming(folder / "index.html") as path:
            path.write_bytes(b"".join(_compose(content, scores, None)))


def _blocks(
    content: PageContent, scores: list[Scores], progress: Progress | None
) -> Iterator[bytes]:
    """Yield each frame as one block of arrays (see `page.contents`), and append its scores."""
    trails = Trails()
    for done, frame in enumerate(content.frames, 1):
        arrays, own = content.read(frame, trails)
        scores.append(own)
        yield pack_arrays(arrays)
        if progress is not None:
            progress(done, len(content.frames))


def _compose(
    content: PageContent, scores: list[Scores], blocks: Iterable[bytes] | None
) -> Iterator[bytes]:
    """Yield a page piece by piece.

    Args:
        content: the contents.
        scores: those of the frames, complete after the last block.
        blocks: the frames, which become part of the page; None if the browser fetches them from the
            folder of the page.
    """
    assets = files("carlasc.viewing.page").joinpath("assets")

    def read(asset: str) -> str:
        return assets.joinpath(asset).read_text("utf-8")

    scripts = "\n".join(map(read, _SCRIPTS))
    texts = {
        "TITLE": html.escape(content.reader.name),
        "STYLE": read("style.css"),
        "CONNECT": "'self'" if blocks is None else "'none'",
        "LICENCE": html.escape(read("vendor/three.LICENSE")).replace("--", "- -"),
        "THREE": read("vendor/three.min.js"),
        "SCRIPTS": f'"use strict";\n{scripts}',
    }
    head, *rest = read("template.html").split("{{")
    yield head.encode()
    for piece in rest:
        name, following = piece.split("}}", 1)
        if name == "FRAMES":
            for number, block in enumerate(blocks or ()):
                tag = f'<script type="application/octet-stream" id="frame{number}">'
                yield tag.encode() + base64.b64encode(block) + b"</script>\n"
        elif name == "SCENE":  # after the frames
            described = {**content.describe(scores), "embedded": blocks is not None}
            text = json.dumps(described, separators=(",", ":"))
            yield text.replace("<", "\\u003c").encode()
        else:
            yield texts[name].encode()
        yield following.encode()


def check_folder(out: Path, overwrite: bool) -> None:
    """Check that the folder of a page can be written: it does not exist, is empty, or is a page
    that may be replaced.

    Raises:
        ConflictError: something else exists there, or `overwrite` is not given.
    """
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    index = out / "index.html"
    if not (index.is_file() and _MARK in index.read_bytes()[:2000] and (out / _FRAMES).is_dir()):
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
