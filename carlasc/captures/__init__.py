"""Raw captures of many sensors: their format (`raw`), a simulated town (`town`) and a CARLA server (`carla`) that record them."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from carlasc.captures.carla import RecordResult as RecordResult
    from carlasc.captures.carla import record as record
    from carlasc.captures.raw import Capture as Capture
    from carlasc.captures.raw import find_captures as find_captures
    from carlasc.captures.town import Actor as Actor
    from carlasc.captures.town import Drive as Drive
    from carlasc.captures.town import Lidar as Lidar
    from carlasc.captures.town import SimulationResult as SimulationResult
    from carlasc.captures.town import simulate as simulate
else:

    def __getattr__(name: str) -> object:
        for part, names in _HOMES.items():
            if name in names:
                return getattr(importlib.import_module(f"carlasc.captures.{part}"), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


_HOMES = {
    "carla": ("RecordResult", "record"),
    "raw": ("Capture", "find_captures"),
    "town": ("Actor", "Drive", "Lidar", "SimulationResult", "simulate"),
}

__all__ = [name for names in _HOMES.values() for name in names]
