"""Texts of a picture and the entries of its legend: their sizes, and how they are drawn. The font is the one that Pillow includes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlasc.errors import import_extra
from carlasc.viewing.colors import Entry

INK, FAINT = (40, 42, 48), (110, 114, 122)
NO_SWATCH = (-1, -1, -1)
"""The colour of an entry that has a name only."""

MOST_LINES = 3  # of a caption


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
    """Return a text that fits into a width in pixels; what was left out is shown by three dots."""
    if font.getlength(text) <= room:
        return text
    while text and font.getlength(f"{text}...") > room:
        text = text[:-1]
    return f"{text}..."


def wrap_text(text: str, font: Any, room: float) -> list[str]:
    """Return the lines of a text that fit into a width in pixels, at most `MOST_LINES`; the last one is shortened if needed."""
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
        (rows for limit in limits if len(rows := _fill(widths, limit, gap)) == fewest), _fill(widths, room, gap)
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
    """Draw an entry of a legend, with its left edge and its vertical middle at a position in pixels."""
    swatch = round(size * 0.95)
    top = round(middle - swatch / 2)
    if entry.color != NO_SWATCH:
        draw.rounded_rectangle(
            (left, top, left + swatch, top + swatch), max(2, size // 6), entry.color, _outline(entry.color)
        )
    draw.text((left + swatch + round(size * 0.45), middle), entry.name, INK, font, anchor="lm")


def draw_legend(entries: Sequence[Entry], font_size: int, most_width: int) -> NDArray[np.uint8]:
    """Draw a legend alone: entries in rows on white, without a wide margin.

    Args:
        entries: at least one.
        font_size: pixels.
        most_width: the width in pixels that rows may have. An entry that is wider has a row of its own.

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


def _outline(color: tuple[int, int, int]) -> tuple[int, int, int]:
    red, green, blue = (round(value * 0.7) for value in color)
    return red, green, blue
