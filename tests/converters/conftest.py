from pathlib import Path

import pytest
from carlasc_recorders import TownDrive
from helpers.datasets.kitti import SMALL_LIDAR, KittiTruth, write_kitti


@pytest.fixture(scope="session")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, KittiTruth]:
    """A SemanticKITTI root with one simulated sequence, 00, of 24 frames around a bend."""
    root = tmp_path_factory.mktemp("kitti")
    return root, write_kitti(root, TownDrive(3, "heavy", SMALL_LIDAR), range(86, 110))
