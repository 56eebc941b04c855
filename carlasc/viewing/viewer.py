"""`view`: a scene in a page for any browser, in a recording for another viewer, or in a window."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import overload

from carlasc.errors import ArgumentError
from carlasc.viewing.finding import SceneSource
from carlasc.viewing.page.page import PAGES, write_page
from carlasc.viewing.recordings.recording import RECORDINGS, write_recording
from carlasc.viewing.scene import Scene, as_scene
from carlasc.viewing.targets import ViewResult
from carlasc.viewing.window import show_window


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
    """Write a scene as a page for any browser or as a recording, or, without `out`, show it in a window until that is closed.

    Args:
        source: a `Scene`; or anything that a scene's `source` may be. Its palette is "class" or "colorblind". A file of a scene
            without `frames` shows the first 60 frames.
        out: file name, whose ending decides: .html is a page in one file, .rrd a recording for Rerun, .mcap one for Foxglove. A name
            without an ending is the folder of a page, which a web server serves: the browser fetches each frame when it is shown,
            and without `frames` the page shows the whole sequence. None opens a window.
        thin_m: points in a page are thinned to one per cell of this side length, metres.
        beside: another run of the same sequence, which a page compares with `source` on both sides of a divider. Anything that a
            scene's `source` may be; of several sequences, the one with the same path or name is taken.
        beside_grid: name of its grid; None as for the grid of `source`. Without `beside`, another grid of `source` itself.
        full_points: whether a recording keeps all points; otherwise at most 30,000 of each frame.
        overwrite: whether an existing file is replaced.
        progress: called with (frames done, frames in all) while a file is written.
        report: called with a line of text: for a recording with `full_points` first about how large it becomes; for a window with
            the keys and the classes, then with what each key did.

    Returns:
        What the file shows and where it is; None for a window.

    Raises:
        ArgumentError: an argument has no meaning.
        MissingDataError: a sequence, grid or frame does not exist.
        FormatError: the data do not have the format.
        ConflictError: `out` exists.
        StorageError: `out` cannot be written; nothing is left behind.
        DependencyError: the SDK of Rerun or of Foxglove is missing; or for a window, Open3D or a library that it needs is
            missing, or there is no screen.
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
        raise ArgumentError("beside", expected="a page, .html or a folder", found=str(out or "a window"))
    if target is not None and is_recording:
        return write_recording(
            scene, target, full_points=full_points, overwrite=overwrite, progress=progress, report=report
        )
    if full_points:
        raise ArgumentError("full_points", expected="a recording, .rrd or .mcap", found=str(out or "a window"))
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
