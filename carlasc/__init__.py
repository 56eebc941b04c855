"""`carlasc`: the SDK for CarlaSC, the data set of complete, trace-free semantic scenes.

Importing it loads NumPy and nothing heavier; the names below are found in their modules on first use.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

_HOME = {  # public name -> module
    "GridSpec": "grids",
    "Grid": "grids",
    "Scan": "scans",
    "ClassTable": "labels",
    "Remap": "labels",
    "open": "sources",
    "Source": "sources",
    "Sink": "sources",
    "Dataset": "dataset",
    "collate": "dataset",
    "Flip": "transforms",
    "regrid": "groundtruth",
    "simulate": "simulation",
    "render": "rendering",
    "pack": "packing",
    "unpack": "packing",
    "info": "inspection.overview",
    "stats": "inspection.statistics",
    "validate": "inspection.validation",
    "convert": "converting",
    "export": "converting",
    "evaluate": "metrics",
    "make_page": "viewing",
    "show": "viewing",
    "record": "recording",
    "download": "downloads",
}

__all__ = ["__version__", "errors", *_HOME]  # noqa: PLE0604 (names of the table)


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"carlasc.{_HOME[name]}"), name)
    if name in ("errors", "metrics", "labels", "geometry", "layout"):
        return importlib.import_module(f"carlasc.{name}")
    raise AttributeError(f"module 'carlasc' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
