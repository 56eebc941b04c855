"""`render`: pictures and films of a scene, written to a file."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import ArgumentError
from carlasc.running.engines import Engine
from carlasc.running.processes import run_all
from carlasc.viewing.colors import merge_legends
from carlasc.viewing.finding import SceneSource
from carlasc.viewing.rendering.cameras import Viewpoint
from carlasc.viewing.rendering.encoding import FILMS, STILLS, encodable_size, is_film, write_pictures
from carlasc.viewing.rendering.frames import FrameRenderer, scan_extent_in, view_of_drive, views_named
from carlasc.viewing.rendering.pages import check_size
from carlasc.viewing.rendering.pictures import DEFAULT_SIZE, View
from carlasc.viewing.scene import Scene, SceneReader, as_scene
from carlasc.viewing.targets import check_target

ORBIT_PICTURES = 120  # of an orbit around a single frame
_DRIVE_FPS, _ORBIT_FPS = 10.0, 20.0  # frames are 0.1 s apart, so that a film runs at the speed of the drive


@dataclass(frozen=True)
class RenderResult:
    """What was drawn.

    Attributes:
        out: the file.
        sequence: path of the sequence.
        what: what is shown, side by side.
        frames: the frames that are shown.
        pictures: number of pictures in the file.
        size: (width, height) pixels.
        classes: name of the class table.
        elapsed_s: how long it took, seconds.
        notes: what was chosen where the scene left a choice, and which parts of a picture are empty.
    """

    out: Path
    sequence: str
    what: tuple[str, ...]
    frames: tuple[int, ...]
    pictures: int
    size: tuple[int, int]
    classes: str
    elapsed_s: float
    notes: tuple[str, ...]


def render(
    source: Scene | SceneSource,
    out: str | os.PathLike[str] | None = None,
    *,
    what: str | None = None,
    view: str = "perspective",
    size: tuple[int, int] = DEFAULT_SIZE,
    legend: bool = True,
    ego: bool = True,
    viewpoint: Viewpoint | None = None,
    orbit: bool = False,
    still: bool = False,
    fps: float | None = None,
    workers: int | None = 1,
    executor: Engine | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> RenderResult:
    """Draw a frame of a scene as a picture (PNG), or several frames as a film (GIF, MP4). No screen and no GPU are needed.

    The camera follows the ego vehicle, because grids and scans are in the frame of its sensor; with `still` it does not move.

    Args:
        source: a `Scene`; or anything that a scene's `source` may be.
        out: file name that ends in .png, .gif or .mp4; None names the file after the sequence, in the current folder.
            A scene without `frames` gives a picture of the first frame, or a film of all frames.
        what: grid, scan, flow, truth, errors: several names, separated by commas, are drawn side by side. None draws the grid,
            with a ground truth also the truth and the errors; or the scan if there is no grid.
        view: "perspective", "bev" (bird's-eye view) or "both".
        size: (width, height) of the picture, pixels.
        legend: whether the picture has a legend.
        ego: whether a plain car is drawn at the sensor.
        viewpoint: where perspective views are taken from; None takes a point behind and above the ego vehicle.
        orbit: whether the camera circles the scene once: while the frames follow each other, or around a single frame.
        still: whether the camera stays in one place of the world while the vehicle drives; needs poses.
        fps: pictures per second of a film; None takes 10, the rate of the data (20 for an orbit around one frame).
        workers: number of processes; None takes all cores. With an executor: the number of its workers.
        executor: draws instead of processes of our own; it is not shut down.
        overwrite: whether an existing file is replaced.
        progress: called with (pictures done, pictures in all).

    Returns:
        What was drawn, and the file that it is in.

    Raises:
        ArgumentError: an argument has no meaning, or arguments contradict each other.
        MissingDataError: a sequence, grid, field or frame does not exist.
        FormatError: the data do not have the format.
        ConflictError: `out` exists.
        StorageError: `out` cannot be written; nothing is left behind.
        DependencyError: a package is missing; the message names the extra.
    """
    started = time.monotonic()
    check_size(size)
    views, scene = views_named(view), as_scene(source)
    reader = scene.open(what)
    film = is_film(Path(out)) if out is not None else orbit or (scene.frames is not None and len(reader.frames) > 1)
    if scene.frames is None and (orbit or not film):
        reader = replace(reader, frames=reader.frames[:1])
    target = _name_after(reader, film) if out is None else Path(out)
    check_target(target, STILLS + FILMS, overwrite)
    if not film and len(reader.frames) > 1:
        found = f"{len(reader.frames)} frames for {target.name}"
        raise ArgumentError("out", expected="a single frame for a PNG", found=found, advice="name a .gif or .mp4")
    if orbit and not film:
        raise ArgumentError("orbit", expected="a film", found=target.name, advice="name a .gif or .mp4")

    renderer = _prepare(reader, views, encodable_size(target, size), legend=legend, ego=ego, orbit=orbit, still=still)
    tasks = _plan(renderer, viewpoint or Viewpoint())
    if fps is None:
        fps = _ORBIT_FPS if orbit and len(reader.frames) == 1 else _DRIVE_FPS
    with closing(run_all(_render_task, tasks, workers=workers, executor=executor)) as pictures:
        write_pictures(target, _reported(pictures, len(tasks), progress), fps)
    notes = list(reader.notes)
    if len(tasks) == 1:
        drawings = ((content, renderer.draw(content, reader.frames[0])) for content in reader.contents)
        notes += [f"{content}: {drawing.note}" for content, drawing in drawings if drawing.note]
    return RenderResult(
        target, reader.path, reader.contents, reader.frames, len(tasks), renderer.size,
        reader.table.name, time.monotonic() - started, tuple(notes),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Task:
    renderer: FrameRenderer
    frame: int
    viewpoint: Viewpoint


def _render_task(task: _Task) -> NDArray[np.uint8]:
    return task.renderer.render(task.frame, task.viewpoint)


def _prepare(
    reader: SceneReader,
    views: tuple[View, ...],
    size: tuple[int, int],
    *,
    legend: bool,
    ego: bool,
    orbit: bool,
    still: bool,
) -> FrameRenderer:
    """Return a renderer whose extent, legend and fixed view are the same in all frames."""
    extent = scan_extent_in(reader)
    fixed_view = view_of_drive(reader, extent) if still else None
    renderer = FrameRenderer(reader, views, extent, size, ego, fixed_view=fixed_view, orbit=orbit)
    return renderer if not legend else replace(renderer, legend=merge_legends(map(renderer.legend_of, reader.frames)))


def _plan(renderer: FrameRenderer, viewpoint: Viewpoint) -> list[_Task]:
    """Return which frame is seen from where in each picture."""
    frames = list(renderer.reader.frames)
    if not renderer.orbit:
        return [_Task(renderer, frame, viewpoint) for frame in frames]
    if len(frames) == 1:
        frames *= ORBIT_PICTURES
    angles = 2 * np.pi * np.arange(len(frames)) / len(frames)
    return [_Task(renderer, frame, viewpoint.turned(float(angle))) for frame, angle in zip(frames, angles, strict=True)]


def _reported(
    pictures: Iterator[NDArray[np.uint8]], total: int, progress: Callable[[int, int], None] | None
) -> Iterator[NDArray[np.uint8]]:
    for done, picture in enumerate(pictures, 1):
        yield picture
        if progress is not None:
            progress(done, total)


def _name_after(reader: SceneReader, film: bool) -> Path:
    """Return a file name made of the sequence, of what is shown and of the frames."""
    first, last = reader.frames[0], reader.frames[-1]
    what = "" if reader.contents == ("grid",) else f"_{'_'.join(reader.contents)}"
    numbers = f"{first:06d}" if first == last else f"{first:06d}-{last:06d}"
    return Path(f"{reader.data.sequence.name or 'carlasc'}{what}_{numbers}.{'mp4' if film else 'png'}")
