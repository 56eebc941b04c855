"""`view`: a scene in a page for any browser, in a recording for another viewer, or in a window."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import overload

from carlasc.errors import ArgumentError
from carlasc.running.spreading import StepCounter
from carlasc.storage.files import write_output
from carlasc.viewing.finding import SceneSource
from carlasc.viewing.page.page import PAGES, write_page
from carlasc.viewing.recordings.content import MAX_POINTS, RecordingWriter, record_frames
from carlasc.viewing.recordings.foxglove import FoxgloveWriter
from carlasc.viewing.recordings.rerun import RerunWriter
from carlasc.viewing.scene import Scene, SceneReader, as_scene
from carlasc.viewing.targets import ViewResult, check_target, first_frames
from carlasc.viewing.window import show_window

_WRITERS: dict[str, Callable[[Path, SceneReader], RecordingWriter]] = {
    ".rrd": RerunWriter,
    ".mcap": FoxgloveWriter,
}
RECORDINGS = tuple(_WRITERS)
"""Endings of the names of recordings: Rerun's, and the one that Foxglove reads."""


def write_recording(
    scene: Scene,
    out: Path,
    *,
    full_points: bool = False,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
    report: Callable[[str], None] | None = None,
) -> ViewResult:
    """Write a scene as a recording; see `carlasc.viewing.view` for the arguments and errors."""
    started = time.monotonic()
    check_target(out, RECORDINGS, overwrite)
    reader = scene.open().right_handed().with_actors()
    if scene.frames is None:
        frames, more = first_frames(reader.frames)
        reader = replace(reader, frames=frames, notes=reader.notes + more)
    max_points = None if full_points else MAX_POINTS
    if full_points and report is not None:
        size = estimate_size(reader, out.suffix, max_points)
        report(
            f"{out}: about {size / 1e6:,.0f} MB: {len(reader.frames)} frames with all of their "
            f"points"
        )
    write_output(
        out, lambda file: _write(reader, Path(file.name), out.suffix, max_points, progress)
    )
    titles = tuple(panel.title for panel in reader.panels)
    return ViewResult(
        out, reader.path, titles, reader.frames, out.stat().st_size, time.monotonic() - started, reader.notes
    )  # fmt: skip


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
    with TemporaryDirectory(prefix="carlasc-") as folder:
        sizes = []
        for number, chosen in enumerate((sample[:1], sample)):
            path = Path(folder) / f"{number}{ending}"
            _write(replace(reader, frames=chosen), path, ending, max_points, None)
            sizes.append(path.stat().st_size)
    if len(sample) == 1:
        return sizes[1]
    return sizes[0] + (sizes[1] - sizes[0]) * (len(frames) - 1) // (len(sample) - 1)


def _write(
    reader: SceneReader,
    path: Path,
    ending: str,
    max_points: int | None,
    progress: Callable[[int, int], None] | None,
) -> None:
    writer, step = _WRITERS[ending.lower()](path, reader), StepCounter(progress, len(reader.frames))
    try:
        for frame in record_frames(reader, max_points):
            writer.write(frame)
            step()
    except BaseException:
        with suppress(OSError):  # the first error is reported
            writer.close()
        raise
    writer.close()


@overload
def view(
    source: Scene | SceneSource,
    out: str | os.PathLike[str],
    *,
    thin_m: float = ...,
    beside: SceneSource | None = ...,
    beside_grid: str | None = ...,
    full_points: bool = ...,
    overwrite: bool = ...,
    progress: Callable[[int, int], None] | None = ...,
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
    out: str | os.PathLike[str] | None = None,
    *,
    thin_m: float = 0.2,
    beside: SceneSource | None = None,
    beside_grid: str | None = None,
    full_points: bool = False,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
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
            for a window, the keys and the classes, and after each key its effect.

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
    scene = as_scene(source)
    if scene.palette == "height":
        raise ArgumentError("palette", expected="class or colorblind", found="height")
    target = None if out is None else Path(out)
    ending = "" if target is None else target.suffix.lower()
    if ending not in ("", *PAGES, *RECORDINGS):
        expected = f"a name that ends in {', '.join((PAGES[0], *RECORDINGS))}, or without an ending for a folder"
        raise ArgumentError("out", expected=expected, found=str(out))
    is_recording = ending in RECORDINGS
    if (beside is not None or beside_grid is not None) and (target is None or is_recording):
        raise ArgumentError(
            "beside", expected="a page, .html or a folder", found=str(out or "a window")
        )
    if target is not None and is_recording:
        return write_recording(
            scene,
            target,
            full_points=full_points,
            overwrite=overwrite,
            progress=progress,
            report=report,
        )
    if full_points:
        raise ArgumentError(
            "full_points", expected="a recording, .rrd or .mcap", found=str(out or "a window")
        )
    if target is not None:
        return write_page(
            scene,
            target,
            thin_m=thin_m,
            beside=beside,
            beside_grid=beside_grid,
            overwrite=overwrite,
            progress=progress,
        )
    show_window(scene, report=report)
    return None
