"""The style of a picture: for a screen, or for a paper, where lengths are centimetres and the legend is a file of its own."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from carlasc.errors import ArgumentError

StyleName = Literal["screen", "paper"]
STYLES: tuple[str, ...] = get_args(StyleName)

_INCHES = {"cm": 1 / 2.54, "mm": 1 / 25.4, "in": 1.0}
_POINTS_PER_INCH = 72
_LENGTH = re.compile(r"(\d+(?:\.\d*)?|\.\d+)\s*([a-z]*)")


@dataclass(frozen=True)
class Style:
    """How a picture is laid out and stored.

    Attributes:
        name: "screen" or "paper".
        size: (width, height), pixels.
        dpi: pixels per inch, which a PNG says in its metadata; None says nothing.
        font_size: pixels; None takes one by the size of the picture.
        legend_apart: whether the legend is a file of its own, next to the picture.
    """

    name: StyleName
    size: tuple[int, int]
    dpi: float | None = None
    font_size: int | None = None
    legend_apart: bool = False

    def legend_file(self, out: Path) -> Path:
        """Return the name of the legend's file: `scene.legend.png` for `scene.png`."""
        return out.with_name(f"{out.stem}.legend{out.suffix}")


_SCREEN = Style("screen", (1280, 720))
_PAPER_DPI, _PAPER_SIZE, _PAPER_FONT_PT = (
    300.0,
    "8.8cm x 5cm",
    8.0,
)  # a column of a page with two columns; a caption's type


def style_of(name: StyleName, size: tuple[int, int] | str | None, dpi: float | None) -> Style:
    """Return the style that a picture is drawn in.

    Args:
        name: "screen" or "paper". On paper, type is 8 points high, and the legend is a file of its own.
        size: (width, height) in pixels; or a text such as "1280x720" (pixels), "8.8cm x 5cm", "88mm x 50mm" or "3.5in x 2in". None takes
            1280 x 720 pixels on a screen and 8.8 x 5 cm on paper.
        dpi: pixels per inch. None takes 300 on paper and for a size with a unit, and says nothing otherwise.

    Raises:
        ArgumentError: an unknown style, a size that is none, or an impossible `dpi`.
    """
    if name not in STYLES:
        raise ArgumentError("style", expected=" or ".join(STYLES), found=repr(name))
    if dpi is not None and not 30 <= dpi <= 2400:
        raise ArgumentError("dpi", expected="30 to 2400 pixels per inch", found=f"{dpi:g}")
    paper = name == "paper"
    if size is None:
        size = _PAPER_SIZE if paper else _SCREEN.size
    if isinstance(size, str):
        lengths, with_unit = _read_lengths(size)
        if dpi is None and (with_unit or paper):
            dpi = _PAPER_DPI
        width, height = (round(length * (dpi or 1.0)) if with_unit else round(length) for length in lengths)
        size = (width, height)
    if not paper:
        return Style("screen", size, dpi)
    dpi = _PAPER_DPI if dpi is None else dpi
    return Style("paper", size, dpi, round(_PAPER_FONT_PT / _POINTS_PER_INCH * dpi), legend_apart=True)


def _read_lengths(text: str) -> tuple[tuple[float, float], bool]:
    """Return the two lengths of a text, in inches if they have a unit, otherwise in pixels; and whether they have one."""
    found = [_LENGTH.fullmatch(part.strip()) for part in re.split(r"\s*x\s*", text.strip().lower(), maxsplit=1)]
    pairs = [(float(match[1]), match[2]) for match in found if match is not None]
    if len(pairs) == 2:
        (width, first), (height, second) = pairs
        first = first or second  # 8.8x5cm means both
        if first == second == "":
            if width.is_integer() and height.is_integer():
                return (width, height), False
        elif first in _INCHES and second in _INCHES:
            return (width * _INCHES[first], height * _INCHES[second]), True
    raise ArgumentError(
        "size", expected="WIDTHxHEIGHT, such as 1280x720 (pixels), 8.8cmx5cm or 3.5inx2in", found=repr(text)
    )
