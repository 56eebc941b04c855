"""Settings that the simulated town and a CARLA server share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import get_args

from carlasc.core.choices import TrafficLevel as TrafficLevel  # noqa: PLC0414 (part of this module)
from carlasc.errors import ArgumentError

TRAFFIC: Mapping[TrafficLevel, int] = {"light": 25, "medium": 50, "heavy": 100}
"""Number of moving vehicles per level of traffic, and of pedestrians."""


BEV_SIZE = (1920, 1080)
"""Width and height of a bird's-eye picture in pixels, as published."""

BEV_HEIGHT_M = 50.0
"""Height of the camera of bird's-eye pictures above the ego vehicle's origin."""

BEV_QUALITY = 88
"""JPEG quality of bird's-eye pictures."""


def check_at_least(minimum: int, **values: int) -> None:
    """Check whole numbers against a lower bound.

    Raises:
        ArgumentError: a value is below the bound. It names the argument.
    """
    for name, value in values.items():
        if value < minimum:
            raise ArgumentError(name, expected=f"at least {minimum}", found=str(value))


def check_traffic(traffic: str) -> None:
    """Check the name of a level of traffic.

    Raises:
        ArgumentError: no level has this name.
    """
    if traffic not in TRAFFIC:
        raise ArgumentError("traffic", expected=f"one of {', '.join(get_args(TrafficLevel))}", found=repr(traffic))
