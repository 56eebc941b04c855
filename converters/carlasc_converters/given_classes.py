"""The class table of somebody's labels: one that carlasc or a converter has by name, or that of a JSON file."""

from __future__ import annotations

from carlasc.converting import converter_names, load_converter, remaps_to_carla
from carlasc.core.classes import ClassTable, Remap
from carlasc.core.tables import CARLA, TABLES, table_from_json
from carlasc.errors import ArgumentError, DependencyError
from carlasc.storage.files import parse_json
from carlasc_converters.files import read_bytes


def classes_given(name: str) -> tuple[ClassTable, Remap | None]:
    """Return a class table, and how its ids become CarlaSC's; None if nothing says so.

    Args:
        name: the name of a table, or the path of a JSON file with a table as carlasc.json has it, or of a carlasc.json.

    Raises:
        ArgumentError: no table has the name.
        MissingDataError: the file does not exist.
        FormatError: the file holds no class table.
    """
    table = _table(name)
    remaps = remaps_to_carla(table)
    if remaps is None:
        return table, None
    mapping = {label: label for label in table.names}
    for remap in remaps:
        mapping = {label: remap.mapping[now] for label, now in mapping.items()}
    return table, Remap(f"{table.name}_to_carla", table, CARLA, mapping)


def _table(name: str) -> ClassTable:
    if name.lower().endswith(".json"):
        values = parse_json(read_bytes(name, "a class table"), name)
        return table_from_json(values.get("classes", values), name)
    known = dict(TABLES)
    for converter in converter_names():
        try:
            table = load_converter(converter).classes
        except (DependencyError, AttributeError):  # of another distribution, broken or without a table of its own
            continue
        known.setdefault(table.name, table)
    if name not in known:
        raise ArgumentError("source_classes", expected=f"one of {', '.join(known)}, or a JSON file", found=repr(name))
    return known[name]
