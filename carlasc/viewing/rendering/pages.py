"""The layout of a picture: panels, their titles and the legend, without overlaps and without clipping.

The layout is computed first, so that every panel is rendered at its final size. Titles are above the panels; the legend is in a column
to the right of square panels, and in rows below wide ones. The font is the one that Pillow includes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import ArgumentError, import_extra
from carlasc.viewing.colors import Entry

SMALLEST = (64, 64)
LARGEST = 16384
_INK, _FAINT = (40, 42, 48), (110, 114, 122)


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
        titles: rectangle of each panel's title; empty if there are no titles.
        entry_boxes: rectangle of each entry of the legend: a swatch and a name.
        entries: the legend. Entries for which there is no space are left out; the last entry then says how many.
    """

    size: tuple[int, int]
    font_size: int
    panels: list[Box]
    titles: list[Box]
    entry_boxes: list[Box]
    entries: list[Entry]


def plan_page(
    size: tuple[int, int], panels: int, *, titled: bool, legend: Sequence[Entry], aspect: float = 16 / 9
) -> Page:
    """Compute the layout of a picture.

    Args:
        size: (width, height) of the whole picture, pixels.
        panels: number of panels.
        titled: whether they have titles.
        legend: entries of the legend; empty for no legend.
        aspect: preferred width over height of a panel.

    Raises:
        ArgumentError: a size that is too small or too large.
    """
    check_size(size)
    width, height = size
    font_size = int(np.clip(round(min(width / 72, height / 40)), 9, 40))
    entries, positions, area = _place_legend(size, font_size, list(legend), panels, aspect)
    columns, rows = _tiling(area.width, area.height, panels, aspect)
    title_height = round(font_size * 1.9) if titled else 0
    gap = max(2, font_size // 2) if panels > 1 else 0
    boxes, titles = [], []
    for number in range(panels):
        column, row = number % columns, number // columns
        left, right = (round(area.width * c / columns) for c in (column, column + 1))
        top, bottom = (round(area.height * r / rows) for r in (row, row + 1))
        left, right = left + (gap if column else 0), right - (gap if column + 1 < columns else 0)
        titles.append(Box(area.x + left, area.y + top, right - left, title_height))
        boxes.append(
            Box(area.x + left, area.y + top + title_height, max(1, right - left), max(1, bottom - top - title_height))
        )
    font = _font(font_size) if entries else None
    entry_boxes = [
        Box(x, y, _entry_width(entry, font, font_size), _line(font_size))
        for entry, (x, y) in zip(entries, positions, strict=True)
    ]
    return Page(size, font_size, boxes, titles if titled else [], entry_boxes, entries)


def check_size(size: tuple[int, int]) -> None:
    """Raise ArgumentError if (width, height) in pixels is not a size that a picture can have."""
    if len(size) != 2 or not all(low <= value <= LARGEST for low, value in zip(SMALLEST, size, strict=True)):
        raise ArgumentError(
            "size",
            expected=f"{SMALLEST[0]}x{SMALLEST[1]} to {LARGEST}x{LARGEST} pixels",
            found="x".join(map(str, size)),
        )


def draw_page(
    page: Page, pictures: Sequence[NDArray[np.uint8]], titles: Sequence[str] = (), notes: Sequence[str | None] = ()
) -> NDArray[np.uint8]:
    """Return the whole picture, (height, width, 3) uint8.

    Args:
        page: the layout.
        pictures: the picture of each panel, in the panel's size.
        titles: the title of each panel; shortened if it is too long.
        notes: for each panel, a line to write into its middle, or None.
    """
    image_module = import_extra("PIL.Image", "render")
    canvas = np.full((page.size[1], page.size[0], 3), 255, np.uint8)
    for box, picture in zip(page.panels, pictures, strict=True):
        canvas[box.y : box.y + box.height, box.x : box.x + box.width] = picture
    image = image_module.fromarray(canvas)
    draw, font = import_extra("PIL.ImageDraw", "render").Draw(image), _font(page.font_size)
    for box, title in zip(page.titles, titles, strict=False):
        text = _shortened(title, font, box.width - 8)
        draw.text((box.x + box.width / 2, box.y + box.height / 2), text, _INK, font, anchor="mm")
    for box, note in zip(page.panels, notes, strict=False):
        if note:
            text = _shortened(note, font, box.width - 8)
            draw.text((box.x + box.width / 2, box.y + box.height / 2), text, _FAINT, font, anchor="mm")
    for entry, box in zip(page.entries, page.entry_boxes, strict=True):
        _draw_entry(draw, font, page.font_size, entry, box)
    return np.asarray(image)


def _draw_entry(draw: Any, font: Any, size: int, entry: Entry, box: Box) -> None:
    x, swatch = box.x, round(size * 0.95)
    middle = box.y + box.height / 2
    top = round(middle - swatch / 2)
    if entry.color != _NO_SWATCH:
        draw.rounded_rectangle(
            (x, top, x + swatch, top + swatch), max(2, size // 6), entry.color, _outline(entry.color)
        )
    draw.text((x + swatch + round(size * 0.45), middle), entry.name, _INK, font, anchor="lm")


_NO_SWATCH = (-1, -1, -1)


def _outline(color: tuple[int, int, int]) -> tuple[int, int, int]:
    red, green, blue = (round(value * 0.7) for value in color)
    return red, green, blue


def _place_legend(
    size: tuple[int, int], font_size: int, entries: list[Entry], panels: int, aspect: float
) -> tuple[list[Entry], list[tuple[int, int]], Box]:
    """Return the entries for which there is space, their positions, and the part of the page that is left for the panels."""
    width, height = size
    page = Box(0, 0, width, height)
    if not entries:
        return [], [], page
    columns, rows = _tiling(width, height, panels, aspect)
    font, pad = _font(font_size), font_size
    widest = max(_entry_width(entry, font, font_size) for entry in entries)
    if columns * rows > panels:  # the last cell of the tiling is free
        room = Box(width - width // columns, height - height // rows, width // columns, height // rows)
        if _legend_columns(len(entries), room.height - 2 * pad, font_size) * (widest + pad) + pad <= room.width:
            return entries, _place_in_columns(room, font_size, len(entries), widest), page
    picture = min(round(aspect * columns / rows * height), width)  # the largest width that the panels can have
    beside = _legend_columns(len(entries), height - 2 * pad, font_size) * (widest + pad) + pad
    if picture + beside <= width or (aspect * columns / rows <= 1.2 and beside <= 0.3 * width < 0.5 * height):
        left = max(0, width - picture - beside) // 2
        picture = min(picture, width - beside)
        room = Box(left + picture, 0, beside, height)
        return entries, _place_in_columns(room, font_size, len(entries), widest), Box(left, 0, picture, height)
    return _place_below(size, font_size, entries)


def _legend_columns(entries: int, height: int, font_size: int) -> int:
    """Return how many columns hold all entries; a column has at least one row."""
    return -(-entries // max(1, height // _line(font_size)))


def _place_in_columns(room: Box, font_size: int, entries: int, widest: int) -> list[tuple[int, int]]:
    """Return positions of all entries, in columns in the middle of a rectangle that is large enough."""
    pad, line = font_size, _line(font_size)
    columns = _legend_columns(entries, room.height - 2 * pad, font_size)
    rows = -(-entries // columns)
    left = room.x + (room.width - columns * (widest + pad) + pad) // 2
    top = room.y + (room.height - rows * line) // 2
    return [(left + (i // rows) * (widest + pad), top + (i % rows) * line) for i in range(entries)]


def _place_below(
    size: tuple[int, int], font_size: int, entries: list[Entry]
) -> tuple[list[Entry], list[tuple[int, int]], Box]:
    """Place entries in centred rows at the bottom, in at most 40 % of the page; the last entry counts those left out."""
    width, height = size
    font, pad, line = _font(font_size), font_size, _line(font_size)
    rows_allowed = max(1, int(0.4 * height) // line)
    lines: list[list[int]] = []
    for room in range(len(entries), 0, -1):
        shown = _cut(entries, room)
        widths = [_entry_width(entry, font, font_size) for entry in shown]
        lines = _wrap(widths, width - 2 * pad, pad)
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


def _cut(entries: list[Entry], room: int) -> list[Entry]:
    if len(entries) <= room:
        return entries
    return [*entries[: room - 1], Entry(f"and {len(entries) - room + 1} more", _NO_SWATCH)]


def _wrap(widths: list[int], room: int, gap: int) -> list[list[int]]:
    """Break entries into as few rows as possible, of about equal length."""
    fewest = len(_fill(widths, room, gap))
    limits = range(max(widths), room, 4)
    return next(
        (rows for limit in limits if len(rows := _fill(widths, limit, gap)) == fewest), _fill(widths, room, gap)
    )


def _fill(widths: list[int], limit: int, gap: int) -> list[list[int]]:
    rows: list[list[int]] = [[]]
    used = 0
    for index, width in enumerate(widths):
        if rows[-1] and used + gap + width > limit:
            rows.append([])
            used = 0
        used += width + (gap if rows[-1] else 0)
        rows[-1].append(index)
    return rows


def _tiling(width: int, height: int, panels: int, aspect: float) -> tuple[int, int]:
    """Return the columns and rows in which panels of an aspect are largest; of equal ones, those with more columns."""

    def scale(columns: int) -> float:
        rows = -(-panels // columns)
        return min(width / columns / aspect, height / rows)

    columns = max(range(panels, 0, -1), key=scale)
    return columns, -(-panels // columns)


def _line(font_size: int) -> int:
    return round(font_size * 1.6)


def _entry_width(entry: Entry, font: Any, size: int) -> int:
    return round(size * 0.95) + round(size * 0.45) + int(np.ceil(font.getlength(entry.name)))


def _shortened(text: str, font: Any, room: float) -> str:
    if font.getlength(text) <= room:
        return text
    while text and font.getlength(f"{text}...") > room:
        text = text[:-1]
    return f"{text}..."


def _font(size: int) -> Any:
    return import_extra("PIL.ImageFont", "render").load_default(size)
