"""Names that a package loads on first use, so that a program waits only for the modules that it needs."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Iterable, Mapping


def late_names(
    package: str, homes: Mapping[str, Iterable[str]]
) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """Return the `__getattr__` and the `__dir__` of a package whose names are imported when they are first asked for, as are its modules.

    Type checkers see nothing of it: the package imports the same names in `if TYPE_CHECKING`.

    Args:
        package: the name of the package, `__name__` in its `__init__`.
        homes: module -> the public names that it holds; modules are named without the package.
    """
    places = {name: f"{package}.{module}" for module, names in homes.items() for name in names}

    def load(name: str) -> object:
        if name in places:
            return getattr(importlib.import_module(places[name]), name)
        if not name.startswith("_") and importlib.util.find_spec(f"{package}.{name}") is not None:
            return importlib.import_module(f"{package}.{name}")
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return load, lambda: sorted(places)
