"""Which converters there are: those of installed distributions, by the entry-point group `carlasc.converters`."""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points

from carlasc.converting.protocol import Converter
from carlasc.errors import ArgumentError, DependencyError

GROUP = "carlasc.converters"


def converter_names() -> tuple[str, ...]:
    """Return the names of the installed converters; none of them is loaded."""
    return tuple(sorted(_entries()))


def load_converter(name: str) -> type[Converter]:
    """Load a converter.

    Raises:
        ArgumentError: none is called so.
        DependencyError: it does not load, or is no converter.
    """
    entries = _entries()
    if name not in entries:
        raise ArgumentError(
            f"converter {name!r}: expected one of {', '.join(sorted(entries)) or 'none: none is installed'} (`carlasc convert --list`)"
        )
    entry = entries[name]
    try:
        found = entry.load()
    except (ImportError, AttributeError) as error:
        raise DependencyError(f"converter {name} ({entry.value}) does not load: {error}") from error
    if not (isinstance(found, type) and issubclass(found, Converter)):
        raise DependencyError(
            f"converter {name} ({entry.value})",
            expected="a class that inherits carlasc.converting.Converter",
            found=f"{found!r}",
        )
    return found


def _entries() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=GROUP)}
