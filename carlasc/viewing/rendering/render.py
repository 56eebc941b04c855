"""`render`: pictures and films of a scene, written to a file."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from carlasc.core.arrays import Uint8Array
from carlasc.core.classes import TableUse
from carlasc.errors import ArgumentError, check_types
from carlasc.running.processes import run_all
from carlasc.running.spreading import Progress, Run, StepCounter
from carlasc.storage import Sequence as StoredSequence
from carlasc.storage import Source
from carlasc.storage.files import AnyPath, check_target
from carlasc.viewing.colors import merge_legends
from carlasc.viewing.rendering.actor_boxes import check_boxes
from carlasc.viewing.rendering.cameras import CameraOptions, Viewpoint
from carlasc.viewing.rendering.drawings import GridColor, check_color
from carlasc.viewing.rendering.encoding import (
    FILMS,
    NAME_A_FILM,
    STILLS,
    check_single,
    encodable_size,
    is_film,
    write_pictures,
)
from carlasc.viewing.rendering.pages import draw_legend
from carlasc.viewing.rendering.panels import (
    Cell,
    FrameRenderer,
    caption_panels,
    columns_of,
    draw_shot,
    plan_cells,
)
from carlasc.viewing.rendering.styles import StyleOptions
from carlasc.viewing.scene import Scene, SceneReader, SceneSource, as_scene

ORBIT_PICTURES = 120  # of an orbit around a single frame
# frames are 0.1 s apart, so that a film runs at the speed of the drive
_DRIVE_FPS, _ORBIT_FPS = (  # fact: film-rate
    10.0,
    20.0,
)

# one source; anything else is a list of sources
_ONE = (
    Scene,
    str,
    os.PathLike,
    Source,
    StoredSequence,
)


@dataclass(frozen=True)
class RenderResult:
    """The result of `render`.

    Attributes:
        out: the file.
        sequence: path of the sequence; several are separated by commas.
        what: the contents, side by side.
        frames: the shown frames.
        pictures: number of pictures in the file.
        size: (width, height) pixels.
        classes: name of the class table.
        elapsed_s: duration, seconds.
        notes: choices that were made for options that were not given, and empty parts of a picture.
        legend: the file of the legend if it is a separate file, or None.
        source_classes: class table by which the labels were read, and what named it.
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
    legend: Path | None = None
    source_classes: TableUse | None = None


def render(
    source: Scene | SceneSource | Sequence[Scene | SceneSource],
    out: AnyPath | None = None,
    *,
    what: str | None = None,
    color: GridColor = "class",
    boxes: bool = False,
    camera: CameraOptions = CameraOptions(),  # noqa: B008 (frozen)
    style: StyleOptions = StyleOptions(),  # noqa: B008 (frozen)
    fps: float | None = None,
    overwrite: bool = False,
    run: Run = Run(workers=1),  # noqa: B008 (frozen)
) -> RenderResult:
    """Draw a frame of a scene as a picture (PNG), or several frames as a film (GIF, MP4, WebP).

    Neither a screen nor a GPU is needed.

    A list of scenes is drawn as panels of one size, from the same camera, with captions. A PNG has
    a panel per frame of each scene, a film has a panel per scene.

    Args:
        source: a `Scene`; or anything that a scene's `source` may be; or a list of these.
        out: file name that ends in .png, .gif, .mp4 or .webp; None names the file after the
            sequence, in the current folder. A scene without `frames` gives a picture of the first
            frame, or a film of all frames.
        what: grid, scan, flow, truth or errors; several names, separated by commas, are drawn side
            by side. None: the grid, with a ground truth also the truth and the errors; or the scan
            if there is no grid.
        color: what the colours of the grid show. "class": classes; "confidence": the probability
            that a voxel is occupied; "views": the scans that saw it; "votes"; "inferred": seen or
            inferred; "actor": the number of its actor; "seen": by how many cameras.
        boxes: draw boxes around actors: those of the data, otherwise the tightest ones around the
            points of each actor.
        camera: the camera. By default the camera follows the ego vehicle, behind and above it,
            because grids and scans are in the frame of its sensor.
        style: size, legend, captions and size of text, for a screen or for a paper.
        fps: frames of a film per second. None: 10, the rate of the data (20 for an orbit around one
            frame).
        overwrite: replace an existing file.
        run: how the pictures are spread over processes, with a callback for progress.

    Returns:
        The file, and its contents.

    Raises:
        ArgumentError: an argument has a wrong value, or arguments contradict each other.
        MissingDataError: a sequence, grid, field or frame does not exist.
        FormatError: the data do not have the format.
        ConflictError: `out` exists.
        StorageError: `out` cannot be written; nothing is left behind.
        DependencyError: a package is missing; the message names the extra.
    """
    check_types(render, locals())
    started = time.monotonic()
    together = not isinstance(source, _ONE)
    scenes = [as_scene(one) for one in ([source] if isinstance(source, _ONE) else source)]
    if not scenes:
        raise ArgumentError("source", expected="at least one source", found="none")
    if not together and (style.captions or style.columns is not None):
        name = "captions" if style.captions else "columns"
        raise ArgumentError(name, expected="several sources or frames in one picture", found="one")
    readers, film = _open_scenes(scenes, what, out, orbit=camera.orbit, together=together)
    target = _name_after(readers[0], film) if out is None else Path(out)
    check_target(target, STILLS + FILMS, overwrite)
    _check_kind(target, None if together else readers[0], style, film=film, orbit=camera.orbit)
    legend_file = (
        style.sheet.legend_file(target) if style.legend and style.sheet.legend_apart else None
    )
    if legend_file is not None:
        check_target(legend_file, STILLS, overwrite)
    for reader in readers:
        check_color(color, reader)
        if boxes:
            check_boxes(reader.data)

    renderers = [
        FrameRenderer(reader, camera, style.ego and reader.shows_ego, color, boxes)
        for reader in readers
    ]
    pictures = plan_cells(renderers, film)
    shown = [cell for cells in pictures for cell in cells]
    entries = merge_legends(c.renderer.legend_of(c.frame) for c in shown if style.legend)
    sheet = replace(style.sheet, size=encodable_size(target, style.sheet.size))
    draw = partial(
        draw_shot,
        sheet=sheet,
        legend=[] if sheet.legend_apart else entries,
        captions=caption_panels(pictures[0], style.captions, film) if together else (),
        columns=style.columns or (columns_of(pictures[0]) if together else None),
    )
    shots = _plan_shots(pictures, camera)
    if fps is None:
        fps = _ORBIT_FPS if camera.orbit and len(pictures) == 1 else _DRIVE_FPS
    with closing(run_all(draw, shots, run)) as drawn:
        write_pictures(target, _reported(drawn, len(shots), run.progress), fps, sheet.dpi)
    if legend_file is not None and entries and sheet.font_size is not None:
        write_pictures(
            legend_file, [draw_legend(entries, sheet.font_size, sheet.size[0])], fps, sheet.dpi
        )
    return RenderResult(
        target,
        ", ".join(dict.fromkeys(reader.path for reader in readers)),
        readers[0].contents,
        tuple(sorted({cell.frame for cell in shown})),
        len(shots),
        sheet.size,
        readers[0].table.name,
        time.monotonic() - started,
        tuple(_notes_of(readers, pictures)),
        legend_file if entries else None,
        readers[0].table_use,
    )


