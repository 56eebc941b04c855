"""The base classes of torch for classes of carlasc, without importing torch.

A class gets its base when torch is imported, before or after carlasc: `isinstance`, `+` and the
types of torch then hold for it and for all its objects. It keeps its name and its module, where
processes that are spawned find it.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Generic, TypeVar

_T_co = TypeVar("_T_co", covariant=True)
_MODULE = "torch.utils.data"
_waiting: dict[type, str] = {}  # class -> name of its base in torch


class NoBase(Generic[_T_co]):
    """The base of a class before torch is imported.

    Python replaces a base only by one of the same layout: those of torch are generic, too.
    """


def inherit(kind: type, base: str) -> None:
    """Make `torch.utils.data.<base>` the base of a class that inherits `NoBase`: at once if torch
    is imported, otherwise as soon as it is.
    """
    _waiting[kind] = base
    if _MODULE in sys.modules:
        _adopt(sys.modules[_MODULE])
    elif _finder not in sys.meta_path:
        sys.meta_path.insert(0, _finder)


def _adopt(module: ModuleType) -> None:
    while _waiting:
        kind, base = _waiting.popitem()
        kind.__bases__ = (getattr(module, base),)


class _Finder(MetaPathFinder):
    """Finds torch.utils.data as usual, and completes its import."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        spec = PathFinder.find_spec(fullname, path, target) if fullname == _MODULE else None
        if spec is not None and spec.loader is not None:
            load = spec.loader.exec_module

            def load_and_adopt(module: ModuleType) -> None:
                load(module)
                _adopt(module)

            spec.loader.exec_module = load_and_adopt  # type: ignore[method-assign]
        return spec


_finder = _Finder()
