"""Which colour stands for what: the tables' own colours, a palette for the colour-blind, and ramps.

The palette for the colour-blind keeps the eleven groups of the paper apart under deuteranopia and protanopia (Machado et al.
2009, severity 1): at least 29 units of CIE 1976 L*a*b* between any two, where the paper's colours come down to 7. It set out from
Okabe and Ito's colours. Classes within a group are shades of it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from carlasc.core.classes import ClassTable, Color
from carlasc.core.tables import CARLA, CARLASC11, REMAPS, SEMANTICKITTI, SEMANTICKITTI19
from carlasc.errors import ArgumentError

PaletteName = Literal["class", "colorblind", "height"]
PALETTES: tuple[str, ...] = get_args(PaletteName)

RIGHT, WRONG, MISSED, INVENTED = (205, 209, 214), (213, 70, 0), (16, 90, 190), (240, 200, 40)
STATIC = (188, 191, 196)
ARROW = (20, 20, 24)
EGO, GLASS = (250, 250, 250), (120, 132, 148)
UNLABELLED = (150, 150, 150)

_GROUPS: dict[int, Color] = {  # by id of the eleven classes
    0: (255, 255, 255),
    1: (10, 176, 245),
    2: (145, 81, 154),
    3: (41, 13, 76),
    4: (200, 20, 10),
    5: (240, 228, 66),
    6: (94, 82, 83),
    7: (231, 229, 180),
    8: (200, 195, 215),
    9: (10, 165, 88),
    10: (16, 69, 190),
}
_RAMP = np.array(  # viridis at five places: lightness rises throughout
    [(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)], np.float64
)


class Entry(NamedTuple):
    """A line of the legend.

    Attributes:
        name: what the colour stands for.
        color: RGB.
        order: where it stands: a class's id; what is no class comes before (below 0) or after (`AFTER_CLASSES` and more).
    """

    name: str
    color: Color
    order: int = 0


AFTER_CLASSES = 1 << 20


@dataclass(frozen=True)
class ClassColors:
    """How the classes of a table are drawn.

    Attributes:
        table: whose ids.
        palette: "class" (the table's own colours), "colorblind", or "height" (by height, whatever the class).
    """

    table: ClassTable = CARLA
    palette: PaletteName = "class"

    def __post_init__(self) -> None:
        if self.palette not in PALETTES:
            raise ArgumentError(f"palette {self.palette!r}: expected one of {', '.join(PALETTES)}")

    @property
    def by_id(self) -> NDArray[np.uint8]:
        """(num_channels, 3) uint8 RGB."""
        return colorblind_palette(self.table) if self.palette == "colorblind" else self.table.palette

    def entries(self, ids: Iterable[int]) -> list[Entry]:
        """Return the legend of some classes, sorted by id; free (0) has none."""
        colors = self.by_id
        return [
            Entry(self.table.names.get(i, f"class {i}"), as_color(colors[i]), i)
            for i in sorted(ids)
            if i and i < len(colors)
        ]


def colorblind_palette(table: ClassTable) -> NDArray[np.uint8]:
    """Return (num_channels, 3) uint8 RGB that people with red-green blindness tell apart."""
    groups = _groups(table)
    palette = np.full((table.num_channels, 3), 128, np.uint8)
    for group, base in _GROUPS.items():
        family = CARLASC11.names[group].lower()
        members = sorted(
            (i for i in table.names if groups.get(i, 3) == group),
            key=lambda i: (table.names[i].lower() not in (family, family.removesuffix("s")), i),
        )
        for number, member in enumerate(members):
            # the one of the group's name, or the first, has its colour; the others come ever nearer to white (to black where that is light)
            target, most = (255, 0.7) if sum(base) < 480 else (0, 0.35)
            share = most * number / max(len(members) - 1, 1) if number else 0.0
            palette[member] = np.round((1 - share) * np.array(base) + share * target)
    return palette


def height_colors(heights: NDArray[np.floating], lower: float, upper: float) -> NDArray[np.uint8]:
    """Return (..., 3) uint8 RGB by height, dark below and light above."""
    position = np.clip((heights - lower) / max(upper - lower, 1e-9), 0, 1) * (len(_RAMP) - 1)
    places = np.arange(len(_RAMP))
    return np.stack([np.interp(position, places, _RAMP[:, c]) for c in range(3)], axis=-1).astype(np.uint8)


def height_entries(lower: float, upper: float) -> list[Entry]:
    """Return the legend of `height_colors`."""
    heights = np.linspace(lower, upper, len(_RAMP))
    return [
        Entry(f"{height:+.1f} m", as_color(color), number - len(_RAMP))
        for number, (height, color) in enumerate(zip(heights, height_colors(heights, lower, upper), strict=True))
    ]


def as_color(rgb: NDArray[np.uint8]) -> Color:
    """Return an RGB array as three plain integers."""
    red, green, blue = (int(value) for value in rgb)
    return red, green, blue


def _groups(table: ClassTable) -> dict[int, int]:
    """Which of the eleven classes an id belongs to; ids that belong to none are Other."""
    eleven = REMAPS["carlasc11"].mapping
    if table == CARLASC11:
        return {i: i for i in table.names}
    if table == CARLA:
        return dict(eleven)
    if table == SEMANTICKITTI19:
        raw = _groups(SEMANTICKITTI)
        first = {k: i for i, k in sorted(REMAPS["semantickitti19"].mapping.items(), reverse=True)}
        return {i: raw[first[i]] for i in table.names if i} | {0: 0}
    to_carla = next((r for r in REMAPS.values() if r.source == table and r.target == CARLA), None)
    if to_carla is None:
        return {i: 0 if i == 0 else 1 + (i - 1) % 10 for i in table.names}
    return {i: (eleven[to_carla.mapping[i]] or 3) if i else 0 for i in table.names}


def merge_legends(legends: Iterable[Iterable[Entry]]) -> list[Entry]:
    """Return the entries of several legends, each once, in their order."""
    return sorted(dict.fromkeys(entry for legend in legends for entry in legend), key=lambda entry: entry.order)
