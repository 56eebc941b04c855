"""Colours of classes, of a prediction's errors, and of heights.

The palette for colour-blind readers starts from the colours of Okabe and Ito. Any two of the
paper's eleven classes differ by at least 29 units of CIE 1976 L*a*b* under deuteranopia and
protanopia (Machado et al. 2009, severity 1); with the paper's own colours the least difference is
7. Classes that belong to the same one of the eleven have shades of its colour.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple, get_args

import numpy as np

from carlasc.core.arrays import AnyFloatArray, AnyIntArray, IntArray, Uint8Array
from carlasc.core.choices import PaletteName as PaletteName  # noqa: PLC0414 (part of this module)
from carlasc.core.classes import ClassTable, Color
from carlasc.core.scans import Scan
from carlasc.core.tables import CARLA, CARLASC11, REMAPS, SEMANTICKITTI, SEMANTICKITTI19
from carlasc.errors import check_choice
from carlasc.metrics.grids import VoxelOutcome

PALETTES: tuple[str, ...] = get_args(PaletteName)

ERRORS = ClassTable(
    "errors",
    {
        VoxelOutcome.NOT_COMPARED: "nothing to compare",
        VoxelOutcome.RIGHT: "right class",
        VoxelOutcome.WRONG: "wrong class",
        VoxelOutcome.MISSED: "missed: predicted free",
        VoxelOutcome.INVENTED: "invented: free in truth",
    },
    {
        VoxelOutcome.NOT_COMPARED: (255, 255, 255),
        VoxelOutcome.RIGHT: (205, 209, 214),
        VoxelOutcome.WRONG: (213, 70, 0),
        VoxelOutcome.MISSED: (16, 90, 190),
        VoxelOutcome.INVENTED: (240, 200, 40),
    },
)
"""Names and colours of the outcomes of comparing a prediction with the ground truth."""

STATIC = (188, 191, 196)
_ACTORS = (  # by number, periodic
    *((10, 176, 245), (213, 70, 0), (10, 165, 88), (138, 86, 194), (240, 200, 40), (200, 20, 10)),
    *((22, 208, 192), (230, 103, 176), (16, 69, 190), (154, 106, 47), (122, 201, 67), (94, 82, 83)),
)
ACTORS = ClassTable(
    "actors",
    {0: "free", 1: "no actor"}
    | {2 + k: f"actors {k or 12}, {(k or 12) + 12}, ..." for k in range(len(_ACTORS))},
    {0: (255, 255, 255), 1: STATIC} | dict(enumerate(_ACTORS, 2)),
)
"""Names and colours of actors by their numbers: `actor_ids` returns the ids."""
ARROW = (20, 20, 24)
EGO = (250, 250, 250)
GLASS = (120, 132, 148)
UNLABELLED = (150, 150, 150)
PATH = (70, 110, 170)

_GROUPS: dict[int, Color] = {  # by id in the paper's eleven classes
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
_RAMP = np.array(  # viridis at five positions: lightness increases from the first to the last
    [(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)], np.float64
)


def actor_ids(instances: AnyIntArray) -> Uint8Array:
    """Return the id in `ACTORS` of each number of an actor, of any shape; 0, no actor, has the id
    1.
    """
    return np.where(instances > 0, 2 + instances.astype(np.int64) % len(_ACTORS), 1).astype(
        np.uint8
    )


class Entry(NamedTuple):
    """An entry of a legend.

    Attributes:
        name: meaning of the colour.
        color: RGB, 0 to 255.
        order: position in the legend: the id of a class; below 0 for entries before the classes,
            `AFTER_CLASSES` and more for entries after them.
    """

    name: str
    color: Color
    order: int = 0


AFTER_CLASSES = 1 << 20


@dataclass(frozen=True)
class ClassColors:
    """The colours in which the classes of a table are drawn.

    Attributes:
        table: the class table.
        palette: "class" (the colours of the table), "colorblind", or "height" (by height, for any
            class).

    Raises:
        ArgumentError: an unknown palette.
    """

    table: ClassTable = CARLA
    palette: PaletteName = "class"

    def __post_init__(self) -> None:
        check_choice("palette", self.palette, PALETTES)

    @property
    def by_id(self) -> Uint8Array:
        """(num_channels, 3) uint8 RGB by class id."""
        return (
            colorblind_palette(self.table) if self.palette == "colorblind" else self.table.palette
        )

    def of_points(self, scan: Scan) -> Uint8Array:
        """Return (N, 3) uint8 RGB of the points of a scan by class: grey without one."""
        colors = self.by_id.copy()
        colors[0] = UNLABELLED
        return colors[np.zeros(len(scan), np.int64) if scan.labels is None else scan.labels]

    def tell_shapes(self, ids: IntArray) -> bool:
        """Whether the colours of the (K,) ids that occur are useful.

        Without labels they are not, and colours by height are used.
        """
        without = {0, self.table.geometry_id, self.table.ground_id}
        return self.palette != "height" and (
            self.table.geometry_id not in ids or not {*ids.tolist()} <= without
        )

    def entries(self, ids: Iterable[int]) -> list[Entry]:
        """Return the legend of the given class ids, sorted by id, without free (0)."""
        colors = self.by_id
        return [
            Entry(self.table.names.get(i, f"class {i}"), as_color(colors[i]), i)
            for i in sorted(ids)
            if i and i < len(colors)
        ]


def colorblind_palette(table: ClassTable) -> Uint8Array:
    """Return (num_channels, 3) uint8 RGB by class id, in colours that readers with red-green
    blindness can distinguish.
    """
    groups = _groups(table)
    palette = np.full((table.num_channels, 3), 128, np.uint8)
    for group, base in _GROUPS.items():
        family = CARLASC11.names[group].lower()
        members = sorted(
            (i for i in table.names if groups.get(i, 3) == group),
            key=lambda i: (table.names[i].lower() not in (family, family.removesuffix("s")), i),
        )
        for number, member in enumerate(members):
            # the class named as the group, or the first one, has the group's colour; the others are
            # blended with white, or with black if the group's colour is light
            target, most = (255, 0.7) if sum(base) < 480 else (0, 0.35)
            share = most * number / max(len(members) - 1, 1) if number else 0.0
            palette[member] = np.round((1 - share) * np.array(base) + share * target)
    return palette


def height_colors(heights: AnyFloatArray, lower: float, upper: float) -> Uint8Array:
    """Return (..., 3) uint8 RGB of heights: dark at `lower`, light at `upper`, both in metres."""
    position = np.clip((heights - lower) / max(upper - lower, 1e-9), 0, 1) * (len(_RAMP) - 1)
    places = np.arange(len(_RAMP))
    return np.stack([np.interp(position, places, _RAMP[:, c]) for c in range(3)], axis=-1).astype(
        np.uint8
    )


def height_entries(lower: float, upper: float) -> list[Entry]:
    """Return the legend of `height_colors`."""
    heights = np.linspace(lower, upper, len(_RAMP))
    return [
        Entry(f"{height:+.1f} m", as_color(color), number - len(_RAMP))
        for number, (height, color) in enumerate(
            zip(heights, height_colors(heights, lower, upper), strict=True)
        )
    ]


def as_color(rgb: Uint8Array) -> Color:
    """Return an RGB array as three plain integers."""
    red, green, blue = (int(value) for value in rgb)
    return red, green, blue


def _groups(table: ClassTable) -> dict[int, int]:
    """Return which of the eleven classes each id belongs to; ids without one count as Other."""
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
    """Return the different entries of several legends, sorted by `order`."""
    return sorted(
        dict.fromkeys(entry for legend in legends for entry in legend),
        key=lambda entry: entry.order,
    )
