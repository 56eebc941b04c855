"""The installed converters: those that distributions declare in the entry-point group `carlasc.converters`."""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points

from carlasc.converting.protocol import Converter
from carlasc.errors import ArgumentError, DependencyError

GROUP = "carlasc.converters"


def converter_names() -> tuple[str, ...]:
    """Return the sorted names of the installed converters, without loading any."""
    return tuple(sorted(_entries()))


def load_converter(name: str) -> type[Converter]:
    """Load a converter by its name.

    Raises:
        ArgumentError: no converter has that name.
        DependencyError: it cannot be loaded, or is not a converter.
    """
    entries = _entries()
    if name not in entries:
        raise ArgumentError(
            "name", expected=f"one of {', '.join(sorted(entries)) or 'no names: none is installed'}", found=repr(name)
        )
    entry = entries[name]
    where = f"converter {name} ({entry.value})"
    try:
        found = entry.load()
    except (ImportError, AttributeError) as error:
        raise DependencyError(where, problem=f"cannot be loaded: {error}") from error
    if not (isinstance(found, type) and issubclass(found, Converter)):
        raise DependencyError(where, expected="a class that inherits carlasc.converting.Converter", found=repr(found))
    return found


def _entries() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=GROUP)}
