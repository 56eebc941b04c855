"""Settings of simulators and of a CARLA server: models, effects and positions of LiDARs, traffic,
bird's-eye pictures, and the address of the server.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from carlasc.core.arrays import AnyFloatArray, FloatArray
from carlasc.core.choices import LidarName
from carlasc.core.choices import TrafficLevel as TrafficLevel  # noqa: PLC0414 (part of this module)
from carlasc.errors import ArgumentError, check_choice, check_types

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
            raise ArgumentError(name, expected=f"at least {minimum}", found=value)


EGO_SENSOR_M = (-0.5, 0.0, 1.8)
"""Offset of sensor 0, the ego sensor, in the vehicle frame."""

MAX_OFFSET_M = 20.0
"""Maximum distance of the other sensors from the origin of the vehicle, along x and along y."""

HEIGHTS_M = (1.0, 5.0)
"""Minimum and maximum z of the other sensors, in the vehicle frame."""


@dataclass(frozen=True)
class Lidar:
    """The model of a LiDAR.

    The defaults are those of the data set (see the format page, `docs/format.md#raw-capture`).

    Attributes:
        channels: number of channels of each LiDAR, one above the other.
        points: number of rays per scan, over all channels. All channels have the same number.
        range_m: range of each LiDAR, in metres.
        upper_deg: elevation of the highest channel, degrees.
        lower_deg: elevation of the lowest channel, degrees.
        noise_m: maximum error of a coordinate, metres. Errors are uniform.
        elevations_deg: elevation of each channel, degrees, from the highest; empty: the same angle
            lies between all channels.
        scattered: whether there are no channels: rays are spread evenly between the elevations, and
            each scan has others.

    Raises:
        ArgumentError: a value is out of its range.
    """

    channels: int = 64
    points: int = 130_000
    range_m: float = 50.0
    upper_deg: float = 2.0
    lower_deg: float = -25.0
    noise_m: float = 0.02
    elevations_deg: tuple[float, ...] = ()
    scattered: bool = False

    def __post_init__(self) -> None:
        each = self.channels
        low = self.lower_deg
        high = self.upper_deg
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
            (
                len(self.elevations_deg) in (0, each),
                "channels",
                f"{len(self.elevations_deg)}, as many as elevations",
                each,
            ),
        ):
            if not valid:
                raise ArgumentError(name, expected=expected, found=found)

    @classmethod
    def named(cls, name: LidarName, **others: Any) -> Self:
        """Return the model of a product, from its data sheet, with some values replaced.

        Raises:
            ArgumentError: the name is unknown, or a value is out of its range.
        """
        check_choice("lidar", name, LidarName)
        return replace(cls(**LIDARS[name]), **others)

    @cached_property
    def directions(self) -> FloatArray:
        """(R, 3) unit vectors of the rays of scan 0 in the sensor frame.

        Channels are ordered from the highest to the lowest. The azimuth of the rays of a channel
        increases from -pi: x towards y.
        """
        if self.scattered:
            return self._towards(0)
        even = np.linspace(self.upper_deg, self.lower_deg, self.channels)
        elevation = np.radians(self.elevations_deg or even)[:, None]
        columns = self.points // self.channels
        return _unit_vectors(elevation, np.linspace(-np.pi, np.pi, columns, endpoint=False))

    def directions_of(self, scan: int) -> FloatArray:
        """Return the (R, 3) unit vectors of the rays of a scan."""
        return self._towards(scan) if self.scattered else self.directions

    @property
    def phases(self) -> FloatArray:
        """(R,) part of a scan's period after which each ray is cast, from 0 to 1."""
        rays = len(self.directions)
        period = rays if self.scattered else self.points // self.channels
        return np.arange(rays) % period / period

    def _towards(self, scan: int) -> FloatArray:
        """Return the directions of the part of an additive sequence that belongs to a scan."""
        steps = np.arange(scan * self.points, (scan + 1) * self.points)
        turn, rise = (steps * step % 1.0 for step in _R2)
        low = math.radians(self.lower_deg)
        high = math.radians(self.upper_deg)
        return _unit_vectors(low + (high - low) * rise, (2 * turn - 1) * np.pi)


# the additive sequence R2 (Roberts, 2018), which covers a square evenly in every part of it
_R2 = (0.7548776662466927, 0.5698402909980532)


