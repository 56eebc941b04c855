"""Settings of simulators and of a CARLA server: model and positions of LiDARs, traffic, bird's-eye
pictures, and the address of the server.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from carlasc.core.arrays import FloatArray
from carlasc.core.choices import TrafficLevel as TrafficLevel  # noqa: PLC0414 (part of this module)
from carlasc.errors import ArgumentError

TRAFFIC: Mapping[TrafficLevel, int] = {"light": 25, "medium": 50, "heavy": 100}
"""Number of moving vehicles, and of pedestrians, by level of traffic."""


BEV_SIZE = (1920, 1080)
"""Width and height of a bird's-eye picture in pixels, as published."""

BEV_HEIGHT_M = 50.0
"""Height of the camera of bird's-eye pictures above the origin of the ego vehicle."""

BEV_QUALITY = 88
"""JPEG quality of bird's-eye pictures."""


def check_at_least(minimum: int, **values: int) -> None:
    """Check integers against a lower bound.

    Raises:
        ArgumentError: a value is below the bound; the message names the argument.
    """
    for name, value in values.items():
        if value < minimum:
            raise ArgumentError(name, expected=f"at least {minimum}", found=str(value))


EGO_SENSOR_M = (-0.5, 0.0, 1.8)
"""Offset of sensor 0, the ego sensor, in the vehicle frame."""

MAX_OFFSET_M = 20.0
"""Maximum distance of the other sensors from the origin of the vehicle, along x and along y."""

HEIGHTS_M = (1.0, 5.0)
"""Minimum and maximum z of the other sensors, in the vehicle frame."""


@dataclass(frozen=True)
class Lidar:
    """The model of a spinning LiDAR.

    The defaults are those of the data set (see the format page, `docs/format.md#raw-capture`).

    Attributes:
        channels: number of channels of each LiDAR, one above the other.
        points: number of rays per scan, over all channels. All channels have the same number.
        range_m: range of each LiDAR, in metres.
        upper_deg: elevation of the highest channel, degrees.
        lower_deg: elevation of the lowest channel, degrees.
        noise_m: maximum error of a coordinate, metres. Errors are uniform.

    Raises:
        ArgumentError: a value is out of its range.
    """

    channels: int = 64
    points: int = 130_000
    range_m: float = 50.0
    upper_deg: float = 2.0
    lower_deg: float = -25.0
    noise_m: float = 0.02

    def __post_init__(self) -> None:
        each, low, high = self.channels, self.lower_deg, self.upper_deg
        for valid, name, expected, found in (
            (each >= 1, "channels", "at least 1", each),
            (self.points >= each, "points", f"at least one per channel ({each})", self.points),
            (0 < self.range_m < 1000, "range_m", "more than 0 and less than 1000 m", self.range_m),
            (
                -90 <= low <= high <= 90,
                "upper_deg",
                "-90 <= lower_deg <= upper_deg <= 90",
                f"{low} and {high}",
            ),
            (0 <= self.noise_m < np.inf, "noise_m", "0 m or more", self.noise_m),
        ):
            if not valid:
                raise ArgumentError(name, expected=expected, found=str(found))

    @cached_property
    def directions(self) -> FloatArray:
        """(R, 3) unit vectors of the rays in the sensor frame.

        Channels are ordered from the highest to the lowest. The azimuth of the rays of a channel
        increases from -pi: x towards y.
        """
        elevation = np.radians(np.linspace(self.upper_deg, self.lower_deg, self.channels))[:, None]
        columns = self.points // self.channels
        azimuth = np.linspace(-np.pi, np.pi, columns, endpoint=False)[None, :]
        rays = (
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation) + 0 * azimuth,
        )
        return np.stack(rays, axis=-1).reshape(-1, 3)


def sensor_offsets(sensors: int, rng: np.random.Generator) -> FloatArray:
    """Draw random positions of the sensors.

    Args:
        sensors: number of sensors.
        rng: source of the random numbers.

    Returns:
        (sensors, 3) float64 offsets in the vehicle frame, metres. The first is the constant offset
        of the ego sensor; the others are uniformly distributed in a box.
    """
    low, high = (
        (-MAX_OFFSET_M, -MAX_OFFSET_M, HEIGHTS_M[0]),
        (MAX_OFFSET_M, MAX_OFFSET_M, HEIGHTS_M[1]),
    )
    return np.vstack([EGO_SENSOR_M, rng.uniform(low, high, (sensors - 1, 3))])


@dataclass(frozen=True)
class ServerOptions:
    """Address and timeout of a CARLA server.

    Attributes:
        host: host of the server.
        port: RPC port of the server.
        traffic_port: port of the traffic manager.
        timeout_s: timeout of answers, seconds.
    """

    host: str = "127.0.0.1"
    port: int = 2000
    traffic_port: int = 8000
    timeout_s: float = 60.0
