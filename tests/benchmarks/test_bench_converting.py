"""Converting scans of SemanticKITTI's size; without `--benchmark-enable` it runs once.

`copy` is what it is measured by: the same files, copied one after the other.
"""

import shutil

import numpy as np
import pytest
from carlasc_recorders import TownDrive
from helpers.datasets.kitti import write_kitti
from helpers.datasets.tiny_kitti import write_tiny_kitti

from carlasc.captures import Lidar
from carlasc.converting import LayoutOptions, convert
from carlasc.motion import PoseOptions
from carlasc.motion.paths import estimate_path
from carlasc.running import Run

pytestmark = pytest.mark.slow

FRAMES, POINTS = 8, 122_000


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    root = tmp_path_factory.mktemp("kitti")
    write_tiny_kitti(root, frames=FRAMES, points=POINTS)
    return root


def test_bench_copy(benchmark, source, tmp_path):
    files = [
        path
        for name in ("velodyne", "labels")
        for path in sorted((source / "sequences" / "00" / name).iterdir())
    ]

    def copy():
        for path in files:
            shutil.copyfile(path, tmp_path / f"{path.parent.name}-{path.name}")

    benchmark(copy)
    assert len(list(tmp_path.iterdir())) == 2 * FRAMES


def test_bench_convert(benchmark, source, tmp_path):
    def run():
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        return convert(
            "kitti",
            source,
            tmp_path / "out",
            layout=LayoutOptions("carla", flow="none"),
            poses=PoseOptions(force=True),
            grids=None,
            run=Run(workers=1),
        )

    assert benchmark(run).made == FRAMES


@pytest.fixture(scope="module")
def traffic(tmp_path_factory):
    root = tmp_path_factory.mktemp("traffic")
    write_kitti(
        root,
        TownDrive(4, "heavy", Lidar(channels=64, points=POINTS)),
        range(240, 240 + FRAMES),
        voxels_every=0,
    )
    return root


@pytest.mark.parametrize("workers", [1, 2])
def test_bench_convert_with_flow(benchmark, traffic, tmp_path, workers):
    """The check of the poses, reading, the motion of actors and writing.

    Few scans: most is the check, and the start of the processes.
    """

    def run():
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        return convert("kitti", traffic, tmp_path / "out", grids=None, run=Run(workers=workers))

    assert benchmark(run).made == FRAMES


def test_bench_velocities(benchmark):
    """A car of 300 points in 20 scans."""
    rng = np.random.default_rng(0)
    body = rng.uniform(0, 1, (300, 3)) * (4.4, 1.8, 1.5)
    body[:150, 1] = 0  # a flank
    observations = [
        body + (0.8 * i, 0, 0) + rng.uniform(-0.02, 0.02, body.shape) for i in range(20)
    ]
    _, velocities, _ = benchmark(estimate_path, observations, np.arange(20) * 0.1, rigid=True)
    assert np.abs(velocities - (8, 0, 0)).max() < 0.5
