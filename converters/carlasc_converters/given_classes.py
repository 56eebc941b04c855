"""The class table of given labels: a table of carlasc or of a converter, by name, or from a JSON
file.
"""

from __future__ import annotations

from carlasc.converting import converter_names, load_converter, remaps_to_carla
from carlasc.core.classes import ClassTable, Remap
from carlasc.core.tables import CARLA
from carlasc.errors import ArgumentError, DependencyError
from carlasc.storage.class_files import read_classes


def classes_given(name: str) -> tuple[ClassTable, Remap | None]:
    """Return a class table, and the map of its ids to CarlaSC's; None if no map exists, or if they
    are CarlaSC's.

    Args:
        name: the name of a table, or the path of a JSON file with a table as carlasc.json has it,
            or of a carlasc.json.

    Raises:
        ArgumentError: neither a table nor a file has this name.
        FormatError: the file does not hold a class table.
    """
    table = _table(name)
    remaps = remaps_to_carla(table)
    if not remaps:
        return table, None
    mapping = {label: label for label in table.names}
    for remap in remaps:
        mapping = {label: remap.mapping[now] for label, now in mapping.items()}
    return table, Remap(f"{table.name}_to_carla", table, CARLA, mapping)


def _table(name: str) -> ClassTable:
    for converter in converter_names():
        try:
            table = load_converter(converter).classes
        except (
            DependencyError,
            AttributeError,
        ):  # a broken converter, or one without a class table
            continue
        if table.name == name:
            return table
    try:
        return read_classes(name)[0]
    except ArgumentError as error:
        error.where = "source_classes"
        raise
