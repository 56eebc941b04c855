"""Several panels in one picture: sources or frames beside each other, from the same camera, each with a caption."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from string import ascii_lowercase

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import ArgumentError, MissingDataError
from carlasc.viewing.colors import Entry
from carlasc.viewing.rendering.cameras import Viewpoint
from carlasc.viewing.rendering.frames import FrameRenderer
from carlasc.viewing.rendering.pictures import draw_panels
from carlasc.viewing.rendering.styles import Style

MOST_PANELS = 64
_VIEW_NAMES = {"perspective": "from behind", "bev": "from above"}


@dataclass(frozen=True, eq=False)
class Cell:
    """One frame of one source.

    Attributes:
        renderer: draws the source.
        frame: frame number.
    """

    renderer: FrameRenderer
    frame: int


@dataclass(frozen=True, eq=False)
class PictureRenderer:
    """Draws pictures of cells.

    Attributes:
        style: size and type.
        legend: entries of the legend, the same in all pictures; empty for no legend.
        captions: a text for each panel, which is put below it; empty for the titles of the contents.
        columns: number of panels in a row; None takes the number with which panels are largest.
    """

    style: Style
    legend: list[Entry] = field(default_factory=list)
    captions: tuple[str, ...] = ()
    columns: int | None = None

    def render(self, cells: Sequence[Cell], viewpoint: Viewpoint) -> NDArray[np.uint8]:
        """Return the picture of some cells, (H, W, 3) uint8."""
        panels = [panel for cell in cells for panel in cell.renderer.panels(cell.frame)]
        if self.captions:
            extent = np.concatenate([panel.drawing.extent for panel in panels])
            panels = [
                replace(panel, title=caption, fixed_view=panel.fixed_view or (extent, np.eye(4)))
                for panel, caption in zip(panels, self.captions, strict=True)
            ]
        return draw_panels(
            panels,
            viewpoint=viewpoint,
            size=self.style.size,
            legend=self.legend,
            axes=cells[0].renderer.reader.axes,
            captioned=bool(self.captions),
            columns=self.columns,
            font_size=self.style.font_size,
        )


def plan_cells(renderers: Sequence[FrameRenderer], film: bool) -> list[list[Cell]]:
    """Return the cells of each picture: of a film, one frame of every source; otherwise all frames of every source.

    Raises:
        ArgumentError: sources of different handedness, or more panels than a picture can have.
        MissingDataError: the sources of a film have no frame in common.
    """
    axes = {renderer.reader.axes for renderer in renderers}
    if len(axes) > 1:
        raise ArgumentError("source", expected="sources with the same axes", found="left-handed and right-handed ones")
    if film:
        frames = [frame for frame in renderers[0].reader.frames if all(frame in r.reader.frames for r in renderers)]
        if not frames:
            raise MissingDataError(renderers[0].reader.path, expected="frames that all sources have", found="none")
        pictures = [[Cell(renderer, frame) for renderer in renderers] for frame in frames]
    else:
        pictures = [[Cell(renderer, frame) for renderer in renderers for frame in renderer.reader.frames]]
    count = len(_parts_of(pictures[0]))
    if count > MOST_PANELS:
        raise ArgumentError(
            "frames", expected=f"at most {MOST_PANELS} panels", found=str(count), advice="choose fewer with `every`"
        )
    return pictures


def columns_of(cells: Sequence[Cell]) -> int | None:
    """Return the panels in a row: those of one source if there are several sources with several panels; otherwise None."""
    sources = len({id(cell.renderer) for cell in cells})
    each = len(_parts_of(cells)) // sources
    return each if sources > 1 and each > 1 else None


def caption_panels(cells: Sequence[Cell], texts: Sequence[str], film: bool) -> tuple[str, ...]:
    """Return the captions of all panels: a letter in brackets, and a text.

    Args:
        cells: what is drawn.
        texts: one for each panel; empty takes what differs between the panels: sequence, grid, frame, content and view.
        film: whether the frames follow each other in a film, so that they are not named.

    Raises:
        ArgumentError: another number of texts than of panels.
    """
    parts = _parts_of(cells)
    if texts and len(texts) != len(parts):
        raise ArgumentError("captions", expected=f"one for each of the {len(parts)} panels", found=str(len(texts)))
    if not texts:
        rows = [row[:2] + row[3:] for row in parts] if film else parts
        differing = [column for column in range(len(rows[0])) if len({row[column] for row in rows}) > 1]
        texts = [", ".join(row[column] for column in differing if row[column]) for row in rows]
    return tuple(f"({_letter(number)}) {text}".strip() for number, text in enumerate(texts))


def _parts_of(cells: Sequence[Cell]) -> list[tuple[str, ...]]:
    """Return sequence, grid, frame, content and view of each panel."""
    return [
        (reader.name, reader.data.grid, f"frame {cell.frame}", _content_name(cell, content), _VIEW_NAMES[view])
        for cell in cells
        for reader in [cell.renderer.reader]
        for content in reader.contents
        for view in cell.renderer.views
    ]


def _content_name(cell: Cell, content: str) -> str:
    return content if content == "grid" and cell.renderer.reader.truth is None else cell.renderer.title(content)


def _letter(number: int) -> str:
    """Return a, b, ... z, aa, ab, ..."""
    first, last = divmod(number, len(ascii_lowercase))
    return (ascii_lowercase[first - 1] if first else "") + ascii_lowercase[last]