def _unit_vectors(elevation: AnyFloatArray, azimuth: AnyFloatArray) -> FloatArray:
    """Return the (R, 3) unit vectors of elevations and azimuths, radians, of shapes that broadcast
    to each other.
    """
    rays = (
        np.cos(elevation) * np.cos(azimuth),
        np.cos(elevation) * np.sin(azimuth),
        np.sin(elevation) + 0 * azimuth,
    )
    return np.stack(rays, axis=-1).reshape(-1, 3)


def _steps(first: float, last: float, count: int) -> tuple[float, ...]:
    """Return values at equal distances, the last one included."""
    return tuple(np.linspace(first, last, count).tolist())


LIDARS: Mapping[LidarName, Mapping[str, Any]] = {
    "carlasc": {},
    # manual 63-HDL64ES3: two blocks of 32 lasers, 1/3 and 1/2 degree apart
    "hdl-64e": {
        "points": 64 * 2083,
        "range_m": 120.0,
        "elevations_deg": _steps(2.0, -25 / 3, 32) + _steps(-8.83, -24.33, 32),
    },
    # manual 63-9243: 2 degrees apart, 0.2 degrees of azimuth at 10 Hz, +-3 cm
    "vlp-16": {
        "channels": 16,
        "points": 16 * 1800,
        "range_m": 100.0,
        "upper_deg": 15.0,
        "lower_deg": -15.0,
        "noise_m": 0.03,
    },
    # data sheet of OS1, revision 6: 45 degrees, 1,024 columns
    "os1-128": {
        "channels": 128,
        "points": 128 * 1024,
        "range_m": 120.0,
        "upper_deg": 22.5,
        "lower_deg": -22.5,
        "noise_m": 0.03,
    },
    # manual 640-en: 1/6 degree apart from 2 to -6 degrees, farther apart above and below
    "pandar64": {
        "points": 64 * 1800,
        "range_m": 200.0,
        "elevations_deg": (15.0, 11.0, 8.0, 5.0, 3.0)
        + _steps(2.0, -6.0, 49)
        + _steps(-7.0, -14.0, 8)
        + (-19.0, -25.0),
    },
    # manual of Mid-360: 200,000 points a second
    "mid-360": {
        "channels": 1,
        "points": 20_000,
        "range_m": 70.0,
        "upper_deg": 52.0,
        "lower_deg": -7.0,
        "scattered": True,
    },
}
"""Values of products, by name. Scans have 10 Hz."""


@dataclass(frozen=True)
class LidarEffects:
    """How the scans of a simulated LiDAR differ from an ideal one's.

    Returns of no surface that is there (of rain and in mirrors) are unlabelled.

    Attributes:
        turning: the LiDAR turns while everything moves. Points are corrected for the motion of the
            vehicle, and have the fields `seconds` and `origins`.
        drop_outs: share of rays without a return, from 0 to 1.
        range_noise: standard deviation of the distance, per metre of distance.
        second_returns: a ray that meets an edge returns what is behind it too.
        reflections: share of the rays to vehicles and buildings that these reflect like mirrors,
            from 0 to 1.
        rain: share of rays that end at a drop of rain, from 0 to 1; most drops are near.

    Raises:
        ArgumentError: a value is out of its range.
    """

    turning: bool = False
    drop_outs: float = 0.0
    range_noise: float = 0.0
    second_returns: bool = False
    reflections: float = 0.0
    rain: float = 0.0

    def __post_init__(self) -> None:
        check_types(LidarEffects, vars(self))
        for name in ("drop_outs", "range_noise", "reflections", "rain"):
            if not 0 <= (value := getattr(self, name)) <= 1:
                raise ArgumentError(name, expected="from 0 to 1", found=value)

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields that scans have because of them."""
        return ("seconds", "origins") if self.turning else ()


def sensor_offsets(sensors: int, rng: np.random.Generator) -> FloatArray:
    """Draw random positions of the sensors.

    Args:
        sensors: number of sensors.
        rng: source of the random numbers.

    Returns:
        (sensors, 3) float64 offsets in the vehicle frame, metres. The first is the constant offset
        of the ego sensor; the others are uniformly distributed in a box.
    """
    low = (-MAX_OFFSET_M, -MAX_OFFSET_M, HEIGHTS_M[0])
    high = (MAX_OFFSET_M, MAX_OFFSET_M, HEIGHTS_M[1])
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
