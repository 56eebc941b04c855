"""The help of commands, without the parts of `rich` that it does not use.

`typer.rich_utils` imports `rich.markdown` and `rich.traceback`, which take as long to load as all the rest of rich. Our help has no
Markdown and our errors are one line, so both classes are loaded only if something asks for them.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import Any

_UNUSED = {"rich.markdown": "Markdown", "rich.traceback": "Traceback"}


class _Late(type):
    """A class that is another class, which is imported when it is first called or asked for an attribute."""

    home: str

    def __call__(cls, *arguments: Any, **options: Any) -> Any:
        return getattr(importlib.import_module(cls.home), cls.__name__)(*arguments, **options)

    def __getattr__(cls, name: str) -> Any:
        return getattr(getattr(importlib.import_module(cls.home), cls.__name__), name)


def load_help() -> None:
    """Import `typer.rich_utils`; where it is already imported, nothing happens."""
    late = {module: name for module, name in _UNUSED.items() if module not in sys.modules}
    for module, name in late.items():
        stand_in = ModuleType(module)
        setattr(stand_in, name, _Late(name, (), {"home": module}))
        sys.modules[module] = stand_in
    try:
        importlib.import_module("typer.rich_utils")
    except (
        ImportError
    ):  # a version of typer that needs more of them: it imports the modules themselves when it shows the help
        return
    finally:
        for module in late:
            del sys.modules[module]
