"""`render`: pictures and films of a sequence, from a path to a file."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import ArgumentError, ConflictError, MissingDataError
from carlasc.running.processes import run_all
from carlasc.storage import Sequence, Source
from carlasc.viewing.rendering.cameras import Viewpoint
from carlasc.viewing.rendering.colors import ClassColors, PaletteName, merge_legends
from carlasc.viewing.rendering.encoding import check_ending, encodable_size, is_film, write_pictures
from carlasc.viewing.rendering.inputs import Input, find_truth, frames_in, in_one_table, open_input
from carlasc.viewing.rendering.pages import LARGEST, SMALLEST
from carlasc.viewing.rendering.pictures import DEFAULT_SIZE
from carlasc.viewing.rendering.shots import (
    Shot,
    available_frames,
    check_cells,
    choose_kinds,
    choose_views,
    extent_for,
    still_standpoint,
)

ORBIT_PICTURES = 120  # of a single frame that the camera goes round
_DRIVE_FPS, _ORBIT_FPS = 10.0, 20.0  # frames are 0.1 s apart: a drive is shown at its own speed


@dataclass(frozen=True)
class RenderResult:
    """What was drawn.

    Attributes:
        out: the file.
        sequence: path of the sequence.
        what: what is shown, side by side.
        frames: the frames in it.
        pictures: number of pictures in the file.
        size: (width, height) pixels.
        classes: name of the class table shown.
        seconds: how long it took.
        notes: what the reader should know: what was chosen, what is empty.
    """

    out: Path
    sequence: str
    what: tuple[str, ...]
    frames: tuple[int, ...]
    pictures: int
    size: tuple[int, int]
    classes: str
    seconds: float
    notes: tuple[str, ...]


def render(
    path: str | os.PathLike[str] | Source | Sequence,
    out: str | os.PathLike[str] | None = None,
    *,
    sequence: str | None = None,
    frame: int | None = None,
    frames: tuple[int | None, int | None] | None = None,
    what: str | None = None,
    view: str = "perspective",
    grid: str | None = None,
    truth: str | os.PathLike[str] | Source | Sequence | None = None,
    truth_grid: str | None = None,
    classes: str | None = None,
    path_classes: str | None = None,
    palette: PaletteName = "class",
    size: tuple[int, int] = DEFAULT_SIZE,
    legend: bool = True,
    ego: bool = True,
    viewpoint: Viewpoint | None = None,
    orbit: bool = False,
    still: bool = False,
    fps: float | None = None,
    workers: int | None = 1,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> RenderResult:
    """Picture a frame of a sequence (PNG), or a range of frames (GIF, MP4). No screen and no GPU are needed.

    The camera follows the ego vehicle, because grids and scans are in its frame; with `still` it stands where it is and the vehicle
    drives past.

    Args:
        path: anything `carlasc.open` takes, a grid's folder, a frame's file in it, a Source or a Sequence.
        out: a name that ends in .png, .gif or .mp4; None makes one up in the current folder.
        sequence: path or name of the sequence where there are several; None takes the first.
        frame: the frame; None takes the first (a picture, an orbit) or all (a film).
        frames: half-open range of frames of a film.
        what: of grid, scan, flow, truth, errors, side by side where several stand with commas between; None shows the grid, or
            the scan where there is none; with a truth grid, truth and errors.
        view: "perspective", "bev" or "both".
        grid: name of the grid; None takes `evaluation`, or the first.
        truth: what a prediction is compared with: anything that `path` may be.
        truth_grid: name of the truth's grid; None as for `grid`.
        classes: name of the class table to show: "carlasc11" for the paper's eleven; None shows the data's own.
        path_classes: class table of the labels at `path` where nothing beside them says.
        palette: "class", "colorblind" or "height".
        size: (width, height) of the picture, pixels.
        legend: whether colours are explained.
        ego: draw a plain car at the sensor's place.
        viewpoint: where perspective views are taken from; None: behind and above the ego vehicle.
        orbit: go once around: while the frames run, or around a single one.
        still: the camera does not move with the vehicle; needs poses.
        fps: pictures a second of a film; None: 10, the data's own rate (an orbit of one frame: 20).
        workers: processes that draw side by side; None takes all cores.
        overwrite: replace a file that is there.
        progress: called with (pictures done, pictures in all).

    Returns:
        What was drawn, and where it is.

    Raises:
        ArgumentError: arguments that make no picture.
        MissingDataError: a sequence, grid, field or frame that is not there.
        FormatError: what is there is not what the format says.
        ConflictError: `out` is there already.
        StorageError: `out` cannot be written; nothing is left behind.
    """
    started = time.monotonic()
    _check_size(size)
    data = open_input(path, sequence, path_classes)
    reference = None if truth is None else find_truth(truth, data.sequence)
    kinds, views = choose_kinds(data, reference, what), choose_views(view)
    drawn = {"grid", "errors"} & set(kinds)
    grid = data.choose_grid(grid) if drawn else ""
    truth_grid = reference.choose_grid(truth_grid) if reference is not None else ""
    data, reference = in_one_table(data, grid, reference, truth_grid, classes)
    available = available_frames(data, reference, kinds, grid, truth_grid)
    film_wanted = is_film(Path(out)) if out is not None else orbit or frames is not None
    chosen = _choose_frames(data, available, data.frame if frame is None else frame, frames, film_wanted and not orbit)
    target = _choose_target(out, data, kinds, chosen, film_wanted, overwrite)
    size = encodable_size(target, size)

    extent = extent_for(data if drawn or reference is None else reference, kinds, grid or truth_grid, chosen[0])
    standpoint = still_standpoint(data, chosen, extent) if still else None
    shot = Shot(
        data, reference, kinds, views, grid, truth_grid, ClassColors(data.table, palette), extent, size, ego,
        standpoint=standpoint, orbit=orbit,
    )  # fmt: skip
    check_cells(shot, chosen[0])
    if legend:
        shot = replace(shot, legend=merge_legends(shot.legend_of(number) for number in chosen))

    tasks = _plan(shot, chosen, viewpoint or Viewpoint(), orbit, film_wanted)
    if fps is None:
        fps = _ORBIT_FPS if orbit and len(chosen) == 1 else _DRIVE_FPS
    with closing(run_all(_draw, tasks, workers=workers)) as pictures:
        write_pictures(target, _reported(pictures, len(tasks), progress), fps)
    notes = [data.note] if data.note else []
    if len(chosen) == 1 and not orbit:
        notes += [f"{kind}: {note}" for kind in kinds if (note := shot.scene(kind, chosen[0]).note)]
    return RenderResult(
        target, data.sequence.path or data.sequence.location, kinds, tuple(chosen), len(tasks), size,
        data.table.name, time.monotonic() - started, tuple(notes),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Task:
    shot: Shot
    frame: int
    viewpoint: Viewpoint


def _draw(task: _Task) -> NDArray[np.uint8]:
    return task.shot.draw(task.frame, task.viewpoint)


def _plan(shot: Shot, frames: list[int], viewpoint: Viewpoint, orbit: bool, film: bool) -> list[_Task]:
    """Which frame is seen from where in each picture."""
    if not orbit:
        return [_Task(shot, frame, viewpoint) for frame in frames]
    if not film:
        raise ArgumentError("orbit: expected a film to show it: end the output's name in .gif or .mp4")
    if len(frames) == 1:
        frames = frames * ORBIT_PICTURES
    turns = 2 * np.pi * np.arange(len(frames)) / len(frames)
    return [_Task(shot, frame, viewpoint.turned(float(turn))) for frame, turn in zip(frames, turns, strict=True)]


def _reported(
    pictures: Iterator[NDArray[np.uint8]], total: int, progress: Callable[[int, int], None] | None
) -> Iterator[NDArray[np.uint8]]:
    for done, picture in enumerate(pictures, 1):
        yield picture
        if progress is not None:
            progress(done, total)


def _choose_frames(
    data: Input, available: np.ndarray, frame: int | None, frames: tuple[int | None, int | None] | None, film: bool
) -> list[int]:
    where = data.sequence.location
    if not len(available):
        raise MissingDataError(where, expected="a frame that has all that is to be drawn", found="none")
    found = f"{available[0]} to {available[-1]} ({len(available)} frames)"
    if frames is not None:
        if frame is not None:
            raise ArgumentError("frames", expected="a frame or a range of them", found="both")
        chosen = frames_in(available, frames)
        if not chosen:
            start, stop = ("" if value is None else value for value in frames)
            raise MissingDataError(where, expected=f"frames {start}:{stop}", found=f"{found}")
        return chosen
    if frame is not None:
        if frame not in available:
            raise MissingDataError(where, expected=f"frame {frame}", found=f"{found}")
        return [frame]
    return [int(number) for number in available] if film else [int(available[0])]


def _choose_target(
    out: str | os.PathLike[str] | None,
    data: Input,
    kinds: tuple[str, ...],
    frames: list[int],
    film: bool,
    overwrite: bool,
) -> Path:
    if out is None:
        name = data.sequence.name or "carlasc"
        what = "" if kinds == ("grid",) else f"_{'_'.join(kinds)}"
        number = f"{frames[0]:06d}" if len(frames) == 1 else f"{frames[0]:06d}-{frames[-1]:06d}"
        target = Path(f"{name}{what}_{number}.{'mp4' if film else 'png'}")
    else:
        target = Path(out)
    check_ending(target)
    if not film and len(frames) > 1:
        raise ArgumentError(
            target, expected="one frame for a PNG", found=f"{len(frames)}", advice="end the name in .gif or .mp4"
        )
    if target.is_dir():
        raise ArgumentError(target, expected="a file name", found="a folder")
    if target.exists() and not overwrite:
        raise ConflictError(f"{target}: is already there: choose another name, or replace it with --overwrite")
    return target


def _check_size(size: tuple[int, int]) -> None:
    if len(size) != 2 or not all(low <= value <= LARGEST for low, value in zip(SMALLEST, size, strict=True)):
        raise ArgumentError(
            "size",
            expected=f"{SMALLEST[0]}x{SMALLEST[1]} to {LARGEST}x{LARGEST} pixels",
            found=f"{'x'.join(map(str, size))}",
        )
