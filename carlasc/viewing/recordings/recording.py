"""A scene as a recording that another viewer opens: the ending of the file name says which."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from carlasc.storage.files import write_output
from carlasc.viewing.recordings.content import MAX_POINTS, RecordingWriter, record_frames
from carlasc.viewing.recordings.foxglove import FoxgloveWriter
from carlasc.viewing.recordings.rerun import RerunWriter
from carlasc.viewing.scene import Scene, SceneReader
from carlasc.viewing.targets import ViewResult, check_target, first_frames

_WRITERS: dict[str, Callable[[Path, SceneReader], RecordingWriter]] = {".rrd": RerunWriter, ".mcap": FoxgloveWriter}
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
    reader = scene.open().right_handed()
    if scene.frames is None:
        frames, more = first_frames(reader.frames)
        reader = replace(reader, frames=frames, notes=reader.notes + more)
    max_points = None if full_points else MAX_POINTS
    if full_points and report is not None:
        size = estimate_size(reader, out.suffix, max_points)
        report(f"{out}: about {size / 1e6:,.0f} MB: {len(reader.frames)} frames with all of their points")
    write_output(out, lambda file: _write(reader, Path(file.name), out.suffix, max_points, progress))
    titles = tuple(panel.title for panel in reader.panels)
    return ViewResult(
        out, reader.path, titles, reader.frames, out.stat().st_size, time.monotonic() - started, reader.notes
    )  # fmt: skip


def estimate_size(reader: SceneReader, ending: str, max_points: int | None) -> int:
    """Return about how many bytes a recording takes: the first, the middle and the last frame are written and thrown away.

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
    writer = _WRITERS[ending.lower()](path, reader)
    try:
        for done, frame in enumerate(record_frames(reader, max_points), 1):
            writer.write(frame)
            if progress is not None:
                progress(done, len(reader.frames))
    except BaseException:
        with suppress(OSError):  # what went wrong first is reported
            writer.close()
        raise
    writer.close()
