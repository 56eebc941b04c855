"""Pictures and films of 1280 x 720 pixels: grids as full as those of the data set, and a full scan."""

from __future__ import annotations

import json

import numpy as np
import pytest

from carlasc import Run
from carlasc.core.grids import Grid, GridSpec
from carlasc.core.scans import Scan
from carlasc.storage.folder import FolderSink
from carlasc.viewing import Look, Scene, render, render_grid, render_scan

pytestmark = pytest.mark.slow


def street(spec):
    """A grid as full as a town's: ground everywhere, walls along a street, trees, cars."""
    x, y, z = np.moveaxis(spec.from_axes(spec.centers()), -1, 0)
    labels = np.where(z < -1.6, np.where(abs(y) < 5, 7, np.where(abs(y) < 8, 8, 22)), 0)
    labels[(abs(abs(y) - 12) < 0.4) & (np.sin(x / 3) > -0.8)] = 1
    labels[(np.hypot((x % 8) - 4, abs(y) - 9) < 1.6) & (z > -0.5)] = 9
    labels[(abs((x % 11) - 5) < 2.2) & (abs(abs(y) - 3.5) < 0.9) & (z < 0)] = 10
    return Grid(spec, labels.astype(np.uint8))


@pytest.mark.benchmark(group="rendering")
@pytest.mark.parametrize("view", ["perspective", "bev"])
@pytest.mark.parametrize("name", ["coarse", "fine", "cylindrical"])
def test_bench_full_grid(benchmark, name, view):
    grid = street(GridSpec.published(name))
    benchmark.pedantic(render_grid, (grid,), {"look": Look(view=view)}, rounds=5, warmup_rounds=1)


@pytest.mark.benchmark(group="rendering")
def test_bench_scan(benchmark):
    points = (
        np.random.default_rng(0)
        .uniform((-25, -25, -2), (25, 25, 1), (130_000, 3))
        .astype(np.float32)
    )
    benchmark.pedantic(render_scan, (Scan(points),), rounds=5, warmup_rounds=1)


@pytest.mark.benchmark(group="films")
@pytest.mark.parametrize("workers", [1, 2])
def test_bench_film(benchmark, tmp_path, workers):
    spec = GridSpec.published()
    sequence = FolderSink(tmp_path / "data").sequence("Train/Town01_Light/cartesian")
    sequence.write_document("evaluation/params.json", json.dumps(spec.to_params()).encode())
    for frame in range(20):
        sequence.write("evaluation/labels", frame, np.roll(street(spec).labels, frame, axis=0))
    scene = Scene(tmp_path / "data", frames=(0, 20))
    benchmark.pedantic(
        render,
        (scene, tmp_path / "film.mp4"),
        {"run": Run(workers), "overwrite": True},
        rounds=2,
        warmup_rounds=1,
    )
