"""The layout of a picture: panels, their titles and the legend, without overlaps and without
clipping.

The layout is computed first, so that every panel is rendered at its final size. Titles are above
the panels; the legend is in a column to the right of square panels, and in rows below wide ones.
Captions, which replace titles, are below the panels. The font is the one that Pillow includes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from carlasc.core.arrays import Uint8Array
from carlasc.core.classes import Color
from carlasc.errors import import_extra
from carlasc.viewing.colors import Entry
from carlasc.viewing.rendering.styles import check_size

INK = (40, 42, 48)
FAINT = (110, 114, 122)
NO_SWATCH = (-1, -1, -1)
"""The colour of an entry that has a name only."""

MOST_LINES = 3  # of a caption


@dataclass(frozen=True)
class Box:
    """A rectangle of the page, in pixels from the top left corner of the page."""

    x: int
    y: int
    width: int
    height: int


@dataclass(frozen=True)
class Page:
    """The positions of all parts of a picture.

    Attributes:
        size: (width, height) of the whole picture.
        font_size: pixels.
        panels: rectangle of each panel.
        titles: rectangle of each panel's title or caption; empty if there are none.
        entry_boxes: rectangle of each entry of the legend: a swatch and a name.
        entries: the legend. Entries without space are left out; the last entry then gives their
            number.
    """

    size: tuple[int, int]
    font_size: int
    panels: list[Box]
    titles: list[Box]
    entry_boxes: list[Box]
    entries: list[Entry]


def plan_page(
    size: tuple[int, int],
    panels: int,
    *,
    titled: bool,
    legend: Sequence[Entry],
    aspect: float = 16 / 9,
    captions: Sequence[str] = (),
    columns: int | None = None,
    font_size: int | None = None,
) -> Page:
    """Compute the layout of a picture.

    Args:
        size: (width, height) of the whole picture, pixels.
        panels: number of panels.
        titled: whether they have titles.
        legend: entries of the legend; empty for no legend.
        aspect: preferred width over height of a panel.
        captions: texts below the panels instead of titles, in as many lines as needed. Empty for
            none.
        columns: number of panels in a row; None takes the number with which panels are largest.
        font_size: pixels; None takes one by the size of the picture.

    Raises:
        ArgumentError: a size that is too small or too large.
    """
    check_size(size)
    width, height = size
    if font_size is None:
        font_size = int(np.clip(round(min(width / 72, height / 40)), 9, 40))
    font = font_of(font_size)
    entries, entry_boxes, area = _place_legend(size, font, list(legend), panels, aspect, columns)
    columns, rows = _tiling(area.width, area.height, panels, aspect, columns)
    gap = max(2, font_size // 2) if panels > 1 else 0
    title_height = round(font_size * 1.9) if titled else 0
    if captions:
        room = area.width / columns - 2 * gap
        lines = max(len(wrap_text(text, font, room)) for text in captions)
        title_height = round(font_size * 0.4) + lines * line_height(font)
    boxes = []
    titles = []
    for number in range(panels):
        column = number % columns
        row = number // columns
        left, right = (round(area.width * c / columns) for c in (column, column + 1))
        top, bottom = (round(area.height * r / rows) for r in (row, row + 1))
        if captions:  # all panels have the same size, so that their contents can be compared
            left, right = left + gap, left + max(gap + 1, area.width // columns - gap)
            bottom = top + area.height // rows
        else:
            left += gap if column else 0
            right -= gap if column + 1 < columns else 0
        width = max(1, right - left)
        height = max(1, bottom - top - title_height)
        title, panel = (height, 0) if captions else (0, title_height)
        titles.append(Box(area.x + left, area.y + top + title, right - left, title_height))
        boxes.append(Box(area.x + left, area.y + top + panel, width, height))
    return Page(size, font_size, boxes, titles if titled or captions else [], entry_boxes, entries)


def draw_page(
    page: Page,
    pictures: Sequence[Uint8Array],
    titles: Sequence[str] = (),
    notes: Sequence[str | None] = (),
    *,
    wrapped: bool = False,
) -> Uint8Array:
    """Return the whole picture, (height, width, 3) uint8.

    Args:
        page: the layout.
        pictures: the picture of each panel, in the panel's size.
        titles: the title or caption of each panel; shortened if it is too long.
        notes: for each panel, a line to write into its middle, or None.
        wrapped: whether titles are captions, which are broken into lines.
    """
    canvas = np.full((page.size[1], page.size[0], 3), 255, np.uint8)
    for box, picture in zip(page.panels, pictures, strict=True):
        canvas[box.y : box.y + box.height, box.x : box.x + box.width] = picture
    image = import_extra("PIL.Image", "render").fromarray(canvas)
    draw = import_extra("PIL.ImageDraw", "render").Draw(image)
    font = font_of(page.font_size)

    def write(box: Box, middle: float, text: str, color: Color) -> None:
        draw.text((box.x + box.width / 2, middle), text, color, font, anchor="mm")

    for box, title in zip(page.titles, titles, strict=False):
        if wrapped:
            top = box.y + round(font.size * 0.4)
            line = line_height(font)
            for number, text in enumerate(wrap_text(title, font, box.width)):
                write(box, top + (number + 0.5) * line, text, INK)
        else:
            write(box, box.y + box.height / 2, shorten(title, font, box.width - 8), INK)
    for box, note in zip(page.panels, notes, strict=False):
        if note:
            write(box, box.y + box.height / 2, shorten(note, font, box.width - 8), FAINT)
    swatch, gap = _swatch(font)
    for entry, box in zip(page.entries, page.entry_boxes, strict=True):
        left = box.x
        middle = box.y + box.height / 2
        if entry.color != NO_SWATCH:
            top = round(middle - swatch / 2)
            outline = tuple(round(value * 0.7) for value in entry.color)
            corners = (left, top, left + swatch, top + swatch)
            draw.rounded_rectangle(corners, max(2, font.size // 6), entry.color, outline)
        draw.text((left + swatch + gap, middle), entry.name, INK, font, anchor="lm")
    return np.asarray(image)


def _place_legend(
    size: tuple[int, int],
    font: Any,
    entries: list[Entry],
    panels: int,
    aspect: float,
    wanted: int | None,
) -> tuple[list[Entry], list[Box], Box]:
    """Return the entries with space, their rectangles, and the rest of the page for the panels."""
    width, height = size
    page = Box(0, 0, width, height)
    if not entries:
        return [], [], page
    columns, rows = _tiling(width, height, panels, aspect, wanted)
    pad = font.size
    line = line_height(font)
    widths = [entry_width(entry, font) for entry in entries]
    step = max(widths) + pad

    def columns_in(height: int) -> int:
        """Return how many columns hold all entries; a column has at least one row."""
        return -(-len(entries) // max(1, (height - 2 * pad) // line))

    def placed_in(room: Box) -> list[Box]:
        """Return the rectangles of all entries, in columns in the middle of a rectangle that is
        large enough.
        """
        columns = columns_in(room.height)
        rows = -(-len(entries) // columns)
        left = room.x + (room.width - columns * step + pad) // 2
        top = room.y + (room.height - rows * line) // 2
        return [
            Box(left + i // rows * step, top + i % rows * line, width, line)
            for i, width in enumerate(widths)
        ]

    across = width // columns
    down = height // rows
    last = Box(width - across, height - down, across, down)  # cell of the tiling
    if columns * rows > panels and columns_in(last.height) * step + pad <= last.width:
        return entries, placed_in(last), page
    # the largest width that the panels can have
    picture = min(round(aspect * columns / rows * height), width)
    beside = columns_in(height) * step + pad
    if picture + beside <= width or (
        aspect * columns / rows <= 1.2 and beside <= 0.3 * width < 0.5 * height
    ):
        left = max(0, width - picture - beside) // 2
        picture = min(picture, width - beside)
        placed = placed_in(Box(left + picture, 0, beside, height))
        return entries, placed, Box(left, 0, picture, height)
    return _place_below(size, font, entries)


def _place_below(
    size: tuple[int, int], font: Any, entries: list[Entry]
) -> tuple[list[Entry], list[Box], Box]:
    """Place entries in centred rows at the bottom, in at most 40% of the page; the last entry
    counts those left out.
    """
    width, height = size
    pad = font.size
    line = line_height(font)
    for room in range(len(entries), 0, -1):
        shown = entries
        if room < len(entries):
            shown = [*entries[: room - 1], Entry(f"and {len(entries) - room + 1} more", NO_SWATCH)]
        rows = wrap_entries([entry_width(entry, font) for entry in shown], width - 2 * pad, pad)
        if len(rows) * line <= max(line, 0.4 * height):
            break
    top = height - len(rows) * line - pad // 2
    placed = _place_rows(rows, font, top, lambda length: (width - length) // 2)
    return shown, placed, Box(0, 0, width, max(1, top - pad // 2))


def _place_rows(
    rows: Sequence[Sequence[int]], font: Any, top: int, left_of: Callable[[int], int]
) -> list[Box]:
    """Return the rectangles of entries in rows.

    Args:
        rows: width of each entry of each row, pixels.
        font: the font.
        top: upper edge of the first row.
        left_of: returns the left edge of a row of a length.
    """
    placed = []
    line = line_height(font)
    for number, row in enumerate(rows):
        x = left_of(sum(row) + font.size * (len(row) - 1))
        for width in row:
            placed.append(Box(max(0, x), top + number * line, width, line))
            x += width + font.size
    return placed


def _tiling(
    width: int, height: int, panels: int, aspect: float, wanted: int | None
) -> tuple[int, int]:
    """Return the given number of columns and its rows; by default those with the largest panels,
    and among equal ones the most columns.
    """

    def scale(columns: int) -> float:
        rows = -(-panels // columns)
        return min(width / columns / aspect, height / rows)

    columns = min(wanted, panels) if wanted else max(range(panels, 0, -1), key=scale)
    return columns, -(-panels // columns)


def font_of(size: int) -> Any:
    """Return the font of a size in pixels."""
    return import_extra("PIL.ImageFont", "render").load_default(size)


def line_height(font: Any) -> int:
    """Return the height of a line of text in pixels."""
    return round(font.size * 1.6)


def _swatch(font: Any) -> tuple[int, int]:
    """Return the width of a swatch, and its distance from the name, in pixels."""
    return round(font.size * 0.95), round(font.size * 0.45)


def entry_width(entry: Entry, font: Any) -> int:
    """Return the width of an entry of a legend in pixels: a swatch and a name."""
    return sum(_swatch(font)) + int(np.ceil(font.getlength(entry.name)))


def shorten(text: str, font: Any, room: float) -> str:
    """Return a text, shortened with three dots to fit into a width in pixels."""
    if font.getlength(text) <= room:
        return text
    while text and font.getlength(f"{text}...") > room:
        text = text[:-1]
    return f"{text}..."


def wrap_text(text: str, font: Any, room: float) -> list[str]:
    """Return the lines of a text that fit into a width in pixels, at most `MOST_LINES`; the last
    one is shortened if needed.
    """
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and font.getlength(longer) > room:
            lines.append(word)
        else:
            lines[-1] = longer
    if len(lines) > MOST_LINES:
        lines = [*lines[: MOST_LINES - 1], " ".join(lines[MOST_LINES - 1 :])]
    return [shorten(line, font, room) for line in lines]


def wrap_entries(widths: Sequence[int], room: int, gap: int) -> list[list[int]]:
    """Break the entries of a legend into as few rows as possible, of about equal length.

    Args:
        widths: width of each entry, pixels.
        room: greatest width of a row, pixels.
        gap: distance between two entries of a row, pixels.

    Returns:
        The widths of the entries of each row.
    """
    widest = _fill(widths, room, gap)
    narrower = (_fill(widths, limit, gap) for limit in range(max(widths), room, 4))
    return next((rows for rows in narrower if len(rows) == len(widest)), widest)


def _fill(widths: Sequence[int], limit: int, gap: int) -> list[list[int]]:
    rows: list[list[int]] = [[]]
    used = 0
    for width in widths:
        if rows[-1] and used + gap + width > limit:
            rows.append([])
            used = 0
        used += width + (gap if rows[-1] else 0)
        rows[-1].append(width)
    return rows


def draw_legend(entries: Sequence[Entry], font_size: int, most_width: int) -> Uint8Array:
    """Draw a legend alone: entries in rows on white, without a wide margin.

    Args:
        entries: at least one.
        font_size: pixels.
        most_width: the width in pixels that rows may have. An entry that is wider has a row of its
            own.

    Returns:
        (height, width, 3) uint8 RGB.
    """
    font = font_of(font_size)
    margin = max(2, font_size // 4)
    widths = [entry_width(entry, font) for entry in entries]
    rows = wrap_entries(widths, most_width - 2 * margin, font_size)
    placed = _place_rows(rows, font, margin, lambda _: margin)
    width = max(box.x + box.width for box in placed) + margin
    height = placed[-1].y + placed[-1].height + margin
    return draw_page(Page((width, height), font_size, [], [], placed, list(entries)), [])
