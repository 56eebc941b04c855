"""`carlasc`: the SDK for CarlaSC, the data set of complete, trace-free semantic scenes.

Importing it loads nothing heavy: a public name, or a room such as `carlasc.metrics`, is loaded on first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

__version__ = "0.1.0"

if TYPE_CHECKING:  # what type checkers and editors see; the table below says the same to Python
    from carlasc import captures as captures
    from carlasc import converting as converting
    from carlasc import core as core
    from carlasc import dataset as dataset
    from carlasc import errors as errors
    from carlasc import groundtruth as groundtruth
    from carlasc import inspection as inspection
    from carlasc import metrics as metrics
    from carlasc import motion as motion
    from carlasc import running as running
    from carlasc import storage as storage
    from carlasc import testing as testing
    from carlasc import viewing as viewing
    from carlasc.captures import record as record
    from carlasc.captures import simulate as simulate
    from carlasc.converting import convert as convert
    from carlasc.converting import export as export
    from carlasc.core import Boxes as Boxes
    from carlasc.core import ClassTable as ClassTable
    from carlasc.core import Grid as Grid
    from carlasc.core import GridSpec as GridSpec
    from carlasc.core import Remap as Remap
    from carlasc.core import Scan as Scan
    from carlasc.core import VoxelFlag as VoxelFlag
    from carlasc.dataset import Dataset as Dataset
    from carlasc.dataset import Flip as Flip
    from carlasc.dataset import ShardSampler as ShardSampler
    from carlasc.dataset import collate as collate
    from carlasc.groundtruth import FromCapture as FromCapture
    from carlasc.groundtruth import FromGrid as FromGrid
    from carlasc.groundtruth import FromScans as FromScans
    from carlasc.groundtruth import Voting as Voting
    from carlasc.groundtruth import regrid as regrid
    from carlasc.inspection import card as card
    from carlasc.inspection import doctor as doctor
    from carlasc.inspection import info as info
    from carlasc.inspection import report as report
    from carlasc.inspection import stats as stats
    from carlasc.inspection import validate as validate
    from carlasc.metrics import evaluate as evaluate
    from carlasc.metrics import scores as scores
    from carlasc.running import Run as Run
    from carlasc.storage import Cache as Cache
    from carlasc.storage import Sink as Sink
    from carlasc.storage import Source as Source
    from carlasc.storage import download as download
    from carlasc.storage import finish as finish
    from carlasc.storage import open as open
    from carlasc.storage import pack as pack
    from carlasc.storage import unpack as unpack
    from carlasc.viewing import Scene as Scene
    from carlasc.viewing import render as render
    from carlasc.viewing import view as view
else:

    def __getattr__(name: str) -> object:
        if name in _ROOMS:
            return importlib.import_module(f"carlasc.{name}")
        for room, names in _HOMES.items():
            if name in names:
                return getattr(importlib.import_module(f"carlasc.{room}"), name)
        raise AttributeError(f"module 'carlasc' has no attribute {name!r}")


_ROOMS = (
    "captures",
    "converting",
    "core",
    "dataset",
    "errors",
    "groundtruth",
    "inspection",
    "metrics",
    "motion",
    "running",
    "storage",
    "testing",
    "viewing",
)
_HOMES = {  # room -> its names that are also names of `carlasc`
    "core": (
        "Boxes",
        "ClassTable",
        "Grid",
        "GridSpec",
        "Remap",
        "Scan",
        "VoxelFlag",
    ),
    "running": ("Run",),
    "storage": (
        "Cache",
        "Sink",
        "Source",
        "download",
        "finish",
        "open",
        "pack",
        "unpack",
    ),
    "captures": (
        "record",
        "simulate",
    ),
    "groundtruth": (
        "FromCapture",
        "FromGrid",
        "FromScans",
        "Voting",
        "regrid",
    ),
    "dataset": (
        "Dataset",
        "Flip",
        "ShardSampler",
        "collate",
    ),
    "metrics": ("evaluate", "scores"),
    "inspection": (
        "card",
        "doctor",
        "info",
        "report",
        "stats",
        "validate",
    ),
    "converting": (
        "convert",
        "export",
    ),
    "viewing": (
        "Scene",
        "render",
        "view",
    ),
}

__all__ = ["__version__", *_ROOMS, *(name for names in _HOMES.values() for name in names)]  # noqa: PLE0604


def __dir__() -> list[str]:
    return sorted(__all__)
