"""The converters, exporters and recorders that installed distributions declare in entry-point
groups.
"""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Any

from carlasc.errors import ArgumentError, DependencyError


def plugin_names(group: str) -> tuple[str, ...]:
    """Return the sorted names in an entry-point group, without loading any."""
    return tuple(sorted({entry.name for entry in entry_points(group=group)}))


def load_plugin(group: str, name: str, base: type | None = None) -> Any:
    """Load what an entry point names.

    Args:
        group: an entry-point group, such as "carlasc.converters".
        name: name of the entry point.
        base: the class that it must inherit; None if it may be anything.

    Raises:
        ArgumentError: the group has no such name.
        DependencyError: it cannot be loaded, or does not inherit `base`.
    """
    entries = {entry.name: entry for entry in entry_points(group=group)}
    if name not in entries:
        expected = f"one of {', '.join(sorted(entries)) or 'no names: none is installed'}"
        raise ArgumentError("name", expected=expected, found=repr(name))
    where = f"{group.removeprefix('carlasc.').removesuffix('s')} {name} ({entries[name].value})"
    try:
        plugin = entries[name].load()
    except Exception as error:  # code of another distribution may fail in any way
        raise DependencyError(where, problem=f"cannot be loaded: {error}") from error
    if base is not None and not (isinstance(plugin, type) and issubclass(plugin, base)):
        public = ".".join([*base.__module__.split(".")[:2], base.__name__])
        raise DependencyError(where, expected=f"a class that inherits {public}", found=repr(plugin))
    return plugin