def _open_scenes(
    scenes: Sequence[Scene],
    what: str | None,
    out: AnyPath | None,
    *,
    orbit: bool,
    together: bool,
) -> tuple[list[SceneReader], bool]:
    """Return readers of the frames to draw, and whether they become a film."""
    readers = [scene.open(what) for scene in scenes]
    several = any(
        scene.frames is not None and len(r.frames) > 1
        for scene, r in zip(scenes, readers, strict=True)
    )
    film = is_film(Path(out)) if out is not None else orbit or (several and not together)
    if orbit or not film:
        readers = [
            replace(reader, frames=reader.frames[:1]) if scene.frames is None else reader
            for scene, reader in zip(scenes, readers, strict=True)
        ]
    return readers, film


def _check_kind(
    target: Path, alone: SceneReader | None, style: StyleOptions, *, film: bool, orbit: bool
) -> None:
    """Raise ArgumentError if several frames are given for one still picture, or the style of paper
    for a film.

    `alone` is the reader if each of its frames is a picture of its own, or None.
    """
    if alone is not None:
        check_single(target, alone.frames)
    if orbit and not film:
        raise ArgumentError("orbit", expected="a film", found=target.name, advice=NAME_A_FILM)
    if style.name == "paper" and film:
        raise ArgumentError(
            "style", expected="screen for a film", found=style.name, advice="name a .png"
        )


def _plan_shots(
    pictures: list[list[Cell]], camera: CameraOptions
) -> list[tuple[list[Cell], Viewpoint]]:
    """Return the frames and the viewpoint of each picture."""
    if not camera.orbit:
        return [(cells, camera.viewpoint) for cells in pictures]
    if len(pictures) == 1:
        pictures = pictures * ORBIT_PICTURES
    angles = (2 * np.pi * np.arange(len(pictures)) / len(pictures)).tolist()
    turned = map(camera.viewpoint.turned, angles)
    return list(zip(pictures, turned, strict=True))


def _reported(
    pictures: Iterator[Uint8Array], total: int, progress: Progress | None
) -> Iterator[Uint8Array]:
    step = StepCounter(progress, total)
    for picture in pictures:
        yield picture
        step()


def _name_after(reader: SceneReader, film: bool) -> Path:
    """Return a file name from the sequence, the contents and the frames."""
    first = reader.frames[0]
    last = reader.frames[-1]
    what = "" if reader.contents == ("grid",) else f"_{'_'.join(reader.contents)}"
    numbers = f"{first:06d}" if first == last else f"{first:06d}-{last:06d}"
    return Path(
        f"{reader.data.sequence.name or 'carlasc'}{what}_{numbers}.{'mp4' if film else 'png'}"
    )


def _notes_of(readers: Sequence[SceneReader], pictures: list[list[Cell]]) -> dict[str, None]:
    """Return the notes of the readers and, for a single picture, notes on empty parts; each note
    once, in order.
    """
    notes = [note for reader in readers for note in reader.notes]
    for cell in pictures[0] if len(pictures) == 1 else []:
        drawings = (
            (content, cell.renderer.draw(content, cell.frame))
            for content in cell.renderer.reader.contents
        )
        notes += [f"{content}: {drawing.note}" for content, drawing in drawings if drawing.note]
    return dict.fromkeys(notes)
