"""Raw captures of many sensors: reading them, and recording them in a simulated town or on a CARLA server."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from carlasc.captures.carla.recording import RecordResult as RecordResult
    from carlasc.captures.carla.recording import record as record
    from carlasc.captures.carla.server import ServerError as ServerError
    from carlasc.captures.lidar import Lidar as Lidar
    from carlasc.captures.raw import Capture as Capture
    from carlasc.captures.raw import Recording as Recording
    from carlasc.captures.raw import find_captures as find_captures
    from carlasc.captures.settings import TrafficLevel as TrafficLevel
    from carlasc.captures.town.actors import Actor as Actor
    from carlasc.captures.town.drive import Drive as Drive
    from carlasc.captures.town.simulated import SimulatedCapture as SimulatedCapture
    from carlasc.captures.town.simulation import SimulationResult as SimulationResult
    from carlasc.captures.town.simulation import simulate as simulate
    from carlasc.captures.writing import CaptureWriter as CaptureWriter
else:

    def __getattr__(name: str) -> object:
        for module, names in _HOMES.items():
            if name in names:
                return getattr(importlib.import_module(f"carlasc.captures.{module}"), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


_HOMES = {  # module -> its public names, which are loaded on first use
    "carla.recording": ("RecordResult", "record"),
    "carla.server": ("ServerError",),
    "lidar": ("Lidar",),
    "raw": ("Capture", "Recording", "find_captures"),
    "settings": ("TrafficLevel",),
    "town.actors": ("Actor",),
    "town.drive": ("Drive",),
    "town.simulated": ("SimulatedCapture",),
    "town.simulation": ("SimulationResult", "simulate"),
    "writing": ("CaptureWriter",),
}

__all__ = [name for names in _HOMES.values() for name in names]
