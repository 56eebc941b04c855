"""The style of a picture: for a screen, or for a paper, with lengths in centimetres and the legend
in a separate file.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from carlasc.core.choices import StyleName as StyleName  # noqa: PLC0414 (part of this module)
from carlasc.errors import ArgumentError, check_choice, check_types

# pixels of a picture
SMALLEST = (64, 64)
LARGEST = 16384

_SCREEN_SIZE = (1280, 720)
# a column of two; the type of a caption
_PAPER_SIZE = "8.8cm x 5cm"
_PAPER_DPI = 300.0
_PAPER_FONT_PT = 8.0
_INCHES = {"cm": 1 / 2.54, "mm": 1 / 25.4, "in": 1.0}
_POINTS_PER_INCH = 72
_LENGTH = r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([a-z]*?)\s*"
_SIZE = re.compile(f"{_LENGTH}x{_LENGTH}")


@dataclass(frozen=True)
class StyleOptions:
    """How a picture looks.

    Attributes:
        name: "screen"; or "paper": PNG with 300 pixels per inch, text of 8 points, and the legend
            in a separate file, NAME.legend.png.
        size: width and height of the picture in pixels, as 1280x720, or with a unit, as 8.8cmx5cm,
            88mmx50mm or 3.5inx2in; in Python also a tuple of pixels. None: 1280x720, or 8.8cmx5cm
            on paper.
        dpi: pixels per inch in the metadata of a PNG. None: 300 on paper and for a size with a
            unit.
        captions: for several scenes: a caption for each panel, after its letter. By default, a
            caption names the differences between the panels.
        columns: for several scenes: number of panels in a row. None: the number of frames of one
            scene, or the best fit.
        legend: draw a legend.
        ego: draw the ego vehicle, as a plain car at the sensor.

    Raises:
        ArgumentError: an unknown style, or an impossible size, `dpi` or number of columns.
    """

    name: StyleName = "screen"
    size: tuple[int, int] | str | None = None
    dpi: float | None = None
    captions: Sequence[str] = ()
    columns: int | None = None
    legend: bool = True
    ego: bool = True

    def __post_init__(self) -> None:
        check_types(StyleOptions, vars(self))
        check_choice("style", self.name, StyleName)
        if self.dpi is not None and not 30 <= self.dpi <= 2400:
            raise ArgumentError("dpi", expected="30 to 2400 pixels per inch", found=f"{self.dpi:g}")
        if self.columns is not None and self.columns < 1:
            raise ArgumentError("columns", expected="1 or more", found=self.columns)
        check_size(self.sheet.size)

    @property
    def sheet(self) -> Sheet:
        """The sheet of a picture in this style."""
        paper = self.name == "paper"
        dpi = self.dpi
        size = (_PAPER_SIZE if paper else _SCREEN_SIZE) if self.size is None else self.size
        if isinstance(size, str):
            lengths, with_unit = _read_lengths(size)
            if dpi is None and (with_unit or paper):
                dpi = _PAPER_DPI
            width, height = (
                round(length * (dpi or 1.0)) if with_unit else round(length) for length in lengths
            )
            size = (width, height)
        if not paper:
            return Sheet(size, dpi)
        dpi = _PAPER_DPI if dpi is None else dpi
        return Sheet(size, dpi, round(_PAPER_FONT_PT / _POINTS_PER_INCH * dpi), legend_apart=True)


@dataclass(frozen=True)
class Sheet:
    """The sheet that a picture is drawn on.

    Attributes:
        size: (width, height), pixels.
        dpi: pixels per inch in the metadata of a PNG; None for none.
        font_size: pixels; None takes one by the size of the picture.
        legend_apart: whether the legend is a separate file, next to the picture.
    """

    size: tuple[int, int]
    dpi: float | None = None
    font_size: int | None = None
    legend_apart: bool = False

    def legend_file(self, out: Path) -> Path:
        """Return the name of the legend's file: `scene.legend.png` for `scene.png`."""
        return out.with_name(f"{out.stem}.legend{out.suffix}")


def check_size(size: tuple[int, int]) -> None:
    """Raise ArgumentError if (width, height) in pixels is not a size that a picture can have."""
    if len(size) != 2 or not all(
        low <= value <= LARGEST for low, value in zip(SMALLEST, size, strict=True)
    ):
        raise ArgumentError(
            "size",
            expected=f"{SMALLEST[0]}x{SMALLEST[1]} to {LARGEST}x{LARGEST} pixels",
            found="x".join(map(str, size)),
        )


def _read_lengths(text: str) -> tuple[tuple[float, float], bool]:
    """Return the two lengths of a text, in inches if they have a unit, otherwise in pixels; and
    whether they have one.
    """
    if match := _SIZE.fullmatch(text.lower()):
        width = float(match[1])
        height = float(match[3])
        # in 8.8x5cm, both are centimetres
        first = match[2] or match[4]
        second = match[4]
        if first == second == "":
            if width.is_integer() and height.is_integer():
                return (width, height), False
        elif first in _INCHES and second in _INCHES:
            return (width * _INCHES[first], height * _INCHES[second]), True
    raise ArgumentError(
        "size",
        expected="WIDTHxHEIGHT, such as 1280x720 (pixels), 8.8cmx5cm or 3.5inx2in",
        found=repr(text),
    )
