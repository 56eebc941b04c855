"""Class tables of data sets, written as text: a line for each class."""

from __future__ import annotations

from typing import Any

from carlasc.core.classes import ClassTable, Color, Remap, color_of
from carlasc.core.tables import CARLA, lines_of

ClassRows = list[tuple[str, Color, str]]
"""Name, colour and name of the class of CarlaSC; the ids are in order, from 0."""


def class_rows(table: str) -> ClassRows:
    """Return the classes of a table: a name, which may have spaces, red, green, blue, and the name
    of the class of CarlaSC in each line.
    """
    return [(" ".join(words[:-4]), color_of(words[-4:-1]), words[-1]) for words in lines_of(table)]


def tables_of(name: str, rows: ClassRows, **kinds: Any) -> tuple[ClassTable, Remap]:
    """Return a class table and its map to CarlaSC's classes.

    Args:
        name: of the table.
        rows: its classes.
        **kinds: the other attributes of `ClassTable`, such as `movable` and `ground`.
    """
    names = {index: row[0] for index, row in enumerate(rows)}
    table = ClassTable(name, names, {index: row[1] for index, row in enumerate(rows)}, **kinds)
    targets = {index: CARLA.id_of(row[2]) for index, row in enumerate(rows)}
    return table, Remap(f"{name}_to_carla", table, CARLA, targets)
