"""The layout of a picture: panels, their titles and the legend, without overlaps and without
clipping.

The layout is computed first, so that every panel is rendered at its final size. Titles are above
the panels; the legend is in a column to the right of square panels, and in rows below wide ones.
Captions, which replace titles, are below the panels. The font is the one that Pillow includes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from carlasc.core.arrays import Uint8Array
from carlasc.errors import import_extra
from carlasc.viewing.colors import Entry
from carlasc.viewing.rendering.styles import check_size

INK, FAINT = (40, 42, 48), (110, 114, 122)
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
    entries, positions, area = _place_legend(size, font_size, list(legend), panels, aspect, columns)
    columns, rows = _tiling(area.width, area.height, panels, aspect, columns)
    gap = max(2, font_size // 2) if panels > 1 else 0
    title_height = round(font_size * 1.9) if titled else 0
    if captions:
        room, font = area.width / columns - 2 * gap, font_of(font_size)
        lines = max(len(wrap_text(text, font, room)) for text in captions)
        title_height = round(font_size * 0.4) + lines * line_height(font_size)
    boxes, titles = [], []
    for number in range(panels):
        column, row = number % columns, number // columns
        left, right = (round(area.width * c / columns) for c in (column, column + 1))
        top, bottom = (round(area.height * r / rows) for r in (row, row + 1))
        if captions:  # all panels have the same size, so that their contents can be compared
            left, right = left + gap, left + max(gap + 1, area.width // columns - gap)
            bottom = top + area.height // rows
        else:
            left, right = (
                left + (gap if column else 0),
                right - (gap if column + 1 < columns else 0),
            )
        width, height = max(1, right - left), max(1, bottom - top - title_height)
        title, panel = (height, 0) if captions else (0, title_height)
        titles.append(Box(area.x + left, area.y + top + title, right - left, title_height))
        boxes.append(Box(area.x + left, area.y + top + panel, width, height))
    font = font_of(font_size) if entries else None
    entry_boxes = [
        Box(x, y, entry_width(entry, font, font_size), line_height(font_size))
        for entry, (x, y) in zip(entries, positions, strict=True)
    ]
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
    image_module = import_extra("PIL.Image", "render")
    canvas = np.full((page.size[1], page.size[0], 3), 255, np.uint8)
    for box, picture in zip(page.panels, pictures, strict=True):
        canvas[box.y : box.y + box.height, box.x : box.x + box.width] = picture
    image = image_module.fromarray(canvas)
    draw, font = import_extra("PIL.ImageDraw", "render").Draw(image), font_of(page.font_size)
    for box, title in zip(page.titles, titles, strict=False):
        line, top = line_height(page.font_size), box.y + round(page.font_size * 0.4)
        lines = (
            wrap_text(title, font, box.width) if wrapped else [shorten(title, font, box.width - 8)]
        )
        for number, text in enumerate(lines):
            middle = top + (number + 0.5) * line if wrapped else box.y + box.height / 2
            draw.text((box.x + box.width / 2, middle), text, INK, font, anchor="mm")
    for box, note in zip(page.panels, notes, strict=False):
        if note:
            text = shorten(note, font, box.width - 8)
            draw.text(
                (box.x + box.width / 2, box.y + box.height / 2), text, FAINT, font, anchor="mm"
            )
    for entry, box in zip(page.entries, page.entry_boxes, strict=True):
        draw_entry(draw, font, page.font_size, entry, box.x, box.y + box.height / 2)
    return np.asarray(image)


def _place_legend(
    size: tuple[int, int],
    font_size: int,
    entries: list[Entry],
    panels: int,
    aspect: float,
    wanted: int | None,
) -> tuple[list[Entry], list[tuple[int, int]], Box]:
    """Return the entries with space, their positions, and the rest of the page for the panels."""
    width, height = size
    page = Box(0, 0, width, height)
    if not entries:
        return [], [], page
    columns, rows = _tiling(width, height, panels, aspect, wanted)
    font, pad = font_of(font_size), font_size
    widest = max(entry_width(entry, font, font_size) for entry in entries)
    if columns * rows > panels:  # the last cell of the tiling is free
        room = Box(
            width - width // columns, height - height // rows, width // columns, height // rows
        )
        if (
            _legend_columns(len(entries), room.height - 2 * pad, font_size) * (widest + pad) + pad
            <= room.width
        ):
            return entries, _place_in_columns(room, font_size, len(entries), widest), page
    # the largest width that the panels can have
    picture = min(round(aspect * columns / rows * height), width)
    beside = _legend_columns(len(entries), height - 2 * pad, font_size) * (widest + pad) + pad
    if picture + beside <= width or (
        aspect * columns / rows <= 1.2 and beside <= 0.3 * width < 0.5 * height
    ):
        left = max(0, width - picture - beside) // 2
        picture = min(picture, width - beside)
        room = Box(left + picture, 0, beside, height)
        return (
            entries,
            _place_in_columns(room, font_size, len(entries), widest),
            Box(left, 0, picture, height),
        )
    return _place_below(size, font_size, entries)


def _legend_columns(entries: int, height: int, font_size: int) -> int:
    """Return how many columns hold all entries; a column has at least one row."""
    return -(-entries // max(1, height // line_height(font_size)))


def _place_in_columns(
    room: Box, font_size: int, entries: int, widest: int
) -> list[tuple[int, int]]:
    """Return positions of all entries, in columns in the middle of a rectangle that is large
    enough.
    """
    pad, line = font_size, line_height(font_size)
    columns = _legend_columns(entries, room.height - 2 * pad, font_size)
    rows = -(-entries // columns)
    left = room.x + (room.width - columns * (widest + pad) + pad) // 2
    top = room.y + (room.height - rows * line) // 2
    return [(left + (i // rows) * (widest + pad), top + (i % rows) * line) for i in range(entries)]


def _place_below(
    size: tuple[int, int], font_size: int, entries: list[Entry]
) -> tuple[list[Entry], list[tuple[int, int]], Box]:
    """Place entries in centred rows at the bottom, in at most 40 % of the page; the last entry
    counts those left out.
    """
    width, height = size
    font, pad, line = font_of(font_size), font_size, line_height(font_size)
    rows_allowed = max(1, int(0.4 * height) // line)
    lines: list[list[int]] = []
    for room in range(len(entries), 0, -1):
        shown = entries
        if room < len(entries):
            shown = [*entries[: room - 1], Entry(f"and {len(entries) - room + 1} more", NO_SWATCH)]
        widths = [entry_width(entry, font, font_size) for entry in shown]
        lines = wrap_entries(widths, width - 2 * pad, pad)
        if len(lines) <= rows_allowed:
            break
    top = height - len(lines) * line - pad // 2
    positions = []
    for number, row in enumerate(lines):
        x = (width - sum(widths[i] for i in row) - pad * (len(row) - 1)) // 2
        for i in row:
            positions.append((max(0, x), top + number * line))
            x += widths[i] + pad
    return shown, positions, Box(0, 0, width, max(1, top - pad // 2))


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


def line_height(size: int) -> int:
    """Return the height of a line of text in pixels."""
    return round(size * 1.6)


def entry_width(entry: Entry, font: Any, size: int) -> int:
    """Return the width of an entry of a legend in pixels: a swatch and a name."""
    return round(size * 0.95) + round(size * 0.45) + int(np.ceil(font.getlength(entry.name)))


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
        The numbers of the entries of each row.
    """
    fewest = len(_fill(widths, room, gap))
    limits = range(max(widths), room, 4)
    return next(
        (rows for limit in limits if len(rows := _fill(widths, limit, gap)) == fewest),
        _fill(widths, room, gap),
    )


