"""`view`: a scene in a page for any browser, or in a window."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import overload

from carlasc.errors import ArgumentError
from carlasc.viewing.finding import SceneSource
from carlasc.viewing.page.page import PageResult, write_page
from carlasc.viewing.scene import Scene, as_scene
from carlasc.viewing.window.window import show_window


@overload
def view(
    source: Scene | SceneSource,
    out: str | os.PathLike[str],
    *,
    thin_m: float = ...,
    overwrite: bool = ...,
    progress: Callable[[int, int], None] | None = ...,
) -> PageResult: ...


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
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
    report: Callable[[str], None] | None = None,
) -> PageResult | None:
    """Write a scene as a self-contained HTML page, or, without `out`, show it in a window until that is closed.

    Args:
        source: a `Scene`; or anything that a scene's `source` may be. Its palette is "class" or "colorblind". A page of a scene
            without `frames` shows the first 60 frames.
        out: file name of the page, which ends in .html; None opens a window.
        thin_m: points in a page are thinned to one per cell of this side length, metres.
        overwrite: whether an existing page is replaced.
        progress: called with (frames done, frames in all) while a page is written.
        report: called with a line of text for what a key did in the window; first with the keys and the classes.

    Returns:
        What the page shows and where it is; None for a window.

    Raises:
        ArgumentError: an argument has no meaning.
        MissingDataError: a sequence, grid or frame does not exist.
        FormatError: the data do not have the format.
        ConflictError: `out` exists.
        StorageError: `out` cannot be written; nothing is left behind.
        DependencyError: for a window, Open3D or a library that it needs is missing, or there is no screen.
    """
    scene = as_scene(source)
    if scene.palette == "height":
        raise ArgumentError("palette", expected="class or colorblind", found="height")
    if out is not None:
        return write_page(scene, Path(out), thin_m=thin_m, overwrite=overwrite, progress=progress)
    show_window(scene, report=report)
    return None
