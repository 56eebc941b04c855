"""Raw captures of many sensors: reading them, and recording them in a simulated town or on a CARLA server."""

from __future__ import annotations

from typing import TYPE_CHECKING

from carlasc.loading import late_names

if TYPE_CHECKING:
    from carlasc.captures.carla.recording import RecordResult, record
    from carlasc.captures.carla.server import ServerError
    from carlasc.captures.lidar import Lidar
    from carlasc.captures.raw import Capture, Recording, find_captures
    from carlasc.captures.settings import TrafficLevel
    from carlasc.captures.town.actors import Actor
    from carlasc.captures.town.drive import Drive
    from carlasc.captures.town.simulated import SimulatedCapture
    from carlasc.captures.town.simulation import SimulationResult, simulate
    from carlasc.captures.writing import CaptureWriter
else:
    __getattr__, __dir__ = late_names(
        __name__,
        {
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
        },
    )

__all__ = [
    "Actor",
    "Capture",
    "CaptureWriter",
    "Drive",
    "Lidar",
    "RecordResult",
    "Recording",
    "ServerError",
    "SimulatedCapture",
    "SimulationResult",
    "TrafficLevel",
    "find_captures",
    "record",
    "simulate",
]
