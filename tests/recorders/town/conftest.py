from __future__ import annotations

import pytest
from carlasc_recorders import TownDrive

from carlasc.captures import Lidar


@pytest.fixture(scope="session")
def drive() -> TownDrive:
    """A drive in heavy traffic with a coarse LiDAR, as noisy as the real one."""
    return _drive()


@pytest.fixture(scope="session")
def twin() -> TownDrive:
    """The same drive, made once more and asked for one thing only: what another process would see."""
    return _drive()


def _drive() -> TownDrive:
    return TownDrive(seed=3, traffic="heavy", lidar=Lidar(channels=32, points=16_000))