def _fill(widths: Sequence[int], limit: int, gap: int) -> list[list[int]]:
    rows: list[list[int]] = [[]]
    used = 0
    for index, width in enumerate(widths):
        if rows[-1] and used + gap + width > limit:
            rows.append([])
            used = 0
        used += width + (gap if rows[-1] else 0)
        rows[-1].append(index)
    return rows


def draw_entry(draw: Any, font: Any, size: int, entry: Entry, left: int, middle: float) -> None:
    """Draw an entry of a legend, with its left edge and its vertical middle at a position in
    pixels.
    """
    swatch = round(size * 0.95)
    top = round(middle - swatch / 2)
    if entry.color != NO_SWATCH:
        outline = tuple(round(value * 0.7) for value in entry.color)
        draw.rounded_rectangle(
            (left, top, left + swatch, top + swatch), max(2, size // 6), entry.color, outline
        )
    draw.text((left + swatch + round(size * 0.45), middle), entry.name, INK, font, anchor="lm")


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
    font, line, margin = font_of(font_size), line_height(font_size), max(2, font_size // 4)
    widths = [entry_width(entry, font, font_size) for entry in entries]
    rows = wrap_entries(widths, most_width - 2 * margin, font_size)
    lengths = [sum(widths[i] for i in row) + font_size * (len(row) - 1) for row in rows]
    size = (max(lengths) + 2 * margin, len(rows) * line + 2 * margin)
    image = import_extra("PIL.Image", "render").new("RGB", size, (255, 255, 255))
    draw = import_extra("PIL.ImageDraw", "render").Draw(image)
    for number, row in enumerate(rows):
        left = margin
        for i in row:
            draw_entry(draw, font, font_size, entries[i], left, margin + (number + 0.5) * line)
            left += widths[i] + font_size
    return np.asarray(image)
