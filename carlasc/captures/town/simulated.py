"""A drive through the simulated town as a capture that is never written: recordings are computed when they are read."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from carlasc.captures.lidar import Lidar
from carlasc.captures.raw import Capture, Recording
from carlasc.captures.settings import TrafficLevel, check_at_least, check_traffic
from carlasc.captures.town.birdseye import render_birdseye
from carlasc.captures.town.drive import Drive
from carlasc.core.geometry import Transform
from carlasc.core.tables import CARLA
from carlasc.errors import MissingDataError
from carlasc.storage.layout import FRAME_PERIOD_S


class SimulatedCapture(Capture):
    """A drive through the simulated town, for `carlasc.regrid`: ground truth without a capture on disk.

    What it returns is equal to what `carlasc.simulate` writes with the same settings. It can be pickled.

    Attributes:
        location: what to call it in errors.
        classes: class table of the labels.
    """

    def __init__(
        self,
        *,
        count: int = 20,
        first_frame: int = 0,
        sensors: int = 20,
        seed: int = 0,
        traffic: TrafficLevel = "medium",
        lidar: Lidar | None = None,
        bev: bool = True,
    ) -> None:
        """Take the settings of a simulation; the arguments are those of `carlasc.simulate`.

        Raises:
            ArgumentError: an argument is out of its range.
        """
        check_at_least(1, count=count, sensors=sensors)
        check_at_least(0, first_frame=first_frame, seed=seed)
        check_traffic(traffic)
        self.location, self.classes = f"the simulated town of seed {seed}", CARLA
        self._frames, self._count = range(first_frame, first_frame + count), sensors
        self._drive_of, self._bev = (seed, traffic, lidar or Lidar()), bev

    @cached_property
    def sensors(self) -> tuple[int, ...]:
        """The sensors' numbers."""
        return tuple(range(self._count))

    @cached_property
    def frames(self) -> NDArray[np.int64]:
        """The frame numbers."""
        return np.array(self._frames, np.int64)

    def read(self, sensor: int, frame: int) -> Recording:
        """Simulate what a sensor records in a frame."""
        self._check(frame)
        return self._drive.record(frame, sensor)

    def read_pose(self, sensor: int, frame: int) -> Transform:
        """Return the (4, 4) float64 world_T_sensor of a frame."""
        self._check(frame)
        return self._drive.sensor_poses(frame, sensor + 1)[sensor]

    def read_poses(self, sensor: int, frames: Iterable[int]) -> NDArray[np.float64]:
        """Return (F, 4, 4) world_T_sensor of several frames."""
        return np.stack([self.read_pose(sensor, frame) for frame in frames])

    def read_times(self, sensor: int = 0) -> Mapping[int, float]:
        """Return the simulation's time in seconds per frame number."""
        return {frame: frame * FRAME_PERIOD_S for frame in self._frames}

    def read_bev(self, frame: int) -> bytes | None:
        """Draw a frame's bird's-eye picture: JPEG bytes; None if the simulation has none."""
        self._check(frame)
        return render_birdseye(self._drive.snapshot(frame)) if self._bev else None

    def has_bev(self, frame: int) -> bool:
        """Whether a frame has a bird's-eye picture."""
        return self._bev and frame in self._frames

    def light(self) -> Capture:
        """Return the capture: it holds settings only."""
        return self

    @property
    def _drive(self) -> Drive:
        return _cached_drive(*self._drive_of)

    def _check(self, frame: int) -> None:
        if frame not in self._frames:
            found = f"frames {self._frames.start} to {self._frames.stop - 1}"
            raise MissingDataError(self.location, expected=f"frame {frame}", found=found)


@lru_cache(maxsize=1)
def _cached_drive(seed: int, traffic: TrafficLevel, lidar: Lidar) -> Drive:
    """Return the drive of this process: the town is built once."""
    return Drive(seed, traffic, lidar)
