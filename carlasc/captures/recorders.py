"""The installed recorders, which distributions declare in the entry-point group
`carlasc.recorders`: simulators, and the recorder of a CARLA server.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from carlasc.errors import load_plugin, plugin_names

if TYPE_CHECKING:
    from carlasc_recorders.carla.recording import record as record  # noqa: PLC0414

GROUP = "carlasc.recorders"


def recorder_names() -> tuple[str, ...]:
    """Return the sorted names of the installed recorders, without loading any."""
    return plugin_names(GROUP)


def load_recorder(name: str, base: type | None = None) -> Any:
    """Load a recorder by its name.

    Args:
        name: name of the entry point.
        base: the class that it must inherit, such as `Simulator`; None if it may be a function.

    Raises:
        ArgumentError: no recorder has that name.
        DependencyError: it cannot be loaded, or does not inherit `base`.
    """
    return load_plugin(GROUP, name, base, "simulator" if base else "name")


def __getattr__(name: str) -> Any:
    """Load `record`, which belongs to the recorder of a CARLA server, on first use."""
    if name == "record":
        return load_recorder("carla")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
