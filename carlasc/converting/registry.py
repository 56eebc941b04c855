"""The installed converters and exporters: those that distributions declare in two entry-point groups."""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from typing import Any

from carlasc.converting.exporter import Exporter
from carlasc.converting.protocol import Converter
from carlasc.core.classes import ClassTable, Remap
from carlasc.core.tables import CARLA, remaps_between
from carlasc.errors import ArgumentError, DependencyError

GROUP = "carlasc.converters"
EXPORTERS = "carlasc.exporters"


def converter_names() -> tuple[str, ...]:
    """Return the sorted names of the installed converters, without loading any."""
    return tuple(sorted(_entries(GROUP)))


def exporter_names() -> tuple[str, ...]:
    """Return the sorted names of the installed exporters, without loading any."""
    return tuple(sorted(_entries(EXPORTERS)))


def load_converter(name: str) -> type[Converter]:
    """Load a converter by its name.

    Raises:
        ArgumentError: no converter has that name.
        DependencyError: it cannot be loaded, or is not a converter.
    """
    found: type[Converter] = _load(GROUP, Converter, name)
    return found


def load_exporter(name: str) -> type[Exporter]:
    """Load an exporter by its name.

    Raises:
        ArgumentError: no exporter has that name.
        DependencyError: it cannot be loaded, or is not an exporter.
    """
    found: type[Exporter] = _load(EXPORTERS, Exporter, name)
    return found


def remaps_to_carla(table: ClassTable) -> tuple[Remap, ...] | None:
    """Return the remaps to apply, in order, to convert ids of a table to CarlaSC's: those of carlasc, or that of an installed converter.

    Returns:
        The remaps; none for CarlaSC's own table. None if nothing maps the table.
    """
    try:
        return remaps_between(table, CARLA)
    except ArgumentError:
        pass
    for name in converter_names():
        try:
            converter = load_converter(name)
        except DependencyError:
            continue  # another distribution's, which is broken, but is not asked for
        if converter.classes == table:
            return (converter.to_carla,)
    return None


def _load(group: str, base: type, name: str) -> Any:
    """Return the class of an entry point, which inherits `base`."""
    entries = _entries(group)
    if name not in entries:
        raise ArgumentError(
            "name", expected=f"one of {', '.join(sorted(entries)) or 'no names: none is installed'}", found=repr(name)
        )
    where = f"{base.__name__.lower()} {name} ({entries[name].value})"
    try:
        found = entries[name].load()
    except Exception as error:  # code of another distribution may fail in any way
        raise DependencyError(where, problem=f"cannot be loaded: {error}") from error
    if not (isinstance(found, type) and issubclass(found, base)):
        expected = f"a class that inherits carlasc.converting.{base.__name__}"
        raise DependencyError(where, expected=expected, found=repr(found))
    return found


def _entries(group: str) -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=group)}
