"""How much the benchmark simulates and trains."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from carlasc import GridSpec
from carlasc.captures import Lidar

SPLITS = (("Train", 100), ("Val", 200), ("Test", 300))  # split, and seed of its first town


@dataclass(frozen=True)
class Scenes:
    """What is simulated.

    Attributes:
        towns: number of drives in Train, Val and Test, each through a town of its own.
        frames: number of labelled frames of each drive, 0.1 s apart.
        margin: scans before the first and after the last of these; so many scans before and after a
            frame are merged into its labels.
        sensors: number of LiDARs of the capture truth, the ego LiDAR included.
        lidar: the LiDARs.
        half_width_m: distance from the sensor to the sides of the grid; its height is the published
            -2..1 m.
        cells: number of cells of the grid along x, y and z.
    """

    towns: tuple[int, int, int]
    frames: int
    margin: int
    sensors: int
    lidar: Lidar
    half_width_m: float
    cells: tuple[int, int, int]

    @property
    def spec(self) -> GridSpec:
        """The grid."""
        half = float(np.float32(self.half_width_m))  # the format's bounds are float32
        return GridSpec("cartesian", self.cells, (-half, -half, -2.0), (half, half, 1.0))


@dataclass(frozen=True)
class Size:
    """The amount of simulation and training.

    Attributes:
        scenes: what is simulated.
        epochs: number of epochs of every network but JS3C-Net.
        trial_epochs: number of epochs after which the learning rate is chosen.
        js3cnet_epochs: number of epochs of JS3C-Net, of which a step takes several times longer on
            a CPU.
        batch_size: samples per step.
        seeds: number of runs of each row.
        workers: number of processes that load data.
    """

    scenes: Scenes
    epochs: int
    trial_epochs: int
    js3cnet_epochs: int
    batch_size: int = 4
    seeds: int = 1
    workers: int = 0


_NEAR = Lidar(channels=32, points=32_000, range_m=30.0)
SIZES = {
    "tiny": Size(
        Scenes(
            (1, 1, 2), 3, 1, 2, Lidar(channels=16, points=6_000, range_m=20.0), 6.4, (16, 16, 8)
        ),
        1,
        1,
        1,
    ),
    "small": Size(Scenes((6, 2, 4), 11, 15, 12, _NEAR, 6.4, (32, 32, 8)), 3, 1, 1, batch_size=2),
    "medium": Size(
        Scenes((10, 3, 8), 11, 15, 12, _NEAR, 6.4, (32, 32, 8)), 18, 6, 6, batch_size=2, seeds=5
    ),
    "long": Size(Scenes((20, 4, 12), 21, 15, 12, _NEAR, 6.4, (32, 32, 8)), 10, 3, 3, seeds=3),
    "full": Size(
        Scenes((24, 3, 6), 100, 30, 20, Lidar(), 25.6, (128, 128, 8)),
        10,
        3,
        10,
        8,
        seeds=3,
        workers=8,
    ),
}


def key_of(settings: Mapping[str, Any]) -> str:
    """Return a short name for settings: equal for equal settings only."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:12]


def settings_of(scenes: Scenes) -> dict[str, Any]:
    """Return the settings of scenes as JSON gives them back."""
    settings: dict[str, Any] = json.loads(json.dumps(asdict(scenes)))
    return settings
