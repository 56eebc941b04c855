"""A small procedural town, LiDARs in it, and the raw capture they record.

`simulate` records a capture; `Drive` gives any frame of any sensor in memory.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from carlasc.captures.town.actors import Actor as Actor
    from carlasc.captures.town.drive import Drive as Drive
    from carlasc.captures.town.lidar import Lidar as Lidar
    from carlasc.captures.town.record import SimulationResult as SimulationResult
    from carlasc.captures.town.record import simulate as simulate

_HOME = {"Actor": "actors", "Drive": "drive", "Lidar": "lidar", "SimulationResult": "record", "simulate": "record"}

__all__ = list(_HOME)


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
